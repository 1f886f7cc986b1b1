"""Gauss and Newton's equations for numbers beside a volume, with the volume projected out.

Variable projection (Golub and Pereyra 1973, SIAM J. Numer. Anal. 10:413): whatever the numbers, the
volume is the one that the readings then give, and what it leaves of them is made small. With r what
is left of the readings, K what is left of their derivatives by the numbers, G a smoothing over
neighbouring cells and W the weights, the equations are KᵀGᵀWGK · step = KᵀGᵀWGr. Both sides are
smoothed: an edge between voxels is nothing that a volume of voxels can explain, and no error of the
numbers either.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["Normal", "misfit", "normal_equations", "products", "smoothed_cells", "unexplained"]

Floats = NDArray[np.float64]

_BLUR_CELLS = 1.5
"""Standard deviation of the smoothing over cells: of a voxel edge 4 % is left, of the shadows'
shifts a quarter."""


@dataclass(frozen=True)
class Normal:
    """Equations for a step of the numbers, from smoothed readings.

    Attributes:
        information: ``(n, n)``, KᵀGᵀWGK.
        pull: ``(n,)``, KᵀGᵀWGr.
        spread: ``(n, n)``, covariance of ``pull`` by the readings' noise.
        misfit: of the smoothed readings, over their noise, root mean square.
    """

    information: Floats
    pull: Floats
    spread: Floats
    misfit: float


def normal_equations(
    own: Tensor,
    rest: Tensor,
    weights: Tensor,
    cells: int,
    explained: Callable[[Tensor], Tensor] | None = None,
) -> Normal:
    """The equations of effects and of what is left of the readings.

    Args:
        own: ``(n, views, …)``, what no volume explains of each number's effect, smoothed.
        rest: ``(1, views, …)``, what the volume leaves of the readings, smoothed.
        weights: ``(views, …)``, inverse variances of the readings; 0: unknown ones.
        cells: axes of the detector, the last of the readings.
        explained: takes off what a volume explains of readings; None: the noise counts as a whole,
            which is more than a volume leaves of it.
    """
    known = weights > 0
    variance = 1.0 / torch.where(known, weights, weights[known].mean())
    noisy = smoothed_cells(own * weights, cells)
    if explained is not None:
        noisy = explained(noisy * variance * known) * weights
    return Normal(
        products(own * weights, own),
        products(own * weights, rest)[:, 0],
        products(noisy * variance, noisy),
        misfit(rest[0], weights, cells),
    )


def misfit(rest: Tensor, weights: Tensor, cells: int) -> float:
    """Root mean square of smoothed readings ``(views, …)`` over their noise; the rest as for
    :func:`normal_equations`."""
    known = weights > 0
    variance = 1.0 / torch.where(known, weights, weights[known].mean())
    quiet = _filtered(variance, _kernel(weights).square(), cells)
    return math.sqrt(float((rest.square() / quiet)[known].double().mean()))


def unexplained(
    readings: Tensor,
    volume: Callable[[Tensor], Tensor],
    project: Callable[[Tensor], Tensor],
    times: int,
) -> Tensor:
    """What no volume explains of readings: what an approximate inverse does is taken off so many
    times.

    Args:
        readings: ``(…, views, …)``.
        volume: of readings; project: of a volume.
        times: ≥ 1.
    """
    for _ in range(times):
        readings = readings - project(volume(readings))
    return readings


def smoothed_cells(readings: Tensor, cells: int) -> Tensor:
    """Readings smoothed over the last ``cells`` axes; the outermost cells are repeated, which is
    nearly its own transpose where readings end in air."""
    return _filtered(readings, _kernel(readings), cells)


def products(a: Tensor, b: Tensor) -> Floats:
    """Inner products ``(n, m)`` of readings ``(n, …)`` and ``(m, …)``."""
    return (a.double().flatten(1) @ b.double().flatten(1).T).numpy()


def _kernel(like: Tensor) -> Tensor:
    reach = math.ceil(3 * _BLUR_CELLS)
    at = torch.arange(-reach, reach + 1, dtype=like.dtype)
    values = torch.exp(-0.5 * (at / _BLUR_CELLS) ** 2)
    return values / values.sum()


def _filtered(readings: Tensor, kernel: Tensor, cells: int) -> Tensor:
    """Filtered along the last ``cells`` axes."""
    reach = kernel.numel() // 2
    out = readings
    for axis in range(readings.dim() - cells, readings.dim()):
        n = readings.shape[axis]
        padded = out.index_select(axis, torch.arange(-reach, n + reach).clamp(0, n - 1))
        # Of one channel, sums of shifted readings take a third of a convolution's time.
        out = torch.zeros_like(readings)
        for first, weight in enumerate(kernel.tolist()):
            out.add_(padded.narrow(axis, first, n), alpha=weight)
    return out
