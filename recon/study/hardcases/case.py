"""What a hard case is, and what is done to a scan in many of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scene import Scene
from torchpcct.scene.plaque import Plaque

__all__ = ["Apply", "Case", "expected", "given", "untouched", "views"]

Apply = Callable[[Scan, Scan, np.random.Generator], Scan]
"""The noise-free scan, its noisy realisation and a random generator, to the scan that is reconstructed."""


@dataclass(frozen=True)
class Case:
    """One hard case.

    Args:
        title: what is wrong with the scan, a table's cell.
        apply: what is done to the scan.
        noise: the best that any method can do, as noise over that of the sound scan: lost quanta are lost. What a
            larger body takes comes on top of it.
        scene: the scene around a plaque, or instead of the body, if it is another one than the sound scan's; ``apply``
            then gets scans of it. What it adds to the sound scan's own bodies, and the voxels beside that, are left out
            of the errors.
        base: ``"plaque"`` or ``"body"``: whose scan is made hard.
        unseen: why no data can show it; empty: they can.
        other: the scene's own bodies differ from those of the sound scan: what the case adds to the error against its
            own truth counts.
        tissues: reconstructed by MBIR with tissues, too.
    """

    title: str
    apply: Apply
    noise: float = 1.0
    scene: Callable[[Plaque], Scene] | None = None
    base: str = "plaque"
    unseen: str = ""
    other: bool = False
    tissues: bool = False


def untouched(scene: Scene, sound: Scene, grid: VolumeGrid) -> NDArray[np.bool_]:
    """Voxels that no body which ``scene`` has beyond those of ``sound`` touches, nor a neighbour of theirs.

    Args:
        scene: of a case.
        sound: of the sound scan.
        grid: ``(z, y, x)``.

    Returns:
        ``grid.shape``, True where the case shows what the sound scan does.
    """
    added = [k for k, name in enumerate(scene.names) if name not in set(sound.names)]
    if not added:
        return np.ones(grid.shape, dtype=bool)
    share = scene.volume_fractions(grid)[added].sum(0)
    return ~np.asarray(ndimage.binary_dilation(share > 0, np.ones((3, 3, 3))))


def expected(change: Callable[[Tensor, Tensor, np.random.Generator], Tensor]) -> Apply:
    """Expected readings and those in air to others; noise comes after it, the sound scan's."""

    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        assert scan.exposure_s is not None
        other = change(clean.counts, clean._at_window(clean.air), rng).float()
        return replace(clean, counts=other).with_noise(scan.exposure_s, scan.seed or 0)

    return apply


def given(make: Callable[[Any, Scan], Scan]) -> Apply:
    """What a user makes of an array of readings."""
    return lambda clean, scan, rng: make(scan.counts.numpy(), scan)


def views(keep: Callable[[int], NDArray[Any]]) -> Apply:
    """Only some of the views."""

    def apply(clean: Scan, scan: Scan, rng: np.random.Generator) -> Scan:
        kept = keep(scan.geometry.views)
        return replace(
            scan, counts=scan.counts[torch.from_numpy(kept)], geometry=scan.geometry.select(kept),
            window=None if scan.window is None else scan.window.select(kept),
        )  # fmt: skip

    return apply
