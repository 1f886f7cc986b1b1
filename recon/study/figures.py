"""What the figures of several studies draw alike: the plaque's axial image, its extent, its
outlines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from recon.study.paper.plaque_scan import PlaqueImage
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.placement import RoiPair
from torchpcct.metrics.roi import PROTOCOL_PIXEL_MM
from torchpcct.viz import Panel

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.figure import Figure
    from numpy.typing import NDArray
    from torch import Tensor

    from torchpcct.typing import Bools, Reals


_SHOWN_PX = 160
"""Edge of the middle of an image of the protocol's pixels that shows the vessel and its
surroundings."""


def extent(
    grid: VolumeGrid, vertical: int = -2, horizontal: int = -1
) -> tuple[float, float, float, float]:
    """Edges (left, right, bottom, top) in mm of an image along two axes of ``grid``, about its
    centre."""
    h, v = grid.extent[horizontal] / 2, grid.extent[vertical] / 2
    return (-h, h, -v, v)


def roi_outlines(rois: RoiPair) -> tuple[tuple[Bools, str], ...]:
    """Outlines of the two ROIs of the CNR for a panel: the core's blue, the fibrous tissue's
    red."""
    return (rois.foreground[0], "deepskyblue"), (rois.background[0], "tomato")


Image = TypeVar("Image", "Tensor", "Reals", "Bools")


def _middle(image: Image) -> Image:
    rows, columns = ((n - _SHOWN_PX) // 2 for n in image.shape)
    return image[rows : rows + _SHOWN_PX, columns : columns + _SHOWN_PX]


def middle_panel(image: Any, title: str = "", **more: Any) -> Panel:
    """The vessel and its surroundings in an image of the protocol's pixels; ``more``: other
    fields of the panel."""
    half = 0.5 * PROTOCOL_PIXEL_MM * _SHOWN_PX
    return Panel(_middle(image), (-half, half, -half, half), title, **more)


def plaque_panel(found: PlaqueImage, title: str = "", caption: str = "") -> Panel:
    """The middle of a measured axial image with the outlines of its lumen (red) and its core,
    where found (yellow)."""
    s = found.segmentation
    outlines = [
        (_middle(s.lumen), "tomato"),
        *([(_middle(s.core), "gold")] if s.core_found else []),
    ]
    return middle_panel(found.image, title, outlines=outlines, caption=caption)


def curve_axes(x_label: str, y_labels: Sequence[str]) -> tuple[Figure, NDArray[np.object_]]:
    """A matplotlib figure of curves over one x, side by side, and its axes: one for every label."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.0 * len(y_labels), 3.8), dpi=130, layout="constrained")
    axes = figure.subplots(1, len(y_labels), squeeze=False)[0]
    for ax, label in zip(axes, y_labels, strict=True):
        ax.set_xlabel(x_label)
        ax.set_ylabel(label)
        ax.grid(alpha=0.3)
    return figure, axes
