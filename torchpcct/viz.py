"""Figures, drawn without a display, and the page that shows volumes in a browser."""

from __future__ import annotations

import base64
import html
import json
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike
    from torch import Tensor

    from torchpcct.volume import Volume

__all__ = ["Panel", "panels", "viewer_page"]

WINDOW_HU = (150.0, 600.0)
"""Centre and width of the paper's display window (C150 / W600)."""


@dataclass(frozen=True)
class Panel:
    """One picture of a figure.

    Args:
        image: ``(rows, columns)`` HU; row 0 is drawn at the bottom, as y and z grow upwards.
        extent: ``(left, right, bottom, top)`` in mm.
        title: text above.
        outlines: ``(mask, colour)`` pairs; the mask is drawn as an outline, same shape and extent
            as ``image`` or any other sampling of that extent.
        caption: text below.
    """

    image: ArrayLike | Tensor
    extent: tuple[float, float, float, float]
    title: str = ""
    outlines: Sequence[tuple[ArrayLike | Tensor, str]] = field(default_factory=tuple)
    caption: str = ""


def panels(
    grid: Sequence[Sequence[Panel]],
    row_labels: Sequence[str] = (),
    title: str = "",
    footer: str = "",
) -> Figure:
    """A matplotlib figure of panels with one grey scale (C150 / W600 HU) and a scale bar.

    Args:
        grid: rows of panels; a row may be shorter than the others.
        row_labels: one text for each row, at its left.
        title, footer: texts above and below all panels.

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
                np.asarray(panel.image),
                cmap="gray",
                vmin=low,
                vmax=high,
                origin="lower",
                extent=panel.extent,
                interpolation="nearest",
            )
            for mask, colour in panel.outlines:
                ax.contour(
                    np.asarray(mask, dtype=float),
                    levels=[0.5],
                    colors=[colour],
                    linewidths=0.9,
                    origin="lower",
                    extent=panel.extent,
                )
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


_LEAST_STEP_HU = 0.1
"""Finest step of the values in a page, HU."""
_MOST_VOXELS = 2**26
"""Voxels of a page at most."""
_CODES = 65535
"""Of a volume in a page: 0 … 65534 are values, 65535 stands for what is none (NaN, infinity)."""


def viewer_page(volumes: Sequence[tuple[str, Volume, float, float]], title: str) -> str:
    """One HTML page, without network, in which a browser shows volumes side by side
    (``viewer.html``).

    Values are rounded to a power of ten, at most 10 / 65533 of the volume's range: to 0.1 HU up to
    a range of 6553 HU.

    Args:
        volumes: label, volume, and level and width of its first grey scale.
        title: of the page.

    Raises:
        ValueError: no volume, or lengths in different units (mm, pixels); a volume without a finite
            value; more voxels than a browser holds.
    """
    lengths = {"pixels" if v.unit == "pixel^-1" else "mm" for _, v, _, _ in volumes}
    if len(lengths) != 1:
        raise ValueError(
            "a page shows volumes in one unit of length, got "
            f"{' and '.join(sorted(lengths)) or 'none'}"
        )
    voxels = sum(v.data.numel() for _, v, _, _ in volumes)
    if voxels > _MOST_VOXELS:
        raise ValueError(
            f"{voxels / 1e6:.0f} million voxels are too many for one page (at most "
            f"{_MOST_VOXELS / 1e6:.0f} million): show fewer volumes, or reconstruct a smaller "
            "extent or larger voxels"
        )
    about, data = [], []
    for number, (label, volume, level, width) in enumerate(volumes):
        flat = volume.slices()
        values = flat.data.detach().cpu().numpy().astype(np.float64)
        finite = np.isfinite(values)
        if not finite.any():
            raise ValueError(f"{label} has no finite value: reconstruct it again")
        low, high = float(values[finite].min()), float(values[finite].max())
        span = max(high - low, 1e-3 * max(abs(low), abs(high)), 1e-30)
        step = 10.0 ** math.ceil(math.log10(span / (_CODES - 2)))
        step = max(step, _LEAST_STEP_HU) if volume.unit == "HU" else step
        low = math.floor(low / step) * step
        codes = np.where(finite, np.rint((np.where(finite, values, low) - low) / step), _CODES)
        # low bytes before high ones: a tenth less than mixed
        split = codes.ravel().astype("<u2").view(np.uint8)
        packed = zlib.compress(np.concatenate([split[::2], split[1::2]]).tobytes(), 9)
        data.append(f'<script id="data{number}" type="text/plain">{base64_text(packed)}</script>')
        grid = {"shape": flat.grid.shape, "spacing": flat.grid.spacing, "center": flat.grid.center}
        about.append(
            {
                "label": label,
                "unit": flat.unit,
                **grid,
                "low": low,
                "step": step,
                "level": level,
                "width": width,
            }
        )
    page = (resources.files("torchpcct") / "viewer.html").read_text(encoding="utf-8")
    for name, text in (
        ("title", html.escape(title)),
        ("length", lengths.pop()),
        ("data", "\n".join(data)),
        ("volumes", json.dumps(about).replace("<", "\\u003c")),
    ):
        page = page.replace("{{" + name + "}}", text)
    return page


def base64_text(content: bytes) -> str:
    """Base64 for a page: broken where it would by chance read like an address, which browsers
    skip."""
    return base64.b64encode(content).decode().replace("http", "ht\ntp")
