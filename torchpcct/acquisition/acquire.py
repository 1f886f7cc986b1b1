"""From a scene and a scanner to a scan."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchpcct.acquisition.plan import Plan, active_window, make_plan
from torchpcct.acquisition.transmission import SUB_RAY_COUNTS, Beam, BodySet, expected_readings
from torchpcct.acquisition.transmission import sub_rays as sub_rays_of
from torchpcct.detector_window import DetectorWindow, shadow
from torchpcct.geometry import ConeBeam, VolumeGrid
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan, check_exposure
from torchpcct.scanner.pileup import PileUpMap

if TYPE_CHECKING:
    from collections.abc import Callable

    from torchpcct.scanner import Scanner
    from torchpcct.scene import Scene

__all__ = ["NOISE_MARGIN_COLUMNS", "acquire", "plan"]

log = logging.getLogger(__name__)

NOISE_MARGIN_COLUMNS = 128
"""Columns kept on either side of a region's shadow. The ramp filter reaches further, but its tail falls as 1 / n²:
noise beyond 128 columns adds less than 1 % to the spectrum of the filtered noise at the lowest frequency that a
1 mm ROI can tell from zero."""


_ENDLESS_MM = 1e5
"""Where an endless body is cut for the bookkeeping of windows: far beyond any scanner."""


class _Builder:
    """Packs a scene's bodies for the kernel: those that differ between views first, the rotationally symmetric last."""

    def __init__(self, scene: Scene, rotation_s: float | None) -> None:
        from torchpcct.scene.chords import pack

        shapes = [body.shape for body in scene.bodies]
        moving = scene.moving
        symmetric = np.array([s.rotationally_symmetric and not m for s, m in zip(shapes, moving, strict=True)])
        # A moving body leads: the circle around the varying bodies moves with the first of them.
        order = np.lexsort((np.arange(len(shapes)), ~np.array(moving), symmetric))
        self.scene, self.order, self.rotation_s = scene, order, rotation_s
        self.varying = int((~symmetric).sum())
        self.kinds, self.params = pack([shapes[i] for i in order])
        boxes = np.array([shapes[i].bounding_box for i in order])  # (bodies, 2, 3)
        boxes = np.clip(boxes[: self.varying] if self.varying else boxes, -_ENDLESS_MM, _ENDLESS_MM)
        self.low, self.high = boxes[:, 0].min(0), boxes[:, 1].max(0)
        self.moving = bool(np.any(moving))
        if self.moving and rotation_s is None:
            raise ValueError("the scene moves: give rotation_s, the time of one turn in s (or exposure_s)")
        mixed = self.moving and not all(moving[i] for i in order[: self.varying])
        size = np.linalg.norm((self.high - self.low)[:2]) / 2
        # Bodies that move beside bodies that do not have no common circle.
        self.circle = (*((self.low + self.high) / 2)[:2], np.inf if mixed else size)
        if self.moving:
            travel = np.abs(scene.offsets(np.linspace(0, float(rotation_s or 0), 256))).max((0, 1))
            self.low, self.high = self.low - travel, self.high + travel

    def __call__(
        self, energies: Any, geometry: ConeBeam, *, empty: bool = False, still: bool = False, symmetric: bool = False
    ) -> BodySet:
        """Bodies at ``energies``; ``empty`` or ``symmetric``: only the rotationally symmetric ones."""
        keep = slice(self.varying if empty or symmetric else 0, None)
        order = self.order[keep]
        contrast = self.scene.contrast(energies)[order]
        views = geometry.views
        offsets = np.zeros((len(order), views, 3))
        drift = np.zeros_like(offsets)
        if self.moving and not still and not empty and not symmetric:
            turn = float(self.rotation_s or 0)
            times = (geometry.angles - self.first_angle) / (2 * np.pi) * turn
            half = self.view_step / (2 * np.pi) * turn / 2
            offsets = self.scene.offsets(times)[order]
            drift = (self.scene.offsets(times + half) - self.scene.offsets(times - half))[order]
        circle = self.circle if len(order) == len(self.order) else (0.0, 0.0, np.inf)
        return BodySet(
            self.kinds[keep], self.params[keep], contrast, np.ascontiguousarray(offsets),
            np.ascontiguousarray(drift), tuple(float(v) for v in circle),  # type: ignore[arg-type]
        )  # fmt: skip

    first_angle = 0.0
    view_step = 0.0


def _prepare(
    scene: Scene, scanner: Scanner, region: VolumeGrid | None, rotation_s: float | None, duty: float,
    tolerance_hu: float, sub_rays: int | None,
) -> tuple[_Builder, Plan, float]:  # fmt: skip
    if not 0 < duty <= 1:
        raise ValueError(f"duty must lie in (0, 1], the share of a view's time with the beam on, got {duty}")
    g = scanner.geometry
    build = _Builder(scene, rotation_s)
    steps = np.diff(g.angles)
    view_step = duty * float(np.median(np.abs(steps))) if steps.size else 0.0
    build.first_angle, build.view_step = float(g.angles[0]), view_step
    kept = None
    if region is not None:
        active = active_window(g, build.low, build.high) if build.varying else None
        kept = shadow(g, region, margin=NOISE_MARGIN_COLUMNS)
        kept = DetectorWindow(kept.first_column, kept.columns, 0, g.rows)
        if active is not None:
            inside = (active.first_column + 4 >= kept.first_column) & (
                active.first_column + active.columns - 4 <= kept.first_column + kept.columns
            )
            if not inside.all():
                raise ValueError(
                    "region does not hold all bodies that differ between views (box "
                    f"{np.round(build.low, 1)} … {np.round(build.high, 1)} mm): enlarge it, or acquire without region"
                )
    plan_ = make_plan(
        scene, scanner, build, (build.low, build.high), kept, view_step, tolerance_hu, sub_rays,
        moving=build.moving, invariant=build.varying == 0,
    )  # fmt: skip
    return build, plan_, view_step


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
    return _prepare(scene, scanner, region, rotation_s, duty, tolerance_hu, sub_rays)[1]


def acquire(
    scene: Scene,
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
) -> Scan:
    """Simulate a scan: exact chords, polychromatic, finite focal spot, cells and views, quantum noise.

    Args:
        scene: nested analytic bodies (mm).
        scanner: source, filters, bowtie, detector and geometry.
        exposure_s: duration of the (one-turn) scan in s at the source's current; None: expected readings.
        seed: realisation of the noise, ≥ 0. A reading's noise depends on the seed and its place alone.
        region: keep only the readings around this grid's shadow (the rest of the detector then reads the
            rotationally symmetric bodies, noise free). All other bodies must lie inside.
        rotation_s: time of one turn in s, for moving scenes; None: ``exposure_s``.
        duty: share of each view's time with the beam on: 1 continuous, → 0 pulsed (no blur by the gantry's turn).
        tolerance_hu: effects of the beam that would change less than this are left out (see :func:`plan`).
        sub_rays: number of beam samples a reading; None: as many as an error of 1e-3 of the peak needs.
        progress: called with the finished fraction, 0…1.

    Returns:
        :class:`torchpcct.Scan`; counts float32. Of an energy-integrating detector: signals in keV, with the second
        moment of the transmitted spectrum in ``quantum``, exact for every reading.

    Raises:
        ValueError: ``exposure_s`` ≤ 0, a bad seed, bodies outside ``region``, a region outside the field of view, a
            moving scene without ``rotation_s``.
    """
    check_exposure(exposure_s)
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"seed must be a whole number ≥ 0, got {seed!r}")
    start = time.perf_counter()
    build, plan_, view_step = _prepare(
        scene, scanner, region, rotation_s if rotation_s is not None else exposure_s, duty, tolerance_hu, sub_rays
    )
    log.info("%s", plan_.table())
    g = scanner.geometry
    energies, spectra = scanner.weights()
    bins, integrating = scanner.detector.bins, scanner.detector.energy_integrating
    if integrating:
        # The variance is one more "bin": the same transmission, weighted by the squared signal.
        spectra = np.concatenate([spectra, scanner.noise_weights()[1]])
    spectra = spectra * scanner.mas_per_view(NOISE_FREE_EXPOSURE_S)
    air = np.einsum("bce,r->brc", spectra, scanner.row_factor)
    step = np.full(g.views, view_step)
    one = g.select([0])
    whole = DetectorWindow([0], g.columns, 0, g.rows)
    beam = Beam(spectra, scanner.row_factor, scanner.source.focal_spot, plan_.points)
    if build.varying == len(build.order):
        surround = np.broadcast_to(air, air.shape)
    else:
        symmetric = build(energies, one, symmetric=True)
        # One view for all: the densest sampling of every effect costs nothing here.
        dense = beam._replace(points=sub_rays_of(SUB_RAY_COUNTS[-1]))
        surround = expected_readings(one, whole, symmetric, dense, step[:1]).numpy()[:, 0]
    counts = _readings(plan_, g, build, energies, beam, step, surround, progress)
    pile_up = scanner.pile_up()
    if pile_up is not None:
        counts, air, surround = _recorded(pile_up, counts, air, surround, plan_.kept)
    quantum = None
    if integrating:
        # In place: the readings of a whole detector are large. Behind a perfect absorber any energy will do.
        dark = counts[:bins] <= 0
        quantum = counts[bins:].div_(counts[:bins]).masked_fill_(dark, float(energies[-1]))

    def squeezed(t: Tensor) -> Tensor:
        return t[0] if bins == 1 else t[:bins]

    def tensor(values: Any) -> Tensor:
        return squeezed(torch.from_numpy(np.array(values, dtype=np.float32)))

    scan = Scan(
        counts=squeezed(counts),
        air=tensor(air),
        geometry=g,
        linearisation=scanner.water_linearisation(),
        window=plan_.kept,
        surround=None if plan_.kept is None else tensor(surround),
        counting=not integrating,
        info={
            "scanner": scanner.name,
            "scene": list(scene.names),
            "plan": plan_.as_dict(),
            "seconds": round(time.perf_counter() - start, 2),
        },
        quantum=None if quantum is None else squeezed(quantum),
        electronic_noise=scanner.detector.electronic_noise if integrating else 0.0,
    )
    return scan if exposure_s is None else scan.with_noise(exposure_s, int(seed))


def _recorded(
    pile_up: PileUpMap, counts: Tensor, air: Any, surround: Any, kept: DetectorWindow | None
) -> tuple[Tensor, Any, Any]:
    """What a detector with dead time records of the expected counts: readings, air, surround."""
    cells = torch.from_numpy(np.array(air))
    columns = np.arange(air.shape[-1])
    for v in range(counts.shape[1]):
        part = cells if kept is None else cells[:, kept.first_row : kept.first_row + kept.rows]
        seen = columns if kept is None else kept.column_indices[v]
        counts[:, v] = pile_up.apply(counts[:, v], part[..., torch.from_numpy(seen)], seen)
    recorded = pile_up.apply(cells, cells, columns).numpy()
    return counts, recorded, pile_up.apply(torch.from_numpy(np.array(surround)), cells, columns).numpy()


def _readings(
    plan_: Plan, g: ConeBeam, build: _Builder, energies: Any, beam: Beam, step: Any, surround: Any, progress: Any
) -> Tensor:
    """Expected readings ``(bins, views, rows, columns)`` of the kept cells, float32."""
    kept = plan_.kept or DetectorWindow(np.zeros(g.views, np.int64), g.columns, 0, g.rows)
    bins = surround.shape[0]
    out = torch.empty((bins, g.views, kept.rows, kept.columns), dtype=torch.float32)
    background = torch.from_numpy(surround.astype(np.float32))[:, kept.first_row : kept.first_row + kept.rows]
    block = 64
    for v0 in range(0, g.views, block):
        views = slice(v0, min(v0 + block, g.views))
        columns = kept.column_indices[views]
        if plan_.kept is None:
            out[:, views] = background[:, None]
        else:
            out[:, views] = background[:, :, torch.from_numpy(columns)].movedim(2, 1)
        if plan_.active is not None:
            a = plan_.active
            window = DetectorWindow(a.first_column[views], a.columns, a.first_row, a.rows)
            part = g.select(views)
            values = expected_readings(part, window, build(energies, part), beam, step[views], surround)
            values = values.to(torch.float32)
            for i, v in enumerate(range(views.start, views.stop)):
                first = int(a.first_column[v] - kept.first_column[v])
                low, high = max(first, 0), min(first + a.columns, kept.columns)
                rows = slice(a.first_row - kept.first_row, a.first_row - kept.first_row + a.rows)
                out[:, v, rows, low:high] = values[:, i, :, low - first : high - first]
        if progress is not None:
            progress(views.stop / g.views)
    return out
