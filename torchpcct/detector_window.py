"""The part of the detector that a grid casts its footprint on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.geometry import (
    Geometry,
    ParallelBeam,
    VolumeGrid,
    beam,
    project_points,
)
from torchpcct.validate import checked, whole
from torchpcct.vector_geometry import VectorGeometry, check_motion

if TYPE_CHECKING:
    from torchpcct.typing import Views


__all__ = ["DetectorWindow", "footprint"]

NOISE_MARGIN_COLUMNS = 128
"""Columns kept on either side of a region's footprint. The ramp filter reaches further, but its
tail falls as 1 / n²: noise beyond 128 columns adds less than 1 % to the spectrum of the filtered
noise at the lowest frequency that a 1 mm ROI can tell from zero."""


@dataclass(frozen=True, eq=False)
class DetectorWindow:
    """The part of a detector that matters: the same number of columns in every view, starting where
    the view says.

    A small inset far from the isocentre is seen by a few per cent of the cells; its window follows
    it around the turn. Data on a window have the shape ``(..., views, rows, columns)`` (2-D:
    ``(..., views, columns)``).

    Args:
        first_column: ``(views,)`` int64, index of the window's first column in each view (0 ≤
            first).
        columns: number of columns, the same in all views.
        first_row, rows: the rows kept, the same in all views (2-D geometries: 0 and 1).
    """

    first_column: NDArray[np.int64]
    columns: int
    first_row: int = 0
    rows: int = 1

    def __post_init__(self) -> None:
        given = np.asarray(self.first_column)
        if given.dtype.kind not in "iu" or given.ndim != 1 or given.size == 0 or given.min() < 0:
            raise ValueError(
                "first_column must be a 1-D array of whole numbers ≥ 0, one per view, got "
                f"{given!r:.80}"
            )
        first = given.astype(np.int64)
        first.setflags(write=False)
        object.__setattr__(self, "first_column", first)
        for name, low in (("columns", 1), ("first_row", 0), ("rows", 1)):
            object.__setattr__(self, name, whole(name, getattr(self, name), low))

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, DetectorWindow)
            and (self.columns, self.first_row, self.rows)
            == (other.columns, other.first_row, other.rows)
            and np.array_equal(self.first_column, other.first_column)
        )

    def __hash__(self) -> int:
        return hash((self.first_column.tobytes(), self.columns, self.first_row, self.rows))

    @property
    def views(self) -> int:
        return int(self.first_column.size)

    @property
    def shape(self) -> tuple[int, int, int]:
        """``(views, rows, columns)``."""
        return self.views, self.rows, self.columns

    @property
    def column_indices(self) -> NDArray[np.int64]:
        """Detector column of every window cell, ``(views, columns)``."""
        return self.first_column[:, None] + np.arange(self.columns)

    def take(self, cells: Tensor) -> Tensor:
        """What each reading of the window has at its cell: ``(..., rows, columns)`` of the whole
        detector to ``(..., views, rows, columns)``."""
        kept = cells[..., self.first_row : self.first_row + self.rows, :]
        if cells.device.type != "cpu":  # one kernel instead of one a view
            columns = torch.from_numpy(self.column_indices).to(cells.device)
            return kept[..., columns].movedim(-2, -3).contiguous()
        out = cells.new_empty((*cells.shape[:-2], *self.shape))
        # Whole runs of columns: 20 times as fast as an index into the cells.
        for view, first in enumerate(self.first_column.tolist()):
            out[..., view, :, :] = kept[..., first : first + self.columns]
        return out

    def less(self, values: Tensor, cells: Tensor, out: Tensor | None = None) -> Tensor:
        """Readings of the window less what stands at their cells, ``values - take(cells)``, view
        by view: what is taken off is never held for all views at once.

        Args:
            values: ``(..., views, rows, columns)``.
            cells: ``(..., rows, columns)`` of the whole detector, on the device and of the dtype of
                ``values``.
            out: where the result is written, ``values`` itself for instance; None: a new tensor.
        """
        tracked = torch.is_grad_enabled() and (values.requires_grad or cells.requires_grad)
        if tracked or values.device.type != "cpu" or values.ndim != cells.ndim + 1:
            return torch.sub(values, self.take(cells), out=out)
        if out is None:
            out = torch.empty_like(values, dtype=torch.result_type(values, cells))
        kept = cells[..., self.first_row : self.first_row + self.rows, :]
        for view, first in enumerate(self.first_column.tolist()):
            torch.sub(
                values[..., view, :, :],
                kept[..., first : first + self.columns],
                out=out[..., view, :, :],
            )
        return out

    def crop(self, values: Tensor, inner: DetectorWindow) -> Tensor:
        """The readings of a smaller window: ``(..., views, rows, columns)`` on this window to those
        on ``inner``.

        Raises:
            ValueError: ``inner`` reaches beyond this window.
        """
        if not self.holds(inner):
            raise ValueError("the inner window reaches beyond the outer one")
        columns = torch.from_numpy(inner.column_indices - self.first_column[:, None])
        row = inner.first_row - self.first_row
        values = values[..., row : row + inner.rows, :]
        index = columns[:, None].to(values.device).expand(*values.shape[:-1], -1)
        return values.gather(-1, index)

    def check(self, geometry: Geometry, name: str = "the window") -> None:
        """Raise ``ValueError`` unless this is a part of the detector of ``geometry`` in each of
        its views."""
        if self.views != geometry.views:
            raise ValueError(
                f"{name} has {self.views} views, but the geometry has {geometry.views}"
            )
        whole = DetectorWindow.full(geometry)
        if not whole.holds(self):
            raise ValueError(
                f"{name} reaches beyond the detector of {whole.rows} rows × {whole.columns} columns"
            )

    @staticmethod
    def full(geometry: Geometry) -> DetectorWindow:
        """The whole detector of ``geometry``."""
        rows = geometry.shape[1] if geometry.has_rows else 1
        return DetectorWindow(np.zeros(geometry.views, np.int64), geometry.columns, 0, rows)

    @staticmethod
    def union(windows: Sequence[DetectorWindow], columns: int) -> DetectorWindow:
        """The smallest window that holds all ``windows`` of a detector with ``columns`` columns."""
        first = np.min([w.first_column for w in windows], axis=0)
        last = np.max([w.first_column + w.columns for w in windows], axis=0)
        width = int((last - first).max())
        first_row = min(w.first_row for w in windows)
        rows = max(w.first_row + w.rows for w in windows) - first_row
        return DetectorWindow(np.minimum(first, columns - width), width, first_row, rows)

    def widened(self, margin: int, outer: DetectorWindow) -> DetectorWindow:
        """This window with ``margin`` more columns on either side and all rows, as far as
        ``outer`` goes."""
        width = min(self.columns + 2 * margin, outer.columns)
        last = outer.first_column + outer.columns - width
        first = np.clip(self.first_column - margin, outer.first_column, last)
        return DetectorWindow(first, width, outer.first_row, outer.rows)

    def within(self, outer: DetectorWindow) -> DetectorWindow:
        """This window, its columns moved into ``outer`` (and cut to its width), its rows cut to
        those of ``outer``.

        Raises:
            ValueError: no row in common.
        """
        columns = min(self.columns, outer.columns)
        first = np.clip(
            self.first_column, outer.first_column, outer.first_column + outer.columns - columns
        )
        row = max(self.first_row, outer.first_row)
        rows = min(self.first_row + self.rows, outer.first_row + outer.rows) - row
        if rows < 1:
            raise ValueError(
                "no detector row of the window sees the grid: move the grid or widen the window"
            )
        return DetectorWindow(first, columns, row, rows)

    def with_rows(self, first_row: int, rows: int) -> DetectorWindow:
        """The same columns of other rows."""
        return DetectorWindow(self.first_column, self.columns, first_row, rows)

    def select(self, views: Views) -> DetectorWindow:
        """The same window for a subset (or reordering) of the views: an index array, mask or
        slice."""
        return DetectorWindow(self.first_column[views], self.columns, self.first_row, self.rows)

    def holds(self, inner: DetectorWindow) -> bool:
        """Whether every reading of ``inner`` is one of this window."""
        before = inner.first_column - self.first_column
        row = inner.first_row - self.first_row
        return bool(
            before.min() >= 0
            and before.max() + inner.columns <= self.columns
            and row >= 0
            and row + inner.rows <= self.rows
        )


@checked
def footprint(
    geometry: Geometry, grid: VolumeGrid, margin: int = 0, motion: object = None
) -> DetectorWindow:
    """The smallest window that sees every voxel corner of ``grid`` in every view.

    Args:
        geometry: parallel, fan or cone beam.
        grid: 2-D grid for a 2-D geometry, 3-D grid for a cone beam.
        margin: columns added on either side (clipped at the detector's edge).
        motion: displacement of the grid per view as for ``Projector``, or None.

    Raises:
        ValueError: a motion of the wrong shape, the grid leaves the field of view, no row sees it,
            or the source's orbit crosses it; a geometry given by vectors.
    """
    if isinstance(geometry, VectorGeometry):
        raise ValueError("a scan given view by view has no windows: use all of its detector")
    geometry = beam(geometry)
    gz = grid.extent[0] / 2 if grid.ndim == 3 else 0.0
    cy, cx = grid.center[-2:]
    hy, hx = grid.extent[-2] / 2, grid.extent[-1] / 2
    corners = np.array([(cx + sx * hx, cy + sy * hy) for sx in (-1, 1) for sy in (-1, 1)])
    beta = geometry.angles[:, None]
    shift = (
        np.zeros((geometry.views, grid.ndim))
        if motion is None
        else check_motion(motion, geometry.views, grid.ndim)
    )
    x, y = corners[:, 0] + shift[:, -1:], corners[:, 1] + shift[:, -2:-1]  # (views, 4)
    if not isinstance(geometry, ParallelBeam):
        depth = geometry.sod - (x * np.cos(beta) + y * np.sin(beta))
        if depth.min() <= 0:
            raise ValueError(
                f"the grid reaches {grid.in_plane_radius:.1f} mm from the axis, beyond the source "
                f"orbit (sod {geometry.sod} mm): move or shrink the grid"
            )
    # Lower and upper end.
    reach = np.array([grid.center[0] - gz, grid.center[0] + gz]) if grid.ndim == 3 else np.zeros(2)
    z = reach[:, None, None] + (shift[:, :1] if grid.ndim == 3 else 0.0)
    position, height = project_points(geometry, x, y, z)
    first_row, rows = 0, 1
    if geometry.has_rows:
        last = geometry.row_positions.size - 1
        row0 = (height.min() - geometry.row_positions[0]) / geometry.row_pitch - 0.5
        row1 = (height.max() - geometry.row_positions[0]) / geometry.row_pitch + 0.5
        if row1 < 0.0 or row0 > last:
            raise ValueError(
                f"the grid (z = {reach[0]:g} … {reach[1]:g} mm) lies above or below all "
                f"{last + 1} rows in every view: move it along z"
            )
        first_row = int(np.clip(math.floor(row0), 0, last))
        rows = int(np.clip(math.ceil(row1), first_row, last)) - first_row + 1
    index = (position - geometry.column_positions[0]) / geometry.column_pitch
    low, high = index.min(axis=1), index.max(axis=1)
    if low.min() < -0.5 - 1e-9 or high.max() > geometry.columns - 0.5 + 1e-9:
        raise ValueError(
            f"the grid (centre x {cx:g}, y {cy:g} mm, {grid.extent[-1]:g} × {grid.extent[-2]:g} "
            f"mm) leaves the field of view of {geometry.columns} columns in some views: move or "
            "shrink it"
        )
    first = np.floor(low + 0.5 - 1e-9).astype(np.int64) - margin
    last = np.ceil(high - 0.5 + 1e-9).astype(np.int64) + margin
    width = min(int((last - first).max()) + 1, geometry.columns)
    first = np.clip(first, 0, geometry.columns - width)
    return DetectorWindow(first, width, first_row, rows)
