"""Filtered backprojection for parallel, fan and cone beams (FDK), flat and curved detectors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon._filtering import FilterPlan, full_window, kernel_names
from recon._operator import apply_linear
from recon.angular_weights import angular_weights
from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam, VolumeGrid
from torchpcct.window import DetectorWindow, shadow

__all__ = ["backproject", "fbp", "filter_sinogram", "filter_windowed"]

_KIND = {"parallel": 0, "flat": 1, "curved": 2}


def _check_data(name: str, data: Any, shape: tuple[int, ...]) -> None:
    if not isinstance(data, Tensor):
        raise TypeError(f"{name} must be a torch.Tensor, got {type(data).__name__}: use torch.as_tensor")
    if data.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name} must be float32 or float64, got {data.dtype}: convert it with .float() or .double()")
    if data.ndim < len(shape) or tuple(data.shape[data.ndim - len(shape) :]) != shape:
        expected = ", ".join(["...", *map(str, shape)])
        raise ValueError(f"{name} must have the shape ({expected}), got {tuple(data.shape)}")


def _check_weights(weights: Any, geometry: Geometry) -> NDArray[np.float64]:
    if weights is None:
        return angular_weights(geometry)
    w = np.asarray(weights, dtype=np.float64)
    if w.shape == (geometry.views,):
        w = w[:, None]
    if w.shape not in ((geometry.views, 1), (geometry.views, geometry.columns)):
        raise ValueError(
            f"weights must have the shape ({geometry.views},) or ({geometry.views}, {geometry.columns}), got {w.shape}"
        )
    return w


def _data_shape(geometry: Geometry, window: DetectorWindow) -> tuple[int, ...]:
    if isinstance(geometry, ConeBeam):
        return (window.views, window.rows, window.columns)
    return (window.views, window.columns)


def _filter(
    data: Tensor, geometry: Geometry, kernel: Any, weights: Any, a: DetectorWindow, b: DetectorWindow
) -> Tensor:
    names, several = kernel_names(kernel)
    plan = FilterPlan(geometry, names, _check_weights(weights, geometry), a, b)
    flat = not isinstance(geometry, ConeBeam)
    out = apply_linear(data.unsqueeze(-2) if flat else data, plan.forward, plan.transpose)
    out = out.squeeze(-2) if flat else out
    kernel_axis = -3 if flat else -4
    return out.movedim(kernel_axis, 0) if several else out.squeeze(kernel_axis)


def filter_sinogram(
    sinogram: Tensor,
    geometry: Geometry,
    kernel: str | Sequence[str] = "standard",
    window: DetectorWindow | None = None,
    *,
    weights: Any = None,
) -> Tensor:
    """Weight and ramp-filter the rows of a scan: the first half of filtered backprojection.

    The result carries the cosine, angular and redundancy weights, ready for :func:`backproject`.

    Args:
        sinogram: line integrals ``(..., views, [rows,] columns)``, float32 or float64, any device.
        geometry: parallel, fan or cone beam.
        kernel: reconstruction kernel (:data:`recon.windows.KERNELS`) or a sequence of them.
        window: return only these readings of every view (rows and columns); default: all.
        weights: angular weights ``(views,)`` or ``(views, columns)`` in rad that replace
            :func:`recon.angular_weights.angular_weights`.

    Returns:
        ``(..., views, [rows,] columns)`` on the window, mm⁻¹; with a sequence of kernels a leading axis of kernels.
        Differentiable to any order. Temporary memory is bounded by :data:`recon._filtering.CHUNK_BYTES` or one view.

    Raises:
        ValueError: a wrong shape, an unknown kernel, a window beyond the detector, views that do not suffice.
        TypeError: data that are not float32 or float64 tensors.
    """
    whole = full_window(geometry)
    _check_data("sinogram", sinogram, _data_shape(geometry, whole))
    return _filter(sinogram, geometry, kernel, weights, whole, whole if window is None else window)


def filter_windowed(
    difference: Tensor,
    geometry: Geometry,
    window_in: DetectorWindow,
    kernel: str | Sequence[str],
    window_out: DetectorWindow,
    *,
    weights: Any = None,
) -> Tensor:
    """Like :func:`filter_sinogram`, for data that are zero outside a window.

    Filtering is linear: after the scan of a background has been filtered once, the scan of a small inset or of other
    noise in its shadow is filtered from that shadow alone. The result equals that of the whole rows to rounding.

    Args:
        difference: ``(..., views, [rows,] columns)`` on ``window_in``.
        geometry: parallel, fan or cone beam.
        window_in: where the data are; zero elsewhere.
        kernel: reconstruction kernel or a sequence of them.
        window_out: the readings to return; its rows must lie within those of ``window_in``.
        weights: see :func:`filter_sinogram`.

    Returns:
        ``(..., views, [rows,] columns)`` on ``window_out``; with a sequence of kernels a leading axis of kernels.

    Raises:
        ValueError, TypeError: as :func:`filter_sinogram`.
    """
    _check_data("difference", difference, _data_shape(geometry, window_in))
    return _filter(difference, geometry, kernel, weights, window_in, window_out)


class _Backprojection:
    """Geometry of one backprojection, and its two maps for numba."""

    def __init__(self, geometry: Geometry, grid: VolumeGrid, window: DetectorWindow) -> None:
        self.grid, self.window = grid, window
        self.cone = isinstance(geometry, ConeBeam)
        if isinstance(geometry, ParallelBeam):
            self.kind, self.sod, self.sdd, pitch = _KIND["parallel"], 0.0, 0.0, geometry.pitch
        elif isinstance(geometry, FanBeam | ConeBeam):
            self.kind, self.sod, self.sdd = _KIND[geometry.detector], geometry.sod, geometry.sdd
            pitch = geometry.pitch if isinstance(geometry, FanBeam) else geometry.pitch[1]
        else:
            raise TypeError(f"geometry must be a ParallelBeam, FanBeam or ConeBeam, got {type(geometry).__name__}")
        if grid.ndim != (3 if self.cone else 2):
            raise ValueError(
                f"a {type(geometry).__name__} needs a {3 if self.cone else 2}-D grid, got {grid.ndim} axes"
            )
        if window.views != geometry.views:
            raise ValueError(f"the window has {window.views} views, but the geometry has {geometry.views}")
        if self.kind != 0 and grid.in_plane_radius >= self.sod:
            raise ValueError(
                f"the grid reaches {grid.in_plane_radius:.1f} mm from the axis, beyond the source orbit (sod {self.sod} "
                "mm): move or shrink the grid"
            )
        self.cosines, self.sines = np.cos(geometry.angles), np.sin(geometry.angles)
        self.scale = 1.0 / pitch
        first = geometry.column_positions[0]
        self.starts = -first / pitch - window.first_column.astype(np.float64)
        self.row_scale = self.row_start = 0.0
        if isinstance(geometry, ConeBeam):
            self.row_scale = 1.0 / geometry.pitch[0]
            self.row_start = -geometry.row_positions[0] / geometry.pitch[0] - window.first_row
        self.mask = self._outside(geometry)
        self._check_window(geometry)

    def _outside(self, geometry: Any) -> NDArray[np.bool_] | None:
        """Voxel columns that some view does not see, or None. An inset must be seen whole."""
        if isinstance(geometry, ParallelBeam):
            u = geometry.column_positions
            radius = max(min(-u[0], u[-1]) + geometry.pitch / 2.0, 0.0)
        else:
            radius = geometry.fov_radius
        y, x = self.grid.axes[-2:]
        outside = np.hypot(y[:, None], x[None, :]) > radius * (1.0 + 1e-9)
        if not outside.any():
            return None
        half_y, half_x = self.grid.extent[-2] / 2.0, self.grid.extent[-1] / 2.0
        cy, cx = self.grid.center[-2:]
        if abs(cy) > half_y or abs(cx) > half_x or outside.all():
            raise ValueError(
                f"the grid (centre x {cx:g}, y {cy:g} mm, {2 * half_x:g} × {2 * half_y:g} mm) leaves the field of view "
                f"of radius {radius:.2f} mm: move or shrink it"
            )
        return outside

    def _check_window(self, geometry: Any) -> None:
        """Every neighbour that interpolation reads must be in the window, or beyond the detector's edge."""
        if self.mask is not None:
            if self.window.columns != geometry.columns:
                raise ValueError("a grid that is larger than the field of view needs all columns: pass no window")
            return
        y, x = self.grid.axes[-2:]
        cy, cx = np.meshgrid(y[[0, -1]], x[[0, -1]], indexing="ij")
        c, s = self.cosines[:, None], self.sines[:, None]
        across = cy.ravel() * c - cx.ravel() * s
        depth = self.sod - (cx.ravel() * c + cy.ravel() * s)
        if self.kind == 0:
            position, height = across, np.ones_like(across)
        elif self.kind == 1:
            position, height = self.sdd * across / depth, self.sdd / depth
        else:
            position, height = self.sdd * np.arctan2(across, depth), self.sdd / np.hypot(across, depth)
        index = position * self.scale + self.starts[:, None]
        first = self.window.first_column
        low, high = index.min(axis=1), index.max(axis=1)
        missing = (low < -1e-6) & (first > 0)
        missing |= (high > self.window.columns - 1 + 1e-6) & (first + self.window.columns < geometry.columns)
        if missing.any():
            raise ValueError(
                f"the window misses columns that the grid needs in view {int(np.argmax(missing))}: "
                "use torchpcct.window.shadow(geometry, grid, margin=1)"
            )
        if isinstance(geometry, ConeBeam):
            z = self.grid.axes[0][[0, -1]]
            row = z[:, None] * np.array([height.min(), height.max()]) * self.row_scale + self.row_start
            w = self.window
            short = row.min() < -1e-6 and w.first_row > 0
            short |= row.max() > w.rows - 1 + 1e-6 and w.first_row + w.rows < geometry.rows
            if short:
                raise ValueError(
                    f"the window's rows {w.first_row}…{w.first_row + w.rows - 1} do not cover the grid: "
                    "use torchpcct.window.shadow(geometry, grid, margin=1)"
                )

    def _arguments(self, dtype: torch.dtype) -> list[Any]:
        axes = self.grid.axes
        common: list[Any] = [self.cosines, self.sines, self.starts, axes[-1], axes[-2]]
        if self.cone:
            common.append(axes[0].astype(np.float64 if dtype == torch.float64 else np.float32))
        common += [self.sod, self.sdd, self.scale]
        return [*common, self.row_scale, self.row_start] if self.cone else common

    def forward(self, data: Tensor) -> Tensor:
        """``(..., views, [rows,] columns)`` to ``(..., [z,] y, x)``."""
        from recon import _backproject as kernels

        n = 3 if self.cone else 2
        lead, shape = data.shape[:-n], data.shape[-n:]
        data = data.reshape(-1, *shape)
        if data.shape[0] == 0:
            return data.new_zeros((*lead, *self.grid.shape))
        data = torch.cat([data, data[..., -1:]], dim=-1)
        if self.cone:
            data = torch.cat([data, data[..., -1:, :]], dim=-2).permute(1, 3, 2, 0).contiguous()
            z, y, x = self.grid.shape
            out = np.empty((y, x, z, data.shape[-1]), dtype=data.numpy().dtype)
            kernels.backproject_3d(self.kind, data.numpy(), *self._arguments(data.dtype), out)
            volume = torch.from_numpy(out).permute(3, 2, 0, 1).contiguous()
        else:
            out = np.empty((data.shape[0], *self.grid.shape), dtype=data.numpy().dtype)
            kernels.backproject_2d(self.kind, data.contiguous().numpy(), *self._arguments(data.dtype), out)
            volume = torch.from_numpy(out)
        if self.mask is not None:
            volume[..., torch.from_numpy(self.mask)] = 0.0
        return volume.view(*lead, *self.grid.shape)

    def transpose(self, volume: Tensor) -> Tensor:
        """``(..., [z,] y, x)`` to ``(..., views, [rows,] columns)``: the exact transpose of :meth:`forward`."""
        from recon import _backproject as kernels

        n = self.grid.ndim
        lead = volume.shape[:-n]
        volume = volume.reshape(-1, *self.grid.shape)
        w = self.window
        shape = (w.views, w.rows, w.columns) if self.cone else (w.views, w.columns)
        if volume.shape[0] == 0:
            return volume.new_zeros((*lead, *shape))
        if self.mask is not None:
            volume = volume.masked_fill(torch.from_numpy(self.mask), 0.0)
        if self.cone:
            volume = volume.permute(2, 3, 1, 0).contiguous()
            out = np.empty((w.views, w.columns + 1, w.rows + 1, volume.shape[-1]), dtype=volume.numpy().dtype)
            kernels.spread_3d(self.kind, volume.numpy(), *self._arguments(volume.dtype), out)
            data = torch.from_numpy(out).permute(3, 0, 2, 1)
            rows = data[..., :-1, :].contiguous()
            rows[..., -1, :] += data[..., -1, :]
            data = rows
        else:
            out = np.empty((volume.shape[0], w.views, w.columns + 1), dtype=volume.numpy().dtype)
            kernels.spread_2d(self.kind, volume.contiguous().numpy(), *self._arguments(volume.dtype), out)
            data = torch.from_numpy(out)
        columns = data[..., :-1].contiguous()
        columns[..., -1] += data[..., -1]
        return columns.view(*lead, *shape)


def backproject(filtered: Tensor, geometry: Geometry, grid: VolumeGrid, window: DetectorWindow | None = None) -> Tensor:
    """Backproject filtered data with FBP's distance weights: the second half of filtered backprojection.

    Voxel driven, with linear interpolation along columns and rows. A voxel whose shadow lies above or below the
    detector's rows reads the outermost row. It is not the adjoint of a projector: see :class:`torchpcct.projector.Projector`.

    Args:
        filtered: result of :func:`filter_sinogram`, ``(..., views, [rows,] columns)``, float32 or float64.
        geometry: parallel or fan beam (2-D grid), or cone beam (3-D grid).
        grid: voxels to reconstruct. A grid about the isocentre may be larger than the field of view: voxels outside
            are 0. A grid beside the isocentre must lie inside.
        window: the readings that ``filtered`` holds, default: the whole detector. It must hold the grid's shadow,
            ``torchpcct.window.shadow(geometry, grid, margin=1)``.

    Returns:
        ``(..., *grid.shape)`` mm⁻¹, dtype and device of ``filtered``. Differentiable to any order.

    Raises:
        ValueError: a wrong shape, a grid outside the field of view or the source's orbit, a window that is too small.
        TypeError: data that are not float32 or float64 tensors, or not a geometry.
    """
    if window is None:
        window = full_window(geometry)
    _check_data("filtered", filtered, _data_shape(geometry, window))
    plan = _Backprojection(geometry, grid, window)
    return apply_linear(filtered, plan.forward, plan.transpose)


def fbp(
    sinogram: Tensor,
    geometry: Geometry,
    grid: VolumeGrid,
    kernel: str | Sequence[str] = "standard",
    window: DetectorWindow | None = None,
    *,
    weights: Any = None,
) -> Tensor:
    """Filtered backprojection (Feldkamp, Davis and Kress, J. Opt. Soc. Am. A 1, 612, 1984, for a cone beam).

    Args:
        sinogram: line integrals ``(..., views, [rows,] columns)``, float32 or float64.
        geometry: parallel, fan or cone beam; a closed circle, a short scan (at least π plus the fan angle), views in
            any order, irregularly spaced or repeated.
        grid: voxels to reconstruct, 2-D for parallel and fan beams, 3-D for cone beams.
        kernel: reconstruction kernel ``"soft"``, ``"standard"``, ``"detail"``, ``"bone"``, ``"ram-lak"``, or a sequence.
        window: readings to filter and backproject; default: the grid's shadow.
        weights: angular weights that replace the automatic ones, see :func:`filter_sinogram`.

    Returns:
        ``(..., *grid.shape)`` mm⁻¹; with a sequence of kernels a leading axis of kernels. Differentiable to any order.

    Raises:
        ValueError, TypeError: as :func:`filter_sinogram` and :func:`backproject`.
    """
    whole = full_window(geometry)
    _check_data("sinogram", sinogram, _data_shape(geometry, whole))
    if window is None:
        try:
            window = shadow(geometry, grid, margin=1)
        except ValueError:
            window = whole  # larger than the field of view: _Backprojection decides
    plan = _Backprojection(geometry, grid, window)
    filtered = filter_sinogram(sinogram, geometry, kernel, window, weights=weights)
    return apply_linear(filtered, plan.forward, plan.transpose)
