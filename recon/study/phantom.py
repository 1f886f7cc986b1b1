"""The plaque itself beside the paper's: what it is made of, what it reads in HU, and its lengths.

Lengths are those of the analytic bodies, and measured on a binary raster of them, which lies along
the plaque's own axes: z along the vessel, x from its axis to the plaque.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from scipy.ndimage import distance_transform_edt

from recon.study.paper import published as paper
from recon.study.report import Check, around
from recon.study.study import Measured, Progress, StudySettings, silent
from torchpcct.geometry import VolumeGrid
from torchpcct.scanner import presets
from torchpcct.scene import Scene
from torchpcct.scene.materials import MATERIALS
from torchpcct.scene.plaque import PATIENT_DIAMETER, Plaque, plaque_scene
from torchpcct.validate import number, numbers
from torchpcct.viz import Panel, panels

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from torchpcct.typing import Floats, Ints, JsonObject


TRANSMITTED = "100 kVp behind 24 cm fat"
"""Spectrum behind the patient for which CT numbers are checked."""
MIDDLE = "64 keV"
"""Energy for which CT numbers are checked."""

_LENGTH_MM = 0.02
"""Accepted error of a length, mm."""
_OFFSET_MM = 0.1
"""Accepted error of a length that the paper gives with one decimal, mm."""

_SOFT_HU = 6.0
"""Accepted difference of soft tissue from the paper's CT number, HU."""
_BLOOD_HU = (400.0, 600.0)
"""Accepted CT numbers of blood, HU."""
_FAT_HU = (-130.0, -85.0)
"""Accepted CT numbers of fat, HU."""

_SHOWN_KEV = 64.0
"""Energy of the picture: there the soft tissues have the paper's CT numbers."""
_PIXEL_MM = 0.02
"""Pixel of the picture."""
_HALF_MM = 2.75
"""Half of its width."""
_MARGIN_MM = 0.1
"""Beyond the bodies that are measured on voxels."""


@dataclass(frozen=True)
class PhantomSettings(StudySettings):
    """Settings of the study; the quick ones take a raster four times as coarse.

    Args:
        voxel_mm: of the raster that is measured [paper: 0.021].
        sections: of the vessel beyond the plaque, on which diameter, wall and place are measured.
        energies_kev: of the monochromatic CT numbers.
    """

    voxel_mm: float = paper.PHANTOM_VOXEL_MM
    sections: int = 5
    energies_kev: tuple[float, ...] = (55.0, 60.0, 63.0, 64.0, 65.0, 70.0)

    QUICK: ClassVar = {"voxel_mm": 4 * paper.PHANTOM_VOXEL_MM}

    def __post_init__(self) -> None:
        self.check_whole(sections=1)
        number("voxel_mm", self.voxel_mm, low=0.005, high=0.1, unit="mm")
        energies = numbers("energies_kev", self.energies_kev, low=20.0, high=150.0, unit="keV")
        object.__setattr__(self, "energies_kev", energies)


def measure(
    settings: PhantomSettings, progress: Progress = silent, folder: str | Path | None = None
) -> Measured:
    """Materials and lengths; nothing is kept in ``folder``."""
    scene, plaque = plaque_scene()
    hu = ct_numbers(settings.energies_kev)
    published = {name: value for name, (_, value, _) in paper.MATERIALS.items()}
    soft = ("vessel_wall", "fibrous_tissue", "necrotic_core")
    data: JsonObject = {
        "materials": compositions(),
        "hu": hu,
        "published_hu": published,
        "nearest": {
            "soft": _nearest(hu, {n: published[n] for n in soft}),
            "all": _nearest(hu, published),
        },
    }
    progress("materials", 1.0)
    data["lengths_mm"] = {
        "bodies": analytic_lengths(scene, plaque),
        "raster": raster_lengths(scene, plaque, settings.voxel_mm, settings.sections),
    }
    data |= {"published_mm": dict(paper.PHANTOM_MM), "assumed_mm": assumptions(plaque)}
    progress("lengths", 1.0)
    return Measured(settings, data)


def compositions() -> list[dict[str, object]]:
    """Per material: density, mass fractions, and their largest difference to the paper's table.

    The library's own fractions are the paper's table, normalised: agreement says that it was copied
    rightly.
    """
    rows = []
    for name, (density, _, published) in paper.MATERIALS.items():
        found = dict(MATERIALS[name].mass_fractions)
        rows.append(
            {
                "material": name,
                "density_g_cm3": MATERIALS[name].density_g_cm3,
                "published_g_cm3": density,
                "fractions": found,
                "published": dict(published),
                "fraction_error": max(
                    abs(found.get(e, 0.0) - published.get(e, 0.0)) for e in {*found, *published}
                ),
            }
        )
    return rows


def ct_numbers(energies_kev: tuple[float, ...]) -> dict[str, dict[str, float]]:
    """Spectrum → material → HU against water.

    Monochromatic; then of the photons that leave the tube, of those behind the patient (the
    scanner's filters, the large bowtie's middle, 24 cm of fat), and of the signals that PCCT and
    EID-CT make of these.
    """
    spectra: dict[str, tuple[float | Floats, float | Floats]] = {
        f"{e:g} keV": (e, 1.0) for e in energies_kev
    }
    patient = {MATERIALS["pericoronary_fat"]: PATIENT_DIAMETER}
    pcct, eid = presets.pcct(), presets.eid()
    middle = pcct.geometry.columns // 2
    energies, photons = pcct.quanta()
    behind = MATERIALS["pericoronary_fat"].attenuation(energies) * PATIENT_DIAMETER
    spectra["100 kVp, filtered, in air"] = energies, photons[middle]
    spectra[TRANSMITTED] = energies, photons[middle] * np.exp(-behind)
    spectra["the same, counted by the PCCT"] = energies, pcct.behind(patient)[0, middle]
    spectra["the same, integrated by the EID-CT"] = (
        eid.weights()[0],
        eid.behind(patient)[0, eid.geometry.columns // 2],
    )
    return {
        name: {m: MATERIALS[m].hu(*spectrum) for m in paper.MATERIALS}
        for name, spectrum in spectra.items()
    }


def _nearest(hu: dict[str, dict[str, float]], published: dict[str, float]) -> dict[str, object]:
    """The spectrum whose CT numbers come nearest to the published ones, and the largest
    difference."""
    miss = {
        spectrum: max(abs(found[n] - v) for n, v in published.items())
        for spectrum, found in hu.items()
    }
    best = min(miss, key=lambda spectrum: miss[spectrum])
    return {"spectrum": best, "hu": miss[best]}


# --- lengths --------------------------------------------------------------------------------------


def analytic_lengths(scene: Scene, plaque: Plaque) -> dict[str, float]:
    """Lengths in mm of the bodies, named as the paper's."""
    # on either side of here there is no plaque
    away = 0.5 * (plaque.bulge_length + plaque.vessel_length) / 2.0
    outer, inner = (float(plaque.section(name, away)[2]) for name in ("outer", "inner"))
    minor, _, major = sorted(2.0 * a for a in plaque.core.semi_axes)
    patient = scene["patient"].shape
    return {
        "core, major axis": major,
        "core, minor axis": minor,
        "fibrous cap": plaque.minimum_cap,
        "wall": outer - inner,
        "vessel diameter": 2.0 * outer,
        "distance from the isocentre": math.hypot(*plaque.position[:2]),
        "patient diameter": 2.0 * float(patient.semi_axes[0]),  # type: ignore[attr-defined]
    }


def assumptions(plaque: Plaque) -> dict[str, float]:
    """Lengths in mm that the paper does not give."""
    throat = 2.0 * float(plaque.section("lumen", 0.0)[3])
    return {
        "core, third axis, along the vessel": 2.0 * plaque.core_semi_axes[2],
        "lumen, diameter beyond the plaque": 2.0 * plaque.inner_radius,
        "lumen, diameter at the plaque's middle": throat,
        "bulge of the wall": plaque.bulge,
        "length of the bulge": plaque.bulge_length,
        "length of the vessel": plaque.vessel_length,
    }


def raster_lengths(
    scene: Scene, plaque: Plaque, voxel_mm: float, sections: int
) -> dict[str, float]:
    """The same lengths on voxels that are what their centre is.

    Core: extents of its voxels. Cap: smallest distance between voxels of core and lumen, less one
    voxel. Vessel and wall: extents of their voxels across the plaque's direction, mean over
    sections beyond the plaque; distance from the isocentre: of the vessel's centre of mass there.
    Patient: voxels on a line through the isocentre.
    """
    around = tuple(a + plaque.minimum_cap + _MARGIN_MM for a in plaque.core.semi_axes)
    labels = _raster(scene, plaque, plaque.core_center, around, voxel_mm)[0]
    inside, lumen = (labels == scene.index(name) for name in ("core", "lumen"))
    cap = (
        distance_transform_edt(~lumen, sampling=voxel_mm)[inside].min() - voxel_mm
        if lumen.any()
        else math.nan
    )
    extents = [float(inside.any(axes).sum() * voxel_mm) for axes in ((0, 1), (0, 2), (1, 2))]
    low, high = 0.5 * plaque.bulge_length, 0.5 * plaque.vessel_length
    heights = low + (np.arange(sections) + 0.5) * (high - low) / sections
    diameters, walls, centres = [], [], []
    reach = plaque.vessel_diameter / 2.0 + _MARGIN_MM
    for z in heights:
        labels, points = _raster(
            scene, plaque, (0.0, 0.0, float(z)), (reach, reach, 0.5 * voxel_mm), voxel_mm
        )
        vessel = labels != scene.index("patient")
        across = labels[0, :, labels.shape[2] // 2]  # to the plaque's direction
        wall = across == scene.index("wall")
        diameters.append((across != scene.index("patient")).sum() * voxel_mm)
        walls.append(0.5 * wall.sum() * voxel_mm)
        centres.append(np.hypot(*points[vessel].mean(0)[:2]))
    radius = float(scene["patient"].shape.semi_axes[0])  # type: ignore[attr-defined]
    n = 2 * math.ceil((radius + 1.0) / voxel_mm)
    line = np.zeros((n, 3))
    line[:, 0] = (np.arange(n) - (n - 1) / 2) * voxel_mm
    return {
        "core, major axis": max(extents),
        "core, minor axis": min(extents),
        "fibrous cap": float(cap),
        "wall": float(np.mean(walls)),
        "vessel diameter": float(np.mean(diameters)),
        "distance from the isocentre": float(np.mean(centres)),
        "patient diameter": float((scene.labels(line) >= 0).sum() * voxel_mm),
    }


def _raster(
    scene: Scene, plaque: Plaque, center: Sequence[float], half: Sequence[float], voxel_mm: float
) -> tuple[Ints, Floats]:
    """Labels ``(z, y, x)`` of a box in the plaque's frame, and its points in the scanner's."""
    n = [max(1, 2 * math.floor(h / voxel_mm) + 1) for h in half][::-1]
    z, y, x = VolumeGrid(tuple(n), voxel_mm, tuple(center)[::-1]).axes
    zz, yy, xx = np.meshgrid(z, y, x, indexing="ij")
    points = plaque.to_scanner(np.stack([xx, yy, zz], -1))
    return scene.labels(points), points


# --- the report -----------------------------------------------------------------------------------


def checks(data: JsonObject) -> list[Check]:
    """Densities, mass fractions, CT numbers and lengths with what is accepted of them."""
    found = []
    for m in data["materials"]:
        name = m["material"].replace("_", " ")
        found.append(
            around(f"{name}: density, g/cm³", m["density_g_cm3"], m["published_g_cm3"], 5e-4)
        )
        # Blood's table sums to 1.0002: normalising moves oxygen by 1.5e-4.
        error = f"{name}: largest error of a mass fraction"
        found.append(Check(error, m["fraction_error"], "0, normalised", high=2e-4))
    accepted = {"blood_iodine": _BLOOD_HU, "pericoronary_fat": _FAT_HU}
    for spectrum in (s for s in (MIDDLE, TRANSMITTED) if s in data["hu"]):
        for material, hu in data["hu"][spectrum].items():
            target = paper.MATERIALS[material][1]
            low, high = accepted.get(material, (target - _SOFT_HU, target + _SOFT_HU))
            check = Check(f"{material.replace('_', ' ')}, HU, {spectrum}", hu, target, low, high)
            found.append(
                check.explained(
                    "the energy that gives soft tissue does not give blood and fat, see below"
                )
            )
    for how, lengths in data["lengths_mm"].items():
        for name, value in lengths.items():
            tolerance = (
                _OFFSET_MM
                if name in ("distance from the isocentre", "patient diameter")
                else _LENGTH_MM
            )
            found.append(around(f"{name}, mm, {how}", value, paper.PHANTOM_MM[name], tolerance))
    return found


def figures(measured: Measured) -> dict[str, Figure]:
    """Axial section through the plaque's middle, and the section along the vessel through wall,
    core and lumen."""
    scene, plaque = plaque_scene()
    values = np.array([m.hu(_SHOWN_KEV) for m in scene.materials])
    across = np.arange(-_HALF_MM, _HALF_MM, _PIXEL_MM) + 0.5 * _PIXEL_MM
    half = plaque.vessel_length / 2.0
    along = np.arange(-half, half, _PIXEL_MM) + 0.5 * _PIXEL_MM

    def panel(x: Floats, y: Floats, z: Floats, vertical: float, title: str) -> Panel:
        points = plaque.to_scanner(np.stack(np.broadcast_arrays(x, y, z), -1))
        return Panel(
            values[scene.labels(points)], (-_HALF_MM, _HALF_MM, -vertical, vertical), title
        )

    line, zero, core = across[None, :], np.zeros(1), np.full(1, plaque.core_center[0])
    row = [
        panel(line, across[:, None], zero, _HALF_MM, "axial"),
        panel(line, zero, along[:, None], half, "sagittal, towards the plaque"),
        panel(core, line, along[:, None], half, "sagittal, through the core"),
    ]
    figure = panels([row], (), "The plaque", f"HU at {_SHOWN_KEV:g} keV, C150 / W600")
    figure.set_size_inches(8.0, 5.2)
    return {"phantom.png": figure}
