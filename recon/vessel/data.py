"""What the reader is given of a scan, in HU: the statistic b = Gx + noise and the operator G."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from recon.conjugate_gradient import conjugate_gradient
from recon.data_term import Quadratic
from recon.least_squares.inset_problem import InsetProblem
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.validate import number

__all__ = ["TissueData"]

Floats = NDArray[np.float64]

_PILOT_SD_MM = 0.25
_PILOT_STEPS = 4
_FLOOR = 0.02
"""Of the spectrum that preconditions, as a share of its largest value."""


@dataclass(frozen=True, eq=False)
class TissueData:
    """−log likelihood ½ xᵀGx − bᵀx of a volume x in HU.

    Args:
        b: ``grid.shape``, HU⁻¹.
        gram: G up to ``scale``, with ``apply``, ``lag_kernels``, ``polynomials``,
            ``periodic_spectrum`` and ``grid`` (:class:`recon.gram.gram.Gram`).
        scale: G in HU⁻² is ``scale`` times ``gram``.
    """

    b: Tensor
    gram: Any
    scale: float

    def __post_init__(self) -> None:
        if self.gram.grid.ndim != 3 or tuple(self.b.shape) != tuple(self.gram.grid.shape):
            raise ValueError(
                f"the statistic has shape {tuple(self.b.shape)}, its operator "
                f"{self.gram.grid.shape}: "
                "both must be of one (z, y, x) grid"
            )
        if not bool(torch.isfinite(self.b).all()):
            raise ValueError("the data hold NaN or Inf: check the scan or the volume")
        number("scale", self.scale, positive=True)

    @property
    def grid(self) -> VolumeGrid:
        """Of the inset."""
        grid: VolumeGrid = self.gram.grid
        return grid

    @classmethod
    def of_scan(cls, scan: Scan, problem: InsetProblem) -> TissueData:
        """From a scan and what all scans of its kind share.

        Raises:
            ValueError: see :class:`recon.least_squares.inset_problem.InsetProblem`.
        """
        return cls.of_term(problem.term(scan))

    @classmethod
    def of_term(cls, term: Quadratic) -> TissueData:
        """From a data term in mm⁻¹, a batch of one volume; its operator is a
        :class:`recon.gram.gram.Gram`."""
        model: Any = term.operator
        gram, hu = model.scaled(float(term.scale)), term.mu_per_hu
        # Attenuation above the background is hu · x + shift.
        shift = torch.full(tuple(gram.grid.shape), term.mu_ref - term.zero_mm, dtype=gram.dtype)
        b = term.b[0].detach().to(gram.dtype)
        return cls((b - gram.apply(shift)) * hu, gram, hu * hu)

    def apply(self, x: Tensor) -> Tensor:
        """G x, HU⁻¹, of volumes in HU ``(..., z, y, x)``."""
        out: Tensor = self.gram.apply(x.to(self.gram.dtype)) * self.scale
        return out

    def pilot(self, b: Tensor | None = None) -> Floats:
        """A smooth linear estimate, ``grid.shape`` HU: some steps towards least squares, then a
        Gaussian filter.

        Args:
            b: of another statistic, ``grid.shape`` HU⁻¹; None: of the data.
        """
        x = self.least_squares(self.b if b is None else b, _PILOT_STEPS)
        sd = [_PILOT_SD_MM / step for step in self.grid.spacing]
        return np.asarray(ndimage.gaussian_filter(x.double().numpy(), sd, mode="nearest"))

    def least_squares(
        self, b: Tensor, steps: int, free: Tensor | float = 1.0, precision: float = 0.0
    ) -> Tensor:
        """Some conjugate gradients towards least squares, ``grid.shape`` HU.

        Args:
            b: ``grid.shape`` HU⁻¹.
            steps: number of them.
            free: 1 in the voxels that may differ from 0, else 0.
            precision: of the prior of every voxel, HU⁻².
        """
        spectrum = self.gram.periodic_spectrum() * self.scale
        floor = _FLOOR * float(spectrum.max())

        def precondition(v: Tensor) -> Tensor:
            return free * torch.fft.irfftn(
                torch.fft.rfftn(free * v, dim=(1, 2, 3)) / (spectrum + floor), s=v.shape[1:]
            )

        def curved(v: Tensor) -> Tensor:
            return free * self.apply(free * v) + v * precision

        return (
            free * conjugate_gradient(curved, (free * b)[None], precondition, iterations=steps)[0]
        )

    def scores(self, left: Tensor, sd_mm: tuple[float, float]) -> Floats:
        """How far each place of a residual stands out of the noise, ``grid.shape`` standard
        deviations.

        The residual b − Gx has the covariance G. What a small body leaves in it is sought as a
        difference of two Gaussians, which knows nothing of slow errors of the background; at the
        rim of the grid the noise is up to 1.2.

        Args:
            left: ``grid.shape`` HU⁻¹.
            sd_mm: of the narrow and of the wide Gaussian.
        """
        n, steps = self.grid.shape, self.grid.spacing
        last = np.fft.rfftfreq(n[2], steps[2])
        f2 = (
            np.fft.fftfreq(n[0], steps[0])[:, None, None] ** 2
            + np.fft.fftfreq(n[1], steps[1])[:, None] ** 2
            + last**2
        )
        passed = np.exp(-2.0 * (math.pi * sd_mm[0]) ** 2 * f2) - np.exp(
            -2.0 * (math.pi * sd_mm[1]) ** 2 * f2
        )
        spectrum = np.asarray(self.gram.periodic_spectrum().double()) * self.scale
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
