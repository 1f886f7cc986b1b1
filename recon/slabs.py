"""Volumes larger than memory: a scan is read, filtered and backprojected slab by slab along z, each
written at once.

Of a cone beam a slab needs the detector rows of its footprint, of a stack of parallel or fan-beam
slices those slices. What decides about the whole (whether the rows end inside the object, how many
readings are dead) is found in a first pass over the scan; every slab then gets the same bits as in
one piece. Slabs do not need each other, so that the workers of :mod:`recon.jobs.execute` may
make them, each within the limit.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import logging
import math
import os
import pickle
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict, Unpack

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.analytic.angular_weights import angular_weights
from recon.analytic.coverage import check_rows, consistency_warnings, sampling_warnings, view_notes
from recon.analytic.detector_edges import ends_cut_off, row_ends
from recon.analytic.fbp import FbpPlan
from recon.api import reconstruct, require_light
from recon.jobs import execute
from recon.jobs.sources import source_digest
from recon.jobs.store import Store
from recon.least_squares.memory import pwls_bytes, resident_bytes
from recon.least_squares.qggmrf import QGGMRF
from recon.metal import metal_warnings
from recon.names import METHODS
from torchpcct.checks.defects import (
    DefectiveCells,
    cell_sums,
    dark_views,
    is_repaired,
    photon_and_light,
    repair_defects,
    wrong_cells,
)
from torchpcct.checks.readings import reading_warnings
from torchpcct.detector_window import DetectorWindow
from torchpcct.devices import available_bytes
from torchpcct.formats.scans import adapted, open_scan, own_options
from torchpcct.formats.volume_slabs import CHUNK, SlabFile, check_slab_name
from torchpcct.geometry import Geometry, VolumeGrid, beam
from torchpcct.projector import Projector
from torchpcct.readings import MOST_DEAD
from torchpcct.scan import Scan
from torchpcct.scan_file import NoSlicesError
from torchpcct.scan_grid import finite_cells, grid_of
from torchpcct.validate import checked, choice, memory_bytes
from torchpcct.volume import from_hu, to_hu

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from torchpcct.typing import Array, JsonObject


__all__ = ["ScanSlices", "SlabPlan", "StackOptions", "plan_slabs", "reconstruct_to"]

_LOG = logging.getLogger(__name__)

HALO = 8
"""Rows read beside those that a slab needs: dead cells are found and interpolated with their
neighbours' help."""
_RESERVE = 150 * 10**6
"""Compiled kernels, and what filters work on (:data:`recon.analytic.filter_plan.CHUNK_BYTES`)."""
_READINGS = 7
"""Arrays of the size of the readings that live at once while they are prepared."""
_VOLUMES = 4
"""Arrays of the size of a slab that live at once while it is prepared."""
_LOOKED_AT = 32
"""Rows in the middle whose readings are tested against their description, at most."""
_RATE = 4e8
"""Voxel updates of the backprojection a second on one core."""
_READ_RATE = 1e8
"""Readings that are read and prepared a second on one core."""


class StackOptions(TypedDict, total=False):
    """Options of PWLS in slabs, as :func:`recon.least_squares.reconstruct.reconstruct_pwls`
    takes them."""

    prior: QGGMRF | None
    tolerance: float
    max_exact: int


class Part(NamedTuple):
    """Some slices or rows of a scan.

    Attributes:
        scan: of a cone beam with ``HALO`` rows more on either side.
        own: where they stand in it.
        zeros, replaced, dead: how many of their readings registered nothing, are such as no object
            can cause, and are interpolated from their neighbours.
    """

    scan: Scan
    own: slice
    zeros: int
    replaced: int
    dead: int


class ScanSlices:
    """A scan of which no more than some slices (of a cone beam: rows of the detector) are in memory
    at a time.

    Args:
        scan: a scan, or a file that is read in parts: ours, Data Exchange, a ``.yaml`` stack of
            ``.npy``, Zarr or TIFF.
        options: of :func:`torchpcct.formats.scans.open_scan`.

    Attributes:
        geometry: of the whole scan.
        count: its slices or rows.
        counts: a tensor without contents, of the shape of the readings.
        first: its first slices.

    Raises:
        ValueError: a scan that has to be read as a whole (a part of the detector, energy bins, a
            geometry view by view; CatSim's and DICOM-CT-PD files).
    """

    window = region = None

    def __init__(self, scan: Scan | str | os.PathLike[str], **options: Any) -> None:
        takes = {"slices"} if isinstance(scan, Scan) else own_options(scan)
        if "slices" not in takes:
            raise ValueError(
                f"{scan} cannot be read slice by slice: convert it to .h5 by open_scan(…).save(…)"
            )
        self.source, self.options = scan, options
        self.cells: DefectiveCells | None = None
        self.photon: float | None = None
        try:
            self.first = self._open(0, 4)
        except NoSlicesError as error:
            raise ValueError(
                f"{scan} can only be read as a whole: leave out memory= ({error})"
            ) from error
        # What the readers estimate from the readings must not differ from slab to slab.
        info = self.first.info
        if "gain" in takes and "signal_of_one_photon" in info:
            self.options["gain"] = info["signal_of_one_photon"]
            if not self.first.counting:
                self.options["electronic_noise"] = self.first.electronic_noise
        elif "photons" in takes and str(info.get("photons")).startswith("estimated"):
            self.options["photons"] = float(self.first.air.flatten()[0])
        self.unit, self.water = self.first.unit, self.first.linearisation.mu_ref
        start, _, self.count = info["slices"]
        g = self.first.geometry
        self.geometry: Geometry = g.with_rows(-start, self.count)
        stack = () if g.has_rows else (self.count,)
        self.counts = torch.empty((*stack, *self.geometry.shape), device="meta")

    def __getstate__(self) -> dict[str, object]:
        """For another process, which reads slabs: the file by its full path, no readings."""
        source = Path(self.source).resolve()  # type: ignore[arg-type]
        return {**self.__dict__, "source": source, "first": None, "counts": None}

    def _open(self, first: int, stop: int) -> Scan:
        part = slice(first, stop)
        if isinstance(self.source, Scan):
            return adapted(self.source, slices=part, **self.options)
        return open_scan(self.source, slices=part, **self.options)

    def seen_grid(
        self,
        voxel: float | None = None,
        extent: object = None,
        center: object = None,
    ) -> VolumeGrid:
        """What :meth:`torchpcct.VolumeGrid.of` gives."""
        return grid_of(self, voxel, extent, center)

    def read(self, first: int, stop: int) -> Part:
        """The slices ``first`` … ``stop - 1``, impossible readings replaced."""
        axis, halo = (1, HALO) if self.geometry.has_rows else (0, 0)
        low = max(first - halo, 0)
        raw = self._open(low, min(stop + halo, self.count))
        cells = (
            None
            if self.cells is None
            else DefectiveCells(
                self.cells.views, *(c[low : low + raw.geometry.rows] for c in self.cells[1:])
            )
        )
        scan, own = repair_defects(raw, cells, self.photon)[0], slice(first - low, stop - low)
        _give_back()
        if halo and scan.dead is not None:
            self._check_interpolated(scan.dead, own, low)

        def own_part(values: Tensor) -> Tensor:
            return values.narrow(axis, own.start, stop - first)

        replaced = (
            0 if scan is raw else int(torch.ne(own_part(scan.counts), own_part(raw.counts)).sum())
        )
        dead = replaced + (0 if raw.dead is None else int(own_part(raw.dead).sum()))
        return Part(scan, own, int((own_part(raw.counts) <= 0).sum()), replaced, dead)

    def find_cells(self, step: int) -> None:
        """Find the cells of a cone beam that are dead or of a wrong gain, by all rows, ``step``
        rows at a time."""
        g = self.geometry
        if not g.has_rows or not is_repaired(self.first):
            return
        start = max((self.count - step) // 2, 0)
        self.photon, light = photon_and_light(self._open(start, start + step))
        lost, zeros = np.zeros(g.views, bool), np.zeros(g.views)
        for _ in range(2):  # again, without the views that turn out to have no signal
            parts, zeros[:] = [], 0.0
            for first in range(0, self.count, step):
                low = max(first - HALO, 0)
                raw = self._open(low, min(first + step + HALO, self.count))
                n = raw.counts.numpy()
                sums = cell_sums(n, raw.air, np.zeros(g.views, np.int64), lost, light)
                parts.append(sums[:, first - low : first - low + step])
                zeros += (n[:, first - low : first - low + step] <= 0).sum((1, 2))
                del raw, n
            before, lost = lost, dark_views(zeros / (self.count * g.columns))
            if (before == lost).all():
                break
        self.cells = wrong_cells(np.concatenate(parts, 1), lost, self.photon, light)

    def _check_interpolated(self, dead: Tensor, own: slice, low: int) -> None:
        """Whether the neighbours that dead cells are interpolated from were read."""
        outer = float(dead.float().mean((1, 2)).max()) > MOST_DEAD
        for side, rows in (
            (low > 0, dead[:, : own.start + 1]),
            (low + dead.shape[1] < self.count, dead[:, own.stop - 1 :]),
        ):
            # and no live reading on one side, from which the row itself would be interpolated
            lost = rows.all(1)
            ends = (
                (lost.cummin(-1).values | lost.flip(-1).cummin(-1).values.flip(-1))
                if side
                else lost & False
            )
            outer = outer or bool(ends.any())
        if outer:
            raise ValueError(
                f"too many readings are dead near row {low + own.start}: slabs read {HALO} rows "
                "beside their own, which do not suffice to interpolate them; reconstruct the whole "
                "volume at once"
            )

    def identity(self) -> str:
        """A text that changes with the readings, as far as the file's size and date and the
        first rows tell."""
        text = hashlib.sha256(self.first.counts.numpy().tobytes())
        text.update(
            repr(
                (
                    self.geometry._key(),
                    self.count,
                    self.unit,
                    self.water,
                    sorted(self.options.items(), key=str),
                )
            ).encode()
        )
        if not isinstance(self.source, Scan):
            stat = Path(self.source).stat()
            text.update(repr((stat.st_size, stat.st_mtime_ns)).encode())
        return text.hexdigest()


@dataclass(frozen=True)
class SlabPlan:
    """How a volume will be reconstructed in slabs.

    Attributes:
        slabs: first slice and the one after the last of each.
        bands: of each, first and last + 1 of the detector rows (slices of a stack) that it needs.
        memory: bytes that the process will hold at most.
        read, written: bytes of float32 readings and voxels.
        seconds: rough estimate, on one core; of FBP.
    """

    slabs: tuple[tuple[int, int], ...]
    bands: tuple[tuple[int, int], ...]
    memory: int
    read: int
    written: int
    seconds: float

    def __str__(self) -> str:
        thick = max(stop - first for first, stop in self.slabs)
        return (
            f"{len(self.slabs)} slabs of up to {thick} slices, {self.memory / 1e9:.2f} GB of "
            f"memory, reads {self.read / 1e9:.2f} GB, writes {self.written / 1e9:.2f} GB, about "
            f"{self.seconds:.0f} s on one core"
        )


def _give_back() -> None:
    """Let the system have the memory that was freed: the C library keeps it, up to several times
    what is in use."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # another C library than GNU's
        ctypes.CDLL(None).malloc_trim(0)


class _SlabFbp:
    """The FBP of a volume, of which slabs are made: with the results of
    :func:`recon.analytic.fbp.fbp`, and within its memory."""

    def __init__(
        self,
        geometry: Geometry,
        grid: VolumeGrid,
        kernel: str,
        sides: tuple[bool, bool],
        water: float,
    ) -> None:
        self.geometry, self.grid, self.water = geometry, grid, water
        self.cone = geometry.has_rows
        plane = grid if self.cone else grid.slice
        self.plan = FbpPlan(geometry, [plane], kernel, sides=sides, outside=water)

    def band(self, first: int, stop: int) -> tuple[int, int]:
        """Detector rows, or slices, that the slices ``first`` … ``stop - 1`` of the volume need."""
        if not self.cone:
            return first, stop
        low, high = self.plan.backprojections[0].rows(first, stop)
        return self.plan.window.first_row + low, self.plan.window.first_row + high

    def needs(self, first: int, stop: int) -> int:
        """Bytes at most while a slab is made."""
        low, high = self.band(first, stop)
        rows = high - low + (2 * HALO if self.cone else 0)
        readings = 4 * rows * self.geometry.views * self.geometry.columns
        completed = readings * self.plan.completed.columns / self.geometry.columns
        filtered = 4 * (high - low) * self.geometry.views * self.plan.window.columns
        slab = 4 * (stop - first) * math.prod(self.grid.shape[1:])
        return int(
            max(_READINGS * readings, 2 * completed + filtered, filtered + slab, _VOLUMES * slab)
        )

    def __call__(self, source: ScanSlices, first: int, stop: int) -> Tensor:
        """The slices ``first`` … ``stop - 1``, in the scan's unit."""
        plan = self.plan
        low, high = self.band(first, stop)
        scan, own, *_ = source.read(low, high)
        lines, geometry = scan.line_integrals(), scan.geometry
        del scan
        completed = plan.complete(lines, beam(geometry)).lines
        del lines
        _give_back()
        if self.cone:
            held = DetectorWindow.full(plan.completed)
            held = held.with_rows(low - own.start, completed.shape[-2])
            filtered = plan.filtered(completed, held, (low, high))
            del completed
            mu = plan.backprojections[0].forward(
                filtered, (first, stop), low - plan.window.first_row
            )
        else:
            filtered = plan.filtered(completed)
            del completed
            (mu,) = plan.backprojected(filtered)
        del filtered
        _give_back()
        return to_hu(mu, self.water).to(torch.float32)


def _pwls_needs(geometry: Geometry, grid: VolumeGrid) -> Callable[[int, int], int]:
    each = pwls_bytes(Projector(geometry, grid.slice), 1, torch.float32, torch.device("cpu"))

    def needs(first: int, stop: int) -> int:
        arrays = _READINGS * math.prod(geometry.shape) + _VOLUMES * math.prod(grid.shape[1:])
        return each + 4 * (stop - first) * arrays

    return needs


@checked
def plan_slabs(
    geometry: Geometry,
    grid: VolumeGrid,
    memory: int | str | None = None,
    method: str = "fbp",
    *,
    sides: tuple[bool, bool] = (False, False),
    done: int = 0,
    parts: int = 1,
) -> SlabPlan:
    """Slabs in which a volume fits into memory.

    Args:
        geometry: of the whole scan: parallel, fan or cone beam.
        grid: ``(z, y, x)``, of a stack ``(slices, y, x)``.
        memory: bytes that a process may hold, with what it holds already, or a text such as "4GB";
            None: what it holds, and its part of what is free.
        method: "fbp"; of stacks also "pwls".
        sides: where the rows end inside the object and are continued (found before the first slab).
        done: slices that are on the disk already.
        parts: slabs at least, if there are slices enough.

    Raises:
        ValueError: a limit that is too small for the thinnest slab, with the smallest that is not;
            a grid, geometry or method that slabs do not do.
    """
    _check(geometry, grid, method)
    base = resident_bytes() + _RESERVE
    free = available_bytes(torch.device("cpu")) // parts
    limit = memory_bytes(memory) if memory is not None else resident_bytes() + free
    fbp = _SlabFbp(geometry, grid, "standard", sides, 0.02) if method == "fbp" else None
    needs = fbp.needs if fbp is not None else _pwls_needs(geometry, grid)
    total = grid.shape[0]

    def cut(thick: int) -> Iterator[tuple[int, int]]:
        return ((first, min(first + thick, total)) for first in range(done, total, thick))

    def most(thick: int) -> int:
        return base + max((needs(*slab) for slab in cut(thick)), default=0)

    thick = max(-(-(total - done) // parts), 1)
    if parts > 1 and thick > CHUNK:
        thick -= thick % CHUNK
    while thick > 1 and most(thick) > limit:
        thick = CHUNK * ((thick - 1) // CHUNK) if thick > CHUNK else thick - 1
    if most(thick) > limit:
        raise ValueError(
            f"memory={memory if memory is not None else limit} is too little: one slice at a time "
            f"needs {math.ceil(most(1) / 1e6)} MB ({base / 1e6:.0f} MB of them for the program "
            f"itself): give memory={math.ceil(most(1) / 1e6)}MB or more, bin the readings, or take "
            "larger voxels"
        )
    slabs = tuple(cut(thick))
    bands = tuple(slab if fbp is None else fbp.band(*slab) for slab in slabs)
    row = 4 * geometry.views * geometry.columns
    count = geometry.shape[1] if geometry.has_rows else total
    read = row * (
        count + sum(high - low + (2 * HALO if geometry.has_rows else 0) for low, high in bands)
    )
    voxels = (total - done) * math.prod(grid.shape[1:])
    seconds = voxels * geometry.views / _RATE + read / 4 / _READ_RATE
    return SlabPlan(slabs, bands, most(thick), read, 4 * voxels, seconds)


def _check(geometry: Geometry, grid: VolumeGrid, method: str) -> None:
    if method in METHODS and method not in ("fbp", "pwls"):
        raise ValueError(
            f"method={method!r} needs the whole volume at once: leave out memory=, or take fbp or "
            "pwls slab by slab"
        )
    choice("method", method, ("fbp", "pwls"))
    if not geometry.on_circle:
        raise ValueError(
            "slabs need a parallel, fan or cone beam on a circle: leave out memory= for a geometry "
            "given view by view"
        )
    if grid.ndim != 3:
        raise ValueError(f"grid must be a (z, y, x) VolumeGrid, got {grid!r}")
    if method == "pwls" and geometry.has_rows:
        raise ValueError(
            'method "pwls" of a cone beam couples all slices: it needs the whole volume in '
            "memory; slabs are for "
            '"fbp", and for stacks of parallel or fan-beam slices'
        )


@checked
def reconstruct_to(
    scan: Scan | str | Path | ScanSlices,
    grid: VolumeGrid,
    path: str | Path,
    method: str = "fbp",
    *,
    memory: int | str | None = None,
    kernel: str = "standard",
    reader: Mapping[str, Any] | None = None,
    progress: Callable[[float], None] | None = None,
    **options: Unpack[StackOptions],
) -> JsonObject:
    """Reconstruct a volume slab by slab into a file, within a limit of memory.

    The same as :func:`recon.reconstruct` and :meth:`torchpcct.volume.Volume.save`, to the bit on
    one thread. FBP (FDK) of parallel, fan and cone beams on a circle, PWLS of stacks of slices. If
    it is interrupted, the finished slabs stay in ``path.unfinished``, and the same call goes on
    with them. Within :func:`recon.jobs.execute.using` the slabs of a file are jobs: each worker
    keeps to ``memory``, reads the file under its full path, and this process puts the slabs into
    the volume.

    What is different: defects are looked for slab by slab, with ``HALO`` rows on either side, so
    that one at the limits of what is recognised may be judged otherwise; the readings are tested
    against their description (:mod:`torchpcct.checks.readings`,
    :func:`recon.analytic.coverage.consistency_warnings`) in the middle rows or slices, which the
    report's ``notes`` name; and what a file does not tell (its reading of one photon) is estimated
    from its first slices.

    Args:
        scan: a file that is read slice by slice (:class:`ScanSlices`), or a scan in memory.
        grid: ``(z, y, x)``, of a stack ``(slices, y, x)`` with all its slices.
        path: ``.nii`` or ``.zarr`` (OME-Zarr 0.5; extra ``io``).
        method: "fbp" or, of stacks, "pwls".
        memory: see :func:`plan_slabs`; the plan is logged before the start.
        kernel: of FBP.
        reader: options of :func:`torchpcct.formats.scans.open_scan`.
        progress: called with the finished fraction, 0…1.
        options: of PWLS (:class:`StackOptions`).

    Returns:
        The report: that of a volume, with the plan as ``slabs``, ``memory_bytes``; ``resumed_at``,
        the first slice of this call; ``minimum``, ``maximum`` and ``mean`` of what it wrote.

    Raises:
        ValueError: a limit that is too small, naming the smallest that works; a scan, grid or
            method that cannot be done in slabs; a starved scan; another ending.
        WriteError: the target cannot be written (a full disk): the finished slabs stay.
        recon.jobs.execute.LeftOut: slabs whose workers died; the others stay.
    """
    check_slab_name(path)
    source = scan if isinstance(scan, ScanSlices) else ScanSlices(scan, **dict(reader or {}))
    g, start = source.geometry, time.perf_counter()
    _check(g, grid, method)
    if not g.has_rows and grid.shape[0] != source.count:
        raise ValueError(
            f"this scan of {source.count} slices needs a grid of as many, got {grid.shape}"
        )
    executor = None if isinstance(source.source, Scan) else execute.current()
    parts = 1 if executor is None else 2 * max(1, getattr(executor, "workers", 1))
    plan = plan_slabs(g, grid, memory, method, parts=parts)
    fixed = [*check_rows(g, grid), *sampling_warnings(g)] if method == "fbp" else []
    all_of_it = (
        source.identity(),
        grid,
        method,
        kernel,
        sorted(options.items()),
        source_digest(__name__),
    )
    key = hashlib.sha256(repr(all_of_it).encode()).hexdigest()
    thick = plan.slabs[0][1] - plan.slabs[0][0]
    source.find_cells(max(high - low for low, high in plan.bands))
    file = SlabFile(path, grid, source.unit, key, min(thick, CHUNK))
    _LOG.info("%s", plan)
    if "sides" not in file.notes:
        try:
            file.notes |= _survey(source, plan)
        except BaseException:
            file.discard()
            raise
    notes = file.notes
    sides: tuple[bool, bool] = tuple(notes["sides"])
    begun = file.done
    if begun or any(sides):
        plan = plan_slabs(g, grid, memory, method, sides=sides, done=begun, parts=parts)
    maker = _Maker(source, grid, method, kernel, sides, dict(options))
    found: dict[str, float] = {}  # in the order of their appearance
    low, high, total = math.inf, -math.inf, 0.0

    def keep(stop: int, values: NDArray[np.float32], texts: dict[str, float]) -> None:
        nonlocal low, high, total
        found.update(texts)
        low, high = min(low, float(values.min())), max(high, float(values.max()))
        total += float(values.sum(dtype=np.float64))
        file.write(values)
        if progress is not None:
            progress(stop / grid.shape[0])

    if executor is None:
        for first, stop in plan.slabs:
            keep(stop, *maker(first, stop))
    else:
        _as_jobs(executor, maker, plan, key, file.part.with_name(file.part.name + ".slabs"), keep)
    fbp = method == "fbp"
    # that of the brightest slab
    metal = sorted((t for t in found if fbp), key=lambda t: -found[t])[:1]
    warnings = list(dict.fromkeys([*notes["warnings"], *fixed, *(metal if fbp else found)]))
    for text in warnings:
        _LOG.warning("%s", text)
    report = {
        "method": method,
        **({"kernel": kernel} if fbp else {}),
        "seconds": round(time.perf_counter() - start, 3),
        "warnings": warnings,
        "notes": [*notes["notes"], *(view_notes(g) if fbp else [])],
        "cells_mm": finite_cells(source.geometry),
        "dead_readings": notes["dead_readings"],
        "slabs": len(plan.slabs),
        "memory_bytes": plan.memory,
        "resumed_at": begun,
        "minimum": low,
        "maximum": high,
        "mean": total / max((grid.shape[0] - begun) * math.prod(grid.shape[1:]), 1),
    }
    file.finish(report)
    return report


class _Maker:
    """Makes slabs: all that a job needs."""

    def __init__(
        self,
        source: ScanSlices,
        grid: VolumeGrid,
        method: str,
        kernel: str,
        sides: tuple[bool, bool],
        options: dict[str, Any],
    ) -> None:
        self.source, self.grid, self.method, self.kernel = source, grid, method, kernel
        self.sides, self.options = sides, options

    @cached_property
    def fbp(self) -> _SlabFbp | None:
        source = self.source
        return (
            _SlabFbp(source.geometry, self.grid, self.kernel, self.sides, source.water)
            if self.method == "fbp"
            else None
        )

    def __call__(self, first: int, stop: int) -> tuple[NDArray[np.float32], dict[str, float]]:
        """Values ``(slices, y, x)`` in the scan's unit, and warnings with the brightness that
        each is for."""
        source = self.source
        if self.fbp is None:
            part = _slices_of(self.grid, first, stop)
            volume = reconstruct(source._open(first, stop), part, self.method, **self.options)
            return volume.data.numpy(), dict.fromkeys(volume.report["warnings"], 0.0)
        values = self.fbp(source, first, stop)
        texts = (
            dict.fromkeys(metal_warnings(values), float(values.max()))
            if source.unit == "HU"
            else {}
        )
        return (values if source.unit == "HU" else from_hu(values, source.water)).numpy(), texts


def _as_jobs(
    executor: Executor,
    maker: _Maker,
    plan: SlabPlan,
    key: str,
    folder: Path,
    keep: Callable[..., None],
) -> None:
    """Let workers make the slabs, cached in ``folder``; each is kept when its turn has come."""
    packed, plane = pickle.dumps(maker), math.prod(maker.grid.shape[1:])
    jobs = [
        execute.Job(
            f"slices {first} … {stop - 1}",
            _slab,
            (packed, key, first, stop),
            (f"{first}-{stop}.npz",),
            seconds=plan.seconds * (stop - first) / maker.grid.shape[0],
            mib=plan.memory / 2**20,
            bytes=4.0 * (stop - first) * plane,
        )
        for first, stop in plan.slabs
    ]
    waiting, done = deque(plan.slabs), set[tuple[int, int]]()

    def finished(job: execute.Job) -> None:
        done.add(job.args[2:])
        while waiting and waiting[0] in done:
            first, stop = waiting.popleft()
            block = _cached_slab(folder, maker, key, first, stop)
            keep(
                stop,
                block["values"],
                dict(zip(block["texts"].tolist(), block["peaks"].tolist(), strict=True)),
            )
            Store(folder).remove(folder / f"{first}-{stop}.npz")

    execute.run(jobs, folder, executor, finished=finished)
    Store(folder).clear()


def _slab(folder: Path, packed: bytes, key: str, first: int, stop: int) -> None:
    _cached_slab(folder, _unpacked(packed), key, first, stop)


@lru_cache(maxsize=1)
def _unpacked(packed: bytes) -> _Maker:
    maker: _Maker = pickle.loads(packed)
    return maker


def _cached_slab(folder: Path, maker: _Maker, key: str, first: int, stop: int) -> dict[str, Array]:
    def compute() -> dict[str, Array]:
        values, texts = maker(first, stop)
        return {
            "values": values,
            "texts": np.array(list(texts), dtype=str),
            "peaks": np.array(list(texts.values())),
        }

    return Store(folder).cached(f"{first}-{stop}", key, compute)


def _slices_of(grid: VolumeGrid, first: int, stop: int) -> VolumeGrid:
    """The slices ``first`` … ``stop - 1`` of a ``(z, y, x)`` grid, at their places."""
    z = grid.center[0] + (first + stop - grid.shape[0]) / 2 * grid.spacing[0]
    return VolumeGrid((stop - first, *grid.shape[1:]), grid.spacing, (z, *grid.center[1:]))


def _survey(source: ScanSlices, plan: SlabPlan) -> JsonObject:
    """What has to be known of all readings before the first slab, and what the middle ones say
    of the scan."""
    g, cone = source.geometry, source.geometry.has_rows
    step = max(high - low for low, high in plan.bands)
    tally, rows = np.zeros(3, np.int64), torch.zeros(g.views, g.columns, dtype=torch.float64)
    ends: list[tuple[float, Tensor, Tensor]] = []
    for first in range(0, source.count, step):
        scan, own, *numbers = source.read(first, min(first + step, source.count))
        tally += numbers
        lines = scan.line_integrals()[(slice(None), own) if cone else own]
        del scan
        if cone:
            rows += lines.sum(1, dtype=torch.float64)
        else:
            ends.append(row_ends(lines))
    zeros, replaced, dead = map(int, tally)
    require_light(zeros / source.counts.numel())
    if cone:
        ends = [row_ends((rows / source.count).float()[None])]
    highest, first_column, last_column = zip(*ends, strict=True)
    sides = ends_cut_off(
        max(highest), torch.cat(first_column), torch.cat(last_column), beam(g), angular_weights(g)
    )
    return {"sides": sides, "dead_readings": dead, **_test_middle(source, plan, replaced, sides)}


def _test_middle(
    source: ScanSlices, plan: SlabPlan, replaced: int, sides: tuple[bool, bool]
) -> JsonObject:
    g, cone = source.geometry, source.geometry.has_rows
    most = min(_LOOKED_AT, max(high - low for low, high in plan.bands), source.count)
    if cone:  # about the plane of the orbit
        first = int(
            np.clip(round(-g.row_positions[0] / g.row_pitch) - most // 2, 0, source.count - most)
        )
    else:
        most -= 1 - most % 2
        first = source.count // 2 - most // 2
    scan = source.read(first, first + most).scan
    flat = VolumeGrid((scan.counts.shape[0], 1, 1), 1.0)
    texts = [*reading_warnings(scan), *consistency_warnings(scan, flat)]
    if replaced:
        share = 100 * replaced / source.counts.numel()
        texts.insert(
            0,
            f"{replaced} readings are such as no object can cause (dead cells, wrong gains, lost "
            f"readings): {share:.2g} % of the readings were interpolated from their neighbours",
        )
    if any(sides) and not any("inside the object" in text for text in texts):
        texts.append(
            "the rows end inside the object above or below the middle: what lies beyond is "
            "continued as water"
        )
    what = f"{'rows' if cone else 'slices'} {first} … {first + most - 1} of {source.count}"
    return {
        "warnings": texts,
        "notes": [f"readings, rotation axis and edges were tested in {what}"],
    }
