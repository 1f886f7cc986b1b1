"""Robust estimates of spread."""

from __future__ import annotations

__all__ = ["MEDIAN_TO_SD"]

MEDIAN_TO_SD = 1.4826
"""Standard deviation over median absolute deviation, of normal values."""
