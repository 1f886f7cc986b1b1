"""A reconstruction of paired draws of b = AᵀW y, in the plaque with and without its core, beside a linear control.

The twin without core has the SAME noise: its b is that of the plaque plus the difference of the two noise-free ones.

The control is the method's own linear response (:mod:`recon.study.dose_factor.response`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.pwls.inset_problem import InsetProblem
from recon.study.dose_factor.response import Response
from torchpcct.metrics.roi import RoiMean

__all__ = ["Draws", "reconstruct_draws"]

Floats = NDArray[np.float64]
Method = Callable[[InsetProblem, Tensor, float], Tensor]
"""``method(problem, b, exposure_s)`` → volumes in HU, ``(batch, z, y, x)``."""

BATCH = 5
"""Volumes at a time."""


@dataclass(frozen=True, eq=False)
class Draws:
    """What a method makes of the draws of one exposure.

    Attributes:
        exposure_s: in s.
        means, absent: ``(n, rois)`` ROI means in HU, with the core and without.
        controls: ``(n, rois)`` of the same draws; None: no control.
        control: their exact moments.
        fat: ``(n,)`` squared deviation from the mean of the draws, averaged over plain fat, HU².
        images: the first draw, with and without the core.
    """

    exposure_s: float
    means: Floats
    absent: Floats
    fat: Floats
    images: tuple[Tensor, Tensor]
    controls: Floats | None = None
    control: Response | None = None


def reconstruct_draws(
    method: Method,
    problem: InsetProblem,
    rois: Sequence[RoiMean],
    fat: NDArray[np.bool_],
    noisy: Tensor,
    change: Tensor,
    exposure_s: float,
    control: Response | None = None,
    progress: Callable[[float], None] | None = None,
) -> Draws:
    """Reconstruct the draws of one exposure with and without the core.

    Args:
        method: of the table.
        problem: of the scan.
        rois, fat: what is read, on the problem's grid.
        noisy: ``(n, z, y, x)`` b of the draws.
        change: ``(z, y, x)`` what taking the core away adds to the noise-free b.
        exposure_s: in s.
        control: of :func:`recon.study.dose_factor.response.linear_response`.
        progress: called with the finished fraction.
    """
    where = torch.from_numpy(fat)
    means: dict[bool, list[Floats]] = {False: [], True: []}
    images: dict[bool, Tensor] = {}
    plain = []
    for first in range(0, len(noisy), BATCH):
        part = noisy[first : first + BATCH]
        for absent in (False, True):
            with torch.no_grad():
                volumes = method(problem, part + change if absent else part, exposure_s)
            means[absent].append(np.stack([r(volumes).numpy() for r in rois], axis=1))
            images.setdefault(absent, volumes[0].clone())
            if not absent:
                plain.append(volumes[:, where])
        if progress is not None:
            progress(min(first + BATCH, len(noisy)) / len(noisy))
    voxels = torch.cat(plain).to(torch.float64)
    return Draws(
        exposure_s,
        np.concatenate(means[False]),
        np.concatenate(means[True]),
        (voxels - voxels.mean(0)).square().mean(1).numpy(),
        (images[False], images[True]),
        None if control is None else control.of(noisy),
        control,
    )
