"""Held-out plaques and noise draws that ``rivals.py`` tunes filters on.

Vessels of four directions are painted on 0.1 mm voxels and projected; their truth is that of volume
fractions, to 0.5 HU rms. Noise is that of real counts of the paper's scan (1968 views): noisy minus
noise-free FBP, and the same of b = AᵀW y; what else is scanned changes the counts by a few per cent
at most.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from recon.analytic.inset import InsetFbp
from recon.evaluate.vessels import PaintedVessel, VesselAxis
from recon.jobs.store import Store
from recon.least_squares.inset_problem import InsetProblem
from recon.study.paper.plaque_scan import inset_grid
from torchpcct import Projector, VolumeGrid
from torchpcct.acquisition.acquire import acquire
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene.plaque import Plaque, plaque_scene
from torchpcct.scene.scene import Scene
from torchpcct.volume import to_hu

ROD_HU = {"fat": -92.65, "wall": 63.53, "fibrous": 103.22, "lumen": 479.97, "core": 41.07}
"""CT numbers of 4 mm rods of each tissue at the plaque's place
(:mod:`recon.study.paper.plaque_scan`)."""
KERNELS = ("soft", "standard", "detail")
_X, _Y, _Z = np.eye(3)
_H = 0.5**0.5
_HELD_OUT: dict[str, tuple[VesselAxis, dict[str, Any], tuple[float, ...]]] = {
    "along z": (
        VesselAxis(_Z, -_X),
        {
            "vessel_diameter": 4.0,
            "wall_thickness": 0.25,
            "cap_thickness": 0.22,
            "bulge": 0.55,
            "core_semi_axes": (0.6, 0.8, 1.3),
        },
        (0.0, 50.0, 92.0, 430.0, 30.0),
    ),
    "tilted": (
        VesselAxis((_H, 0.0, _H), _Y),
        {"vessel_diameter": 2.8, "bulge": 0.45, "core_semi_axes": (0.45, 0.7, 0.7)},
        (0.0, 45.0, 100.0, 380.0, 20.0),
    ),
    "in plane": (
        VesselAxis(_Y, -_Z),
        {"vessel_diameter": 3.0, "bulge": 0.5, "core_semi_axes": (0.5, 0.7, 0.9)},
        (0.0, 55.0, 90.0, 400.0, 45.0),
    ),
    "curved": (
        VesselAxis(_X, _Z, 6.5),
        {"vessel_diameter": 3.6, "bulge": 0.5, "core_semi_axes": (0.55, 1.1, 0.8)},
        (0.0, 60.0, 110.0, 460.0, 40.0),
    ),
}
"""Centreline, plaque, and HU of fat, wall, fibrous tissue, lumen and core (fat's is added)."""
DIRECTIONS = tuple(_HELD_OUT)
TISSUES = ("patient", "wall", "fibrous", "lumen", "core")
PAPER_HU = dict(zip(TISSUES, (ROD_HU[k] for k in ("fat", *TISSUES[1:])), strict=True))


@dataclass(frozen=True, eq=False)
class Place:
    """A scene, noise free.

    Attributes:
        fbp: ``(kernels, z, y, x)`` HU; b: ``(z, y, x)`` at 1 s; true: ``(z, y, x)`` HU.
        inside, flat: masks of the error and of the noise; core, around: of the core and of the
            fibrous tissue about it.
    """

    fbp: Tensor
    b: Tensor
    true: Tensor
    inside: Tensor
    flat: Tensor
    core: Tensor
    around: Tensor


class Bench:
    """Scans, draws and places, kept in a folder."""

    def __init__(self, folder: Path) -> None:
        self.store, self.plaque = Store(folder), Plaque()
        self.grid = inset_grid(self.plaque, 0.2)
        self.clean = self.scan("paper_0", plaque_scene()[0])
        self.fbp = InsetFbp(self.clean, [self.grid], KERNELS)
        self.problem = InsetProblem(self.clean, self.grid)

    def scan(self, name: str, scene: Scene) -> Scan:
        path = self.store.path(f"{name}.h5")
        if not path.exists():
            acquire(scene, presets.pcct(), region=self.grid).save(path)
        return Scan.load(path)

    @lru_cache(maxsize=64)  # noqa: B019
    def noise(self, dose: float, k: int) -> tuple[Tensor, Tensor]:
        """Of FBP with every kernel, HU, and of b."""

        def compute() -> dict[str, Any]:
            noisy = self.clean.with_noise(dose, k)
            b = [self.problem.term(s).b[0] for s in (noisy, self.clean)]
            return {
                "fbp": (self.fbp(noisy)[0] - self.fbp(self.clean)[0]).numpy(),
                "b": (b[0] - dose * b[1]).numpy(),
            }

        found = self.store.cached(f"draws/{dose:g}_{k}", "1", compute)
        return torch.from_numpy(found["fbp"]), torch.from_numpy(found["b"])

    def painted(self, vessel: PaintedVessel, values: dict[str, float]) -> tuple[Tensor, Tensor]:
        """FBP and b of a vessel in any direction, on 0.1 mm voxels."""
        return self.projected(
            vessel.painted(self.fine, {k: h - values["patient"] for k, h in values.items()})
        )

    @property
    def fine(self) -> VolumeGrid:
        """Of what is painted: half the inset's voxels."""
        g = self.grid
        return VolumeGrid(tuple(2 * n for n in g.shape), g.spacing[0] / 2, g.center)

    def projected(self, above_fat: Any) -> tuple[Tensor, Tensor]:
        """FBP ``(kernels, z, y, x)`` in HU and b of the patient with so many HU added on the
        fine grid."""
        p, window = self.problem, self.clean.window
        added = torch.from_numpy(above_fat * (p.mu_ref / 1000.0)).float()
        lines = Projector(p.geometry, self.fine, window)(added)
        images = self.fbp.images(lines + window.take(self.clean.exterior_line_integrals()))[0]
        b = p.projector.T(p.weights * p.outer.crop(lines, p.window))
        return to_hu(images, p.mu_ref), b

    @lru_cache(maxsize=8)  # noqa: B019
    def held_out(self, name: str, core: bool = True) -> Place:
        """Of the tuning; without ``core`` its place is fibrous."""
        line, geometry, hu = _HELD_OUT[name]
        shape = Plaque(position=(0.0, 0.0, 0.0), vessel_length=8.0, **geometry)
        values = dict(zip(TISSUES, (hu[0] + PAPER_HU["patient"], *hu[1:]), strict=True))
        if not core:
            values["core"] = values["fibrous"]
        kept = f"held_out_{name}" + ("" if core else "_without_core")
        return self.vessel(kept, PaintedVessel(line, self.grid.center, plaque=shape), values)

    def vessel(self, name: str, vessel: PaintedVessel, values: dict[str, float]) -> Place:
        """Of a vessel with a plaque."""

        def compute() -> dict[str, Any]:
            fbp, b = self.painted(vessel, values)
            return {"fbp": fbp.numpy(), "b": b.numpy()}

        found = {
            k: torch.from_numpy(v).float()
            for k, v in self.store.cached(f"places/{name}", "3", compute).items()
        }
        share = {
            k: torch.from_numpy(v).float() for k, v in vessel.volume_fractions(self.grid).items()
        }
        true = sum(share[k] * values[k] for k in TISSUES)
        fat = share["patient"] > 1 - 1e-6
        away = torch.from_numpy(ndimage.distance_transform_edt(fat.numpy(), self.grid.spacing))
        flat = torch.zeros_like(fat)
        flat[4:-4, 4:-4, 4:-4] = (away > 1.5)[4:-4, 4:-4, 4:-4]
        core = share["core"] > 0.8
        beside = torch.from_numpy(
            ndimage.distance_transform_edt(~core.numpy(), self.grid.spacing) < 1.2
        )
        around = (share["fibrous"] > 0.8) & beside
        return Place(
            **found, true=true, inside=share["patient"] < 0.5, flat=flat, core=core, around=around
        )
