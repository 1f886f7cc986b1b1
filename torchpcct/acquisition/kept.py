"""Expected readings that were computed before: another realisation of a scan costs its noise alone.

Of the latest scenes they are held in memory, :data:`MOST_BYTES` of all together;
:func:`forget_readings` releases them. A command is a process of its own: :class:`ReadingsFolder`
keeps them in files, in the user's own cache.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
import threading
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchpcct.cache_folder import private_folder

if TYPE_CHECKING:
    from torchpcct.acquisition.plan import Plan
    from torchpcct.typing import Floats


__all__ = ["forget_readings"]

MOST_BYTES = 2**28
"""Of the readings held in memory, of all scenes together; the folder holds twice as many."""
_SOURCES = ("acquisition", "scene", "scanner")
"""Packages whose code decides what a reading is."""


class KnownReadings(NamedTuple):
    """What :func:`torchpcct.acquire` computed of one scene and scanner.

    Attributes:
        plan: what was modelled.
        exterior: readings of the symmetric bodies.
        blocks: readings of the varying bodies by the name of the block of views.
    """

    plan: Plan
    exterior: Floats
    blocks: dict[str, Tensor]

    @property
    def bytes(self) -> int:
        """Size of the readings."""
        return sum(block.nbytes for block in self.blocks.values()) + self.exterior.nbytes


_held: OrderedDict[str, KnownReadings] = OrderedDict()
_lock = threading.Lock()


def fingerprint(*arguments: object) -> str | None:
    """Names what readings are computed from, and the code that computes them; None where that
    cannot be computed (a shape or material of the user's own that cannot be pickled)."""
    try:
        content = pickle.dumps(arguments, protocol=4)
    except Exception:  # whatever the user's own class raises
        return None
    return hashlib.sha256(_code() + content).hexdigest()


@cache
def _code() -> bytes:
    digest = hashlib.sha256()
    for package in _SOURCES:
        for file in sorted((Path(__file__).parent.parent / package).rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.digest()


def recall(key: str | None) -> KnownReadings | None:
    """What is held for a fingerprint; it becomes the latest."""
    with _lock:
        if key is None or key not in _held:
            return None
        _held.move_to_end(key)
        return _held[key]


def remember(key: str | None, known: KnownReadings) -> None:
    """Hold readings; of others the oldest are released until all fit."""
    if key is None or known.bytes > MOST_BYTES:
        return
    with _lock:
        _held[key] = known
        while sum(k.bytes for k in _held.values()) > MOST_BYTES:
            _held.popitem(last=False)


def forget_readings() -> None:
    """Release all expected readings that are held in memory."""
    with _lock:
        _held.clear()


class ReadingsFolder:
    """Readings in files, for ``keep`` of :func:`torchpcct.acquire`; where none can be written they
    are computed again.

    Args:
        key: :func:`fingerprint` of what they are computed from; None: nothing is kept.
        folder: where, one folder for each fingerprint; None: in the user's own cache.
        most_bytes: of all together; the oldest are removed.
    """

    def __init__(
        self, key: str | None, folder: Path | None = None, most_bytes: int = 2 * MOST_BYTES
    ) -> None:
        base = private_folder("readings") if folder is None else folder
        self._base, self._most = base, most_bytes
        self._folder = None if key is None or base is None else base / key

    def __call__(self, name: str, compute: Callable[[], Tensor]) -> Tensor:
        """The readings of a block of views: kept or computed."""
        if self._folder is None:
            return compute()
        path = self._folder / f"{name}.npy"
        with suppress(OSError, ValueError, EOFError):  # not there, or cut off
            values = np.load(path, allow_pickle=False)
            os.utime(self._folder)
            return torch.from_numpy(values)
        found = compute()
        with suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
            draft = path.with_suffix(f".{os.getpid()}")
            with draft.open("wb") as file:
                np.save(file, found.numpy())
            draft.replace(path)
            self._make_room()
        return found

    def _make_room(self) -> None:
        """Remove the folders that were not used for longest, but not this one."""
        assert self._base is not None
        sizes = {
            folder: sum(f.stat().st_size for f in folder.iterdir())
            for folder in sorted(self._base.iterdir(), key=lambda f: f.stat().st_mtime)
        }
        for folder in sizes:
            if sum(sizes.values()) <= self._most:
                return
            if folder != self._folder:
                sizes[folder] = 0
                shutil.rmtree(folder, ignore_errors=True)
