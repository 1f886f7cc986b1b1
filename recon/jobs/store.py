"""Cached results on disk: each appears whole or not at all, and is used again by the next run."""

from __future__ import annotations

import contextlib
import copy
import hashlib
import importlib
import json
import logging
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch

from recon.jobs import execute
from recon.jobs.sources import source_digest
from torchpcct.files import LEFTOVER, abandoned, atomic_write, is_foreign, read_hdf5

if TYPE_CHECKING:
    from torchpcct.scan import Scan
    from torchpcct.typing import Array

log = logging.getLogger(__name__)


_TRIES = 100
"""To write a result, where others clear its folder; it is only cached for later, and a study goes
on without."""

_MARK = "cached_as"
"""What the store wrote carries its own file name under this name: a file is removed only if it
says so itself, and one that no store wrote is never replaced. The folder of a cache may be the
user's, or a link to one."""
_SCAN = re.compile(r"-[0-9a-f]{16}\.h5$")
"""Names of kept scans end so, with a task's fingerprint."""


def _digest(key: str, arrays: Mapping[str, Array]) -> str:
    total = hashlib.sha256(key.encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        total.update(f"{name} {array.dtype.str} {array.shape};".encode())
        total.update(array.data)
    return total.hexdigest()


def _read(path: Path) -> tuple[str, dict[str, Array]] | None:
    """Key and arrays of a stored result; None where an earlier version stored it.

    Raises:
        ValueError: its checksum is of another content.
        Exception: whatever a damaged archive leads to.
    """
    with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
        arrays = {k: file[k] for k in file.files}
    if arrays.pop(_MARK, None) is None:
        return None
    key, digest = (str(arrays.pop(k, "")) for k in ("key", "sum"))
    if digest != _digest(key, arrays):
        raise ValueError("its content does not match its checksum")
    return key, arrays


class Store:
    """A folder of ``.npz`` files, each with the key (settings, parameters) that it was made with,
    and its checksum.

    The folder may hold files of others, and be a link: :meth:`clear` and :meth:`remove` touch only
    what a store wrote.

    Args:
        folder: made if need be.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def path(self, name: str) -> Path:
        """A file's path; its folder is made if need be."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def has(self, name: str, key: str) -> bool:
        """Whether a result was cached under this name, with this key."""
        try:
            with np.load(self.folder / (name + ".npz"), allow_pickle=False) as file:
                return _MARK in file and str(file["key"]) == key
        except Exception:  # none, or damaged
            return False

    def cached(self, name: str, key: str, compute: Callable[[], T]) -> T:
        """A result: read if it was cached with the same key, else computed and written.

        A file of that name that no store wrote stays, and the result is not cached.

        Args:
            name: path in the folder, without ending.
            key: everything that the result depends on.
            compute: gives it, anything that :func:`packed` takes.
        """
        path = self.folder / (name + ".npz")
        foreign = is_foreign(path)
        if foreign:
            log.warning(
                "%s is not a stored result of a study: it is left unchanged, and the result of "
                "that name is not stored",
                path,
            )
        elif path.exists():
            try:
                found = _read(path)
                if found is not None and found[0] == key:
                    return unpacked(found[1])
            except Exception as error:  # a damaged archive can fail in any way
                log.warning("%s cannot be read (%s): computed again", path, error)
            else:
                why = "by an earlier version" if found is None else "with other settings"
                log.info("%s was made %s: computed again", path, why)
        arrays = packed(compute())
        if foreign:
            return unpacked(arrays)
        digest = _digest(key, arrays)
        sealed: dict[str, Any] = {
            "key": np.array(key),
            "sum": np.array(digest),
            _MARK: np.array(path.name),
            **arrays,
        }
        for _ in range(_TRIES):
            try:
                # its folder again, which others may clear
                with atomic_write(self.path(name + ".npz")) as part:
                    np.savez(part, **sealed)
                break
            except (FileNotFoundError, FileExistsError) as error:  # of its folder
                log.info("cleared while it was written: %s", error)
        return unpacked(arrays)

    def keep_scan(self, scan: Scan, path: Path) -> None:
        """Write a scan to a path of this folder, marked as the store's."""
        replace(scan, info={**scan.info, _MARK: path.name}).save(path)

    def remove(self, path: Path) -> bool:
        """Remove a file if a store wrote it under this name, or what a store that is dead was
        writing.

        Returns:
            Whether it is gone.
        """
        if not (abandoned(path) if LEFTOVER.match(path.name) else was_kept(path)):
            return False
        path.unlink(missing_ok=True)
        return True

    def clear(self) -> None:
        """Remove what stores wrote into the folder and below, and the folders that this leaves
        empty.

        All else stays: files of others, links, folders that were empty, and what is being written
        at this moment.
        """
        emptied = {str(self.folder)}
        for place, _, names in os.walk(self.folder, topdown=False):
            removed = [name for name in names if self.remove(Path(place, name))]
            if removed or place in emptied:
                # not empty: somebody writes, or it is the user's; or it is a link
                with contextlib.suppress(OSError):
                    os.rmdir(place)
                    emptied.add(os.path.dirname(place))


def was_kept(path: Path) -> bool:
    """Whether a store wrote this file, under this name: the file says so."""
    if path.is_symlink():
        return False
    try:
        if path.suffix == ".npz":
            with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
                return str(file[_MARK]) == path.name
        if path.suffix == ".h5" and _SCAN.search(path.name):
            with read_hdf5(path, "scan") as file:
                return bool(json.loads(file.attrs["info"])[_MARK] == path.name)
    except Exception:  # damaged, or of others
        return False
    return False


T = TypeVar("T")
Step = tuple[Callable[..., object], Iterable[tuple[object, ...]]]
"""A function of a module and the calls of it that are independent, for :meth:`StudyCache.ahead`."""


class StudyCache:
    """The cache of one study: results of its finished parts, of whatever kind, so that the same
    command goes on after an interruption.

    A result is used again only with the same settings and the same source (and weights) of all
    that the study imports: a report never mixes two versions of them. Unlike those of a
    :class:`Store` that a study fills on purpose, they are of no use once the report stands:
    :meth:`clear` takes them away.

    Args:
        folder: of the study's results, where they lie in ``cache``; None: nothing is cached.
        settings: of the study, a dataclass.
    """

    FOLDER = "cache"

    def __init__(self, folder: str | Path | None, settings: object) -> None:
        self._store = None if folder is None else Store(Path(folder) / self.FOLDER)
        self._key = "" if folder is None else f"{settings!r} {_study_digest(settings)}"
        self._settings, self._prefix = settings, ""
        self._asked: set[str] = set()

    def __call__(self, name: str, compute: Callable[[], T]) -> T:
        """What ``compute`` gives, or gave before: anything that :func:`packed` takes.

        Raises:
            ValueError: a name that was asked for already, which would give the other result.
        """
        if self._prefix + name in self._asked:
            raise ValueError(
                f"two cached results of a study have the name {self._prefix + name!r}: name one "
                "of them otherwise"
            )
        self._asked.add(self._prefix + name)
        if self._store is None:
            return compute()
        found: T = self._store.cached(self._prefix + name, self._key, compute)
        return found

    def ahead(self, function: Callable[..., object], calls: Iterable[tuple[object, ...]]) -> None:
        """Let other processes compute and cache the results of calls that are independent, before
        this one reads them one by one.

        Nothing without an executor (:mod:`recon.jobs.execute`), or where nothing is cached.

        Args:
            function: of a module; called as ``function(settings, cache, *call)`` it caches its
                results as the study does.
            calls: texts and numbers, which also name the job.
        """
        executor = execute.current()
        if self._store is None or executor is None:
            return
        store, key = self._store, self._key
        execute.run(
            self._left(function, calls),
            store.folder,
            executor,
            finished=lambda job: store.cached(self._done(job), key, dict),
        )

    def plan(self, *steps: Step) -> None:
        """In a dry run list the jobs of all steps that are not done, of each what :meth:`ahead` is
        given; nothing where none is left.

        Raises:
            recon.jobs.execute.Planned: with the list.
        """
        left = [job for function, calls in steps for job in self._left(function, calls)]
        if left and isinstance(planner := execute.current(), execute.Planner):
            execute.run(left, Path(), planner)

    def _left(
        self, function: Callable[..., object], calls: Iterable[tuple[object, ...]]
    ) -> list[execute.Job]:
        """Those of the jobs of :meth:`ahead` that are not done."""
        name = function.__name__.strip("_")
        jobs = [
            execute.Job(
                " ".join(map(str, (name, *call))),
                _ahead,
                (self._settings, self._prefix, function, call),
                makes=("**/*.npz",),
                module=function.__module__,
            )
            for call in calls
        ]
        store = self._store
        return [j for j in jobs if store is None or not store.has(self._done(j), self._key)]

    def _done(self, job: execute.Job) -> str:
        """Name of what is cached to say that a job is done."""
        return f"done/{hashlib.sha256((self._prefix + job.name).encode()).hexdigest()[:12]}"

    def within(self, prefix: str) -> StudyCache:
        """The same, with names that begin with ``prefix/``."""
        other = copy.copy(self)
        other._prefix = f"{self._prefix}{prefix}/"
        return other

    def folder(self, name: str) -> Path | None:
        """For an evaluation that is part of the study and has a cache of its own; None: nothing is
        cached."""
        return None if self._store is None else self._store.folder / self._prefix / name

    @classmethod
    def clear(cls, folder: str | Path) -> None:
        """Remove what a finished study has cached, and nothing else that lies there."""
        if (Path(folder) / cls.FOLDER).is_dir():
            Store(Path(folder) / cls.FOLDER).clear()


def _ahead(
    root: Path,
    settings: object,
    prefix: str,
    function: Callable[..., object],
    call: tuple[object, ...],
) -> None:
    cache = StudyCache(root.parent, settings)
    cache._prefix = prefix
    function(settings, cache, *call)


def _study_digest(settings: object) -> str:
    """Of the module of a study, in which its settings stand beside its measuring, with all it
    imports."""
    module = type(settings).__module__
    return source_digest(module) if module.startswith("recon.") else source_digest()


def packed(value: object) -> dict[str, Array]:
    """Arrays, and under ``tree`` the JSON text of what they make up, for :meth:`Store.cached`.

    Args:
        value: None, truth values, numbers, texts, arrays, tensors, dataclasses of this software
            (their fields that are given at construction), and lists, tuples and dictionaries of all
            these.

    Raises:
        TypeError: a value of another kind.
    """
    arrays: dict[str, Array] = {}
    return {"tree": np.array(json.dumps(_packed(value, arrays))), **arrays}


def _packed(value: object, arrays: dict[str, Array]) -> object:
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, np.ndarray | np.generic | torch.Tensor):
        name = f"a{len(arrays)}"
        arrays[name] = (
            value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
        )
        if arrays[name].dtype.hasobject:
            raise TypeError("a cached result cannot hold an array of Python objects")
        kinds = {torch.Tensor: "tensor", np.ndarray: "array"}
        return {
            next((text for kind, text in kinds.items() if isinstance(value, kind)), "scalar"): name
        }
    if isinstance(value, list | tuple):
        return {
            type(value).__name__ if type(value) in (list, tuple) else "tuple": [
                _packed(v, arrays) for v in value
            ]
        }
    if isinstance(value, Mapping):
        return {"dict": [[_packed(k, arrays), _packed(v, arrays)] for k, v in value.items()]}
    kind = type(value)
    if is_dataclass(kind) and kind.__module__.startswith(("torchpcct.", "recon.")):
        parts = {f.name: _packed(getattr(value, f.name), arrays) for f in fields(kind) if f.init}
        return {"made": [kind.__module__, kind.__qualname__, parts]}
    raise TypeError(f"a cached result cannot hold a {kind.__module__}.{kind.__qualname__}")


def unpacked(arrays: Mapping[str, Array]) -> Any:
    """The value of :func:`packed`.

    Raises:
        ValueError: a dataclass that is not of this software.
    """
    return _unpacked(json.loads(str(arrays["tree"])), arrays)


def _unpacked(tree: Any, arrays: Mapping[str, Array]) -> Any:
    if not isinstance(tree, dict):
        return tree
    ((kind, of),) = tree.items()
    if kind == "tensor":
        return torch.from_numpy(np.array(arrays[of]))
    if kind in ("array", "scalar"):
        return arrays[of] if kind == "array" else arrays[of][()]
    if kind == "list":
        return [_unpacked(v, arrays) for v in of]
    if kind == "tuple":
        return tuple(_unpacked(v, arrays) for v in of)
    if kind == "dict":
        return {_unpacked(k, arrays): _unpacked(v, arrays) for k, v in of}
    module, name, parts = of
    ours = module.startswith(("torchpcct.", "recon."))
    made: type | None = getattr(importlib.import_module(module), name) if ours else None
    if made is None or not is_dataclass(made):
        raise ValueError(
            f"a stored result has a {module}.{name}, which is not a dataclass of this software"
        )
    return made(**{k: _unpacked(v, arrays) for k, v in parts.items()})
