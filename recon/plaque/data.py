"""What the reader is given, in HU: the statistic b = Gx + noise and the operator G, from a scan or from a volume."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from recon.conjugate_gradient import conjugate_gradient
from recon.plaque.stationary import Spectrum, StationaryGram
from recon.pwls.inset_problem import InsetProblem
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.validate import number

__all__ = ["TissueData"]

Floats = NDArray[np.float64]

_PILOT_SD_MM = 0.25
_PILOT_STEPS = 4
_PILOT_FLOOR = 0.02


@dataclass(frozen=True, eq=False)
class TissueData:
    """−log likelihood ½ xᵀGx − bᵀx of a volume x in HU.

    Args:
        b: ``grid.shape``, HU⁻¹.
        gram: G up to ``scale``, with ``apply``, ``lag_kernels``, ``polynomials``, ``periodic_spectrum`` and ``grid``
            (:class:`recon.gram.gram.Gram`).
        scale: G in HU⁻² is ``scale`` times ``gram``.
        source: what the data are, for the report.
    """

    b: Tensor
    gram: Any
    scale: float
    source: str = "scan"

    def __post_init__(self) -> None:
        if self.gram.grid.ndim != 3 or tuple(self.b.shape) != tuple(self.gram.grid.shape):
            raise ValueError(
                f"the statistic has shape {tuple(self.b.shape)}, its operator {self.gram.grid.shape}: "
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
            ValueError: see :class:`recon.pwls.inset_problem.InsetProblem`.
        """
        return cls.of_statistic(problem.statistic(scan).b, problem, scan.exposure_s or NOISE_FREE_EXPOSURE_S)

    @classmethod
    def of_statistic(cls, b: Tensor, problem: Any, exposure_s: float) -> TissueData:
        """From AᵀW y in the units of a problem (``gram`` at 1 s, ``mu_ref`` and ``level`` in mm⁻¹).

        Args:
            b: AᵀW y with the background taken off, W that of the exposure.
            problem: :class:`recon.pwls.inset_problem.InsetProblem`.
            exposure_s: of b, s.
        """
        gram, hu = problem.gram.scaled(exposure_s), problem.mu_ref / 1000.0
        # Attenuation above the background is hu · x + shift.
        shift = torch.full(tuple(gram.grid.shape), problem.mu_ref - problem.level, dtype=gram.dtype)
        return cls((b.to(gram.dtype) - gram.apply(shift)) * hu, gram, hu * hu)

    @classmethod
    def of_volume(
        cls, volume: Tensor, grid: VolumeGrid, noise_power: Spectrum, transfer: Spectrum | None = None
    ) -> TissueData:
        """From a reconstructed volume of a linear method and a model of its noise.

        Args:
            volume: ``grid.shape`` HU.
            grid: of the volume.
            noise_power: HU² mm³ at (in-plane, axial) frequencies in line pairs per mm, e.g. from
                :mod:`torchpcct.metrics.noise_power`.
            transfer: the method's transfer function at the same; None: 1, then edges read softer than they are.

        Raises:
            ValueError: another shape than the grid's, noise power that is not finite or nowhere positive.
        """
        if tuple(volume.shape) != tuple(grid.shape):
            raise ValueError(f"volume has shape {tuple(volume.shape)}, its grid {tuple(grid.shape)}")
        gram = StationaryGram(grid, noise_power, transfer)
        return cls(gram.statistic(volume), gram, 1.0, "volume with a stationary noise model")

    def apply(self, x: Tensor) -> Tensor:
        """G x, HU⁻¹, of volumes in HU ``(..., z, y, x)``."""
        out: Tensor = self.gram.apply(x.to(self.gram.dtype)) * self.scale
        return out

    def pilot(self) -> Floats:
        """A smooth linear estimate, ``grid.shape`` HU: some steps towards least squares, then a Gaussian filter."""
        spectrum = self.gram.periodic_spectrum() * self.scale
        floor = _PILOT_FLOOR * float(spectrum.max())

        def precondition(v: Tensor) -> Tensor:
            return torch.fft.irfftn(torch.fft.rfftn(v, dim=(1, 2, 3)) / (spectrum + floor), s=v.shape[1:])

        x = conjugate_gradient(self.apply, self.b[None], precondition, iterations=_PILOT_STEPS)
        sd = [_PILOT_SD_MM / step for step in self.grid.spacing]
        return np.asarray(ndimage.gaussian_filter(x[0].double().numpy(), sd, mode="nearest"))
