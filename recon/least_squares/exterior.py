"""What lies around an inset when nobody knows it: found by a coarse FBP of the whole field, and
taken off the data.

The readings of the inset's footprint hold the patient too. Their line integrals are split as

    y = A x + (y_coarse of what the inset does not hold) + noise,

with a full-field FBP on voxels that are a whole multiple of the inset's, so that the part inside
the inset can be put back voxel by voxel (what remains of an interior problem after the outside is
known; Ziegler, Nielsen, Grass 2008, Med. Phys. 35:1317). Coarse voxels carry the low frequencies of
the noise of the whole field, and they alone: high ones stay with their readings, as the weights of
PWLS assume. A second FBP, on larger voxels still, adds what the first does not explain. Along z the
readings are extended by the outermost rows. It takes views enough for its voxels, about 1500 for a
thorax: with 246 the details of the inset leak into its own exterior (10 HU at the edge of a lumen).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Hashable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from recon.analytic.angular_weights import angular_weights
from recon.analytic.detector_edges import cut_off
from recon.analytic.fbp import fbp
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam, VolumeGrid
from torchpcct.projector import Projector

CELL_MM = 0.35 * 626.0 / 1098.0
"""Detector cell at the axis of the scanner on which lengths were chosen, that of the paper, mm."""
FIELD_MM = 626.0 * math.sin(0.35 * 1500 / 2 / 1098.0)
"""Radius of the field of view of that scanner, mm."""
COARSE_MM = 0.6
"""Voxels of the whole field, and its detector cells at the axis, in mm: about 1 lp/mm. On other
scanners so many times as large as the field of view is, and not less than a cell."""
SECOND = 2
"""The second FBP, which adds what the first does not explain, does with so much larger ones in the
plane: cupping and steps at the ends, no details."""
COARSE_ROW_MM = 1.5
"""Rows are joined to about this height at the axis, in mm, likewise: patients change slowly along
z."""
TIE = 1e-9
"""Of a count: rounding of what it is computed from must not decide between two whole numbers."""


def length_unit(geometry: ConeBeam) -> float:
    """How many times as large the detector cells at the axis are as those of :data:`CELL_MM`.

    What was chosen in mm for an inset, the default prior, is taken so many times as large: a scan
    with all lengths times any number, in another unit or of a smaller scanner, gives the same
    image.
    """
    return geometry.cell / CELL_MM


class UnknownExterior:
    """Takes off what the inset does not hold.

    Args:
        geometry: of the whole scan.
        grid: ``(z, y, x)`` grid of the inset.
        window: its footprint.
        projector: of the inset on its footprint.

    Attributes:
        coarse: the grid of the whole field.
    """

    def __init__(
        self, geometry: ConeBeam, grid: VolumeGrid, window: DetectorWindow, projector: Projector
    ) -> None:
        self.geometry, self.grid, self.window, self.projector = geometry, grid, window, projector
        self._all = DetectorWindow.full(geometry)
        self._first, self._second = (
            _Field(geometry, grid, size) for size in (COARSE_MM, SECOND * COARSE_MM)
        )
        self.coarse = self._first.grid
        self._left = Projector(self._second.inner, self.coarse)
        self._around = Projector(geometry, self.coarse, window)
        self._last: tuple[Hashable, Tensor] | None = None

    def volume(self, lines: Tensor) -> Tensor:
        """The whole field without the inset's details, ``coarse.shape`` mm⁻¹, from line integrals
        of all cells.

        Coarse voxels and joined rows would smear the details beyond the inset, and they would be
        taken off its own readings: a fine FBP of the inset, less the mean along its sides, is taken
        off first. (Less its own mean, the step that is left at its sides would be smeared: 2.4 HU
        of a ball in fat.)

        The last volume is kept: the level of a scan and its own readings need the same.

        Raises:
            ValueError: the rows end inside the object.
        """
        of = _fingerprint(lines)
        if self._last is not None and self._last[0] == of:
            return self._last[1]
        if any(cut_off(lines, self.geometry, angular_weights(self.geometry))):
            raise ValueError(
                "the rows end inside the object: what lies beyond the field of view cannot be "
                "taken off the inset's readings (250 HU of a thorax were left); use fbp with "
                "outside=, or a detector that holds the body"
            )
        fine = fbp(lines, self.geometry, self.grid)
        around = lines.clone()
        w = self.window
        columns = torch.from_numpy(w.column_indices).to(lines.device)[:, None].expand(w.shape)
        rows = around[:, w.first_row : w.first_row + w.rows]
        rows.scatter_add_(-1, columns, -self.projector(fine - _sides(fine).mean()))
        x = self._first.fbp(self._first.joined(around))
        left = self._second.fbp(self._second.joined(around) - self._left(x), outside=0.0)
        x += resampled(left, self._second.grid, self.coarse)
        self._last = (of, x)
        return x

    def inside(self, volume: Tensor) -> Tensor:
        """The coarse volume on the inset's voxels."""
        return resampled(volume, self.coarse, self.grid)

    def level(self, lines: Tensor) -> float:
        """Mean of the inset in mm⁻¹, from line integrals of the whole detector."""
        return float(self.inside(self.volume(lines)).mean())

    def take_off(self, lines: Tensor, level: float) -> Tensor:
        """Line integrals of the inset alone, less those of a constant.

        Args:
            lines: of the whole detector, ``(views, rows, columns)``.
            level: the constant in mm⁻¹ that the inset's voxels are counted from.

        Returns:
            ``(views, rows, columns)`` on the inset's footprint.
        """
        volume = self.volume(lines)
        kept = self._all.crop(lines, self.window)
        return kept - self._around(volume) + self.projector(self.inside(volume) - level)


class _Field:
    """FBP of the whole field from joined cells, on voxels about as large as they.

    Args:
        geometry: of the whole scan.
        inset: grid of the inset: the voxels are a whole multiple of its own, and one corner is its
            first one.
        size: mm, of voxels and cells in the plane of the scanner of the paper.

    Attributes:
        inner: the joined detector.
        grid: of the field.
    """

    def __init__(self, geometry: ConeBeam, inset: VolumeGrid, size: float) -> None:
        g = geometry
        scale = g.sdd / g.sod
        share = g.fov_radius / FIELD_MM
        self._coarse_row, size = (
            max(length * share, pitch / scale)
            for length, pitch in zip((COARSE_ROW_MM, size), g.pitch, strict=True)
        )
        self._views = _joined_views(g, size)
        self._bin = (
            min(max(_rounded(self._coarse_row * scale / g.pitch[0]), 1), g.rows),
            max(_rounded(size * scale / g.pitch[1]), 1),
        )
        # Rows and columns that do not fill a bin are left out, as many at either end as the other.
        self._skip = tuple(
            (n % b) // 2 for n, b in zip((g.rows, g.columns), self._bin, strict=True)
        )
        rows, columns = (n // b for n, b in zip((g.rows, g.columns), self._bin, strict=True))
        pitch = tuple(p * b for p, b in zip(g.pitch, self._bin, strict=True))
        angles = g.angles.reshape(-1, self._views).mean(1)
        self.inner = ConeBeam(
            angles, g.sod, g.sdd, columns, rows, pitch, self._offset(g, rows, columns), g.detector
        )
        # Half the height in mm that the rays of the detector reach inside the field of view.
        edge = max(abs(g.row_positions[0]), abs(g.row_positions[-1])) + g.pitch[0] / 2
        half_height = edge * (g.sod + g.fov_radius) / g.sdd
        top = g.sdd / (g.sod - self.inner.fov_radius) * half_height
        self._extra = math.ceil(max(top / pitch[0] - rows / 2, 0)) + 1
        self._extended = replace(self.inner, rows=rows + 2 * self._extra)
        self.grid = self._whole_multiple(inset, size, half_height)

    def _offset(self, g: ConeBeam, rows: int, columns: int) -> tuple[float, float]:
        """Where the middle of the joined cells lies."""
        found = []
        for at, first, count, join in zip(
            (g.row_positions, g.column_positions),
            self._skip,
            (rows, columns),
            self._bin,
            strict=True,
        ):
            found.append(float((at[first] + at[first + count * join - 1]) / 2))
        return found[0], found[1]

    def _whole_multiple(self, inset: VolumeGrid, size: float, half_height: float) -> VolumeGrid:
        shape, spacing, center = [], [], []
        for axis, (n, h, c) in enumerate(
            zip(inset.shape, inset.spacing, inset.center, strict=True)
        ):
            wanted, reach = (
                (self._coarse_row, half_height) if axis == 0 else (size, self.inner.fov_radius)
            )
            coarse = h * max(_rounded(wanted / h), 1)
            corner = c - n * h / 2
            before, after = (
                math.ceil(way / coarse - TIE) for way in (corner + reach, reach - corner)
            )
            shape.append(before + after)
            spacing.append(coarse)
            center.append(corner + (after - before) * coarse / 2)
        return VolumeGrid(tuple(shape), tuple(spacing), tuple(center))

    def joined(self, lines: Tensor) -> Tensor:
        """Line integrals of the whole detector in joined views on the joined one, ``(views,
        rows, columns)``."""
        rows, columns = self.inner.rows, self.inner.columns
        (r, c), (br, bc) = self._skip, self._bin
        kept = lines[:, r : r + rows * br, c : c + columns * bc]
        return kept.reshape(-1, self._views, rows, br, columns, bc).mean((1, 3, 5))

    def fbp(self, data: Tensor, outside: float | None = None) -> Tensor:
        """Volume ``grid.shape`` in mm⁻¹ of joined readings, rows extended by the outermost.

        ``outside`` as for :func:`recon.analytic.fbp.fbp`: 0 for a residual, which has no edge to be
        continued.
        """
        extended = torch.cat(
            [data[:, :1]] * self._extra + [data] + [data[:, -1:]] * self._extra, dim=1
        )
        return torch.nan_to_num(fbp(extended, self._extended, self.grid, outside=outside))


def _fingerprint(lines: Tensor) -> Hashable:
    """What line integrals are distinguished by: a hash or, of those on a device, from which nothing
    is to be copied, the sums of the bits of all views."""
    if lines.device.type == "cpu":
        return hashlib.blake2b(lines.contiguous().numpy().data).digest()
    bits = lines.contiguous().view(torch.int32 if lines.dtype == torch.float32 else torch.int64)
    return tuple(bits.flatten(1).sum(1, dtype=torch.int64).tolist())


def _rounded(value: float) -> int:
    """The nearest whole number, upwards from a half whatever the rounding of the last digit."""
    return math.floor(value + 0.5 + TIE)


def _joined_views(g: ConeBeam, size: float) -> int:
    """How many neighbouring views are joined: as many as leave those that voxels of ``size`` mm
    in the field need."""
    if g.views < 2:
        return 1
    steps = np.diff(g.angles)
    if not np.allclose(steps, steps.mean(), rtol=0.0, atol=1e-6):
        return 1
    needed = (
        0.9
        * math.pi
        * g.fov_radius
        / size
        * (g.angles[-1] - g.angles[0] + steps.mean())
        / (2 * math.pi)
    )
    most = max(int(g.views / max(abs(needed), 1.0)), 1)
    return max(k for k in range(1, most + 1) if g.views % k == 0)


def resampled(volume: Tensor, grid: VolumeGrid, onto: VolumeGrid) -> Tensor:
    """A volume ``grid.shape`` at the voxels of another grid: each takes the voxel that holds its
    centre."""
    for axis, (at, own, h) in enumerate(zip(onto.axes, grid.axes, grid.spacing, strict=True)):
        index = np.clip(np.floor((at - own[0]) / h + 0.5), 0, volume.shape[axis] - 1).astype(
            np.int64
        )
        volume = volume.index_select(axis, torch.from_numpy(index).to(volume.device))
    return volume


def _sides(volume: Tensor) -> Tensor:
    """The outermost rows and columns of all slices of ``(z, y, x)``, ``(z, n)``."""
    inner = volume[:, 1:-1]
    return torch.cat([volume[:, 0], volume[:, -1], inner[..., 0], inner[..., -1]], 1)
