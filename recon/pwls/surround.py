"""What lies around an inset when nobody knows it: found by a coarse FBP of the whole field, and taken off the data.

The readings of the inset's shadow hold the patient too. Their line integrals are split as

    y = A x + (y_coarse of what the inset does not hold) + noise,

with a full-field FBP on voxels that are a whole multiple of the inset's, so that the part inside the inset can be put
back voxel by voxel (what remains of an interior problem after the outside is known; Ziegler, Nielsen, Grass 2008, Med.
Phys. 35:1317). Coarse voxels carry the low frequencies of the noise of the whole field, and they alone: high ones stay
with their readings, as the weights of PWLS assume. A second FBP adds what the first does not explain. Along z the
readings are extended by the outermost rows.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from recon.fbp.fbp import fbp
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam, VolumeGrid
from torchpcct.projector import Projector

__all__ = ["UnknownSurround"]

# Voxels of the whole field, and its detector cells at the axis, in mm: about 1 lp/mm.
COARSE_MM = 0.6
# Rows are joined to about this height at the axis, in mm: patients change slowly along z.
COARSE_ROW_MM = 1.5


class UnknownSurround:
    """Takes off what the inset does not hold.

    Args:
        geometry: of the whole scan.
        grid: ``(z, y, x)`` grid of the inset.
        window: its shadow.
        projector: of the inset on its shadow.

    Attributes:
        coarse: the grid of the whole field.
    """

    def __init__(self, geometry: ConeBeam, grid: VolumeGrid, window: DetectorWindow, projector: Projector) -> None:
        g = geometry
        self.grid, self.window, self.projector = grid, window, projector
        self._all = DetectorWindow.full(g)
        scale = g.sdd / g.sod
        self._bin = (
            min(max(round(COARSE_ROW_MM * scale / g.pitch[0]), 1), g.rows),
            max(round(COARSE_MM * scale / g.pitch[1]), 1),
        )
        # Rows and columns that do not fill a bin are left out, as many at either end as the other.
        self._first = tuple((n % b) // 2 for n, b in zip((g.rows, g.columns), self._bin, strict=True))
        rows, columns = (n // b for n, b in zip((g.rows, g.columns), self._bin, strict=True))
        pitch = tuple(p * b for p, b in zip(g.pitch, self._bin, strict=True))
        inner = ConeBeam(g.angles, g.sod, g.sdd, columns, rows, pitch, self._offset(g, rows, columns), g.detector)
        top = g.sdd / (g.sod - inner.fov_radius) * self._half_height(g)
        self._extra = math.ceil(max(top / pitch[0] - rows / 2, 0)) + 1
        self._inner = inner
        self.geometry = replace(inner, rows=rows + 2 * self._extra)
        self.coarse = self._coarse_grid(grid, inner, self._half_height(g))
        self._whole = Projector(inner, self.coarse)
        self._shadow = Projector(g, self.coarse, window)

    def _offset(self, g: ConeBeam, rows: int, columns: int) -> tuple[float, float]:
        """Where the middle of the joined cells lies."""
        found = []
        for at, first, count, join in zip(
            (g.row_positions, g.column_positions), self._first, (rows, columns), self._bin, strict=True
        ):
            found.append(float((at[first] + at[first + count * join - 1]) / 2))
        return found[0], found[1]

    @staticmethod
    def _half_height(g: ConeBeam) -> float:
        """Half the height in mm that the rays of the detector reach inside the field of view."""
        edge = max(abs(g.row_positions[0]), abs(g.row_positions[-1])) + g.pitch[0] / 2
        return edge * (g.sod + g.fov_radius) / g.sdd

    @staticmethod
    def _coarse_grid(grid: VolumeGrid, g: ConeBeam, half_height: float) -> VolumeGrid:
        """Voxels of a whole multiple of the inset's, one of whose corners is the inset's first corner."""
        shape, spacing, center = [], [], []
        for axis, (n, h, c) in enumerate(zip(grid.shape, grid.spacing, grid.center, strict=True)):
            wanted, reach = (COARSE_ROW_MM, half_height) if axis == 0 else (COARSE_MM, g.fov_radius)
            coarse = h * max(round(wanted / h), 1)
            corner = c - n * h / 2
            before, after = math.ceil((corner + reach) / coarse), math.ceil((reach - corner) / coarse)
            shape.append(before + after)
            spacing.append(coarse)
            center.append(corner + (after - before) * coarse / 2)
        return VolumeGrid(tuple(shape), tuple(spacing), tuple(center))

    def joined(self, lines: Tensor) -> Tensor:
        """Line integrals of the whole detector on the coarse one, ``(views, coarse rows, coarse columns)``."""
        rows, columns = self._inner.rows, self._inner.columns
        (r, c), (br, bc) = self._first, self._bin
        kept = lines[:, r : r + rows * br, c : c + columns * bc]
        return kept.reshape(lines.shape[0], rows, br, columns, bc).mean((2, 4))

    def volume(self, lines: Tensor) -> Tensor:
        """The whole field without the inset's details, ``coarse.shape`` mm⁻¹, from line integrals of all cells.

        Coarse voxels and joined rows would smear the details beyond the inset, and they would be taken off its own
        readings: a fine FBP of the inset, less the mean along its sides, is taken off first. (Less its own mean, the
        step that is left at its sides would be smeared: 2.4 HU of a ball in fat.)
        """
        fine = fbp(lines, self._shadow.geometry, self.grid)
        around = lines.clone()
        w = self.window
        columns = torch.from_numpy(w.column_indices)[:, None].expand(w.shape)
        rows = around[:, w.first_row : w.first_row + w.rows]
        rows.scatter_add_(-1, columns, -self.projector(fine - _sides(fine).mean()))
        data = self.joined(around)
        x = self._field(data)
        return x + self._field(data - self._whole(x))

    def _field(self, data: Tensor) -> Tensor:
        """FBP of the coarse readings, rows extended."""
        extended = torch.cat([data[:, :1]] * self._extra + [data] + [data[:, -1:]] * self._extra, dim=1)
        return torch.nan_to_num(fbp(extended, self.geometry, self.coarse))

    def inside(self, volume: Tensor) -> Tensor:
        """The coarse volume on the inset's voxels."""
        for axis, (at, low, h) in enumerate(
            zip(self.grid.axes, (a[0] for a in self.coarse.axes), self.coarse.spacing, strict=True)
        ):
            index = np.clip(np.floor((at - low) / h + 0.5), 0, volume.shape[axis] - 1).astype(np.int64)
            volume = volume.index_select(axis, torch.from_numpy(index))
        return volume

    def level(self, lines: Tensor) -> float:
        """Mean of the inset in mm⁻¹, from line integrals of the whole detector."""
        return float(self.inside(self.volume(lines)).mean())

    def take_off(self, lines: Tensor, level: float) -> Tensor:
        """Line integrals of the inset alone, less those of a constant.

        Args:
            lines: of the whole detector, ``(views, rows, columns)``.
            level: the constant in mm⁻¹ that the inset's voxels are counted from.

        Returns:
            ``(views, rows, columns)`` on the inset's shadow.
        """
        volume = self.volume(lines)
        kept = self._all.crop(lines, self.window)
        return kept - self._shadow(volume) + self.projector(self.inside(volume) - level)


def _sides(volume: Tensor) -> Tensor:
    """The outermost rows and columns of all slices of ``(z, y, x)``, ``(z, n)``."""
    inner = volume[:, 1:-1]
    return torch.cat([volume[:, 0], volume[:, -1], inner[..., 0], inner[..., -1]], 1)
