"""What the paper concludes from its tables, as functions of a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.noise.few_runs import Table
from recon.study.paper import facts as paper

__all__ = ["CLAIMS", "Claim"]

Setting = tuple[str, float]


@dataclass(frozen=True)
class Claim:
    """A statement of the paper about its tables.

    Attributes:
        text: what it says.
        needs: settings that must be among those studied.
        holds: ``holds(table, settings)`` → booleans of the table's leading axes.
    """

    text: str
    needs: tuple[Setting, ...]
    holds: Callable[[Table, Sequence[Setting]], NDArray[np.bool_]]


def _smallest(
    figure: Any, settings: Sequence[Setting], shared: int, place: Any, among: Sequence[Any] | None = None
) -> NDArray[np.bool_]:
    """Whether of the settings that share a kernel (``shared`` 0) or a voxel size (1) always the one with the other
    coordinate at ``place`` has the smallest ``figure`` ``(..., settings)``; ``among``: the shared values looked at."""
    result = np.ones(figure.shape[:-1], dtype=bool)
    for value in dict.fromkeys(s[shared] for s in settings):
        if among is None or value in among:
            members = [i for i, s in enumerate(settings) if s[shared] == value]
            wanted = [settings[i][1 - shared] for i in members].index(place)
            result &= figure[..., members].argmin(-1) == wanted
    return result


def _cnr_at(table: Table, settings: Sequence[Setting], wanted: Sequence[Setting]) -> Any:
    return table.cnr[..., [settings.index(w) for w in wanted]]


_QUARTER = tuple((kernel, 0.25) for kernel in paper.KERNELS)
_NOISE_FREE = np.array([paper.NOISE_FREE_ROI_HU["foreground"], paper.NOISE_FREE_ROI_HU["background"]])

CLAIMS = (
    Claim(
        "soft, 0.25 mm has the highest CNR",
        _QUARTER[:1],
        lambda t, s: t.cnr.argmax(-1) == s.index(_QUARTER[0]),
    ),
    Claim(
        "soft and standard at 0.25 mm have the two highest CNRs",
        _QUARTER[:2],
        lambda t, s: (t.cnr >= _cnr_at(t, s, _QUARTER[:2]).min(-1, keepdims=True)).sum(-1) == 2,
    ),
    Claim(
        "at 0.25 mm the CNR falls from soft over standard and detail to bone",
        _QUARTER,
        lambda t, s: (np.diff(_cnr_at(t, s, _QUARTER), axis=-1) < 0).all(-1),
    ),
    Claim(
        "the soft kernel has the least noise at every voxel size",
        _QUARTER[:2],
        lambda t, s: _smallest(t.noise, s, 1, "soft"),
    ),
    Claim(
        "the SD of the core's mean is smallest at 0.25 mm with every kernel",
        _QUARTER[:1],
        lambda t, s: _smallest(t.sd[..., 0], s, 0, 0.25),
    ),
    Claim(
        "the means come closest to 40 and 92 HU at 0.25 mm (soft and standard)",
        _QUARTER[:2],
        lambda t, s: _smallest(np.abs(t.mean - _NOISE_FREE).sum(-1), s, 0, 0.25, ("soft", "standard")),
    ),
    Claim(
        "bone, 0.30 mm has the lowest CNR",
        (("bone", 0.30),),
        lambda t, s: t.cnr.argmin(-1) == s.index(("bone", 0.30)),
    ),
)
"""What the paper reads from its tables. All but the last are stated in its text; the last one is read off its table."""
