"""Photon-counting CT in PyTorch: scenes, scanners, scans, projectors, metrics.

Read in the order of the data: :mod:`~torchpcct.geometry` (axes, angles, grids),
:mod:`~torchpcct.scene` (what is scanned), :mod:`~torchpcct.scanner` (by what),
:mod:`~torchpcct.acquisition` (the simulation), :mod:`~torchpcct.scan` (its readings),
:mod:`~torchpcct.formats` (files of other programs), :mod:`~torchpcct.projector`,
:mod:`~torchpcct.volume`, :mod:`~torchpcct.metrics`. Reconstruction is the package :mod:`recon`.
"""

import os
from typing import TYPE_CHECKING

# The threads of the kernels (threads.py) and of torch take turns. By default an idle OpenMP thread
# spins and steals the core from the others: several times slower. OpenMP reads it when torch loads,
# so it stands before anything else.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from torchpcct.cache_folder import ensure_cache
from torchpcct.files import VERSION
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid, full_turn

ensure_cache()  # nothing above compiles kernels

if TYPE_CHECKING:
    from torchpcct.acquisition.acquire import acquire
    from torchpcct.projector import Projector
    from torchpcct.scan import Scan
    from torchpcct.scene.voxels import VoxelScene
    from torchpcct.vector_geometry import VectorGeometry
    from torchpcct.volume import Volume

__version__ = VERSION

__all__ = [
    "ConeBeam",
    "FanBeam",
    "ParallelBeam",
    "Projector",
    "Scan",
    "VectorGeometry",
    "Volume",
    "VolumeGrid",
    "VoxelScene",
    "acquire",
    "full_turn",
]

_LAZY = {
    "Projector": "torchpcct.projector",
    "Scan": "torchpcct.scan",
    "VectorGeometry": "torchpcct.vector_geometry",
    "Volume": "torchpcct.volume",
    "VoxelScene": "torchpcct.scene.voxels",
    "acquire": "torchpcct.acquisition.acquire",
}
"""Names of the package that are imported at their first use, and from where."""


def _check_cache(folder: str, home: str) -> None:
    """Warn if numba can keep compiled kernels neither beside the package nor at home: loading a
    kernel would fail."""
    if "NUMBA_CACHE_DIR" in os.environ or any(
        os.access(_existing(path), os.W_OK) for path in (folder, home)
    ):
        return
    import warnings

    warnings.warn(
        f"numba can keep compiled kernels neither in {folder} nor in {home}: set NUMBA_CACHE_DIR "
        "to a folder that you can write",
        RuntimeWarning,
        stacklevel=2,
    )


def _existing(path: str) -> str:
    """The nearest folder above that exists."""
    while not os.path.exists(path) and os.path.dirname(path) != path:
        path = os.path.dirname(path)
    return path


_check_cache(os.path.dirname(__file__), os.path.expanduser("~/.cache/numba"))


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})


def __getattr__(name: str) -> object:
    # Kernels compile and torch loads on first use: ``import torchpcct`` stays quick.
    if name in _LAZY:
        import importlib

        value = getattr(importlib.import_module(_LAZY[name]), name)
        globals()[name] = value  # also takes the place of a submodule of the same name
        return value
    raise AttributeError(f"module 'torchpcct' has no attribute {name!r}")
