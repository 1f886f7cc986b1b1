"""Readings of dead cells are interpolated from their neighbours, so that they do not spread over the image."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["MOST_DEAD", "bridge"]

_BLOCK = 2**20
"""Readings that are bridged at a time, about."""
MOST_DEAD = 0.25
"""Largest share of a view's readings that may be dead: beyond it the neighbours say too little."""


def bridge(lines: Tensor, dead: Tensor, rows: bool, most: float = MOST_DEAD) -> Tensor:
    """Replace dead readings by linear interpolation between the nearest live ones.

    Along the columns of a row where live readings stand on both sides, else along the rows; beyond the outermost live
    column (then row) its value is repeated. Views without any live reading are interpolated between the nearest live
    ones, in the order given.

    Args:
        lines: ``(..., views, [rows,] columns)``.
        dead: bool of the same shape, or one that broadcasts to it.
        rows: whether the last axis but one is the detector's rows (cone beams), so that a lost row can be bridged.
        most: largest share of a view's readings that may be dead; 1: any, as long as a reading is left.

    Returns:
        Tensor of the shape and dtype of ``lines``: linear in the live readings, differentiable, and independent of
        what the dead ones hold.

    Raises:
        ValueError: a view of which more than ``most`` is dead; no live reading at all.
    """
    dead = dead.expand(lines.shape)
    axes = (-2, -1) if rows else (-1,)
    share = dead.float().mean(axes)
    if float(share.max()) > most:
        worst = torch.unravel_index(share.argmax(), share.shape)
        raise ValueError(
            f"{100 * float(share.max()):.0f} % of the readings of view {int(worst[-1])} are dead (NaN, Inf or masked), "
            f"at most {100 * most:.0f} % can be bridged: leave bad views out with geometry.select"
        )
    if bool(dead.all()):
        raise ValueError("no live reading is left: the scan cannot be used")
    across = ((-1, True), (-2, True), (-1, False), (-2, False)) if rows else ((-1, True), (-1, False))
    view = -3 if rows else -2
    # What a dead cell holds must not reach anything, not as 0 × NaN either. Block by block: indices need memory.
    split = max(view, -lines.ndim)
    step = lines.shape[split] if split != view else max(1, _BLOCK * lines.shape[view] // max(lines.numel(), 1))
    blocks = [
        _bridged_along(torch.where(d, 0.0, v), d, across)
        for v, d in zip(lines.split(step, split), dead.split(step, split), strict=True)
    ]
    values, left = (torch.cat(parts, split) for parts in zip(*blocks, strict=True))
    return _bridged_along(values, left, ((view, True), (view, False)))[0]


def _bridged_along(values: Tensor, dead: Tensor, axes: Sequence[tuple[int, bool]]) -> tuple[Tensor, Tensor]:
    """:func:`_bridged` along one axis after the other, until nothing is dead."""
    for axis, between in axes:
        if not bool(dead.any()):
            break
        values, dead = _bridged(values, dead, axis, between)
    return values, dead


def _bridged(values: Tensor, dead: Tensor, axis: int, between: bool) -> tuple[Tensor, Tensor]:
    """Linear interpolation over the dead along one axis, and what stays dead.

    Args:
        values: any shape, finite.
        dead: of the same shape.
        axis: of both.
        between: only between two live readings; else beyond the outermost live one, too, which is repeated there.
    """
    n = values.shape[axis]
    values, dead = values.movedim(axis, -1), dead.movedim(axis, -1).clone()
    touched = dead.any(-1) & ~dead.all(-1)
    lost = dead[touched]
    place = torch.arange(n, device=values.device).expand(lost.shape)
    left = torch.where(lost, -1, place).cummax(-1).values
    right = torch.where(lost, n, place).flip(-1).cummin(-1).values.flip(-1)
    if between:
        reached = lost & (left >= 0) & (right < n)
        left, right = left.clamp(min=0), right.clamp(max=n - 1)
    else:
        reached = lost
        left, right = torch.where(left < 0, right, left), torch.where(right == n, left, right)
    share = (place - left) / (right - left).clamp(min=1)
    old = values[touched]
    filled = torch.lerp(old.gather(-1, left), old.gather(-1, right), share.to(values.dtype))
    out = values.clone()
    out[touched] = torch.where(reached, filled, old)
    dead[touched] = lost & ~reached
    return out.movedim(-1, axis), dead.movedim(-1, axis)
