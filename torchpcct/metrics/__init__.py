"""Figures of merit."""

from torchpcct.metrics.cnr import Interval, cnr, cnr_from_moments, cnr_interval, cnr_range, mean_interval, sd_interval

__all__ = ["Interval", "cnr", "cnr_from_moments", "cnr_interval", "cnr_range", "mean_interval", "sd_interval"]
