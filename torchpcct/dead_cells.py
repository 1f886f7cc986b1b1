"""Cells that read nothing: bridged by their neighbours, so that they do not spread over the image."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["MOST_DEAD", "bridge"]

MOST_DEAD = 0.25
"""Largest share of a view's readings that may be dead: beyond it the neighbours say too little."""


def bridge(lines: Tensor, dead: Tensor, rows: bool) -> Tensor:
    """Replace dead readings by linear interpolation between the nearest live columns of the same row.

    Beyond the outermost live column its value is repeated. A row without any live column is interpolated between the
    nearest live rows.

    Args:
        lines: ``(..., views, [rows,] columns)``.
        dead: bool of the same shape, or one that broadcasts to it.
        rows: whether the last axis but one is the detector's rows (cone beams), so that a lost row can be bridged.

    Returns:
        Tensor of the shape and dtype of ``lines``: linear in the live readings, differentiable, and independent of
        what the dead ones hold.

    Raises:
        ValueError: a view of which more than :data:`MOST_DEAD` is dead.
    """
    dead = dead.expand(lines.shape)
    axes = (-2, -1) if rows else (-1,)
    share = dead.float().mean(axes)
    if float(share.max()) > MOST_DEAD:
        worst = torch.unravel_index(share.argmax(), share.shape)
        raise ValueError(
            f"{100 * float(share.max()):.0f} % of the readings of view {int(worst[-1])} are dead (NaN, Inf or masked), "
            f"at most {100 * MOST_DEAD:.0f} % can be bridged: leave bad views out with geometry.select"
        )
    touched = dead.any(-1)
    filled = lines.clone()
    filled[touched] = _between(lines[touched], dead[touched], -1)
    lost = dead.all(-1, keepdim=True)
    if rows and bool(lost.any()):
        filled = torch.where(lost, _between(filled, lost.expand(lines.shape), -2), filled)
    return filled


def _between(values: Tensor, dead: Tensor, axis: int) -> Tensor:
    """Linear interpolation over the dead along one axis; lines without any live value become 0."""
    n = values.shape[axis]
    values, dead = values.movedim(axis, -1), dead.movedim(axis, -1)
    place = torch.arange(n, device=values.device).expand(values.shape)
    left = torch.where(dead, -1, place).cummax(-1).values
    right = torch.where(dead, n, place).flip(-1).cummin(-1).values.flip(-1)
    left, right = torch.where(left < 0, right, left), torch.where(right == n, left, right)
    share = (place - left) / (right - left).clamp(min=1)
    clean = torch.where(dead, 0.0, values)  # what a dead cell holds must not reach anything, not as 0 × NaN either
    left, right = left.clamp(0, n - 1), right.clamp(0, n - 1)
    filled = torch.lerp(clean.gather(-1, left), clean.gather(-1, right), share.to(values.dtype))
    return torch.where(dead, filled, clean).movedim(-1, axis)
