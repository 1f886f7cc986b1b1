"""What the studies of the plaque share: grids, ROIs, the noise-free scan and its FBP, what is
read off an image."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from recon.analytic.inset import InsetFbp
from recon.jobs.store import StudyCache
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.placement import RoiPair, place_rois
from torchpcct.metrics.plaque_measures import (
    PlaqueSegmentation,
    basin_depth,
    cap_on_line,
    dice,
    segment_plaque,
)
from torchpcct.metrics.roi import axial_grid
from torchpcct.scan import Scan
from torchpcct.scanner import Scanner, presets
from torchpcct.scene import Body, EllipticCylinder, Scene
from torchpcct.scene.plaque import Plaque

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from torchpcct.metrics.roi import RoiMean
    from torchpcct.scene.materials import Material
    from torchpcct.typing import JsonObject


INSET_MM = (11.3, 9.0, 9.0)
"""Extent (z, y, x) of the reconstructed inset: the paper's 113 × 90 × 90 voxels of 0.1 mm."""

REFERENCE_VOXEL_MM = 0.10
"""Voxel of the noise-free image that the ROIs are checked on, mm."""
REFERENCE_KERNEL = "standard"
"""Kernel of FBP of that image."""

SCANNERS: dict[str, Callable[..., Scanner]] = {"PCCT": presets.pcct, "EID-CT": presets.eid}
"""The paper's two scanners: name → preset, called with the number of views."""


def inset_grid(plaque: Plaque, voxel_mm: float) -> VolumeGrid:
    """The grid of the inset about a plaque at a voxel size."""
    z, y, x = INSET_MM
    # Never smaller than the inset: the protocol's image of 256 × 0.035 mm must fit in.
    shape = tuple(math.ceil(extent / voxel_mm - 1e-6) for extent in (z, y, x))
    px, py, pz = plaque.position
    return VolumeGrid(shape, voxel_mm, (pz, py, px))


def duty(scanner: Scanner, full_views: int) -> float:
    """Share of a view's time with the beam on: fewer views than ``full_views`` stand for the
    same scan, thinned out."""
    return min(1.0, scanner.geometry.views / full_views)


def equal_dose(scanner: Scanner) -> float:
    """Exposure of a scanner over that of the PCCT at equal dose: equal fluence at the isocentre.

    The spectrum in front of the patient is the same, so it falls with the square of the tube's
    distance."""
    return float((scanner.geometry.sod / presets.pcct(8).geometry.sod) ** 2)


@dataclass
class PlaqueScan:
    """A noise-free scan of the plaque, and FBP on all grids of a study.

    Attributes:
        clean: windowed about the inset.
        fine: grid of the reference image.
        grids, pairs: for every voxel size the grid and its two ROI means (core, fibrous).
        rois: the ROIs.
        fbp: on ``grids`` with the study's kernels.
    """

    clean: Scan
    fine: VolumeGrid
    grids: list[VolumeGrid]
    pairs: list[tuple[RoiMean, RoiMean]]
    rois: RoiPair
    fbp: InsetFbp

    def roi_means(self, volumes: Sequence[Tensor]) -> NDArray[np.float64]:
        """``(S, 2)`` HU, the two ROI means of what ``fbp`` gives: all grids and kernels, the
        grid varying slowest."""
        return np.array(
            [
                [float(roi(volume)) for roi in pair]
                for pair, grid in zip(self.pairs, volumes, strict=True)
                for volume in grid
            ]
        )


def prepare(
    kernels: Sequence[str],
    voxels_mm: Sequence[float],
    scene: tuple[Scene, Plaque],
    scanner: Scanner,
    full_views: int,
    progress: Callable[[float], None] | None = None,
    cache: StudyCache | None = None,
) -> PlaqueScan:
    """Simulate the noise-free scan of a plaque in its scene and place grids and ROIs; the scan
    is kept in ``cache``.

    Raises:
        ValueError: ROIs that come out empty; an inset outside the field of view.
    """
    bodies, plaque = scene
    grids = [inset_grid(plaque, v) for v in voxels_mm]
    fine = inset_grid(plaque, REFERENCE_VOXEL_MM)
    rois = place_rois(bodies, axial_grid(fine.center))
    region = enclosing([*grids, fine])
    on = duty(scanner, full_views)
    cache = cache or StudyCache(None, None)
    clean = cache(
        "scan", lambda: acquire(bodies, scanner, region=region, duty=on, progress=progress)
    )
    return PlaqueScan(
        clean, fine, grids, [rois.on(g) for g in grids], rois, InsetFbp(clean, grids, kernels)
    )


def reference_fbp(scan: Scan, grid: VolumeGrid, motion: ArrayLike | None = None) -> Tensor:
    """FBP with the reference kernel, ``(z, y, x)`` HU; ``motion``: of
    :class:`recon.analytic.inset.InsetFbp`."""
    return InsetFbp(scan, [grid], [REFERENCE_KERNEL], motion=motion)(scan)[0][0]


def enclosing(grids: list[VolumeGrid]) -> VolumeGrid:
    """One voxel as large as the largest of ``grids`` that share a centre."""
    extent = tuple(max(g.extent[a] for g in grids) for a in range(3))
    return VolumeGrid((1, 1, 1), extent, grids[0].center)


# --- what each tissue reads -----------------------------------------------------------------------


_ROWS = 12
"""Detector rows about the middle: more do not change what the middle slices read."""
_ROD_VIEWS = 60
"""Views per turn, likewise."""
_ROD_MM = 4.0
"""Diameter of the rod, mm."""
_LENGTH_MM = 8.0
"""Its length, mm."""
_READ_SLICES = 3
"""Slices that are read."""
_ROD_VOXEL_MM = 0.25
"""Voxel size, mm."""
_MARGIN_MM = 1.0
"""What is read keeps this far from the rod's edge: beyond the reach of every kernel's blur."""


def rod_values(
    scene: Scene,
    scanner: Scanner,
    position: tuple[float, ...],
    tissues: Mapping[str, Material | str],
) -> dict[str, float]:
    """True values of tissues: the HU of a rod of each at the plaque's place, tissue → HU.

    The true value of a tissue in HU is a matter of definition: it hinges on the spectrum that
    arrives behind the patient and on the scanner's water correction. A least-squares fit of all
    tissues to one scan of the plaque has to tell thin layers apart and moves by tens of HU with
    what it takes the fat for. A rod of the tissue alone, at the same place in the same patient, is
    large enough for the plateau of its FBP image (standard kernel) to be read directly: no fit, no
    edges, no noise.

    Rods of 3, 4 and 6 mm agree within 0.03 HU but for blood with iodine, which hardens its own beam
    and reads 1.2 HU less per mm of diameter: rods are about as thick as the vessel.

    Args:
        scene: its first body is the patient, a cylinder about the scanner's axis, which stays as it
            is.
        scanner: of the study; its views are thinned out.
        position: ``(x, y, ...)`` mm of the plaque, e.g. ``Plaque.position``.
        tissues: name → material.

    Raises:
        ValueError: a rod that leaves the patient, an unknown material.
    """
    g, radius = scanner.geometry, _ROD_MM / 2
    count = min(_ROD_VIEWS, g.views)
    x, y = (float(v) for v in position[:2])
    # The beam is on for as long as in one view of the whole scan.
    thinned = scanner.with_views(count)
    device = thinned.replace(geometry=replace(thinned.geometry, rows=min(g.rows, _ROWS)))
    region = VolumeGrid((1, 1, 1), (_LENGTH_MM + 0.5, _ROD_MM + 0.5, _ROD_MM + 0.5), (0.0, y, x))
    across = 2 * int((radius - _MARGIN_MM) / _ROD_VOXEL_MM) + 1
    grid = VolumeGrid((_READ_SLICES, across, across), _ROD_VOXEL_MM, (0.0, y, x))
    read = _disc(grid, radius - _MARGIN_MM)
    shape = EllipticCylinder(radius, _LENGTH_MM / 2, position=(x, y, 0.0))
    hu = {}
    for name, material in tissues.items():
        rod = Scene(
            [replace(scene.bodies[0], name="patient"), Body("rod", shape, material, "patient")]
        )
        scan = acquire(rod, device, region=region, duty=count / g.views)
        hu[str(name)] = float(reference_fbp(scan, grid).double().numpy()[read].mean())
    return hu


def _disc(grid: VolumeGrid, radius: float) -> NDArray[np.bool_]:
    y, x = (axis - c for axis, c in zip(grid.axes[1:], grid.center[1:], strict=True))
    inside = np.hypot(y[:, None], x) <= radius + 1e-9
    return np.broadcast_to(inside, grid.shape)


@dataclass(frozen=True, eq=False)
class Truth:
    """The plaque as it is, on the protocol's axial image through its middle.

    Attributes:
        image: the axial image, ``(1, y, x)``.
        masks: ``"lumen"`` and ``"core"`` → ``(y, x)`` bool, where they are.
        line: ``(y, x)`` mm of the lumen's and of the core's centre: the line on which the cap is
            measured.
    """

    image: VolumeGrid
    masks: dict[str, NDArray[np.bool_]]
    line: tuple[tuple[float, float], tuple[float, float]]

    @classmethod
    def of(cls, scene: Scene, plaque: Plaque) -> Truth:
        """Of a scene at rest and its plaque."""
        image = axial_grid(plaque.position[::-1])
        labels = scene.labels(image)[0]
        x, y, _, _ = (float(v) for v in plaque.section("lumen", 0.0))
        lumen, core = plaque.to_scanner((x, y, 0.0)), plaque.to_scanner(plaque.core_center)
        return cls(
            image,
            {name: labels == scene.index(name) for name in ("lumen", "core")},
            ((float(lumen[1]), float(lumen[0])), (float(core[1]), float(core[0]))),
        )


@dataclass(frozen=True, eq=False)
class PlaqueImage:
    """One axial image, and what is measured of it.

    Attributes:
        image: ``(y, x)`` HU.
        segmentation: of it.
        measures: JSON values: ``lumen_mm2``, ``core_mm2``: areas; ``core_found``; ``cap_line_mm``:
            cap thickness on the line from the lumen's to the core's centre, NaN where there is no
            lumen; ``lumen_dice``, ``core_dice``: overlap of the segmented regions with the true
            ones; ``basin_depth_hu``: of the core's basin
            (:func:`torchpcct.metrics.plaque_measures.basin_depth`); and what a study adds.
    """

    image: Tensor
    segmentation: PlaqueSegmentation
    measures: JsonObject

    def __getitem__(self, name: str) -> Any:
        return self.measures[name]


def measure_plaque(image: Tensor, truth: Truth, **more: object) -> PlaqueImage:
    """Segment and measure an axial image ``(y, x)`` HU on ``truth.image``; ``more``: measures of
    the study's own."""
    found = segment_plaque(image, truth.image)
    measures = {
        "lumen_mm2": found.lumen_area,
        "core_found": found.core_found,
        "core_mm2": found.core_area,
        "cap_line_mm": cap_on_line(image, truth.image, *truth.line),
        "lumen_dice": dice(found.lumen, truth.masks["lumen"]),
        "core_dice": dice(found.core, truth.masks["core"]),
        "basin_depth_hu": basin_depth(image, truth.image, truth.masks["core"]),
    }
    return PlaqueImage(image, found, {**more, **measures})
