"""What the reader is given of a scan: its data term in HU, b = Gx + noise of covariance G."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from recon.conjugate_gradient import conjugate_gradient
from recon.data_term import Quadratic
from torchpcct.geometry import VolumeGrid

Floats = NDArray[np.float64]

_PILOT_SD_MM = 0.25
"""Standard deviation of the Gaussian filter of the pilot estimate, mm."""
_PILOT_STEPS = 4
"""Conjugate gradients of the pilot estimate."""
_FLOOR = 0.02
"""Of the spectrum that preconditions, relative to its largest value."""


def in_hu(term: Quadratic) -> Quadratic:
    """The data term of volumes in HU (water 0), of one scan.

    Args:
        term: in mm⁻¹ (:meth:`recon.least_squares.inset_problem.InsetProblem.term`), a batch of one;
            its operator is a :class:`recon.gram.gram.Gram`. One in HU is given back.

    Raises:
        ValueError: several volumes, no (z, y, x) grid, NaN or Inf in the data.
    """
    model: Any = term.operator
    if model.grid.ndim != 3 or tuple(term.b.shape) != (1, *model.grid.shape):
        raise ValueError(
            f"the data have the shape {tuple(term.b.shape)}, their operator {model.grid.shape}: "
            "both must be of one (z, y, x) grid, and of one scan"
        )
    if not bool(torch.isfinite(term.b).all()):
        raise ValueError("the data hold NaN or Inf: check the scan or the volume")
    if term.unit is not None:
        return term
    gram, hu = model.scaled(float(term.scale)), term.mu_per_hu
    # Attenuation above the background is hu · x + shift.
    shift = torch.full(term.b.shape, term.mu_ref - term.zero_mm, dtype=gram.dtype)
    b = (term.b.detach().to(gram.dtype) - gram.apply(shift)) * hu
    scale = torch.tensor([hu * hu], dtype=torch.float64)
    unit = torch.ones(1, dtype=gram.dtype)
    return replace(term, operator=gram, b=b, scale=scale, unit=unit, level=None, energy=None)


def grid_of(term: Quadratic) -> VolumeGrid:
    """Of the inset."""
    operator: Any = term.operator
    grid: VolumeGrid = operator.grid
    return grid


def pilot(term: Quadratic, b: Tensor | None = None) -> Floats:
    """A smooth linear estimate, ``grid.shape`` HU: some steps towards least squares, then a
    Gaussian filter.

    Args:
        term: in HU.
        b: of other data, ``grid.shape`` HU⁻¹; None: its own.
    """
    x = least_squares(term, term.b[0] if b is None else b, _PILOT_STEPS)
    sd = [_PILOT_SD_MM / step for step in term.spacing]
    return np.asarray(ndimage.gaussian_filter(x.double().numpy(), sd, mode="nearest"))


def least_squares(
    term: Quadratic, b: Tensor, steps: int, free: Tensor | float = 1.0, precision: float = 0.0
) -> Tensor:
    """Some conjugate gradients towards least squares, ``grid.shape`` HU.

    Args:
        term: in HU.
        b: ``grid.shape`` HU⁻¹.
        steps: number of them.
        free: 1 in the voxels that may differ from 0, else 0.
        precision: of the prior of every voxel, HU⁻².
    """
    spectrum = term.spectrum()[0]
    floor = _FLOOR * float(spectrum.max())

    def precondition(v: Tensor) -> Tensor:
        return free * torch.fft.irfftn(
            torch.fft.rfftn(free * v, dim=(1, 2, 3)) / (spectrum + floor), s=v.shape[1:]
        )

    def curved(v: Tensor) -> Tensor:
        return free * term.apply(free * v) + v * precision

    return free * conjugate_gradient(curved, (free * b)[None], precondition, iterations=steps)[0]


def scores(term: Quadratic, left: Tensor, sd_mm: tuple[float, float]) -> Floats:
    """How far each place of a residual stands out of the noise, ``grid.shape`` standard
    deviations.

    The residual b − Gx has the covariance G. What a small body leaves in it is sought as a
    difference of two Gaussians, which knows nothing of slow errors of the background; at the
    rim of the grid the noise is up to 1.2.

    Args:
        term: in HU.
        left: ``grid.shape`` HU⁻¹.
        sd_mm: of the narrow and of the wide Gaussian.
    """
    n, steps = term.shape, term.spacing
    last = np.fft.rfftfreq(n[2], steps[2])
    f2 = (
        np.fft.fftfreq(n[0], steps[0])[:, None, None] ** 2
        + np.fft.fftfreq(n[1], steps[1])[:, None] ** 2
        + last**2
    )
    passed = np.exp(-2.0 * (math.pi * sd_mm[0]) ** 2 * f2) - np.exp(
        -2.0 * (math.pi * sd_mm[1]) ** 2 * f2
    )
    spectrum = np.asarray(term.operator.periodic_spectrum().double()) * float(term.scale)
    # Frequencies of a real volume come in pairs, but for the first and, of an even number, the
    # last.
    pairs = np.where((last > 0) & (last < 0.5 / steps[2] - 1e-9), 2.0, 1.0)
    noise = math.sqrt(float((pairs * passed**2 * spectrum).sum()) / math.prod(n))
    narrow, wide = (
        ndimage.gaussian_filter(
            left.double().numpy(), [sd / step for step in steps], mode="nearest"
        )
        for sd in sd_mm
    )
    return np.asarray((narrow - wide) / noise)
