"""Figures, drawn without a display."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

__all__ = ["WINDOW_HU", "Panel", "panels"]

WINDOW_HU = (150.0, 600.0)
"""Centre and width of the paper's display window (C150 / W600)."""


@dataclass(frozen=True)
class Panel:
    """One picture of a figure.

    Args:
        image: ``(rows, columns)`` HU; row 0 is drawn at the bottom, as y and z grow upwards.
        extent: ``(left, right, bottom, top)`` in mm.
        title: text above.
        outlines: ``(mask, colour)`` pairs; the mask is drawn as an outline, same shape and extent as ``image``
            or any other sampling of that extent.
        caption: text below.
    """

    image: Any
    extent: tuple[float, float, float, float]
    title: str = ""
    outlines: Sequence[tuple[Any, str]] = field(default_factory=tuple)
    caption: str = ""


def panels(grid: Sequence[Sequence[Panel]], row_labels: Sequence[str] = (), title: str = "", footer: str = "") -> Any:
    """A matplotlib figure of panels with one grey scale (C150 / W600 HU) and a scale bar.

    Returns:
        ``matplotlib.figure.Figure``; save it with ``figure.savefig(path)``.
    """
    from matplotlib.figure import Figure

    rows, columns = len(grid), max(len(r) for r in grid)
    figure = Figure(figsize=(1.9 * columns + 0.9, 2.15 * rows + 0.8), dpi=150, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    low, high = WINDOW_HU[0] - WINDOW_HU[1] / 2, WINDOW_HU[0] + WINDOW_HU[1] / 2
    shown = None
    for r in range(rows):
        for c in range(columns):
            ax = axes[r, c]
            ax.set_xticks([])
            ax.set_yticks([])
            if c >= len(grid[r]):
                ax.set_visible(False)
                continue
            panel = grid[r][c]
            shown = ax.imshow(
                np.asarray(panel.image), cmap="gray", vmin=low, vmax=high, origin="lower", extent=panel.extent,
                interpolation="nearest",
            )  # fmt: skip
            for mask, colour in panel.outlines:
                ax.contour(
                    np.asarray(mask, dtype=float), levels=[0.5], colors=[colour], linewidths=0.9, origin="lower",
                    extent=panel.extent,
                )  # fmt: skip
            ax.set_title(panel.title, fontsize=8)
            if panel.caption:
                ax.set_xlabel(panel.caption, fontsize=7)
            if c == 0 and r < len(row_labels):
                ax.set_ylabel(row_labels[r], fontsize=8)
    first = axes[0, 0]
    left, _, bottom, _ = grid[0][0].extent
    first.plot([left + 0.5, left + 1.5], [bottom + 0.5, bottom + 0.5], color="white", linewidth=2)
    first.text(left + 1.0, bottom + 0.75, "1 mm", color="white", fontsize=6, ha="center")
    if shown is not None:
        figure.colorbar(shown, ax=axes, shrink=0.6, label="HU", pad=0.01)
    if title:
        figure.suptitle(title, fontsize=10)
    if footer:
        figure.supxlabel(footer, fontsize=7)
    return figure
