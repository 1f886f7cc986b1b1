"""From a scene and a scanner to a scan: bodies → plan → expected readings → what the detector records → noise."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpcct.acquisition.bodies import Bodies
from torchpcct.acquisition.detection import detected, signal_spectra
from torchpcct.acquisition.plan import Plan, make_plan
from torchpcct.acquisition.transmission import SUB_RAY_COUNTS, Beam, expected_readings
from torchpcct.acquisition.transmission import sub_rays as sub_rays_of
from torchpcct.acquisition.voxels import acquire_voxels
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan, check_exposure
from torchpcct.scanner.scanner import Scanner
from torchpcct.scene.scene import Scene
from torchpcct.scene.voxels import VoxelScene
from torchpcct.validate import checked, whole

__all__ = ["acquire", "plan"]

log = logging.getLogger(__name__)

VIEWS_AT_A_TIME = 64
"""Views whose readings are computed, and kept, together."""


def plan(
    scene: Scene,
    scanner: Scanner,
    *,
    region: VolumeGrid | None = None,
    rotation_s: float | None = None,
    duty: float = 1.0,
    tolerance_hu: float = 0.5,
    sub_rays: int | None = None,
) -> Plan:
    """What :func:`acquire` would do with the same arguments: effects, errors in HU, time and memory."""
    return make_plan(Bodies.of(scene, scanner.geometry, rotation_s, duty), scanner, region, tolerance_hu, sub_rays)


@checked
def acquire(
    scene: Scene | VoxelScene,
    scanner: Scanner,
    *,
    exposure_s: float | None = None,
    seed: int = 0,
    region: VolumeGrid | None = None,
    rotation_s: float | None = None,
    duty: float = 1.0,
    tolerance_hu: float = 0.5,
    sub_rays: int | None = None,
    progress: Callable[[float], None] | None = None,
    keep: Callable[[str, Callable[[], Tensor]], Tensor] | None = None,
) -> Scan:
    """Simulate a scan: exact chords, polychromatic, finite focal spot, cells and views, quantum noise.

    Args:
        scene: nested analytic bodies (mm), or a voxel volume, of which the whole detector is computed without the blur
            of focal spot and turning gantry; none of the arguments after ``seed`` applies to it but ``progress``.
        scanner: source, filters, bowtie, detector and geometry.
        exposure_s: duration of the (one-turn) scan in s at the source's current; None: expected readings.
        seed: realisation of the noise, ≥ 0. A reading's noise depends on the seed and its place alone.
        region: keep only the readings around this grid's footprint (the rest of the detector then reads the
            rotationally symmetric bodies, noise free). All other bodies must lie inside.
        rotation_s: time of one turn in s, for moving scenes; None: ``exposure_s``.
        duty: share of each view's time with the beam on: 1 continuous, → 0 pulsed (no blur by the gantry's turn).
        tolerance_hu: effects of the beam that would change less than this are left out (see :func:`plan`).
        sub_rays: number of beam samples a reading; None: as many as an error of 1e-3 of the peak needs.
        progress: called with the finished fraction, 0…1.
        keep: called with a name and what computes it for every block of views, returns its readings: computed, or
            those that it kept of an interrupted simulation with the same arguments. None: nothing is kept.

    Returns:
        :class:`torchpcct.Scan`; counts float32. Of an energy-integrating detector: signals in keV, with the second
        moment of the transmitted spectrum in ``quantum``, exact for every reading.

    Raises:
        ValueError: ``exposure_s`` ≤ 0, a bad seed, bodies outside ``region``, a region outside the field of view, a
            moving scene without ``rotation_s``, a ``duty`` outside (0, 1], ``tolerance_hu`` below 0 or NaN.
        TypeError: an argument of the wrong kind.
    """
    check_exposure(exposure_s)
    seed = whole("seed", seed, low=0)
    if isinstance(scene, VoxelScene):
        if region is not None or rotation_s is not None or sub_rays is not None or duty != 1.0:
            raise ValueError("a voxel volume is scanned whole, at rest: leave out region, rotation_s, duty, sub_rays")
        clean = acquire_voxels(scene, scanner, progress=progress)
        return clean if exposure_s is None else clean.with_noise(exposure_s, seed)
    start = time.perf_counter()
    g = scanner.geometry
    bodies = Bodies.of(scene, g, exposure_s if rotation_s is None else rotation_s, duty)
    plan_ = make_plan(bodies, scanner, region, tolerance_hu, sub_rays)
    log.info("%s", plan_.table())
    energies, spectra, air = signal_spectra(scanner)
    beam = Beam(spectra, scanner.row_factor, scanner.source.focal_spot, plan_.points)
    # One view for all: the densest sampling of every effect costs nothing here.
    dense, one = beam._replace(points=sub_rays_of(SUB_RAY_COUNTS[-1])), g.select([0])
    symmetric, step = bodies.symmetric(energies, one), np.array([bodies.view_step])
    surround = expected_readings(one, DetectorWindow.full(one), symmetric, dense, step).numpy()[:, 0]
    counts = _readings(plan_, bodies, scanner, energies, beam, surround, progress, keep or _computed)
    info = {
        "scanner": scanner.name,
        "scene": list(scene.names),
        "plan": plan_.as_dict(),
        "seconds": round(time.perf_counter() - start, 2),
    }
    kept = None if plan_.kept is None else surround
    scan = detected(scanner, counts, air, energies, info, kept, plan_.kept)
    return scan if exposure_s is None else scan.with_noise(exposure_s, seed)


def _computed(_: str, compute: Callable[[], Tensor]) -> Tensor:
    return compute()


def _readings(
    plan_: Plan, bodies: Bodies, scanner: Scanner, energies: Any, beam: Beam, surround: Any, progress: Any, keep: Any
) -> Tensor:
    """Expected readings ``(bins, views, rows, columns)`` of the kept cells, float32."""
    g, active = scanner.geometry, plan_.active
    kept = plan_.kept or DetectorWindow.full(g)
    out = torch.empty((len(surround), *kept.shape), dtype=torch.float32)
    background = torch.from_numpy(surround.astype(np.float32))

    def near(views: slice) -> Tensor:
        """What the bodies inside the region change, of the active cells."""
        assert active is not None
        part, step = g.select(views), np.full(views.stop - views.start, bodies.view_step)
        found = expected_readings(part, active.select(views), bodies.at(energies, part), beam, step, surround)
        return found.to(torch.float32)

    for v0 in range(0, g.views, VIEWS_AT_A_TIME):
        views = slice(v0, min(v0 + VIEWS_AT_A_TIME, g.views))
        out[:, views] = background[:, None] if plan_.kept is None else kept.select(views).take(background)
        if active is not None:
            values = keep(f"views_{views.start}-{views.stop}", partial(near, views))
            rows = slice(active.first_row - kept.first_row, active.first_row - kept.first_row + active.rows)
            for i, v in enumerate(range(views.start, views.stop)):
                first = int(active.first_column[v] - kept.first_column[v])
                low, high = max(first, 0), min(first + active.columns, kept.columns)
                out[:, v, rows, low:high] = values[:, i, :, low - first : high - first]
        if progress is not None:
            progress(views.stop / g.views)
    return out
