"""From a scene and a scanner to a scan: bodies → plan → expected readings → what the detector
records → noise."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchpcct.acquisition.bodies import Bodies
from torchpcct.acquisition.kept import MOST_BYTES, KnownReadings, fingerprint, recall, remember
from torchpcct.acquisition.plan import Plan, make_plan
from torchpcct.acquisition.spectra import signal_spectra
from torchpcct.acquisition.transmission import SUB_RAY_COUNTS, Beam, compress, expected_readings
from torchpcct.acquisition.transmission import sub_rays as sub_rays_of
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam, VolumeGrid
from torchpcct.projector import Projector
from torchpcct.scan import Scan, check_exposure
from torchpcct.scanner.scanner import Scanner
from torchpcct.scene.scene import Scene
from torchpcct.scene.voxels import VoxelScene
from torchpcct.validate import checked, whole

if TYPE_CHECKING:
    from torchpcct.typing import Floats


__all__ = ["acquire", "acquire_voxels"]

_TOLERANCE = 1e-5
"""Error of a line integral over a metre of body by the number of basis maps."""
_DENSEST_GAS = 0.02
"""Density in g/cm³ up to which a material is a gas: radon has 0.01."""
_SUB_COLUMNS = 2
"""Parts of a cell whose transmissions are averaged: a cell records the mean of the photons, not
of the path lengths."""
_LEFT_OUT = (
    "focal spot, gantry turn during a view, scatter; voxels are uniform, and edges as "
    "coarse as they are"
)
"""What is not simulated of a scene of voxels, for its plan."""
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
    """What :func:`acquire` would do with the same arguments: effects, errors in HU, time and
    memory."""
    return make_plan(
        Bodies.of(scene, scanner.geometry, rotation_s, duty),
        scanner,
        region,
        tolerance_hu,
        sub_rays,
    )


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
    """Simulate a scan: exact chords, polychromatic, finite focal spot, cells and views, quantum
    noise.

    Args:
        scene: nested analytic bodies (mm), or a voxel volume, of which the whole detector is
            computed without the blur of focal spot and turning gantry; none of the arguments after
            ``seed`` applies to it but ``progress``.
        scanner: source, filters, bowtie, detector and geometry.
        exposure_s: duration of the (one-turn) scan in s at the source's current; None: expected
            readings.
        seed: realisation of the noise, ≥ 0. A reading's noise depends on the seed and its place
            alone.
        region: keep only the readings around this grid's footprint (the rest of the detector then
            reads the rotationally symmetric bodies, noise free), in all rows. All other bodies must
            lie inside as they are seen along z. They may go on beyond its slices: FBP of any slices
            is right, PWLS and MBIR need a grid whose slices hold them, and warn of one whose do
            not.
        rotation_s: time of one turn in s, for moving scenes; None: ``exposure_s``.
        duty: share of each view's time with the beam on: 1 continuous, → 0 pulsed (no blur by the
            gantry's turn).
        tolerance_hu: effects of the beam that would change less than this are left out (see
            :func:`plan`).
        sub_rays: number of beam samples a reading; None: as many as an error of 1e-3 of the peak
            needs.
        progress: called with the finished fraction, 0…1.
        keep: called with a name and what computes it for every block of views, returns its
            readings: computed, or those that it kept of an interrupted simulation with the same
            arguments. None: they stay in memory, as far as they are small, and another seed or
            exposure of the same scene costs its noise alone
            (:func:`torchpcct.acquisition.kept.forget_readings` releases them).

    Returns:
        :class:`torchpcct.Scan`; counts float32. Of an energy-integrating detector: signals in keV,
        with the second moment of the transmitted spectrum in ``quantum``, exact for every reading.

    Raises:
        ValueError: ``exposure_s`` ≤ 0, a bad seed, a body that reaches the tube or the detector,
            bodies outside ``region``, a region outside the
            field of view, a moving scene without ``rotation_s``, a ``duty`` outside (0, 1],
            ``tolerance_hu`` below 0 or NaN.
        TypeError: an argument of the wrong kind.
    """
    check_exposure(exposure_s)
    seed = whole("seed", seed, low=0)
    if isinstance(scene, VoxelScene):
        if region is not None or rotation_s is not None or sub_rays is not None or duty != 1.0:
            raise ValueError(
                "a voxel volume is scanned whole, at rest: leave out region, rotation_s, duty, "
                "sub_rays"
            )
        clean = acquire_voxels(scene, scanner, progress=progress)
        return clean if exposure_s is None else clean.with_noise(exposure_s, seed)
    _require_outside(scene, scanner.geometry)
    start = time.perf_counter()
    turn_s = exposure_s if rotation_s is None else rotation_s
    key = readings_key(
        scene,
        scanner,
        region=region,
        rotation_s=turn_s,
        duty=duty,
        tolerance_hu=tolerance_hu,
        sub_rays=sub_rays,
    )
    known = recall(key)
    g = scanner.geometry
    bodies = Bodies.of(scene, g, turn_s, duty)
    if known is None:
        plan_ = make_plan(bodies, scanner, region, tolerance_hu, sub_rays)
    else:
        plan_ = known.plan
    log.info("%s", plan_.table())
    energies, _, air = signal_spectra(scanner)
    used = energies[plan_.nodes.indices]
    beam = Beam(plan_.nodes.spectra, scanner.row_factor, scanner.source.focal_spot, plan_.points)
    if known is None:
        # One view for all: the densest sampling of every effect costs nothing here.
        dense, one = beam._replace(points=sub_rays_of(SUB_RAY_COUNTS[-1])), g.select([0])
        symmetric, step = bodies.symmetric(used, one), np.array([bodies.view_step])
        seen = expected_readings(one, DetectorWindow.full(one), symmetric, dense, step)
        known = KnownReadings(plan_, seen.numpy()[:, 0], {})
    exterior = known.exterior
    counts = _readings(plan_, bodies, scanner, used, beam, known, progress, keep or _computed)
    remember(key, known)
    info = {
        "scanner": scanner.name,
        "scene": list(scene.names),
        "plan": plan_.as_dict(),
        "seconds": round(time.perf_counter() - start, 2),
    }
    kept = None if plan_.kept is None else exterior
    scan = detected(scanner, counts, air, energies, info, kept, plan_.kept)
    scan = scan if plan_.kept is None else replace(scan, region=region)
    return scan if exposure_s is None else scan.with_noise(exposure_s, seed)


def _require_outside(scene: Scene, geometry: ConeBeam) -> None:
    """Refuse (ValueError) a tube or a detector within a body: chords are those of whole lines, as
    if both were outside. Gases may be all around."""
    radial = np.stack(
        [np.cos(geometry.angles), np.sin(geometry.angles), 0.0 * geometry.angles], axis=1
    )
    for what, distance in (("tube", geometry.sod), ("detector", geometry.sod - geometry.sdd)):
        inside = scene.labels(distance * radial)
        for k in np.unique(inside[inside >= 0]):
            if scene.materials[k].density_g_cm3 > _DENSEST_GAS:
                raise ValueError(
                    f"the body {scene.names[k]!r} reaches the {what}, {abs(distance):g} mm from "
                    "the axis: are scene and scanner in mm?"
                )


def readings_key(scene: Scene, scanner: Scanner, **options: object) -> str | None:
    """Names the expected readings of :func:`acquire` with these arguments: seed and exposure do
    not belong to them, unless the scene moves and ``rotation_s`` is that of the exposure."""
    if scene.is_static:
        options["rotation_s"] = None
    return fingerprint(scene, scanner, sorted(options.items()))


def _computed(_: str, compute: Callable[[], Tensor]) -> Tensor:
    return compute()


def _readings(
    plan_: Plan,
    bodies: Bodies,
    scanner: Scanner,
    energies: Floats,
    beam: Beam,
    known: KnownReadings,
    progress: Callable[[float], None] | None,
    keep: Callable[[str, Callable[[], Tensor]], Tensor],
) -> Tensor:
    """Expected readings ``(bins, views, rows, columns)`` of the kept cells, float32; those of the
    varying bodies join what is ``known``."""
    g, active, exterior = scanner.geometry, plan_.active, known.exterior
    kept = plan_.kept or DetectorWindow.full(g)
    out = torch.empty((len(exterior), *kept.shape), dtype=torch.float32)
    background = torch.from_numpy(exterior.astype(np.float32))

    def near(views: slice) -> Tensor:
        """What the bodies inside the region change, of the active cells."""
        assert active is not None
        part, step = g.select(views), np.full(views.stop - views.start, bodies.view_step)
        found = expected_readings(
            part, active.select(views), bodies.at(energies, part), beam, step, exterior
        )
        return found.to(torch.float32)

    for v0 in range(0, g.views, VIEWS_AT_A_TIME):
        views = slice(v0, min(v0 + VIEWS_AT_A_TIME, g.views))
        out[:, views] = (
            background[:, None] if plan_.kept is None else kept.select(views).take(background)
        )
        if active is not None:
            name = f"views_{views.start}-{views.stop}"
            values = known.blocks.get(name)
            if values is None:
                values = keep(name, partial(near, views))
                if known.bytes + values.nbytes <= MOST_BYTES:
                    known.blocks[name] = values
            rows = slice(
                active.first_row - kept.first_row, active.first_row - kept.first_row + active.rows
            )
            for i, v in enumerate(range(views.start, views.stop)):
                first = int(active.first_column[v] - kept.first_column[v])
                low, high = max(first, 0), min(first + active.columns, kept.columns)
                out[:, v, rows, low:high] = values[:, i, :, low - first : high - first]
        if progress is not None:
            progress(views.stop / g.views)
    return out


def acquire_voxels(
    scene: VoxelScene, scanner: Scanner, *, progress: Callable[[float], None] | None = None
) -> Scan:
    """The noise-free scan of a voxel volume, whole detector; called by :func:`torchpcct.acquire`.

    The attenuation of all tissues at all energies is compressed to a few basis maps
    (:func:`~torchpcct.acquisition.transmission.compress`), which the distance-driven projector
    integrates over parts of each cell; the polychromatic transmission is exact from there.

    Args:
        scene: tissues in voxels.
        scanner: what scans it.
        progress: called with the finished fraction.

    Raises:
        ValueError: a source inside the grid.
    """
    start = time.perf_counter()
    g: ConeBeam = scanner.geometry
    energies, spectra, air = signal_spectra(scanner)
    scene = scene.read_by(energies, spectra[: scanner.detector.bins, g.columns // 2].sum(0))
    coefficients, basis = compress(scene.contrast(energies), tolerance=_TOLERANCE)
    maps = torch.from_numpy(scene.mixed(coefficients))
    fine = replace(
        g, columns=g.columns * _SUB_COLUMNS, pitch=(g.pitch[0], g.pitch[1] / _SUB_COLUMNS)
    )
    # (bins, columns, energies)
    weight = torch.from_numpy((spectra / _SUB_COLUMNS).astype(np.float32))
    bins = weight.shape[0]
    rows = torch.from_numpy(np.asarray(scanner.row_factor, dtype=np.float32))
    spectrum = torch.from_numpy(basis.astype(np.float32))
    counts = torch.empty((bins, *g.shape), dtype=torch.float32)
    block = max(1, min(g.views, 2**24 // (max(len(basis), 1) * g.rows * fine.columns)))
    for v0 in range(0, g.views, block):
        part = fine.select(slice(v0, min(v0 + block, g.views)))
        lines = Projector(part, scene.grid)(maps)  # (rank, views, rows, fine columns)
        for v in range(part.views):
            counts[:, v0 + v] = _voxel_readings(lines[:, v], spectrum, weight) * rows[:, None]
        if progress is not None:
            progress((v0 + part.views) / g.views)
    info = {
        "scanner": scanner.name,
        "scene": list(scene.names),
        "plan": {
            "basis_maps": len(basis),
            "sub_columns": _SUB_COLUMNS,
            "left_out": _LEFT_OUT,
            "clipped": scene.clipped,
            "above_muscle": scene.above_muscle,
        },
        "seconds": round(time.perf_counter() - start, 2),
    }
    return detected(scanner, counts, air, energies, info)


def _voxel_readings(lines: Tensor, spectrum: Tensor, weight: Tensor) -> Tensor:
    """``(bins, rows, columns)`` of one view: ``lines (rank, rows, columns · sub)``, ``spectrum
    (rank, energies)``."""
    out = lines.new_empty((weight.shape[0], lines.shape[1], weight.shape[1]))
    for r in range(lines.shape[1]):
        transmitted = torch.exp(-(lines[:, r].T @ spectrum))  # (columns · sub, energies)
        cells = transmitted.view(-1, _SUB_COLUMNS, spectrum.shape[1]).sum(1)
        out[:, r] = (weight * cells).sum(-1)
    return out


def detected(
    scanner: Scanner,
    counts: Tensor,
    air: Floats,
    energies: Floats,
    info: dict[str, object],
    exterior: Floats | None = None,
    window: DetectorWindow | None = None,
) -> Scan:
    """The noise-free scan of expected readings, with what the detector makes of them.

    Args:
        scanner: whose detector it is.
        counts: ``(bins, views, rows, columns)`` float32, the bins of :func:`signal_spectra`;
            overwritten, as the readings of a whole detector are large.
        air, exterior: ``(bins, rows, columns)``; exterior None: of a scan without window.
        energies: ``(E,)`` keV.
        info: of the scan.
        window: the part of the detector that ``counts`` hold; None: all of it.
    """
    g, detector, bins = scanner.geometry, scanner.detector, scanner.detector.bins
    bare = torch.from_numpy(np.array(air))
    behind = None if exterior is None else torch.from_numpy(np.array(exterior))
    pile_up = scanner.pile_up()
    if pile_up is not None:
        kept, cells, columns = window or DetectorWindow.full(g), bare, np.arange(g.columns)
        part = cells[:, kept.first_row : kept.first_row + kept.rows]
        for v, seen in enumerate(kept.column_indices):
            counts[:, v] = pile_up.apply(counts[:, v], part[..., torch.from_numpy(seen)], seen)
        bare = pile_up.apply(cells, cells, columns)
        behind = None if behind is None else pile_up.apply(behind, cells, columns)
    quantum = None
    if detector.energy_integrating:
        dark = counts[:bins] <= 0  # behind a perfect absorber any energy will do
        quantum = counts[bins:].div_(counts[:bins]).masked_fill_(dark, float(energies[-1]))

    def of_bins(values: Tensor) -> Tensor:
        return (values[0] if bins == 1 else values[:bins]).to(torch.float32)

    return Scan(
        counts=of_bins(counts),
        air=of_bins(bare),
        geometry=g,
        linearisation=scanner.water_linearisation(),
        window=window,
        exterior=None if behind is None else of_bins(behind),
        counting=not detector.energy_integrating,
        info=info,
        quantum=None if quantum is None else of_bins(quantum),
        electronic_noise=detector.electronic_noise if detector.energy_integrating else 0.0,
    )


log = logging.getLogger(__name__)
