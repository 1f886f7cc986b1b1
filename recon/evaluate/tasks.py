"""Tasks from YAML, and those that come with the package (``recon/evaluate/tasks/*.yaml``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon.evaluate.store import Store
from recon.evaluate.task import Facts, Task
from recon.evaluate.vessels import SHAPES, Vessel
from torchpcct import Projector, VolumeGrid
from torchpcct.acquisition.config import configured, grid_of
from torchpcct.formats.damage import read_yaml
from torchpcct.metrics.placement import place_rois, whole_rois
from torchpcct.metrics.roi import axial_grid
from torchpcct.scan import Scan
from torchpcct.scene.plaque import plaque_scene
from torchpcct.scene.plaque.plaque import Plaque
from torchpcct.scene.scene import Scene
from torchpcct.validate import choice, number, numbers

__all__ = ["TASKS", "VesselTask", "read_task", "task_text"]

Floats = NDArray[np.float64]

_FOLDER = resources.files("recon") / "evaluate" / "tasks"
TASKS: tuple[str, ...] = tuple(sorted(Path(str(p)).stem for p in _FOLDER.iterdir() if str(p).endswith(".yaml")))
"""Names of the tasks that come with the package."""
_KEYS = ("name", "title", "scene", "scanner", "signal", "background", "inset", "exposures_s", "reference", "rois",
         "tolerance_hu", "vessel")  # fmt: skip
_VOXEL_MM = 0.2
"""What MBIR's network was trained on."""


def task_text(name: str) -> str:
    """The YAML of a task of :data:`TASKS`.

    Raises:
        ValueError: no such task.
    """
    choice("task", name, TASKS)
    return (_FOLDER / f"{name}.yaml").read_text(encoding="utf-8")


def read_task(what: Any) -> Task:
    """A task from its name (:data:`TASKS`), from a YAML file, or as it is.

    Raises:
        ValueError, TypeError: an unknown name, a file that describes no task; the message names what is wrong.
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


def _task(values: Any, name: str, folder: Path) -> Task:
    if not isinstance(values, Mapping):
        raise ValueError(f"task {name} must be a mapping with {', '.join(_KEYS)}; see torchpcct show-task")
    unknown = [str(k) for k in values if k not in _KEYS]
    if unknown:
        raise ValueError(f"task {name}: unknown {', '.join(unknown)}; it takes {', '.join(_KEYS)}")
    for key in ("scene", "signal", "inset"):
        if key not in values:
            raise ValueError(f"task {name} needs {key}; see torchpcct show-task plaque")
    name = str(values.get("name", name))
    config = configured({k: values[k] for k in ("scene", "scanner", "tolerance_hu") if k in values}, folder)
    scene = config.scene
    if not isinstance(scene, Scene):
        raise ValueError(f"task {name}: the scene must be made of bodies (kind plaque, thorax, water or bodies)")
    signal = values["signal"]
    signal = (signal,) if isinstance(signal, str) else tuple(signal)
    if not signal:
        raise ValueError(f"task {name}: signal names no body of the scene")
    given: dict[str, Any] = {k: values[k] for k in ("background", "title", "reference") if k in values}
    if "exposures_s" in values:
        given["exposures_s"] = tuple(np.ravel(values["exposures_s"]).tolist())
    grid = _inset(f"task {name}: inset", values["inset"], scene, signal)
    make: Any = Task
    if "vessel" in values:
        given["direction"], make = choice("vessel", values["vessel"], tuple(SHAPES)), VesselTask
    task: Task = make(
        name, scene, signal, config.scanner, grid, tolerance_hu=config.tolerance_hu, **given,
    )  # fmt: skip
    if values.get("rois") is None:
        return task
    choice("rois", values["rois"], ("protocol",))
    options = {k: v for k, v in values["scene"].items() if k not in ("kind", "bodies", "variant")}
    return replace(task, rois=_protocol(plaque_scene(**options)[1], grid))


def _inset(name: str, value: Any, scene: Scene, signal: tuple[str, ...]) -> VolumeGrid:
    """A grid as of ``region``; or of ``size`` mm about the signal, in voxels of ``voxel_mm``."""
    if not isinstance(value, Mapping) or "size" not in value:
        return grid_of(name, value)
    unknown = [str(k) for k in value if k not in ("size", "voxel_mm", "center")]
    if unknown:
        raise ValueError(f"{name}: unknown {', '.join(unknown)}; with size it takes voxel_mm and center")

    def triple(what: Any) -> list[float]:
        return [what[a] for a in "zyx"] if isinstance(what, Mapping) else list(what)

    size = numbers(f"{name}.size", triple(value["size"]), 3, positive=True, unit="mm")
    voxel = number(f"{name}.voxel_mm", value.get("voxel_mm", _VOXEL_MM), positive=True, unit="mm")
    # About what the signal lies in, where that is small: a plaque's vessel, not a patient.
    parent = scene[signal[0]].parent
    boxes = [scene.bounding_box(signal)]
    while parent is not None:
        box = scene.bounding_box([parent])
        if not np.isfinite(box).all() or (box[1] - box[0])[:2].max() > min(size):
            break
        boxes.append(box)
        parent = scene[parent].parent
    middle = boxes[-1].mean(0)[::-1]
    center = numbers(f"{name}.center", triple(value["center"]), 3) if "center" in value else middle
    shape = tuple(int(np.ceil(s / voxel - 1e-6)) for s in size)
    return VolumeGrid(shape, voxel, tuple(float(c) for c in center))


def _protocol(plaque: Plaque, grid: VolumeGrid) -> dict[str, Any]:
    """The ROIs of the paper, and the same two tissues in the whole section and in all slices of the core."""
    plain = plaque_scene(plaque)[0]
    x, y, z = (float(v) for v in plaque.to_scanner(plaque.core_center))
    half = float(plaque.core.semi_axes[2])
    pairs = {
        "small": place_rois(plain, axial_grid(grid.center)),
        "slice": whole_rois(plain, VolumeGrid((1, 80, 80), 0.04, (grid.center[0], y, x))),
        "lesion": whole_rois(plain, VolumeGrid((max(1, int(2 * half / 0.05)), 64, 64), 0.05, (z, y, x))),
    }
    return {name: tuple(roi.weights for roi in pair.on(grid)) for name, pair in pairs.items()}


@dataclass(frozen=True, eq=False)
class VesselTask(Task):
    """The paper's plaque on a vessel of any direction.

    The scene gives patient, tissues and scanner; the vessel is painted on 0.1 mm voxels and projected, and changes the
    counts of the patient without it.

    Args:
        direction: a name of :data:`recon.evaluate.vessels.SHAPES`.
    """

    direction: str = "tilted"

    @cached_property
    def _vessel(self) -> Vessel:
        line, branch = SHAPES[self.direction]
        return Vessel(line, self.grid.center, branch)

    def scan(self, store: Store, signal: str) -> Scan:
        """See :meth:`Task.scan`: of the same plaque along z, on the same scanner."""
        return super().scan(Store(store.folder / "straight"), signal)

    def scans(self, store: Store) -> tuple[Scan, Scan]:
        """See :meth:`Task.scans`."""
        paths = [self.scan_file(store, name) for name in ("present", "absent")]
        if not all(p.exists() for p in paths):
            straight = super().scans(store)
            facts = self._facts_of(*straight)
            values = {("core" if t == "signal" else t): v for t, v in zip(facts.tissues, facts.values_hu, strict=True)}
            plain = _without_inset(straight[1])
            fine = VolumeGrid(tuple(2 * n for n in self.grid.shape), self.grid.spacing[0] / 2, self.grid.center)
            project = Projector(plain.geometry, fine, plain.window)
            for path, core in zip(paths, (values["core"], values["fibrous"]), strict=True):
                hu = {n: v - values[self.scene.names[0]] for n, v in {**values, "core": core}.items()}
                x = torch.from_numpy(self._vessel.painted(fine, hu) * (plain.linearisation.mu_ref / 1000.0)).float()
                replace(plain, counts=_behind(plain, project(x))).save(path)
        present, absent = (Scan.load(p) for p in paths)
        return present, absent

    def facts(self, store: Store) -> Facts:
        """Of the vessel along z: values and limit of other directions differ little."""
        return self._facts_of(*super().scans(store))

    @cached_property
    def shares(self) -> dict[str, Floats]:
        """See :attr:`Task.shares`."""
        tissues = list(self._groups)
        own = {"core" if t == "signal" else t: row for t, row in zip(tissues, np.eye(len(tissues)), strict=True)}
        found = np.ascontiguousarray(np.moveaxis(self._vessel.painted(self.grid, own, samples=3), -1, 0))
        return dict(zip(tissues, found, strict=True))

    @property
    def _beside(self) -> Floats:
        return self.shares[self.background]


def _without_inset(scan: Scan) -> Scan:
    """The scan of what surrounds the inset alone."""
    assert scan.surround is not None
    assert scan.window is not None
    return replace(scan, counts=scan.window.take(scan.surround).to(scan.counts))


def _behind(scan: Scan, added: Any) -> Any:
    """Counts of a noise-free scan with linearised line integrals ``added`` on its window."""
    p = scan._at_window(scan.air.log()) - scan.counts.log()
    # One Newton step of the linearisation: what is added is a few per cent of what is there.
    half = p + 0.5 * added / scan.linearisation.slope(p, scan.window)
    return scan.counts * (-added / scan.linearisation.slope(half, scan.window)).exp()
