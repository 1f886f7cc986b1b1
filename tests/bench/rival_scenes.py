"""Scenes, their twins and noise draws that ``rivals.py`` measures on: held-out plaques, the paper's, muscle.

Straight vessels, spheres and line pairs are simulated with all effects (``acquire``); vessels of other directions are
painted on 0.1 mm voxels and projected. Noise is that of real counts of the paper's scan (1968 views): noisy minus
noise-free FBP, and the same of b = AᵀW y; what else is scanned changes the counts by a few per cent at most.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rod_values import ROD_HU
from scipy import ndimage
from torch import Tensor

from recon.evaluate.store import Store
from recon.evaluate.vessels import SHAPES, Centreline, Vessel
from recon.fbp.inset import InsetFbp
from recon.pwls.inset_problem import InsetProblem
from recon.study.dose_factor.settings import Settings
from recon.study.dose_factor.variant import Variant
from recon.study.dose_factor.vessels import fine_grid
from recon.study.paper.plaque_scan import inset_grid
from torchpcct import Projector, VolumeGrid
from torchpcct.acquisition.acquire import acquire
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene.bodies import Box, Ellipsoid
from torchpcct.scene.plaque import Plaque, interpolate_material, plaque_scene
from torchpcct.scene.scene import Body, Scene, voxel_centres
from torchpcct.volume import to_hu

KERNELS = ("soft", "standard", "detail")
_X, _Y, _Z = np.eye(3)
_H = 0.5**0.5
_HELD_OUT: dict[str, tuple[Centreline, dict[str, Any], tuple[float, ...]]] = {
    "along z": (
        Centreline(_Z, -_X),
        {"vessel_diameter": 4.0, "wall_thickness": 0.25, "cap_thickness": 0.22, "bulge": 0.55,
         "core_semi_axes": (0.6, 0.8, 1.3)}, (0.0, 50.0, 92.0, 430.0, 30.0),
    ),
    "tilted": (
        Centreline((_H, 0.0, _H), _Y), {"vessel_diameter": 2.8, "bulge": 0.45, "core_semi_axes": (0.45, 0.7, 0.7)},
        (0.0, 45.0, 100.0, 380.0, 20.0),
    ),
    "in plane": (
        Centreline(_Y, -_Z), {"vessel_diameter": 3.0, "bulge": 0.5, "core_semi_axes": (0.5, 0.7, 0.9)},
        (0.0, 55.0, 90.0, 400.0, 45.0),
    ),
    "curved": (
        Centreline(_X, _Z, 6.5), {"vessel_diameter": 3.6, "bulge": 0.5, "core_semi_axes": (0.55, 1.1, 0.8)},
        (0.0, 60.0, 110.0, 460.0, 40.0),
    ),
}  # fmt: skip
"""Centreline, plaque, and HU of fat, wall, fibrous tissue, lumen and core (fat's is added)."""
DIRECTIONS = tuple(_HELD_OUT)
PLACES = ("paper", "tilted", "in plane", "curved", "2 mm vessel", "half-size core", "two cores", "muscle",
          "pairs 1.0 mm", "pairs 1.4 mm")  # fmt: skip
MUSCLE_HU, SPHERE_HU, PAIRS_HU = 55.0, 30.0, 200.0
TISSUES = ("patient", "wall", "fibrous", "lumen", "core")
PAPER_HU = dict(zip(TISSUES, (ROD_HU[k] for k in ("fat", *TISSUES[1:])), strict=True))


def between(hu: float) -> Any:
    """A tissue of a CT number: fibrous tissue with more or less of the core's, or of blood with iodine."""
    other, name = ("core", "necrotic_core") if hu < PAPER_HU["fibrous"] else ("lumen", "blood_iodine")
    weight = (hu - PAPER_HU["fibrous"]) / (PAPER_HU[other] - PAPER_HU["fibrous"])
    return interpolate_material(f"{hu:g} HU", "fibrous_tissue", name, weight)


@dataclass(frozen=True, eq=False)
class Place:
    """A scene and its twin without the core, noise free.

    Attributes:
        fbp: ``(2, kernels, z, y, x)`` HU; b: ``(2, z, y, x)`` at 1 s; true: ``(2, z, y, x)`` HU.
        inside, flat: masks of the error and of the noise; rows: name → the two means that make the contrast.
        contrast: true one, HU; rim: name → mask, read on the noise-free volume.
    """

    fbp: Tensor
    b: Tensor
    true: Tensor
    inside: Tensor
    flat: Tensor
    rows: dict[str, tuple[Tensor, Tensor]]
    contrast: float
    rim: dict[str, Tensor]


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
            b = [self.problem.statistic(s).b for s in (noisy, self.clean)]
            return {"fbp": (self.fbp(noisy)[0] - self.fbp(self.clean)[0]).numpy(), "b": (b[0] - dose * b[1]).numpy()}

        found = self.store.piece(f"draws/{dose:g}_{k}", "1", compute)
        return torch.from_numpy(found["fbp"]), torch.from_numpy(found["b"])

    def acquired(self, name: str, scenes: list[Scene]) -> tuple[Tensor, Tensor]:
        """FBP and b of analytic scenes."""
        scans = [self.scan(f"{name}_{k}", s) for k, s in enumerate(scenes)]
        return torch.stack([self.fbp(s)[0] for s in scans]), torch.stack([self.problem.statistic(s).b for s in scans])

    def painted(self, vessel: Vessel, values: list[dict[str, float]]) -> tuple[Tensor, Tensor]:
        """FBP and b of a vessel in any direction, on 0.1 mm voxels."""
        p, window, fine = self.problem, self.clean.window, fine_grid(self.grid)
        x = np.stack([vessel.painted(fine, {k: h - v["patient"] for k, h in v.items()}) for v in values])
        lines = Projector(p.geometry, fine, window)(torch.from_numpy(x * (p.mu_ref / 1000.0)).float())
        images = self.fbp.images(lines + window.take(p.background))[0]  # kernels first
        b = p.projector.T(p.weights * p.outer.crop(lines, p.window))
        return to_hu(images, p.mu_ref).movedim(0, 1), b

    @lru_cache(maxsize=8)  # noqa: B019
    def held_out(self, name: str) -> Place:
        """Of the tuning."""
        line, geometry, hu = _HELD_OUT[name]
        shape = Plaque(position=(0.0, 0.0, 0.0), vessel_length=8.0, **geometry)
        values = dict(zip(TISSUES, (hu[0] + PAPER_HU["patient"], *hu[1:]), strict=True))
        return self.vessel(f"held_out_{name}", Vessel(line, self.grid.center, plaque=shape), values)

    def vessel(self, name: str, vessel: Vessel, values: dict[str, float], scenes: Any = None) -> Place:
        """Of a vessel with a plaque; with ``scenes`` that analytic one and its twin."""
        twins = [values, {**values, "core": values["fibrous"]}]

        def compute() -> dict[str, Any]:
            fbp, b = self.acquired(name, scenes) if scenes else self.painted(vessel, twins)
            return {"fbp": fbp.numpy(), "b": b.numpy()}

        found = {k: torch.from_numpy(v).float() for k, v in self.store.piece(f"places/{name}", "1", compute).items()}
        share, near = self.shares(scenes[0].labels if scenes else vessel.labels, scenes[0].names if scenes else TISSUES)
        true = torch.stack([sum(share[k] * v[k] for k in TISSUES) for v in twins])
        fat = share["patient"] > 1 - 1e-6
        away = torch.from_numpy(ndimage.distance_transform_edt(fat.numpy(), self.grid.spacing))
        flat = torch.zeros_like(fat)
        flat[4:-4, 4:-4, 4:-4] = (away > 1.5)[4:-4, 4:-4, 4:-4]
        fibrous = (share["fibrous"] + share["core"] > 1 - 1e-6) & (near > 0.3) & (near < 0.5)
        core = share["core"] > 0.99
        rim = {"fat": fat & (away <= 0.8), "fibrous": fibrous, "core": core & (near < near[core].min() + 0.15)}
        if name == "paper":
            variant = Variant("paper", Settings())
            pairs = {roi: variant.pair_of(roi) for roi in ("paper", "section", "tissue")}
        else:
            pairs = {roi: vessel.rois(roi) for roi in ("section", "tissue")}
        rows = {k: tuple(r.weights for r in pair.on(self.grid)) for k, pair in pairs.items()}
        return Place(**found, true=true, inside=share["patient"] < 0.5, flat=flat, rows=rows,
                     contrast=values["fibrous"] - values["core"], rim=rim)  # fmt: skip

    def shares(self, labels: Callable[[Any], Any], names: Any) -> tuple[dict[str, Tensor], Tensor]:
        """Tissue → share of every voxel; distance of voxels from the lumen, mm. A second core counts as core."""
        n = 3
        fine = VolumeGrid(tuple(n * k for k in self.grid.shape), self.grid.spacing[0] / n, self.grid.center)
        found = np.concatenate([labels(z) for z in np.array_split(voxel_centres(fine), 9)])

        def blocks(values: Any) -> Tensor:
            z, y, x = self.grid.shape
            return torch.from_numpy(values.reshape(z, n, y, n, x, n).mean((1, 3, 5), dtype=np.float64)).float()

        share = {k: blocks(np.isin(found, [i for i, m in enumerate(names) if m.startswith(k)])) for k in TISSUES}
        lumen = np.isin(found, [i for i, m in enumerate(names) if m == "lumen"])
        return share, blocks(ndimage.distance_transform_edt(~lumen, fine.spacing))

    @lru_cache(maxsize=2)  # noqa: B019
    def place(self, name: str) -> Place:
        """Of those measured."""
        shapes = {"tilted": "tilted", "in plane": "in_plane_x", "curved": "curved_5mm"}
        if name in shapes:
            return self.vessel(name, Vessel(*SHAPES[shapes[name]][:1], self.grid.center), PAPER_HU)
        if name in ("muscle", "pairs 1.0 mm", "pairs 1.4 mm"):
            return self.muscle(name)
        x, y, z = self.plaque.position
        options: dict[str, Any] = {
            "paper": {}, "half-size core": {"core_scale": 0.5},
            "2 mm vessel": {"vessel_diameter": 2.0, "bulge": 0.4, "core_semi_axes": (0.35, 0.5, 0.8)},
            "two cores": {"core_shift": (0.0, 0.0, -0.75), "core_semi_axes": (0.45, 0.8, 0.6)},
        }[name]  # fmt: skip
        plaque = replace(self.plaque, **options)
        scenes = []
        for core in ("necrotic_core", "fibrous_tissue"):
            second = Ellipsoid(plaque.core.semi_axes, position=(*np.array(plaque.core.position)[:2], z + 0.75))
            extra = (Body("core_2", second, core, "fibrous"),) if name == "two cores" else ()
            scenes.append(plaque_scene(plaque, core=core, extra=extra)[0])
        own = replace(plaque, position=(0.0, 0.0, 0.0))
        return self.vessel(name, Vessel(SHAPES["straight"][0], (z, y, x), plaque=own), PAPER_HU, scenes)

    def muscle(self, name: str) -> Place:
        """A piece of muscle in the fat, in it a sphere of 3 mm (+30 HU) or line pairs of 200 HU; its twin has none."""
        x, y, z = self.plaque.position
        patient = plaque_scene()[0].bodies[0]
        host = Body("muscle", Ellipsoid((4.2, 4.2, 5.3), position=(x, y, z)), between(MUSCLE_HU), "patient")
        r = torch.from_numpy(np.linalg.norm(voxel_centres(self.grid) - (x, y, z), axis=-1))
        flat = (r > 2.2) & (r < 3.3)
        if name == "muscle":
            added, things = SPHERE_HU, [Body("sphere", Ellipsoid(1.5, position=(x, y, z)), between(85.0), "muscle")]
            pair, inside = (flat, r < 1.1), r < 2.0
        else:
            period, added = float(name.split()[1]), PAIRS_HU
            at = [x + (k - 1.5) * period for k in range(4)]
            boxes = [Box((period / 4, 1.2, 1.2), position=(c, y, z)) for c in at]
            things = [Body(f"bar_{k}", box, between(MUSCLE_HU + added), "muscle") for k, box in enumerate(boxes)]
            off = torch.from_numpy(voxel_centres(self.grid) - (x, y, z)).abs()
            inner = (off[..., 1] < 0.8) & (off[..., 2] < 0.8)
            phase = torch.cos(2 * np.pi / period * (torch.from_numpy(voxel_centres(self.grid)[..., 0]) - at[0]))
            inner &= off[..., 0] < 1.5 * period + 1e-6
            # Weights of a cosine over three whole periods: its amplitude, bright less dark.
            pair, inside = (inner * (-phase).clamp(min=0), inner * phase.clamp(min=0)), r < 2.0
        scenes = [Scene((patient, host, *more)) for more in (things, [])]
        found = self.store.piece(f"places/{name}", "1", lambda: dict(
            zip(("fbp", "b"), (t.numpy() for t in self.acquired(name, scenes)), strict=True)))  # fmt: skip
        values = {"patient": PAPER_HU["patient"], "muscle": MUSCLE_HU}
        true = [s.render(self.grid, {n: values.get(n, MUSCLE_HU + added) for n in s.names}) for s in scenes]
        rows = tuple(w.double() / w.double().sum() for w in pair)
        tensors = {k: torch.from_numpy(v).float() for k, v in found.items()}
        true_t = torch.from_numpy(np.stack(true)).float()
        contrast = float(((true_t[0] - true_t[1]).double() * (rows[1] - rows[0])).sum())
        return Place(**tensors, true=true_t, inside=inside, flat=flat, rows={"tissue": rows}, contrast=contrast, rim={})
