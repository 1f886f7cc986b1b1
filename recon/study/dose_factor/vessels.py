"""Vessels that run in any direction: each method on a voxel model that is finer than its own grid.

The truth is painted on 0.1 mm voxels and projected exactly onto the paper scan's readings, b = AᵀW (A_fine x_fine), so
that the methods' own grid is not that of the data. Geometry, weights, Gram and noise are the paper scene's: with one
seed, all vessels, with and without core, carry the same noise.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.evaluate.vessels import Vessel, vessel
from recon.pwls.inset_problem import InsetProblem
from recon.study.dose_factor.realisations import Realisations
from recon.study.dose_factor.settings import VESSEL_ROIS
from torchpcct.geometry import VolumeGrid
from torchpcct.projector import Projector
from torchpcct.scan import Scan

__all__ = ["FINE_MM", "VesselPlace", "fine_grid", "projected"]

FINE_MM = 0.1
"""Voxels of the truth; each is the mean of 2³ points."""

FAT_VOXELS = 2000
"""Of plain fat, kept of every volume for its noise."""


def fine_grid(grid: VolumeGrid) -> VolumeGrid:
    """The truth's grid over the extent of ``grid``."""
    factor = max(1, round(grid.spacing[0] / FINE_MM))
    return VolumeGrid(tuple(factor * n for n in grid.shape), tuple(s / factor for s in grid.spacing), grid.center)


def projected(problem: InsetProblem, x: Any, grid: VolumeGrid) -> Tensor:
    """b = AᵀW (A_grid x) at 1 s: noise-free statistic on the problem's grid of a volume on another one.

    Args:
        problem: of the scan.
        x: ``(..., *grid.shape)`` attenuation above the background, mm⁻¹.
        grid: of ``x``, over the problem's extent.
    """
    volume = torch.as_tensor(x, dtype=problem.weights.dtype)
    readings = Projector(problem.geometry, grid, problem.window)(volume)
    b: Tensor = problem.projector.T(problem.weights * readings)
    return b


class VesselPlace:
    """A vessel on the paper scene's scan: what is read of its volumes.

    Args:
        noise: of the study; gives the scene, its problem and the store.
        vessel_name: of :data:`recon.study.dose_factor.settings.VESSELS`.
    """

    noise_of = "paper"

    def __init__(self, noise: Realisations, vessel_name: str) -> None:
        self.noise, self.vessel_name = noise, vessel_name
        self.name = f"vessel_{vessel_name}"

    @property
    def problem(self) -> InsetProblem:
        return self.noise.scene("paper").problem

    @property
    def clean(self) -> Scan:
        return self.noise.scene("paper").clean

    @cached_property
    def _shape(self) -> Vessel:
        return vessel(self.vessel_name, self.problem.grid.center)

    @cached_property
    def key(self) -> str:
        values = " ".join(f"{k}={v:.3f}" for k, v in self.tissues_hu().items())
        return f"fine={FINE_MM} {values}"

    def tissues_hu(self) -> dict[str, float]:
        """Tissue → true HU above the fat, by rods in the paper's scene."""
        values = self.noise.scene("paper").facts.tissue_hu
        return {k: v - values["patient"] for k, v in values.items()}

    @cached_property
    def statistics(self) -> Tensor:
        """b at 1 s ``(2, z, y, x)`` of the vessel with its core, and with fibrous tissue in its place."""

        def compute() -> dict[str, Any]:
            grid, values = fine_grid(self.problem.grid), self.tissues_hu()
            twin = {**values, "core": values["fibrous"]}
            x = np.stack([self._shape.painted(grid, v) for v in (values, twin)]) * (self.problem.mu_ref / 1000.0)
            return {"b": projected(self.problem, x, grid).to(torch.float32).numpy()}

        piece = self.noise.store.piece(f"vessels/{self.vessel_name}", f"{self.noise.key} {self.key}", compute)
        return torch.from_numpy(piece["b"])

    @cached_property
    def weights(self) -> Tensor:
        pairs = [self._shape.rois(name).on(self.problem.grid) for name in VESSEL_ROIS]
        return torch.stack([r.weights for pair in pairs for r in pair])

    @cached_property
    def fat(self) -> NDArray[np.int64]:
        found = np.flatnonzero(self._shape.plain_fat(self.problem.grid))
        if found.size == 0:
            raise ValueError("no plain fat beside the vessel: enlarge the inset")
        return found[:: -(-found.size // FAT_VOXELS)]
