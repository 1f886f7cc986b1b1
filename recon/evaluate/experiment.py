"""Tasks × methods × exposures × realisations: the jobs of the instrument, and what they found.

An evaluation is a list of jobs (:func:`_jobs`), each of which caches results in a folder: what is
there already is not computed again. They are run here or by an executor
(:mod:`recon.jobs.execute`); then the cache is read.
"""

from __future__ import annotations

import json
import logging
import pickle
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from recon.evaluate.energies import BINS, EnergyRealisations, with_bins
from recon.evaluate.estimates import Record, ReferenceNoise, records_of
from recon.evaluate.measure import BLOCK, Measurement, Reader, RoiReadings, kept_as
from recon.evaluate.methods import Method, MethodLike, listed, method_of
from recon.evaluate.realisations import Realisations, Simulated
from recon.evaluate.task import GroundTruth, Task, exposures_of
from recon.evaluate.tasks import TaskLike, read_task
from recon.jobs import execute
from recon.jobs.execute import Job, Unportable
from recon.jobs.store import Store
from torchpcct.files import atomic_write
from torchpcct.validate import checked, whole

if TYPE_CHECKING:
    from torchpcct.typing import JsonObject

__all__ = ["Evaluation", "TaskResult", "evaluate", "export_scans"]

log = logging.getLogger(__name__)

Progress = Callable[[str, float], None]
LEAST = 8
"""Realisations: fewer give no intervals."""


@dataclass(frozen=True, eq=False)
class TaskResult:
    """What was found of one task, for pictures and text.

    Attributes:
        task, ground_truth: what was looked at.
        true_hu: ROI → contrast that the signal adds, background less signal.
        truth: ``(z, y, x)`` HU with the signal.
        volumes: (method, exposure) → first noisy volume, and that of noise-free data.
    """

    task: Task
    ground_truth: GroundTruth
    true_hu: dict[str, float]
    truth: NDArray[np.float32]
    volumes: dict[tuple[str, float], tuple[NDArray[np.float16], NDArray[np.float16]]]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Result of :func:`evaluate`.

    Attributes:
        records: one for each figure: task, method, exposure_s, figure, where, value, low, high,
            unit, n. ``low`` and ``high`` end the 95 % interval; NaN: the value is exact, or a time.
        results: of each task.
        settings: of the run.
    """

    records: list[Record]
    results: list[TaskResult]
    settings: JsonObject


@checked
def evaluate(
    tasks: TaskLike | Sequence[TaskLike],
    methods: MethodLike | Sequence[MethodLike],
    *,
    exposures_s: float | Sequence[float] | None = None,
    n: int = 20,
    seed: int = 0,
    folder: str | Path | None = None,
    progress: Progress | None = None,
    executor: Executor | None = None,
) -> Evaluation:
    """Measure methods at tasks, all on the same noise realisations.

    Args:
        tasks: names of ready ones, YAML files, :class:`recon.evaluate.Task` objects; one or a list.
        methods: names, functions of ``(scan, grid)`` that give a volume in HU,
            :class:`recon.evaluate.Method` objects, :func:`recon.evaluate.denoiser` of a function of
            an image; one or a list.
        exposures_s: of the scans in s, one or a list; None: those of each task.
        n: realisations of each, at least 8.
        seed: of the first.
        folder: where scans and finished results are cached; the same call goes on after an
            interruption, and a second one with more methods or realisations computes what is new.
            None: nothing is cached.
        progress: called with a text and the finished fraction of it.
        executor: where volumes are computed, any of :mod:`concurrent.futures`, best one of
            :mod:`recon.jobs.execute`; None: that of :func:`recon.jobs.execute.using`, else
            here, one after another. The figures are the same, but for times.

    Raises:
        ValueError, TypeError: an unknown task or method, bad values; a method whose volume has
            another shape or unit, holds NaN or is shifted.
        recon.jobs.execute.LeftOut: jobs that failed wherever they were tried; the others are
            kept.
    """
    n, seed = whole("n", n, LEAST), whole("seed", seed, 0)
    todo = [read_task(t) for t in listed(tasks)]
    run = [method_of(m) for m in listed(methods)]
    _different("tasks", [t.name for t in todo])
    _different("methods", [m.name for m in run])
    weighted = [m.name for m in run if m.energies is not None]
    if weighted and not any(t.has_energies for t in todo):
        painted = ", ".join(t.name for t in todo)
        raise ValueError(
            f"{', '.join(weighted)}: the tissues of {painted} are given in HU, without energies; "
            "energies= takes tasks whose scene is made of bodies alone"
        )
    exposures = None if exposures_s is None else exposures_of(listed(exposures_s))
    if folder is None:
        with TemporaryDirectory() as kept:
            return evaluate(
                todo,
                run,
                exposures_s=exposures,
                n=n,
                seed=seed,
                folder=kept,
                progress=progress,
                executor=executor,
            )
    folder, executor = Path(folder), executor or execute.current()
    if executor is not None:
        jobs = [
            job
            for task in todo
            for job in _sent(task, run, exposures or task.exposures_s, n, seed, folder, executor)
        ]
        execute.run(jobs, folder, executor, progress)
    records: list[Record] = []
    seen = []
    for task in todo:
        bench = _Bench(folder, task, _everyone(task, run), seed)
        asked = exposures or task.exposures_s
        # All of them without an executor; with one, those of methods that no other process takes.
        left = _jobs(bench, list(bench.methods.values()), bench, asked, n, workers=1)
        execute.run(left, folder, None, progress)
        found, what = _read(bench, asked, n)
        records += found
        seen.append(what)
    settings = {
        "tasks": [t.name for t in todo],
        "methods": [m.name for m in run],
        "n": n,
        "seed": seed,
        "exposures_s": exposures,
    }
    return Evaluation(records, seen, settings)


def _everyone(task: Task, methods: Sequence[Method]) -> list[Method]:
    """The methods after the task's reference; of tissues given in HU there are no energies."""
    reference = method_of(task.reference)
    if not reference.is_fbp:
        raise ValueError(
            f"task {task.name}: factors are quoted against FBP, got {reference.name!r}"
        )
    for method in methods:
        if method.energies is not None and not task.has_energies:
            log.warning(
                "%s is left out of task %s: its tissues are given in HU, without energies",
                method.name,
                task.name,
            )
    fit = (m for m in methods if m.energies is None or task.has_energies)
    return [reference, *(m for m in fit if m.name != reference.name)]


# --- jobs -----------------------------------------------------------------------------------------


def _sent(
    task: Task,
    methods: Sequence[Method],
    exposures: Sequence[float],
    n: int,
    seed: int,
    folder: Path,
    executor: Executor,
) -> list[Job]:
    """The jobs of all methods that other processes can be given."""
    everyone, sent = _everyone(task, methods), []
    for method in everyone:
        try:
            execute.packed_call(executor, method)
            sent.append(method)
        except Unportable as error:
            log.warning(
                "%s is computed in this process: other processes cannot load its function (%s); "
                "put it into a module",
                method.name,
                error,
            )
    bench = _Bench(folder, task, everyone, seed)
    packed = zlib.compress(
        execute.packed_call(executor, (task, sent, seed, bench.realisations.kernels))
    )
    return _jobs(bench, sent, packed, exposures, n, workers=getattr(executor, "workers", 16))


def _jobs(
    bench: _Bench,
    methods: Sequence[Method],
    given: _Bench | bytes,
    exposures: Sequence[float],
    n: int,
    workers: int,
) -> list[Job]:
    """All that an evaluation of a task computes and that is not there yet: scans and ground truth,
    then every block of realisations.

    A job draws its realisations for several methods: for all of them, if there are jobs enough for
    all workers.

    Args:
        bench: of the task.
        methods: of its methods those that are asked for.
        given: the bench as jobs take it.
        exposures: in s.
        n: realisations.
        workers: that take jobs at once.
    """
    task, seed, store = bench.realisations.task, bench.realisations.seed, bench.realisations.store
    place, first = f"{task.name}/", f"{task.name}: ground truth"
    jobs, scans = [], {f"{task.name}: scan, signal {s}": s for s in ("present", "absent")}
    in_bins = {f"{task.name}: scan in energy bins, signal {s}": s for s in ("present", "absent")}
    weighted = False
    if not store.has("facts", f"2 {task.fingerprint}"):
        jobs += [Job(name, _run_job, (given, "scan", signal)) for name, signal in scans.items()]
        jobs.append(
            Job(first, _run_job, (given, "ground_truth"), (f"{place}facts.npz",), tuple(scans))
        )
    wanted = _kernels(methods, None)
    exact = [
        kernel for kernel in wanted if not store.has(f"exact_{kernel}", f"2 {task.fingerprint}")
    ]
    if exact:
        name, made = (
            f"{task.name}: exact noise, {', '.join(exact)}",
            tuple(f"{place}exact_{k}.npz" for k in exact),
        )
        jobs.append(Job(name, _run_job, (given, "exact", exact), made, tuple(scans)))
    blocks = _blocks(n)
    groups = min(len(methods), -(-2 * workers // (len(blocks) * len(exposures)))) or 1
    for exposure in exposures:
        for group in (methods[g::groups] for g in range(groups)):
            kept = {m.name: kept_as(m, exposure, task, seed) for m in group}
            known = f"{task.name}: {exposure:g} s, noise-free, {', '.join(kept)}"
            for k in (range(0), *blocks):
                asked = [
                    m.name
                    for m in group
                    if not all(
                        store.has(f"{kept[m.name][0]}/{part}", kept[m.name][1])
                        for part in _parts(m, k)
                    )
                ]
                if not asked:
                    continue
                weighted |= any(bench.methods[name].energies is not None for name in asked)
                files = (
                    f"{place}{kept[m.name][0]}/{part}.npz" for m in group for part in _parts(m, k)
                )
                name = (
                    f"{task.name}: {exposure:g} s, {k.start}-{k.stop}, {', '.join(asked)}"
                    if k
                    else known
                )
                seconds, mib, kept_bytes = _estimate(
                    task, [m for m in group if m.name in asked], max(len(k), 1)
                )
                jobs.append(
                    Job(
                        name,
                        _run_job,
                        (given, "block", exposure, asked, k),
                        (*files, f"{place}*sigma_*.npz", f"{place}energies_*.npz"),
                        (first, *in_bins, known) if k else (first, *in_bins),
                        seconds=seconds,
                        mib=mib,
                        bytes=kept_bytes,
                    )
                )
    if not weighted:
        return jobs
    first_of_all = [
        Job(name, _run_job, (given, "bins", signal)) for name, signal in in_bins.items()
    ]
    return [*first_of_all, *jobs]


def _blocks(n: int) -> list[range]:
    """Realisations that are measured and cached together."""
    return [range(start, min(start + BLOCK, n)) for start in range(0, n, BLOCK)]


def _parts(method: Method, k: range) -> tuple[str, ...]:
    """Names of what is cached of a block; of an empty one, of noise-free data."""
    if k:
        return (f"{k.start}-{k.stop}",)
    return ("clean",) if method.network is None else ("clean", "response")


_SECONDS = {"fbp": 0.0, "pwls": 1.0, "mbir": 1.0}
"""Seconds of a volume of 10⁵ voxels on one core, by method."""
_OTHER_S = 0.2
"""The same of a filter or another function."""
_DRAW_S = 2.0
"""Seconds of a noisy scan and its twin with FBP of them (1968 views)."""
_DRAW_IN_BINS_S = 22.0
"""The same of scans whose counts are split among eight energy bins."""
_MIB = 2600.0
"""Memory of a process, MiB."""
_MIB_IN_BINS = 6500.0
"""The same where counts are split among energy bins."""


def _estimate(task: Task, methods: Sequence[Method], n: int) -> tuple[float, float, float]:
    """Rough seconds of realisations on one core, memory in MiB, and bytes that are kept."""
    volumes = 2 * n * task.grid.voxels / 1e5
    seconds = volumes * sum(_SECONDS.get(m.name.partition(":")[0], _OTHER_S) for m in methods)
    in_bins = len({m.energies for m in methods} - {None})
    seconds += n * (_DRAW_S + in_bins * _DRAW_IN_BINS_S)
    kept = len(methods) * (2.0 * task.grid.voxels + 8e3 * n * (3 + len(task.names)))
    return seconds, _MIB_IN_BINS if in_bins else _MIB, kept


def _kernels(methods: Sequence[Method], energies: str | None, exact: bool = True) -> list[str]:
    """Kernels of FBP that methods with an option ``energies`` ask for; ``exact``: whose noise is
    exact."""
    asked = (m for m in methods if m.energies == energies and (m.is_fbp or not exact))
    return list(dict.fromkeys(k for m in asked for k in (m.kernels[:1] if exact else m.kernels)))


class _Bench:
    """A task with the methods that are measured at it: its realisations, what reads their volumes,
    and what its jobs do."""

    def __init__(
        self,
        folder: Path,
        task: Task,
        methods: Sequence[Method],
        seed: int,
        kernels: Sequence[str] | None = None,
    ) -> None:
        if kernels is None:
            kernels = _kernels(methods, None, exact=False)
        self.realisations = Realisations(task, Store(folder / task.name), seed, kernels)
        self.methods = {m.name: m for m in methods}
        self._weighted = dict[str, Realisations]()
        self._readers = dict[str | None, Reader]()

    def realisations_of(self, energies: str | None) -> Realisations:
        """The realisations that methods with an option ``energies`` are given."""
        if energies is None:
            return self.realisations
        if energies not in self._weighted:
            kernels = _kernels(list(self.methods.values()), energies, exact=False)
            self._weighted[energies] = EnergyRealisations(self.realisations, energies, kernels)
        return self._weighted[energies]

    def reader_of(self, energies: str | None) -> Reader:
        """Of their volumes; it needs the ground truth."""
        if energies not in self._readers:
            realisations = self.realisations_of(energies)
            self._readers[energies] = Reader(
                realisations.task, realisations.task.truth(realisations.ground_truth)
            )
        return self._readers[energies]

    def scan(self, signal: str) -> None:
        self.realisations.task.prepare(self.realisations.store, signal)

    def bins(self, signal: str) -> None:
        task = self.realisations.task
        in_bins = replace(task, scanner=with_bins(task.scanner))
        in_bins.scan(Store(self.realisations.store.folder / BINS), signal)

    def ground_truth(self) -> None:
        _ = self.realisations.ground_truth

    def exact(self, kernels: Sequence[str]) -> None:
        self.realisations.exact_covariances(kernels)

    def block(self, exposure: float, names: Sequence[str], k: range) -> None:
        """Measure methods at an exposure and cache it: a block of realisations, or, if it is
        empty, noise-free data."""
        pairs = self._pairs(exposure, k)
        # Methods of one option ``energies`` follow each other: their realisations are in memory.
        for name in sorted(names, key=lambda name: self.methods[name].energies or ""):
            measurement = self.measurement(name, exposure)
            if k:
                measurement.block(k, partial(pairs, self.methods[name].energies))

    def readings(self, name: str, exposure: float, n: int) -> RoiReadings:
        """Of a method at an exposure, from the cache; what cannot be read is computed."""
        measurement = self.measurement(name, exposure)
        for k in _blocks(n):
            measurement.block(k, partial(self._pairs(exposure, k), self.methods[name].energies))
        return measurement.readings()

    def measurement(self, name: str, exposure: float) -> Measurement:
        """Of a method at an exposure."""
        method = self.methods[name]
        realisations, reader = (
            self.realisations_of(method.energies),
            self.reader_of(method.energies),
        )
        return Measurement(method, realisations, reader, exposure)

    def _pairs(
        self, exposure: float, k: range
    ) -> Callable[[str | None], list[tuple[Simulated, Simulated]]]:
        """Realisations for an option ``energies``, drawn if a method needs them; those of the
        option asked for last are kept."""
        return lru_cache(maxsize=1)(
            lambda energies: [self.realisations_of(energies).pair(exposure, i) for i in k]
        )

    def contrasts(self, energies: str | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """True contrasts of the ROIs: what the signal adds, and what there is without it, HU."""
        truth, regions = self.reader_of(energies).truth, self.realisations.task.regions
        added, absent = (
            np.array([float((hu.double() * (b - a)).sum()) for a, b in regions.values()])
            for hu in (truth[0] - truth[1], truth[1])
        )
        return added, absent


@lru_cache(maxsize=1)
def _bench(folder: Path, packed: bytes) -> _Bench:
    return _Bench(folder, *pickle.loads(zlib.decompress(packed)))


def _run_job(folder: Path, given: _Bench | bytes, job: str, *args: object) -> None:
    bench = given if isinstance(given, _Bench) else _bench(folder, given)
    getattr(bench, job)(*args)


# --- what was found -------------------------------------------------------------------------------


def _read(bench: _Bench, exposures: Sequence[float], n: int) -> tuple[list[Record], TaskResult]:
    """The figures of a task, from what its jobs have cached."""
    reader, task, everyone = (
        bench.reader_of(None),
        bench.realisations.task,
        list(bench.methods.values()),
    )
    reference = everyone[0]
    kinds = list(dict.fromkeys(m.energies for m in everyone))
    contrasts = {e: bench.contrasts(e) for e in kinds}
    at_1_s = {e: bench.realisations_of(e).exact_covariances(_kernels(everyone, e)) for e in kinds}
    records: list[Record] = []
    volumes = {}
    for exposure in exposures:
        found = {m.name: bench.readings(m.name, exposure, n) for m in everyone}
        base = found[reference.name]
        known = at_1_s[reference.energies][reference.kernels[0]] / exposure
        control = ReferenceNoise(known, base.clean_rois, base.rois)
        for method in everyone:
            own = found[method.name]
            e = method.energies
            exact = at_1_s[e][method.kernels[0]] / exposure if method.is_fbp else None
            volumes[method.name, exposure] = (own.first, own.first_clean)
            records += records_of(
                task.name,
                method.name,
                exposure,
                own,
                base,
                control,
                bench.realisations_of(e).ground_truth,
                *contrasts[e],
                reader.rois,
                exact,
                contrasts[reference.energies][0],
            )
    true_hu = dict(zip(reader.rois, contrasts[reference.energies][0].tolist(), strict=True))
    truth = reader.truth[0].numpy()
    return records, TaskResult(task, bench.realisations.ground_truth, true_hu, truth, volumes)


def measured_before(
    report: Path,
    tasks: Sequence[TaskLike],
    folder: Path,
    *,
    exposures_s: float | Sequence[float] | None = None,
    n: int = 20,
    seed: int = 0,
) -> list[str]:
    """Methods of an earlier report that belong on the page of another call of :func:`evaluate` in
    the same folder.

    Args:
        report: JSON of :func:`recon.evaluate.report.save`; there need be none.
        tasks, exposures_s, n, seed: of the new call.
        folder: of the cached results.

    Returns:
        Names of the methods that were measured at these tasks, exposures and realisations, and
        whose results are all cached: they cost nothing. Of others the log says why they are left
        out.
    """
    try:
        settings = json.loads(report.read_text(encoding="utf-8"))["settings"]
        given, before = (
            (
                sorted(names),
                None if exposures is None else [float(e) for e in listed(exposures)],
                runs,
                first,
            )
            for names, exposures, runs, first in (
                ([read_task(t).name for t in tasks], exposures_s, n, seed),
                (settings["tasks"], settings["exposures_s"], settings["n"], settings["seed"]),
            )
        )
        names = [str(name) for name in settings["methods"]]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    if given != before:
        log.warning(
            "%s was measured at other tasks, exposures or realisations: its methods are removed "
            "from the report",
            report,
        )
        return []
    kept = []
    for name in names:
        try:
            method = method_of(name)
            there = all(
                _finished(read_task(t), method, exposures_s, n, seed, folder) for t in tasks
            )
        except (ValueError, TypeError, OSError, ImportError, AttributeError):
            there = False
        if there:
            kept.append(name)
        else:
            log.warning(
                "%s is removed from %s: the method, or the code that computes it, has changed; "
                "give it again to measure it",
                name,
                report,
            )
    return kept


def _finished(
    task: Task,
    method: Method,
    exposures_s: float | Sequence[float] | None,
    n: int,
    seed: int,
    folder: Path,
) -> bool:
    """Whether all results of a method are cached, of a task that it is measured at."""
    if method.energies is not None and not task.has_energies:
        return True
    store = Store(folder / task.name)
    blocks = [range(0), *_blocks(n)]
    for exposure in task.exposures_s if exposures_s is None else listed(exposures_s):
        place, key = kept_as(method, float(exposure), task, seed)
        if not all(store.has(f"{place}/{part}", key) for k in blocks for part in _parts(method, k)):
            return False
    return True


def _different(kind: str, names: list[str]) -> None:
    """Refuse a name that is given twice (ValueError)."""
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise ValueError(
            f"{kind}: {', '.join(sorted(twice))} given twice; give one of them another name"
        )


def _note_export(task: Task, seed: int, folder: Path) -> None:
    """Note beside exported scans what they are of, so that none of other noise or of another task
    ever lie among them.

    Raises:
        ValueError: there are scans of something else.
    """
    noted = folder / "export.json"
    what = {"task": task.fingerprint, "seed": seed}
    try:
        before = json.loads(noted.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        before = None
    if any(folder.glob("*.h5")) and before != what:
        raise ValueError(
            f"{folder} holds scans of another seed or task, or of another version of it: export "
            "into a new folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(noted) as part:
        part.write_text(json.dumps(what) + "\n", encoding="utf-8")


@checked
def export_scans(
    tasks: TaskLike | Sequence[TaskLike],
    folder: str | Path,
    *,
    exposures_s: float | Sequence[float] | None = None,
    n: int = 20,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the scans that :func:`evaluate` with the same arguments draws, for a program that
    cannot be called.

    ``FOLDER/TASK/EXPOSUREs_NUMBER_present.h5`` and ``…_absent.h5``, noise free with ``clean`` for
    the number, and ``grid.json`` with the inset's shape, spacing and centre ``(z, y, x)`` mm. Save
    the volumes in HU under the scans' names (``.nii.gz``, ``.mha``, ``.h5``, ``.zarr`` or DICOM
    folders) in ``OTHER/TASK``, and evaluate the method ``files:OTHER``. ``torchpcct reconstruct
    FOLDER/TASK/*.h5 --out OTHER/TASK`` does so; its ``_METHOD`` may stay.

    Args:
        tasks: names, files or tasks, one or several.
        folder: FOLDER above; it is made if it does not exist.
        exposures_s: in s; None: those of each task.
        n: noise realisations, at least 8.
        seed: of the first realisation.

    Returns:
        The files of the scans.

    Raises:
        ValueError, TypeError: as of :func:`evaluate`; a folder that holds scans of another task or
            seed.
    """
    n, seed = whole("n", n, LEAST), whole("seed", seed, 0)
    exposures = None if exposures_s is None else exposures_of(listed(exposures_s))
    written = []
    todo = [read_task(t) for t in listed(tasks)]
    _different("tasks", [t.name for t in todo])
    for task in todo:
        _note_export(task, seed, Path(folder) / task.name)
    for task in todo:
        with TemporaryDirectory() as kept:
            realisations = Realisations(task, Store(Path(kept)), seed)
            for exposure in exposures or task.exposures_s:
                pairs = [[realisations.noise_free(p, exposure) for p in (True, False)]]
                for k in range(-1, n):
                    for realisation in pairs[0] if k < 0 else realisations.pair(exposure, k):
                        path = Path(folder) / f"{realisation.label}.h5"
                        path.parent.mkdir(parents=True, exist_ok=True)
                        realisation.scan.save(path)
                        written.append(path)
                    if progress is not None:
                        progress(f"{task.name}: {exposure:g} s", (k + 2) / (n + 1))
        grid = {"shape": task.grid.shape, "spacing": task.grid.spacing, "center": task.grid.center}
        with atomic_write(Path(folder) / task.name / "grid.json") as part:
            part.write_text(json.dumps(grid) + "\n", encoding="utf-8")
    return written
