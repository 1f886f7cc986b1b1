"""Tasks from YAML, and those that come with the package (``recon/evaluate/tasks/*.yaml``)."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from recon.evaluate.anatomies import ANATOMIES, Anatomy
from recon.evaluate.names import TASKS
from recon.evaluate.task import BESIDE_MM, GroundTruth, SomeViews, Task, contrast_bound
from recon.evaluate.vessels import SHAPES, PaintedVessel
from recon.jobs.store import Store
from recon.mbir.mbir import overlap
from torchpcct import Projector, VolumeGrid
from torchpcct.acquisition.config import configured, grid_of
from torchpcct.formats.damage import read_yaml
from torchpcct.metrics.placement import place_rois, whole_rois
from torchpcct.metrics.roi import axial_grid
from torchpcct.scan import Scan
from torchpcct.scene.plaque import plaque_scene
from torchpcct.scene.plaque.plaque import Plaque
from torchpcct.scene.scene import Scene
from torchpcct.validate import choice, number, numbers, whole
from torchpcct.volume import Volume

__all__ = ["AnatomyTask", "VesselTask", "VoxelTask", "read_task"]

Floats = NDArray[np.float64]

_FOLDER = resources.files("recon") / "evaluate" / "tasks"
"""Of the tasks that come with the package."""
_KEYS = (
    "name",
    "title",
    "scene",
    "scanner",
    "signal",
    "background",
    "inset",
    "exposures_s",
    "reference",
    "rois",
    "tolerance_hu",
    "vessel",
    "voxels",
    "anatomy",
)
"""Of a task in YAML."""
_VOXEL_MM = 0.2
"""What MBIR's network was trained on."""
_LONGEST = 10_000
"""Voxels along an edge of an inset at most: insets are small parts of what is scanned."""
_FARTHEST_MM = 1e6
"""Places of insets at most, from the axis."""
_FEATURE = "feature"
"""The signal of an anatomy."""
_FAT = "fat"
"""Its tissue that is the patient's."""


def task_text(name: str) -> str:
    """The YAML of a task of :data:`TASKS`.

    Raises:
        ValueError: no such task.
    """
    choice("task", name, TASKS)
    return (_FOLDER / f"{name}.yaml").read_text(encoding="utf-8")


TaskLike: TypeAlias = str | os.PathLike[str] | Task
"""What a task is given by: its name (:data:`recon.evaluate.names.TASKS`), a YAML file, or
itself."""


def read_task(what: TaskLike) -> Task:
    """A task from its name (:data:`TASKS`), from a YAML file, or as it is.

    Raises:
        ValueError, TypeError: an unknown name, a file that describes no task; the message names
            what is wrong.
        FileNotFoundError: no such file.
    """
    if isinstance(what, Task):
        return what
    path = Path(str(what))
    if path.suffix in (".yaml", ".yml"):
        return _task(read_yaml(path, "a task"), path.stem, path.parent)
    choice("task", str(what), TASKS)
    with resources.as_file(_FOLDER / f"{what}.yaml") as file:
        return _task(read_yaml(file, "a task"), str(what), file.parent)


def _task(values: object, name: str, folder: Path) -> Task:
    if not isinstance(values, Mapping):
        raise ValueError(
            f"task {name} must be a mapping with {', '.join(_KEYS)}; see torchpcct show-task"
        )
    unknown = [str(k) for k in values if k not in _KEYS]
    if unknown:
        raise ValueError(f"task {name}: unknown {', '.join(unknown)}; it takes {', '.join(_KEYS)}")
    values = {key: value for key, value in values.items() if value is not None}
    for key in ("scene", "signal", "inset"):
        if key not in values:
            raise ValueError(f"task {name} needs {key}; see torchpcct show-task plaque")
    for key in ("name", "background"):
        if not isinstance(values.get(key, ""), str) and (
            key != "name" or not _is_whole(values[key])
        ):
            raise TypeError(f"task {name}: {key} must be a text, got {values[key]!r:.200}")
    name = (
        str(values["name"])
        if "name" in values
        else re.sub(r"[^A-Za-z0-9._-]", "_", name).lstrip(".")[:64] or "task"
    )
    config = configured(
        {k: values[k] for k in ("scene", "scanner", "tolerance_hu") if k in values}, folder
    )
    scene = config.scene
    if not isinstance(scene, Scene):
        raise ValueError(
            f"task {name}: the scene must be made of bodies (kind plaque, thorax, water or bodies)"
        )
    signal = values["signal"]
    signal = (signal,) if isinstance(signal, str) else signal
    if not isinstance(signal, list | tuple) or not all(isinstance(each, str) for each in signal):
        raise TypeError(
            f"task {name}: signal must be the name of a body of the scene, or a list of names, got "
            f"{signal!r:.200}"
        )
    signal = tuple(signal)
    if not signal:
        raise ValueError(f"task {name}: signal names no body of the scene")
    given: dict[str, Any] = {
        k: values[k] for k in ("background", "title", "reference") if k in values
    }
    if "exposures_s" in values:
        given["exposures_s"] = tuple(np.ravel(values["exposures_s"]).tolist())
    kinds = [key for key in ("vessel", "voxels", "anatomy") if key in values]
    if len(kinds) > 1:
        raise ValueError(
            f"task {name}: {' and '.join(kinds)} are of different kinds of task: give one of them"
        )
    make: type[Task] = Task
    if "voxels" in values:
        make, given = VoxelTask, given | _labels(f"task {name}: voxels", values["voxels"], folder)
    elif "vessel" in values:
        given["direction"], make = choice("vessel", values["vessel"], tuple(SHAPES)), VesselTask
    elif "anatomy" in values:
        given["anatomy"], make = choice("anatomy", values["anatomy"], tuple(ANATOMIES)), AnatomyTask
    painted = issubclass(make, _PaintedTask)
    grid = _inset(f"task {name}: inset", values["inset"], scene, () if painted else signal)
    task: Task = make(
        name, scene, signal, config.scanner, grid, tolerance_hu=config.tolerance_hu, **given
    )
    if values.get("rois") is None:
        return task
    choice("rois", values["rois"], ("protocol",))
    options = {k: v for k, v in values["scene"].items() if k not in ("kind", "bodies", "variant")}
    return replace(task, rois=_protocol(plaque_scene(**options)[1], grid))


def _is_whole(value: object) -> bool:
    """Whether YAML has read a name for a whole number, such as 7."""
    return isinstance(value, int) and not isinstance(value, bool)


def _inset(name: str, value: object, scene: Scene, signal: tuple[str, ...]) -> VolumeGrid:
    """A grid as of ``region``; or of ``size`` mm about the signal, in voxels of ``voxel_mm``."""
    if not isinstance(value, Mapping) or "size" not in value:
        return grid_of(name, value)
    unknown = [str(k) for k in value if k not in ("size", "voxel_mm", "center")]
    if unknown:
        raise ValueError(
            f"{name}: unknown {', '.join(unknown)}; with size it takes voxel_mm and center"
        )

    def triple(key: str, **limits: Any) -> tuple[float, ...]:
        given = value[key]
        if isinstance(given, Mapping):
            if set(given) != set("zyx"):
                raise ValueError(
                    f"{name}.{key} must have z, y and x in mm, got {dict(given)!r:.200}"
                )
            given = [given[axis] for axis in "zyx"]
        return tuple(numbers(f"{name}.{key}", given, 3, unit="mm", **limits))

    size = triple("size", positive=True)
    voxel = number(f"{name}.voxel_mm", value.get("voxel_mm", _VOXEL_MM), positive=True, unit="mm")
    if not voxel <= min(size) or max(size) > _LONGEST * voxel:
        raise ValueError(
            f"{name}: voxel_mm must make 1 to {_LONGEST} voxels of each edge, got {voxel:g} mm for "
            f"edges of {' × '.join(f'{s:g}' for s in size)} mm"
        )
    shape = tuple(int(np.ceil(s / voxel - 1e-6)) for s in size)
    if "center" in value:
        return VolumeGrid(shape, voxel, triple("center", low=-_FARTHEST_MM, high=_FARTHEST_MM))
    if not signal:
        raise ValueError(f"{name} needs center {{z, y, x}} in mm: that is where the voxels are put")
    # About what the signal lies in, where that is small: a plaque's vessel, not a patient.
    parent = scene[signal[0]].parent
    boxes = [scene.bounding_box(signal)]
    while parent is not None:
        box = scene.bounding_box([parent])
        if not np.isfinite(box).all() or (box[1] - box[0])[:2].max() > min(size):
            break
        boxes.append(box)
        parent = scene[parent].parent
    return VolumeGrid(shape, voxel, tuple(float(c) for c in boxes[-1].mean(0)[::-1]))


def _labels(name: str, value: object, folder: Path) -> dict[str, object]:
    """``file`` and ``tissues`` of a task's ``voxels``."""
    if (
        not isinstance(value, Mapping)
        or set(value) != {"file", "tissues"}
        or not isinstance(value["tissues"], Mapping)
    ):
        raise ValueError(
            f"{name} takes file, a volume of whole numbers, and tissues {{name: {{label: 1, hu: "
            f"50}}}}"
        )
    tissues = {}
    for tissue, of in value["tissues"].items():
        if not isinstance(of, Mapping) or set(of) != {"label", "hu"}:
            raise ValueError(f"{name}: tissue {tissue!r} needs label and hu, got {of!r}")
        tissues[str(tissue)] = (
            whole(f"{name}: label of {tissue}", of["label"], 1),
            number(f"{name}: hu", of["hu"]),
        )
    volume = Volume.load(folder / str(value["file"]))
    return {"labels": np.asarray(volume.data), "spacing": volume.grid.spacing, "tissues": tissues}


def _protocol(plaque: Plaque, grid: VolumeGrid) -> dict[str, tuple[Tensor, Tensor]]:
    """The ROIs of the paper, and the same two tissues in the whole section and in all slices of
    the core."""
    plain = plaque_scene(plaque)[0]
    x, y, z = (float(v) for v in plaque.to_scanner(plaque.core_center))
    half = float(plaque.core.semi_axes[2])
    pairs = {
        "small": place_rois(plain, axial_grid(grid.center)),
        "slice": whole_rois(plain, VolumeGrid((1, 80, 80), 0.04, (grid.center[0], y, x))),
        "lesion": whole_rois(
            plain, VolumeGrid((max(1, int(2 * half / 0.05)), 64, 64), 0.05, (z, y, x))
        ),
    }
    return {
        name: (a.weights, b.weights)
        for name, (a, b) in ((name, pair.on(grid)) for name, pair in pairs.items())
    }


@dataclass(frozen=True, eq=False)
class VesselTask(Task):
    """The paper's plaque on a vessel of any direction.

    The scene gives patient, tissues and scanner; the vessel is painted on 0.1 mm voxels and
    projected, and changes the counts of the patient without it.

    Args:
        direction: a name of :data:`recon.evaluate.vessels.SHAPES`.
        Others: see :class:`recon.evaluate.task.Task`.
    """

    direction: str = "tilted"
    has_energies: ClassVar[bool] = False

    @cached_property
    def _vessel(self) -> PaintedVessel:
        line, branch = SHAPES[self.direction]
        return PaintedVessel(line, self.grid.center, branch)

    def scan(self, store: Store, signal: str) -> Scan:
        """See :meth:`Task.scan`."""
        present, absent = self.scans(store)
        return present if signal == "present" else absent

    def prepare(self, store: Store, signal: str) -> None:
        """See :meth:`Task.prepare`: the scan of the same plaque along z, on the same scanner."""
        self._along_z(store, signal)

    def _along_z(self, store: Store, signal: str) -> Scan:
        return super().scan(Store(store.folder / "straight"), signal)

    def scans(self, store: Store) -> tuple[Scan, Scan]:
        """See :meth:`Task.scans`."""
        paths = [self.scan_file(store, name) for name in ("present", "absent")]
        if not all(p.exists() for p in paths):
            straight = self._along_z(store, "present"), self._along_z(store, "absent")
            ground_truth = self.ground_truth_of(*straight)
            values = {
                ("core" if t == "signal" else t): v
                for t, v in zip(ground_truth.tissues, ground_truth.values_hu, strict=True)
            }
            for path, core in zip(paths, (values["core"], values["fibrous"]), strict=True):
                hu = {
                    n: v - values[self.scene.names[0]] for n, v in {**values, "core": core}.items()
                }
                made = with_painted(
                    without_inset(straight[1]), self.grid, partial(self._vessel.painted, values=hu)
                )
                store.keep_scan(made, path)
        present, absent = (Scan.load(p) for p in paths)
        return present, absent

    def ground_truth(self, store: Store) -> GroundTruth:
        """Of the vessel along z: values and limit of other directions differ little."""
        return self.ground_truth_of(self._along_z(store, "present"), self._along_z(store, "absent"))

    @cached_property
    def volume_fractions(self) -> dict[str, Floats]:
        """See :attr:`Task.volume_fractions`."""
        own, none = self._vessel.volume_fractions(self.grid), np.zeros(self.grid.shape)
        return {
            t: sum((own[n] for n in names if n in own), none) for t, names in self._groups.items()
        }

    @property
    def _beside(self) -> Floats:
        return self.volume_fractions[self.background]


@dataclass(frozen=True, eq=False)
class _PaintedTask(Task):
    """Tissues of given HU, painted over a patient made of bodies.

    The scene is the patient alone, round about the axis. The tissues are painted over it on voxels
    half as large as the inset's, projected, and change the patient's counts.
    """

    has_energies: ClassVar[bool] = False

    def __post_init__(self) -> None:
        both = set(self.tissues_hu) & set(self.scene.names)
        if both or not self.background:
            tissues = ", ".join(self.tissues_hu)
            why = (
                f"{', '.join(sorted(both))} is a tissue and a body"
                if both
                else f"name the background, of {tissues}"
            )
            raise ValueError(f"task {self.name}: {why}")
        super().__post_init__()

    @property
    def tissues_hu(self) -> Mapping[str, float]:
        """HU of all tissues but the patient's."""
        raise NotImplementedError

    @property
    def names(self) -> tuple[str, ...]:
        """See :attr:`Task.names`."""
        return (*self.tissues_hu, *self.scene.names)

    @cached_property
    def patient(self) -> str:
        """The body in which the middle of the inset lies."""
        z, y, x = self.grid.center
        return self.scene.names[int(self.scene.labels(np.array([[x, y, z]]))[0])]

    def _painted(self, grid: VolumeGrid, values: Mapping[str, float], *, signal: bool) -> Floats:
        """Mean over each voxel of ``values`` of the tissues, with or without the signal."""
        raise NotImplementedError

    def scan(self, store: Store, signal: str) -> Scan:
        """See :meth:`Task.scan`."""
        path = self.scan_file(store, signal)
        if not path.exists():
            plain = self._alone(store)
            seen = SomeViews(plain)
            here = self._patient_hu(seen, self._bodies(seen))
            hu = {tissue: value - here for tissue, value in self.tissues_hu.items()}
            painted = partial(self._painted, values=hu, signal=signal == "present")
            store.keep_scan(with_painted(plain, self.grid, painted), path)
        return Scan.load(path)

    def _alone(self, store: Store) -> Scan:
        """The patient without what is painted."""
        return Task.scan(self, Store(store.folder / "patient"), "present")

    def _bodies(self, seen: SomeViews) -> dict[str, Tensor]:
        """Body → its path lengths, mm, without what is painted."""
        names = list(self.scene.names)
        return dict(zip(names, seen.path_lengths(self, [[n] for n in names]), strict=True))

    def _patient_hu(self, seen: SomeViews, bodies: Mapping[str, Tensor]) -> float:
        maps = list(bodies.values())
        return float(seen.values(maps, seen.information(maps))[list(bodies).index(self.patient)])

    @property
    def _signal_hu(self) -> float:
        return self.tissues_hu[self.signal[0]]

    def ground_truth(self, store: Store) -> GroundTruth:
        """The values are given; the limit is that of tissues with these shapes in this patient."""
        seen = SomeViews(self._alone(store))
        project = Projector(seen.geometry, self.grid, seen.window)
        bodies = self._bodies(seen)
        maps = {
            t: project(torch.from_numpy(own).float())
            for t, own in self.volume_fractions.items()
            if t != self.patient
        }
        values = {
            **self.tissues_hu,
            "signal": self._signal_hu,
            self.patient: self._patient_hu(seen, bodies),
        }
        bodies[self.patient] = bodies[self.patient] - torch.stack(list(maps.values())).sum(0)
        ordered = [
            (maps | bodies)[tissue]
            for tissue in [*self.volume_fractions, *(n for n in bodies if n != self.patient)]
        ]
        limit = contrast_bound(seen.information(ordered))
        return GroundTruth(
            tuple(self.volume_fractions),
            tuple(values[tissue] for tissue in self.volume_fractions),
            limit,
        )

    @property
    def _beside(self) -> Floats:
        return self.volume_fractions[self.background]


@dataclass(frozen=True, eq=False)
class VoxelTask(_PaintedTask):
    """A segmented lesion of the user's own: labels of voxels, put into a patient made of bodies.

    Args:
        labels: ``(z, y, x)`` whole numbers; 0 and whatever ``tissues`` does not name is the
            patient. Their middle lies in the middle of the inset; what is beyond the inset is left
            out.
        spacing: ``(z, y, x)`` of their voxels, mm.
        tissues: name → label and HU on this scanner; signal and background are two of them.
        Others: see :class:`recon.evaluate.task.Task`.

    Raises:
        ValueError: labels that are not whole numbers or of three axes, a label that no voxel has, a
            name that is a body's, no background.
    """

    labels: Any = None
    spacing: tuple[float, ...] = (1.0, 1.0, 1.0)
    tissues: Mapping[str, tuple[int, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        labels = np.asarray(self.labels)
        if labels.ndim != 3 or not np.array_equal(labels, np.round(labels)):
            raise ValueError(
                f"task {self.name}: labels must be whole numbers (z, y, x), got shape "
                f"{labels.shape}"
            )
        for tissue, (label, _) in self.tissues.items():
            if not (labels == label).any():
                raise ValueError(f"task {self.name}: no voxel has the label {label} of {tissue!r}")
        object.__setattr__(self, "labels", labels.astype(np.int64))
        super().__post_init__()
        if len(self.signal) != 1 or not {*self.signal, self.background} <= set(self.tissues):
            raise ValueError(
                f"task {self.name}: signal and background must each be one of "
                f"{', '.join(self.tissues)}"
            )

    @property
    def tissues_hu(self) -> Mapping[str, float]:
        """HU of all tissues but the patient's."""
        return {tissue: hu for tissue, (_, hu) in self.tissues.items()}

    @cached_property
    def _groups(self) -> dict[str, list[str]]:
        others = [t for t in self.tissues if t not in (*self.signal, self.background)]
        tissues = {"signal": list(self.signal), **{t: [t] for t in (self.background, *others)}}
        return {**tissues, self.patient: [self.patient]}

    def _painted(self, grid: VolumeGrid, values: Mapping[str, float], *, signal: bool) -> Floats:
        hu = dict(values) if signal else {**values, self.signal[0]: values[self.background]}
        return np.sum(
            [share * hu[tissue] for tissue, share in self._fractions_on(grid).items()], axis=0
        )

    def _fractions_on(self, grid: VolumeGrid) -> dict[str, Floats]:
        """Tissue → its share of every voxel of a grid, exactly."""
        along = [
            overlap(VolumeGrid(self.labels.shape, self.spacing, self.grid.center), grid, a)
            for a in range(3)
        ]
        return {
            tissue: np.einsum(
                "iz,jy,kx,zyx->ijk",
                *along,
                (self.labels == label).astype(np.float64),
                optimize=True,
            )
            for tissue, (label, _) in self.tissues.items()
        }

    @cached_property
    def volume_fractions(self) -> dict[str, Floats]:
        """See :attr:`Task.volume_fractions`."""
        own = self._fractions_on(self.grid)
        order = {
            ("signal" if n in self.signal else n): own[n]
            for ns in self._groups.values()
            for n in ns
            if n in own
        }
        return {**order, self.patient: 1.0 - np.sum(list(own.values()), axis=0)}


@dataclass(frozen=True, eq=False)
class AnatomyTask(_PaintedTask):
    """A vessel that breaks assumptions, in a patient made of bodies.

    The signal is the anatomy's feature; without it there is what the anatomy has in its place,
    which may be several tissues. It is read in the voxels that it changes by more than half of what
    it changes at most, thin as it may be.

    Args:
        anatomy: a name of :data:`recon.evaluate.anatomies.ANATOMIES`.
        Others: see :class:`recon.evaluate.task.Task`.

    Raises:
        ValueError: another signal than ``"feature"``, a background that is neither a tissue of the
            anatomy's base nor the patient.
    """

    anatomy: str = "healthy"

    def __post_init__(self) -> None:
        super().__post_init__()
        grounds = [*dict.fromkeys(part.tissue for part in self._what.base), self.patient]
        if self.signal != (_FEATURE,) or self.background not in grounds:
            raise ValueError(
                f"task {self.name}: of an anatomy the signal is {_FEATURE!r} and the background "
                f"one of {', '.join(grounds)}, got {', '.join(self.signal)} and {self.background!r}"
            )

    @property
    def _what(self) -> Anatomy:
        return ANATOMIES[self.anatomy]

    @property
    def tissues_hu(self) -> Mapping[str, float]:
        """HU of all tissues but the patient's, which is the anatomy's fat; the feature's is the
        mean over it."""
        tissues = {t: hu for t, hu in self._what.values.items() if t != _FAT}
        return {_FEATURE: 0.0, **tissues}

    def _painted(self, grid: VolumeGrid, values: Mapping[str, float], *, signal: bool) -> Floats:
        return self._what.painted(_about_middle(grid, self.grid), values, feature=signal)

    @cached_property
    def _changes(self) -> dict[tuple[str, str], Floats]:
        """(tissue with the signal, without it) → its share of every voxel."""
        return self._what.volume_fractions(_about_middle(self.grid, self.grid))

    @property
    def _signal_hu(self) -> float:
        changed = {
            pair: float(own.sum()) for pair, own in self._changes.items() if pair[0] != pair[1]
        }
        return sum(self._what.values[pair[0]] * size for pair, size in changed.items()) / sum(
            changed.values()
        )

    @cached_property
    def volume_fractions(self) -> dict[str, Floats]:
        """See :attr:`Task.volume_fractions`."""
        signal = np.sum(
            [own for (after, before), own in self._changes.items() if after != before], axis=0
        )
        kept = {t: self._changes.get((t, t), np.zeros(self.grid.shape)) for t in self._what.values}
        kept[self.patient] = kept.pop(_FAT)
        background = kept.pop(self.background)
        return {
            "signal": signal,
            self.background: background,
            **{t: own for t, own in kept.items() if own.any()},
        }

    def truth(self, ground_truth: GroundTruth) -> tuple[Tensor, Tensor]:
        """See :meth:`Task.truth`."""
        patient = dict(zip(ground_truth.tissues, ground_truth.values_hu, strict=True))[self.patient]
        present, absent = self._hu(patient)
        return torch.from_numpy(present).float(), torch.from_numpy(absent).float()

    def _hu(self, patient: float) -> tuple[Floats, Floats]:
        """With and without the signal."""
        values = {**self._what.values, _FAT: patient}
        both = [[values[pair[k]] * own for pair, own in self._changes.items()] for k in (0, 1)]
        return np.sum(both[0], axis=0), np.sum(both[1], axis=0)

    @cached_property
    def _signal_voxels(self) -> NDArray[np.bool_]:
        present, absent = self._hu(self._what.values[_FAT])
        change = np.abs(present - absent)
        return np.asarray(change > 0.5 * change.max())

    @property
    def _constant(self) -> list[Floats]:
        return list(self._changes.values())

    @property
    def _rest(self) -> Floats:
        """Fat, and muscle as far as there is any: the vessel alone is looked at, whatever it
        lies on."""
        return self.volume_fractions[self.patient] + self.volume_fractions.get("muscle", 0.0)

    @property
    def _around(self) -> NDArray[np.bool_]:
        """Of the background, so far from the signal that its blur does not reach there."""
        away = ndimage.distance_transform_edt(
            self.volume_fractions["signal"] == 0.0, sampling=self.grid.spacing
        )
        return self._pure(self.background, np.where(away > BESIDE_MM, self._beside, 0.0))


def _about_middle(grid: VolumeGrid, inset: VolumeGrid) -> VolumeGrid:
    """A grid in the coordinates about the inset's middle."""
    return replace(
        grid, center=tuple(a - b for a, b in zip(grid.center, inset.center, strict=True))
    )


def without_inset(scan: Scan) -> Scan:
    """The scan of what surrounds the inset alone."""
    assert scan.exterior is not None
    assert scan.window is not None
    return replace(scan, counts=scan.window.take(scan.exterior).to(scan.counts))


def with_painted(scan: Scan, inset: VolumeGrid, painted: Callable[[VolumeGrid], Floats]) -> Scan:
    """A noise-free scan, and in its inset the HU that are painted on a grid of half its voxels
    added."""
    fine = VolumeGrid(tuple(2 * n for n in inset.shape), inset.spacing[0] / 2, inset.center)
    mu = torch.from_numpy(painted(fine) * (scan.linearisation.mu_ref / 1000.0)).float()
    return scan.with_added(Projector(scan.geometry, fine, scan.window)(mu))
