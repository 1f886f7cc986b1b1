"""Vessels that run in any direction: each method on a voxel model that is finer than its own grid.

The truth is painted on 0.1 mm voxels and projected exactly onto the paper scan's readings, b = AᵀW (A_fine x_fine), so
that the methods' own grid is not that of the data. Geometry, weights, Gram and noise are the paper scene's: with one
seed, all vessels, with and without core, carry the same noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.pwls.inset_problem import InsetProblem
from recon.study.dose_factor.methods import LinearFilter, Method, fingerprint
from recon.study.dose_factor.realisations import Realisations
from recon.study.dose_factor.settings import VESSEL_ROIS
from recon.study.dose_factor.vessel_shapes import Vessel, vessel
from torchpcct.geometry import VolumeGrid
from torchpcct.projector import Projector

__all__ = ["FINE_MM", "VesselScans", "fine_grid", "projected"]

FINE_MM = 0.1
"""Voxels of the truth; each is the mean of 2³ points."""

FAT_VOXELS = 2000
"""Of plain fat, kept of every volume for its noise."""

TWIN_REALIZATIONS = 8
"""Reconstructed without the core too, in whole blocks. What the core adds hardly changes from draw to draw (at 2 s by
below 1 % with MBIR), so few say what the slope is."""

Key = tuple[str, str, float]


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


@dataclass(frozen=True)
class _Placed:
    """What is read of every volume: ROI means and some voxels of plain fat."""

    rois: Any
    fat: Any

    @classmethod
    def of(cls, shape: Vessel, grid: VolumeGrid) -> _Placed:
        fat = np.flatnonzero(shape.plain_fat(grid))
        if fat.size == 0:
            raise ValueError("no plain fat beside the vessel: enlarge the inset")
        rois = [shape.rois(name).on(grid) for name in VESSEL_ROIS]
        return cls(rois, torch.from_numpy(fat[:: -(-fat.size // FAT_VOXELS)]))

    def means(self, volumes: Tensor) -> Any:
        """``(n, rois, 2)`` core and fibrous tissue."""
        return torch.stack([torch.stack([r(volumes) for r in pair], dim=-1) for pair in self.rois], dim=-2).numpy()

    def noise(self, volumes: Tensor) -> Any:
        return volumes.flatten(1)[:, self.fat].numpy().astype(np.float16)


class VesselScans:
    """Vessels on the paper scene's scan, reconstructed in pieces on disk.

    Args:
        noise: of the study; gives the scene, its problem and the store.
    """

    def __init__(self, noise: Realisations) -> None:
        self.noise, self.settings = noise, noise.settings
        self._placed: dict[str, _Placed] = {}
        self._draws: tuple[Any, Tensor] | None = None
        self._responses: dict[str, tuple[Any, Tensor]] = {}

    @property
    def _problem(self) -> InsetProblem:
        return self.noise.scene("paper").problem

    @property
    def key(self) -> str:
        """What all pieces depend on."""
        values = " ".join(f"{k}={v:.3f}" for k, v in self.tissues_hu().items())
        return f"{self.noise.key} fine={FINE_MM} {values}"

    def tissues_hu(self) -> dict[str, float]:
        """Tissue → true HU above the fat, by rods in the paper's scene."""
        values = self.noise.scene("paper").facts.tissue_hu
        return {k: v - values["patient"] for k, v in values.items()}

    def clean(self, name: str) -> dict[str, Any]:
        """``b`` at 1 s ``(2, z, y, x)`` of a vessel with its core, and with fibrous tissue in its place."""

        def compute() -> dict[str, Any]:
            problem = self._problem
            grid, shape = fine_grid(problem.grid), vessel(name, problem.grid.center)
            values = self.tissues_hu()
            twin = {**values, "core": values["fibrous"]}
            x = np.stack([shape.painted(grid, v) for v in (values, twin)]) * (problem.mu_ref / 1000.0)
            return {"b": projected(problem, x, grid).to(torch.float32).numpy()}

        return self.noise.store.piece(f"vessels/{name}", self.key, compute)

    def jobs(self, names: Iterable[str], methods: Iterable[Method]) -> list[tuple[Key, Callable[[], dict[str, Any]]]]:
        """``(method, vessel, dose)`` and what gives a piece of it; a dose's realisations block by block."""
        s, names, methods = self.settings, tuple(names), tuple(methods)
        return [
            ((method.name, name, dose), partial(self._piece, method, name, dose, block))
            for dose in s.scene_doses for block in s.blocks(s.scene_n) for name in names for method in methods
        ]  # fmt: skip

    def _piece(self, method: Method, name: str, dose: float, block: range) -> dict[str, Any]:
        """ROI means ``(n, rois, 2)`` with the core and, on the same noise, without it; voxels of plain fat.

        ``absent`` has the first :data:`TWIN_REALIZATIONS` only. Of a linear filter also ``expected``, ``(1, 2, rois,
        2)``: the means without noise, with and without the core.
        """

        def compute() -> dict[str, Any]:
            clean = torch.from_numpy(self.clean(name)["b"]) * dose
            if name not in self._placed:
                self._placed[name] = _Placed.of(vessel(name, self._problem.grid.center), self._problem.grid)
            placed = self._placed[name]
            volumes = self._reconstructed(method, clean[0], dose, block)
            result = {"roi": placed.means(volumes), "fat": placed.noise(volumes), "absent": placed.means(volumes[:0])}
            if block.start < TWIN_REALIZATIONS:
                result["absent"] = placed.means(self._reconstructed(method, clean[1], dose, block))
            if isinstance(method, LinearFilter):
                with torch.no_grad():
                    result["expected"] = placed.means(method(self._problem, clean, dose))[None]
            return result

        place = f"methods/{method.name}/vessel_{name}_{dose:g}s_{block.start}-{block.stop}"
        return self.noise.store.piece(place, f"{self.key} {fingerprint(method)} 2", compute)

    def _reconstructed(self, method: Method, clean: Tensor, dose: float, block: range) -> Tensor:
        """Volumes of ``clean`` (z, y, x) with the noise of a block."""
        noise = self._noise(dose, block)
        with torch.no_grad():
            if not isinstance(method, LinearFilter):
                return method(self._problem, clean + noise, dose).to(torch.float32)
            # Linear: what the noise does is the same in every vessel.
            if method.name not in self._responses or self._responses[method.name][0] != (dose, block):
                both = method(self._problem, torch.cat([noise, torch.zeros_like(noise[:1])]), dose)
                self._responses[method.name] = ((dose, block), both[:-1] - both[-1:])
            return (method(self._problem, clean[None], dose) + self._responses[method.name][1]).to(torch.float32)

    def _noise(self, dose: float, block: range) -> Tensor:
        """Of the paper scene; kept for the next method and vessel."""
        if self._draws is None or self._draws[0] != (dose, block):
            self._draws = ((dose, block), self.noise.gram_noise("paper", dose, block))
        return self._draws[1]
