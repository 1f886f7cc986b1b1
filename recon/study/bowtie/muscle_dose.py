"""Why the chest wall's muscle gets 45 % less dose here and 55 % less in the paper: one change at a time.

Unscattered photons. The paper reads its figures from a map of ratios, "side ribs", "skin and major muscles", and does
not say where; its thorax is XCIST's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.bowtie.dose_maps import RAMPS_MM, TISSUES
from recon.study.bowtie.slices import BOWTIES, enlarged, wide_scanners
from torchpcct.dose import ctdi_dose, primary_dose
from torchpcct.geometry import VolumeGrid
from torchpcct.scanner import Scanner
from torchpcct.scanner.filters import ROI_RAMP_MM, large_bowtie, roi_bowtie
from torchpcct.scene import Body, EllipticCylinder, Scene
from torchpcct.scene.materials import MATERIALS
from torchpcct.scene.phantoms.thorax import thorax

__all__ = ["READINGS", "Change", "changes", "muscle_causes", "with_arms"]

Floats = NDArray[np.float64]

READINGS = {
    "means": "mean dose with over mean dose without",
    "voxels": "mean of the voxels' own reductions",
    "outer half": "means, half of the muscle next to the fat",
    "front and back": "means, muscle more than 60 mm before or behind the middle",
    "largest tenth": "reduction that a tenth of its voxels exceed",
}
"""How "the" reduction of a tissue may be read from two dose maps → in tables."""

_ARM_MM = (45.0, 220.0)
"""Radius of an arm and distance of its middle from that of the chest (arms down)."""

_VIEWS = 180


@dataclass(frozen=True)
class Change:
    """One change of what the paper leaves open.

    Args:
        name: in tables.
        ramp_mm: width of the ROI bowtie's ramp.
        material: of the ROI bowtie.
        flat_mm: aluminium of the flat filter; None: the preset's.
        scale: factor on the thorax's lengths.
        arms: whether they hang at the sides.
        centred: whether the chest's middle, not the heart, lies at the isocentre.
    """

    name: str
    ramp_mm: float = ROI_RAMP_MM
    material: str = "aluminium"
    flat_mm: float | None = None
    scale: float = 1.0
    arms: bool = False
    centred: bool = False

    @property
    def beam(self) -> tuple[Any, ...]:
        """What changes the beam, not the chest."""
        return self.ramp_mm, self.material, self.flat_mm

    def scanners(self) -> dict[str, Scanner]:
        """By bowtie."""
        plain = wide_scanners(8)["large"]
        if self.flat_mm is not None:
            plain = plain.replace(filters=((MATERIALS["aluminium"], self.flat_mm),))
        roi = roi_bowtie(plain.geometry.sod, ramp_mm=self.ramp_mm, material=MATERIALS[self.material])
        return dict(zip(BOWTIES, (plain, plain.replace(bowties=(large_bowtie(), roi))), strict=True))

    def scene(self) -> Scene:
        """The chest."""
        chest = enlarged(thorax((0.0, 0.0)) if self.centred else thorax(), self.scale)
        return with_arms(chest) if self.arms else chest


def changes() -> list[Change]:
    """All changes, none first."""
    return [
        Change("as in this study"),
        *(Change(f"ramp of {w:g} mm", ramp_mm=w) for w in RAMPS_MM if w != ROI_RAMP_MM),
        Change("ROI bowtie of copper", material="copper"),
        Change("flat filter of 6 mm", flat_mm=6.0),
        Change("chest 10 % smaller", scale=0.9),
        Change("chest 10 % larger", scale=1.1),
        Change("arms down", arms=True),
        Change("middle of the chest at the isocentre", centred=True),
    ]


def with_arms(chest: Scene) -> Scene:
    """The chest between two arms of muscle with a humerus, at its own height."""
    x, y, z = chest["skin"].shape.position
    radius, apart = _ARM_MM
    bodies = []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        place = (x + sign * apart, y, z)
        bodies.append(Body(f"arm_{side}", EllipticCylinder(radius, position=place), "skeletal_muscle"))
        bodies.append(
            Body(f"humerus_{side}", EllipticCylinder(12.0, position=place), "cortical_bone", f"arm_{side}")
        )  # fmt: skip
    return chest.add(*bodies)


def muscle_causes(map_mm: float, exposure_s: float, progress: Callable[[float], None]) -> list[dict[str, Any]]:
    """Reductions in % by every change: ``readings`` of the muscle, and of ``side ribs``, ``skin`` and the CTDI
    phantom's ``periphery`` by their means."""
    asked, periphery = changes(), math.nan
    rows: list[dict[str, Any]] = []
    for k, change in enumerate(asked):
        scanners, scene = change.scanners(), change.scene()
        low, high = scene.bounding_box("skin")[:, 1::-1]  # (y, x)
        extent, center = high - low, 0.5 * (low + high)
        grid = VolumeGrid(tuple(math.ceil(e / map_mm) for e in extent), map_mm, tuple(center))
        doses = [primary_dose(scene, scanners[b], grid, exposure_s, views=_VIEWS) for b in BOWTIES]
        y, x = np.meshgrid(*grid.axes, indexing="ij")
        labels = scene.labels(np.stack([x, y, np.zeros_like(x)], axis=-1))
        if k == 0 or change.beam != asked[0].beam:
            large, roi = (ctdi_dose(scanners[b], exposure_s, axial="plane").total_peripheral for b in BOWTIES)
            periphery = 100.0 * (1.0 - roi / large)
        else:
            periphery = rows[0]["periphery"]
        inside = {t: np.isin(labels, [i for i, n in enumerate(scene.names) if n.startswith(TISSUES[t])])
                  for t in ("side ribs", "skin", "muscle of the chest wall")}  # fmt: skip
        muscle = inside.pop("muscle of the chest wall")
        rows.append({
            "change": change.name,
            "readings": _readings(doses, muscle, scene, x, y),
            **{t: _means(doses, where) for t, where in inside.items()},
            "periphery": periphery,
        })  # fmt: skip
        progress((k + 1) / len(asked))
    return rows


def _means(doses: list[Floats], where: Any) -> float:
    return float(100.0 * (1.0 - doses[1][where].sum() / doses[0][where].sum())) if where.any() else math.nan


def _readings(doses: list[Floats], muscle: Any, scene: Scene, x: Floats, y: Floats) -> dict[str, float]:
    (a, b), (x0, y0, _) = scene["muscle"].shape.semi_axes, scene["muscle"].shape.position  # type: ignore[attr-defined]
    radius = np.hypot((x - x0) / a, (y - y0) / b)
    lit = muscle & (doses[0] > 0)
    own = 100.0 * (1.0 - doses[1][lit] / doses[0][lit])
    return {
        "means": _means(doses, muscle),
        "voxels": float(own.mean()),
        "outer half": _means(doses, muscle & (radius > np.median(radius[muscle]))),
        "front and back": _means(doses, muscle & (np.abs(y - y0) > 60.0)),
        "largest tenth": float(np.percentile(own, 90.0)),
    }
