"""Figures of merit: CNR, the Cramér–Rao bound, observer, resolution, noise.

Reading order: ``placement`` and ``roi`` say where is measured, ``cnr`` is the paper's figure over
realisations, ``cramer_rao`` the best that any unbiased method can reach. ``intervals`` gives
figures theirs (bootstrap, jackknife), ``control`` narrows them. (What they are for, the dose
factor, is :mod:`recon.evaluate`.) ``observer`` asks whether the core is seen, ``resolution`` and
``noise_power`` how sharp and how noisy an image is, and ``plaque_measures`` measures lumen, core
and cap. ``residual_test`` asks whether a volume explains its data at all, ``half_split`` what noise
and resolution a real scan has, without a truth.
"""

from torchpcct.metrics.cnr import cnr, cnr_from_moments, cnr_interval, cnr_range, sd_interval
from torchpcct.metrics.control import controlled_log_variance, controlled_mean
from torchpcct.metrics.cramer_rao import cramer_rao_bound, information_matrix
from torchpcct.metrics.intervals import Estimate, Jackknifed, combined
from torchpcct.metrics.noise_power import NoisePower, noise_power_spectrum
from torchpcct.metrics.observer import (
    channel_responses,
    d_prime,
    dog_channels,
    hotelling_scores,
    observe,
    template_channel,
)
from torchpcct.metrics.plaque_measures import lumen_area
from torchpcct.metrics.residual_test import ResidualTest, residual_test
from torchpcct.metrics.resolution import TransferFunction, edge_profile, task_transfer

__all__ = [
    "Estimate",
    "Jackknifed",
    "NoisePower",
    "ResidualTest",
    "TransferFunction",
    "channel_responses",
    "cnr",
    "cnr_from_moments",
    "cnr_interval",
    "cnr_range",
    "combined",
    "controlled_log_variance",
    "controlled_mean",
    "cramer_rao_bound",
    "d_prime",
    "dog_channels",
    "edge_profile",
    "hotelling_scores",
    "information_matrix",
    "lumen_area",
    "noise_power_spectrum",
    "observe",
    "residual_test",
    "sd_interval",
    "task_transfer",
    "template_channel",
]
