"""Weighted backprojection of filtered detector data, and its exact transpose."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
import torch
from numpy.polynomial import Chebyshev, Polynomial
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.detector_window import DetectorWindow
from torchpcct.devices import require_triton
from torchpcct.geometry import Beam, Geometry, ParallelBeam, VolumeGrid, beam
from torchpcct.projector.cpu.symmetry import (
    Orbits,
    find_orbits,
    inverse,
    no_orbits,
    place,
)
from torchpcct.projector.operator import apply_linear, is_free
from torchpcct.projector.rays import rays_of
from torchpcct.threads import run
from torchpcct.validate import checked
from torchpcct.vector_geometry import check_motion

if TYPE_CHECKING:
    from torchpcct.typing import Floats


__all__ = ["backproject"]

_KIND = {"parallel": 0, "flat": 1, "curved": 2}
"""Detectors by the number that the kernels know."""
_TILES = ((12, 24), (8, 12))
"""Voxel columns of one task of the 3-D backprojection: small enough for the caches, large enough to
share look-ups."""
_ATAN_TERMS = {torch.float32: (7, 20), torch.float64: (12, 20)}
"""Polynomial lengths of the arc tangent, for usual fans and for half-fans near 90°: one compiled
variant each."""
_ATAN_TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-11}
"""Errors of the fan angle, in columns, at which the longer polynomial takes over: far below
rounding."""
_FEWEST_ROWS = 8
"""Rows of a slab at least: products of a matrix with fewer rows are summed in another order by some
libraries."""


_LANES = 8
"""Values that share positions and weights: a register of float32."""
_SPARE = 17
"""Places behind a row of one lane, or of eight, that are loaded and not used."""
_BLOCK_BYTES = 128 << 10
"""Sums of a task, which stay in the second-level cache."""
_BLOCK_LINES = 16
"""Lines of a task at most."""


@functools.lru_cache(maxsize=64)
def _atan_polynomial(reach: float, columns_per_rad: float, dtype: torch.dtype) -> tuple[float, ...]:
    """Coefficients c of ``2 atan(t) ≈ t · c(t²)`` for |t| ≤ reach, highest power first."""
    tolerance = _ATAN_TOLERANCE[dtype] / max(columns_per_rad, 1.0)
    reach = max(reach, 1e-3)
    u = 0.5 * reach**2 * (1.0 - np.cos((np.arange(200) + 0.5) / 200 * math.pi))
    value = 2.0 * np.arctan(np.sqrt(u)) / np.sqrt(u)
    for terms in _ATAN_TERMS[dtype]:
        fit = Chebyshev.fit(u, value, terms - 1, domain=[0.0, reach**2])
        if np.abs(fit(u) - value).max() * reach < tolerance:
            break
    return tuple(float(c) for c in fit.convert(kind=Polynomial).coef[::-1])


@checked
def check_data(name: str, data: object, shape: tuple[int, ...]) -> None:
    if not isinstance(data, Tensor):
        raise TypeError(
            f"{name} must be a torch.Tensor, got {type(data).__name__}: use torch.as_tensor"
        )
    if data.dtype not in (torch.float32, torch.float64):
        raise TypeError(
            f"{name} must be float32 or float64, got {data.dtype}: convert it with .float() or "
            ".double()"
        )
    if data.ndim < len(shape) or tuple(data.shape[data.ndim - len(shape) :]) != shape:
        expected = ", ".join(["...", *map(str, shape)])
        raise ValueError(f"{name} must have the shape ({expected}), got {tuple(data.shape)}")


@checked
def data_shape(geometry: Geometry, window: DetectorWindow) -> tuple[int, ...]:
    if geometry.has_rows:
        return (window.views, window.rows, window.columns)
    return (window.views, window.columns)


@functools.lru_cache(maxsize=16)
def _shared_views(geometry: Beam, grid: VolumeGrid, moving: bool) -> Orbits:
    """Views of a slice that share positions and weights: no two, unless the grid lies on itself
    after every turn and reflection."""
    found = find_orbits(geometry, grid, rays_of(geometry), moving)
    placed = place(found.operations, grid)
    return no_orbits(geometry.views) if placed.apart or placed.shift.any() else found


class BackprojectionPlan:
    """Geometry of one backprojection, and its two maps for numba; arguments as of
    :func:`backproject`."""

    def __init__(
        self,
        geometry: Geometry,
        grid: VolumeGrid,
        window: DetectorWindow,
        motion: Any = None,
    ) -> None:
        self.grid, self.window = grid, window
        self.geometry = geometry = beam(geometry)
        self.cone, pitch = geometry.has_rows, geometry.column_pitch
        if isinstance(geometry, ParallelBeam):
            self.kind, self.sod, self.sdd = _KIND["parallel"], 0.0, 0.0
        else:
            self.kind, self.sod, self.sdd = _KIND[geometry.detector], geometry.sod, geometry.sdd
        axes = 3 if self.cone else 2
        if grid.ndim != axes:
            raise ValueError(
                f"a {type(geometry).__name__} needs a {axes}-D grid, got {grid.ndim} axes"
            )
        window.check(geometry)
        self.cosines, self.sines = np.cos(geometry.angles), np.sin(geometry.angles)
        self.shifts = _shifts(motion, self.cosines, self.sines, grid.ndim)
        self.motion = motion if is_free(motion) else None
        self.travel = float(np.hypot(self.shifts[:, 0], self.shifts[:, 1]).max())
        if self.kind != 0 and grid.in_plane_radius + self.travel >= self.sod:
            raise ValueError(
                f"the grid reaches {grid.in_plane_radius + self.travel:.1f} mm from the axis, "
                f"beyond the source orbit (sod {self.sod} mm): move or shrink the grid"
            )
        self.scale = 1.0 / pitch
        first = geometry.column_positions[0]
        self.starts = -first / pitch - window.first_column.astype(np.float64)
        self.row_scale = self.row_start = 0.0
        if self.cone:
            self.row_scale = 1.0 / geometry.row_pitch
            self.row_start = -geometry.row_positions[0] / geometry.row_pitch - window.first_row
        self.mask = self._outside(geometry)
        self._check_window(geometry)

    def _outside(self, geometry: Beam) -> NDArray[np.bool_] | None:
        """Voxel columns that some view may not see, or None. An inset must be seen whole.

        A grid that moves loses the voxels that its longest displacement could take out of the field
        of view."""
        self.radius = float(geometry.fov_radius)
        y, x = self.grid.axes[-2:]
        limit = self.radius * (1.0 + 1e-9)
        if np.hypot(np.abs(y).max(), np.abs(x).max()) + self.travel <= limit:
            return None
        outside = np.hypot(y[:, None], x[None, :]) + self.travel > limit
        half_y, half_x = self.grid.extent[-2] / 2.0, self.grid.extent[-1] / 2.0
        cy, cx = self.grid.center[-2:]
        if abs(cy) > half_y or abs(cx) > half_x or outside.all():
            raise ValueError(
                f"the grid (centre x {cx:g}, y {cy:g} mm, {2 * half_x:g} × {2 * half_y:g} mm) "
                f"leaves the field of view of radius {self.radius:.2f} mm: move or shrink it"
            )
        return outside

    def _check_window(self, geometry: Any) -> None:
        """Every neighbour that interpolation reads must be in the window, or beyond the
        detector's edge."""
        if self.mask is not None:
            if self.window.columns != geometry.columns:
                raise ValueError(
                    "a grid that is larger than the field of view needs all columns: pass no window"
                )
            return
        y, x = self.grid.axes[-2:]
        cy, cx = np.meshgrid(y[[0, -1]], x[[0, -1]], indexing="ij")
        c, s = self.cosines[:, None], self.sines[:, None]
        across = cy.ravel() * c - cx.ravel() * s + self.shifts[:, 1:2]
        depth = self.sod - self.shifts[:, :1] - (cx.ravel() * c + cy.ravel() * s)
        if self.kind == 0:
            position, height = across, np.ones_like(across)
        elif self.kind == 1:
            position, height = self.sdd * across / depth, self.sdd / depth
        else:
            position, height = (
                self.sdd * np.arctan2(across, depth),
                self.sdd / np.hypot(across, depth),
            )
        index = position * self.scale + self.starts[:, None]
        first = self.window.first_column
        low, high = index.min(axis=1), index.max(axis=1)
        missing = (low < -1e-6) & (first > 0)
        missing |= (high > self.window.columns - 1 + 1e-6) & (
            first + self.window.columns < geometry.columns
        )
        if missing.any():
            raise ValueError(
                f"the window misses columns that the grid needs in view {int(np.argmax(missing))}: "
                "use torchpcct.detector_window.footprint(geometry, grid, margin=1, motion=motion)"
            )
        if self.cone:
            z = self.grid.axes[0][[0, -1]] + np.array(
                [self.shifts[:, 2].min(), self.shifts[:, 2].max()]
            )
            row = (
                z[:, None] * np.array([height.min(), height.max()]) * self.row_scale
                + self.row_start
            )
            w = self.window
            short = row.min() < -1e-6 and w.first_row > 0
            short |= row.max() > w.rows - 1 + 1e-6 and w.first_row + w.rows < geometry.rows
            if short:
                raise ValueError(
                    f"the window's rows {w.first_row}…{w.first_row + w.rows - 1} do not cover the "
                    "grid: use torchpcct.detector_window.footprint(geometry, grid, margin=1, "
                    "motion=motion)"
                )

    def _arguments(self, dtype: torch.dtype) -> list[object]:
        axes = self.grid.axes
        common: list[object] = [
            self.cosines,
            self.sines,
            self.shifts,
            self.starts,
            axes[-1],
            axes[-2],
        ]
        if self.cone:
            common.append(axes[0])
        common += [self.sod, self.sdd, self.scale]
        if self.cone:
            common += [self.row_scale, self.row_start]
        radius = self.grid.in_plane_radius + self.travel
        reach = math.tan(0.5 * math.asin(radius / self.sod)) if self.kind == 2 else 0.0
        return [*common, _atan_polynomial(reach, self.sdd * self.scale, dtype)]

    def _tile(self) -> tuple[int, int]:
        """The largest tile over which heights on the detector change by about a row at most, if
        one will do."""
        _, dy, dx = self.grid.spacing
        reach = float(np.abs(self.grid.axes[0]).max()) * self.row_scale
        near = max(self.sod - math.hypot(*self.grid.center[1:]), 0.1 * self.sod)
        diagonal = near**2 / (self.sdd * max(reach, 1e-9))
        for y, x in _TILES:
            if math.hypot(y * dy, x * dx) <= diagonal:
                return y, x
        return _TILES[0]

    def rows(self, first: int, stop: int) -> tuple[int, int]:
        """Of a cone beam: the first row of the window that the slices ``first`` … ``stop - 1``
        read, and the one after their last."""
        seen = self.radius if self.mask is not None else self.grid.in_plane_radius
        radius = min(seen, self.grid.in_plane_radius) + self.travel
        z = self.grid.axes[0][[first, stop - 1]] + np.array(
            [self.shifts[:, 2].min(), self.shifts[:, 2].max()]
        )
        heights = self.sdd / (self.sod + np.array([-radius, radius])) * self.row_scale
        row = np.outer(z, heights) + self.row_start
        # What a row needs of its neighbours, and a kink of a tile that reaches beyond the field of
        # view.
        low = int(np.clip(math.floor(row.min()) - 3, 0, max(self.window.rows - _FEWEST_ROWS, 0)))
        return low, int(
            np.clip(
                math.floor(row.max()) + 4,
                min(low + _FEWEST_ROWS, self.window.rows),
                self.window.rows,
            )
        )

    def __call__(self, filtered: Tensor) -> Tensor:
        """:meth:`forward`, differentiable, of data on any device; of a motion that wants
        gradients, of first order by both."""
        if self.motion is not None:
            return cast(Tensor, _AlongMotion.apply(filtered, self.motion, self))
        return apply_linear(filtered, self.forward, self.transpose)

    def _there(self, like: Tensor) -> tuple[Any, ...]:
        """What :mod:`recon.analytic.backproject_triton` is given beside the data: on the device and
        in the dtype of ``like``."""
        axes, center = self.grid.axes, self.grid.center
        c, s, (cy, cx) = self.cosines, self.sines, center[-2:]
        across = cy * c - cx * s + self.shifts[:, 1]
        depth = self.sod - self.shifts[:, 0] - (cx * c + cy * s)
        unit, reach = self.scale * (self.sdd or 1.0), 0.0
        if self.kind == _KIND["parallel"]:
            position = across
        elif self.kind == _KIND["flat"]:
            position = across / depth
        else:
            position = np.arctan2(across, depth)
            y, x = (axis[[0, -1]] - m for axis, m in zip(axes[-2:], (cy, cx), strict=True))
            y, x = (v.ravel()[:, None] for v in np.meshgrid(y, x, indexing="ij"))
            corners = np.arctan2(across + y * c - x * s, depth - (x * c + y * s))
            reach = math.tan(0.5 * float(np.abs(corners - position).max()))
        position = position * unit + self.starts
        whole = np.floor(position)
        table = np.stack([c, s, across, depth, position - whole, self.shifts[:, 2]], 1)
        atan = _atan_polynomial(reach, unit, like.dtype)
        numbers = [
            number
            for axis, middle, pitch in zip(axes, center, self.grid.spacing, strict=True)
            for number in (axis[0] - middle, pitch)
        ]
        numbers += [self.sod, unit]
        if self.cone:
            numbers[0] = axes[0][0]
            numbers += [self.sdd * self.row_scale, self.row_start]
        return (
            torch.from_numpy(table).to(like),
            torch.from_numpy(whole.astype(np.int32)).to(like.device),
            torch.from_numpy(np.array(atan)).to(like),
            torch.from_numpy(np.array(numbers)).to(like),
            self.kind,
        )

    def _forward_there(self, data: Tensor) -> Tensor:
        """:meth:`forward` by Triton's kernels."""
        require_triton(data.device, "filtered backprojection")
        from recon.analytic import backproject_triton as kernels  # Triton may be missing

        n = 3 if self.cone else 2
        lead, shape = data.shape[:-n], data.shape[-n:]
        out = data.new_empty((math.prod(lead), *self.grid.shape))
        if out.shape[0]:
            work = kernels.backproject_volume if self.cone else kernels.backproject_plane
            work(data.reshape(-1, *shape).contiguous(), out, *self._there(data))
            if self.mask is not None:
                out.masked_fill_(torch.from_numpy(self.mask).to(out.device), 0.0)
        return out.view(*lead, *self.grid.shape)

    def _transpose_there(self, volume: Tensor) -> Tensor:
        """:meth:`transpose` with torch alone: view by view the same weights are added up, without
        atomics (``index_put_`` sorts), so that the sums have a fixed order."""
        w, n = self.window, self.grid.ndim
        lead = volume.shape[:-n]
        cells = (w.rows, w.columns) if self.cone else (w.columns,)
        out = volume.new_zeros((math.prod(lead), w.views, math.prod(cells)))
        flat = volume.reshape(len(out), -1)
        if self.mask is not None:
            outside = torch.from_numpy(np.broadcast_to(self.mask, self.grid.shape).ravel().copy())
            flat = flat.masked_fill(outside.to(flat.device), 0.0)
        batch = torch.arange(len(out), device=flat.device)[:, None]
        axes = self._axes(flat.device)
        for v in range(w.views):
            for cell, weight in self._neighbours(v, *axes):
                values = flat * weight.to(flat)
                where = batch.expand(values.shape), cell.expand(values.shape)
                out[:, v].index_put_(where, values, accumulate=True)
        return out.view(*lead, w.views, *cells)

    def _axes(self, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
        """Places of the voxels, z, y and x, which broadcast."""
        z, y, x = (
            torch.from_numpy(axis.copy()).to(device)
            for axis in (self.grid.axes if self.cone else (np.zeros(1), *self.grid.axes))
        )
        return z[:, None, None], y[:, None], x

    def by_motion(self, data: Tensor, gradient: Tensor) -> Tensor:
        """Gradient of ⟨gradient, forward(data)⟩ by the motion, ``(views, axes)`` float64.

        Args:
            data: ``(..., views, [rows,] columns)``.
            gradient: ``(..., [z,] y, x)``.
        """
        n = self.grid.ndim
        flat = gradient.reshape(-1, *self.grid.shape)
        if self.mask is not None:
            flat = flat.masked_fill(torch.from_numpy(self.mask).to(flat.device), 0.0)
        flat = flat.flatten(1)
        cells = data.reshape(-1, *data.shape[-n:]).flatten(2)
        axes = self._axes(data.device)
        found = torch.zeros(self.window.views, 3, dtype=torch.float64)
        for v in range(self.window.views):
            shift = torch.tensor(self.shifts[v], device=data.device, requires_grad=True)
            with torch.enable_grad():
                total = shift.new_zeros(())
                for cell, weight in self._neighbours(v, *axes, shift=shift):
                    total = total + ((flat * cells[:, v, cell]).sum(0).double() * weight).sum()
            found[v] = torch.autograd.grad(total, shift)[0].cpu()
        toward, aside, up = found.unbind(1)
        c, s = torch.from_numpy(self.cosines), torch.from_numpy(self.sines)
        plane = [toward * s + aside * c, toward * c - aside * s]
        return torch.stack([up, *plane] if self.cone else plane, 1)

    def _neighbours(
        self, view: int, z: Tensor, y: Tensor, x: Tensor, shift: Tensor | None = None
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Of one view the readings that voxels are interpolated between, flattened, and their
        weights, ``(voxels,)`` each; ``shift``: the view's :attr:`shifts` as a tensor."""
        c, s = float(self.cosines[view]), float(self.sines[view])
        toward, aside, up = self.shifts[view].tolist() if shift is None else shift
        across, depth = y * c - x * s + aside, (self.sod - toward) - (x * c + y * s)
        distance = depth
        if self.kind == _KIND["parallel"]:
            position, height = across, torch.ones_like(across)
            weight = height
        else:
            if self.kind == _KIND["curved"]:
                distance = torch.hypot(across, depth)
                position = self.sdd * torch.atan2(across, depth)
            else:
                position = self.sdd * across / depth
            height, weight = self.sdd / distance, (self.sod / distance).square()
        columns = _between(position * self.scale + float(self.starts[view]), self.window.columns)
        rows = [(torch.zeros_like(z, dtype=torch.int64), torch.ones_like(z))]
        if self.cone:
            rows = _between((z + up) * height * self.row_scale + self.row_start, self.window.rows)
        for row, along in rows:
            for column, share in columns:
                cell = (row * self.window.columns + column).flatten()
                yield cell, (weight * share * along).flatten()

    def forward(
        self, data: Tensor, slices: tuple[int, int] | None = None, first_row: int = 0
    ) -> Tensor:
        """``(..., views, [rows,] columns)`` to ``(..., [z,] y, x)``.

        Of a cone beam, with ``slices`` (first, stop) only these of the volume, from the rows of the
        window that start at ``first_row`` and hold :meth:`rows`: the same bits as in the whole.
        On another device than the CPU, where ``slices`` are not known, Triton's kernels do it.
        """
        if data.device.type != "cpu":
            if slices is not None:
                raise ValueError("slab by slab FBP computes on the CPU: move the data there")
            return self._forward_there(data)
        from recon.analytic import backproject_kernels as kernels  # numba loads with its first use

        n = 3 if self.cone else 2
        lead, shape = data.shape[:-n], data.shape[-n:]
        first, stop = (0, self.grid.shape[0]) if slices is None else slices
        shape_out = (stop - first, *self.grid.shape[1:]) if self.cone else self.grid.shape
        out = data.new_empty((math.prod(lead), *shape_out))
        if out.shape[0]:
            numbers = data.reshape(-1, *shape).contiguous().numpy()
            arguments = self._arguments(data.dtype)
            if self.cone:
                tile, z = self._tile(), self.grid.axes[0]
                arguments[6] = z[first:stop]
                arguments += [float(first_row), z[0], z[-1]]
                tasks = len(out) * math.prod(
                    -(-n // t) for n, t in zip(out.shape[-2:], tile, strict=True)
                )
                run(
                    kernels.backproject_3d,
                    tasks,
                    self.kind,
                    numbers,
                    *arguments,
                    *tile,
                    out.numpy(),
                )
            else:
                self._plane(numbers, arguments, out.numpy())
            if self.mask is not None:
                out.masked_fill_(torch.from_numpy(self.mask), 0.0)
        return out.view(*lead, *shape_out)

    def _plane(self, data: NDArray, arguments: list[Any], out: NDArray) -> None:
        """Slices ``data (B, V, columns)`` into ``out (B, Y, X)``: symmetric views of a slice, and
        slices, are lanes that share positions and weights."""
        from recon.analytic import backproject_kernels as kernels

        orbits, (ny, nx) = self._orbits, self.grid.shape
        operations = len(orbits.operations)
        images = max(1, min(len(data), _LANES // operations))
        lanes = 1 << (images * operations - 1).bit_length()
        groups, views = -(-len(data) // images), orbits.views.size
        poses = [np.ascontiguousarray(values[orbits.views]) for values in arguments[:4]]
        columns, first = self.window.columns, np.zeros(self.window.views, dtype=np.int64)
        if operations > 1:  # what symmetric views share refers to the whole detector
            columns, first = self.geometry.columns, self.window.first_column
            poses[-1] = poses[-1] + first[orbits.views]
        rows = np.empty((groups, views, columns * lanes + _SPARE), dtype=data.dtype)
        run(
            kernels.interleave_lanes,
            groups * views,
            data,
            first,
            orbits.target,
            orbits.reverse,
            images,
            columns,
            lanes,
            rows,
            operations=columns * lanes,
        )
        block = max(1, min(_BLOCK_BYTES // (nx * lanes * data.itemsize), _BLOCK_LINES))
        sums = np.empty((groups, ny, nx * lanes), dtype=data.dtype)
        run(
            kernels.backproject_2d,
            groups * -(-ny // block),
            (0,) * lanes,
            self.kind,
            rows,
            *poses,
            *arguments[4:],
            columns,
            block,
            self._inside(),
            sums,
        )
        run(
            kernels.collect_lanes,
            len(data) * -(-ny // kernels.TILE),
            sums.reshape(groups, ny, nx, lanes),
            np.array([inverse(g, ny, nx) for g in orbits.operations]),
            images,
            out,
            operations=kernels.TILE * nx * operations,
        )

    @functools.cached_property
    def _orbits(self) -> Orbits:
        """Of a slice: which views share positions and weights."""
        return _shared_views(self.geometry, self.grid, bool(self.shifts.any()))

    def _inside(self) -> NDArray[np.int64]:
        """Of a slice: ``(Y, 2)``, the first pixel of each line that some view sees, and the one
        after the last."""
        ny, nx = self.grid.shape
        if self.mask is None:
            return np.tile([0, nx], (ny, 1))
        seen: NDArray[np.bool_] = np.logical_not(self.mask)
        first, last = seen.argmax(axis=1), nx - seen[:, ::-1].argmax(axis=1)
        some = np.asarray(seen.any(axis=1))
        return np.where(some[:, None], np.stack([first, last], axis=1), 0)

    def transpose(self, volume: Tensor) -> Tensor:
        """``(..., [z,] y, x)`` to ``(..., views, [rows,] columns)``: the exact transpose of
        :meth:`forward`."""
        if volume.device.type != "cpu":
            return self._transpose_there(volume)
        from recon.analytic import backproject_kernels as kernels  # numba loads with its first use

        n = self.grid.ndim
        lead = volume.shape[:-n]
        w = self.window
        shape = (w.views, w.rows, w.columns) if self.cone else (w.views, w.columns)
        out = volume.new_empty((math.prod(lead), *shape))
        if out.shape[0]:
            volume = volume.reshape(-1, *self.grid.shape)
            if self.mask is not None:
                volume = volume.masked_fill(torch.from_numpy(self.mask), 0.0)
            arguments = self._arguments(volume.dtype)
            if self.cone:
                numbers = volume.permute(0, 2, 3, 1).contiguous().numpy()
                run(
                    kernels.spread_3d,
                    len(out) * w.views,
                    self.kind,
                    numbers,
                    *arguments,
                    out.numpy(),
                )
            else:
                numbers = volume.contiguous().numpy()
                run(
                    kernels.spread_2d,
                    len(out) * w.views,
                    self.kind,
                    numbers,
                    *arguments,
                    out.numpy(),
                )
        return out.view(*lead, *shape)


class _MotionContext(Protocol):
    """What a backprojection along a motion keeps for its derivatives."""

    plan: BackprojectionPlan
    saved_tensors: tuple[Tensor, ...]
    needs_input_grad: tuple[bool, ...]

    def save_for_backward(self, *tensors: Tensor) -> None: ...


class _AlongMotion(torch.autograd.Function):
    """Backprojection with gradients by the data and by the motion.

    A volume is piecewise smooth in the motion: as of the projector's readings, a second derivative
    by it says nothing.
    """

    @staticmethod
    def forward(filtered: Tensor, motion: Tensor, plan: BackprojectionPlan) -> Tensor:
        return plan.forward(filtered)

    @staticmethod
    def setup_context(
        ctx: _MotionContext, inputs: tuple[Tensor, Tensor, BackprojectionPlan], output: Tensor
    ) -> None:
        filtered, motion, ctx.plan = inputs
        ctx.save_for_backward(filtered, motion)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: _MotionContext, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        filtered, motion = ctx.saved_tensors
        (gradient,) = gradients
        by_data = ctx.plan.transpose(gradient) if ctx.needs_input_grad[0] else None
        by_motion = None
        if ctx.needs_input_grad[1]:
            by_motion = ctx.plan.by_motion(filtered, gradient).to(motion)
        return by_data, by_motion, None


def _between(position: Tensor, cells: int) -> list[tuple[Tensor, Tensor]]:
    """The two cells about each place and their shares; the outermost cell is repeated."""
    at = position.clamp(0.0, cells - 1.0)
    low = at.floor().clamp_max(max(cells - 2, 0))
    share = at - low
    left = low.long()
    return [(left, 1.0 - share), ((left + 1).clamp_max(cells - 1), share)]


def _shifts(motion: Any, cosines: Floats, sines: Floats, axes: int) -> NDArray[np.float64]:
    """Displacement towards the source, along the columns and upwards, ``(views, 3)`` mm."""
    out = np.zeros((cosines.size, 3))
    if motion is None:
        return out
    shift = check_motion(motion, cosines.size, axes)
    x, y = shift[:, -1], shift[:, -2]
    out[:, 0], out[:, 1] = x * cosines + y * sines, y * cosines - x * sines
    if axes == 3:
        out[:, 2] = shift[:, 0]
    return out


@checked
def backproject(
    filtered: Tensor,
    geometry: Geometry,
    grid: VolumeGrid,
    window: DetectorWindow | None = None,
    *,
    motion: object = None,
) -> Tensor:
    """Backproject filtered data with FBP's distance weights: the second half of filtered
    backprojection.

    Voxel driven, with linear interpolation along columns and rows. A voxel whose footprint lies
    above or below the detector's rows reads the outermost row. It is not the adjoint of a
    projector; that is the projector's ``T``.

    Args:
        filtered: result of ``filter_sinogram``, ``(..., views, [rows,] columns)``, float32 or
            float64.
        geometry: parallel or fan beam (2-D grid), or cone beam (3-D grid).
        grid: voxels to reconstruct. A grid about the isocentre may be larger than the field of
            view: voxels outside are 0. A grid beside the isocentre must lie inside.
        window: the readings that ``filtered`` holds, default: the whole detector. It must hold the
            grid's footprint, ``torchpcct.detector_window.footprint(geometry, grid, margin=1,
            motion=motion)``.
        motion: displacement of the grid in every view, ``(views, 2)`` (y, x) or ``(views, 3)`` (z,
            y, x) mm as for :class:`torchpcct.projector.Projector`, or None: everything that the
            data hold moves with the grid, and the image shows it at rest. What stands still must be
            backprojected on its own, without motion (see :class:`recon.analytic.inset.InsetFbp`).
            By a tensor that requires a gradient the image has one.

    Returns:
        ``(..., *grid.shape)`` mm⁻¹, dtype and device of ``filtered``. Differentiable to any order;
        by a motion, to the first.

    Raises:
        ValueError: a wrong shape, a grid outside the field of view or the source's orbit, a window
            that is too small, a motion that is not finite.
        TypeError: data that are not float32 or float64 tensors, or not a geometry.
    """
    if window is None:
        window = DetectorWindow.full(geometry)
    check_data("filtered", filtered, data_shape(geometry, window))
    return BackprojectionPlan(geometry, grid, window, motion)(filtered)
