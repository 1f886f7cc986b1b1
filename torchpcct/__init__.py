"""Photon-counting CT in PyTorch: scenes, scanners, scans, projectors, metrics."""

import os
from typing import TYPE_CHECKING, Any

# numba's and torch's thread pools take turns here. By default an idle OpenMP thread spins for a while and steals the
# core from the other pool: several times slower. OpenMP reads it when torch loads, so it stands before anything else.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from torchpcct.files import VERSION
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid, full_turn

if TYPE_CHECKING:
    from torchpcct.acquisition.acquire import acquire
    from torchpcct.projector import Projector
    from torchpcct.scan import Scan
    from torchpcct.volume import Volume

__version__ = VERSION

__all__ = [
    "ConeBeam",
    "FanBeam",
    "ParallelBeam",
    "Projector",
    "Scan",
    "Volume",
    "VolumeGrid",
    "acquire",
    "full_turn",
]

_LAZY = {
    "Projector": "torchpcct.projector",
    "Scan": "torchpcct.scan",
    "Volume": "torchpcct.volume",
    "acquire": "torchpcct.acquisition.acquire",
}


def __getattr__(name: str) -> Any:
    # Kernels compile and torch loads on first use: ``import torchpcct`` stays quick.
    if name in _LAZY:
        import importlib

        value = getattr(importlib.import_module(_LAZY[name]), name)
        globals()[name] = value  # also takes the place of a submodule of the same name
        return value
    raise AttributeError(f"module 'torchpcct' has no attribute {name!r}")
