"""Filtered backprojection for parallel, fan and cone beams (FDK), flat and curved detectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.fbp.angular_weights import angular_weights
from recon.fbp.backproject import BackprojectionPlan, backproject, check_data, data_shape
from recon.fbp.filter_plan import FilterPlan, kernel_names
from recon.linear_operator import apply_linear
from torchpcct.detector_window import DetectorWindow, shadow
from torchpcct.geometry import ConeBeam, Geometry, VolumeGrid

__all__ = ["backproject", "fbp", "filter_sinogram", "filter_windowed", "interleave"]

G = TypeVar("G", bound=Geometry)


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
        sinogram: line integrals ``(..., views, [rows,] columns)``, float32 or float64. Data of another device are
            filtered on the CPU and sent back.
        geometry: parallel, fan or cone beam.
        kernel: reconstruction kernel (:data:`recon.fbp.ramp.KERNELS`) or a sequence of them.
        window: return only these readings of every view (rows and columns); default: all.
        weights: angular weights ``(views,)`` or ``(views, columns)`` in rad that replace
            :func:`recon.fbp.angular_weights.angular_weights`.

    Returns:
        ``(..., views, [rows,] columns)`` on the window, mm⁻¹; with a sequence of kernels a leading axis of kernels.
        Differentiable to any order. Temporary memory is bounded by :data:`recon.fbp.filter_plan.CHUNK_BYTES` or one
        view.

    Raises:
        ValueError: a wrong shape, an unknown kernel, a window beyond the detector, views that do not suffice.
        TypeError: data that are not float32 or float64 tensors.
    """
    whole = DetectorWindow.full(geometry)
    check_data("sinogram", sinogram, data_shape(geometry, whole))
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
    check_data("difference", difference, data_shape(geometry, window_in))
    return _filter(difference, geometry, kernel, weights, window_in, window_out)


def interleave(sinogram: Tensor, geometry: G) -> tuple[Tensor, G]:
    """Spread the columns over a detector of half the pitch, for scans with a quarter-column offset.

    The opposite ray of a detector shifted by a quarter column falls between two columns. Filtering every view on a
    grid of half the pitch, zeros between the readings, reaches up to twice the Nyquist frequency of one view; what one
    view aliases there, its opposite cancels. The windows of :mod:`recon.fbp.ramp` then refer to the doubled Nyquist
    frequency. Without the offset nothing cancels: details near the isocentre come out aliased.

    Args:
        sinogram: ``(..., columns)``.
        geometry: parallel, fan or cone beam of a closed scan with an offset of about a quarter column.

    Returns:
        ``(..., 2 · columns)`` and its geometry, for :func:`fbp`.

    Raises:
        ValueError, TypeError: a wrong shape or dtype.
    """
    check_data("sinogram", sinogram, data_shape(geometry, DetectorWindow.full(geometry)))
    # the mean of a reading and a zero is half the reading
    spread = torch.stack([2.0 * sinogram, torch.zeros_like(sinogram)], dim=-1).flatten(-2)
    if isinstance(geometry, ConeBeam):
        row, column = geometry.pitch
        pitch: Any = (row, column / 2.0)
        offset: Any = (geometry.offset[0], geometry.offset[1] + column / 4.0)
    else:
        g: Any = geometry
        pitch, offset = g.pitch / 2.0, g.offset + g.pitch / 4.0
    changes: dict[str, Any] = {"columns": 2 * geometry.columns, "pitch": pitch, "offset": offset}
    return spread, replace(geometry, **changes)  # type: ignore[type-var]


def fbp(
    sinogram: Tensor,
    geometry: Geometry,
    grid: VolumeGrid,
    kernel: str | Sequence[str] = "standard",
    window: DetectorWindow | None = None,
    *,
    weights: Any = None,
    motion: Any = None,
) -> Tensor:
    """Filtered backprojection (Feldkamp, Davis and Kress, J. Opt. Soc. Am. A 1, 612, 1984, for a cone beam).

    With ``motion`` each view's filtered data are backprojected along the rays that met the displaced object (Schäfer,
    Borgert, Rasche and Grass, IEEE Trans. Med. Imaging 25, 895, 2006). That neglects how the motion changes the
    density of the rays through the object, by (mm per rad of rotation) / sod: 0.1 % for a coronary artery.

    Args:
        sinogram: line integrals ``(..., views, [rows,] columns)``, float32 or float64.
        geometry: parallel, fan or cone beam; a closed circle, a short scan (at least π plus the fan angle), views in
            any order, irregularly spaced or repeated.
        grid: voxels to reconstruct, 2-D for parallel and fan beams, 3-D for cone beams.
        kernel: reconstruction kernel ``"soft"``, ``"standard"``, ``"detail"``, ``"bone"``, ``"ram-lak"``, or several.
        window: readings to filter and backproject; default: the grid's shadow.
        weights: angular weights that replace the automatic ones, see :func:`filter_sinogram`.
        motion: displacement of everything in the scan in every view, see :func:`backproject`.

    Returns:
        ``(..., *grid.shape)`` mm⁻¹; with a sequence of kernels a leading axis of kernels. Differentiable to any order.

    Raises:
        ValueError, TypeError: as :func:`filter_sinogram` and :func:`backproject`.
    """
    check_data("sinogram", sinogram, data_shape(geometry, DetectorWindow.full(geometry)))
    if window is None:
        window = _shadow_or_whole(geometry, grid, motion)
    plan = BackprojectionPlan(geometry, grid, window, motion)
    filtered = filter_sinogram(sinogram, geometry, kernel, window, weights=weights)
    return apply_linear(filtered, plan.forward, plan.transpose)


def _shadow_or_whole(geometry: Geometry, grid: VolumeGrid, motion: Any = None) -> DetectorWindow:
    try:
        return shadow(geometry, grid, margin=1, motion=motion)
    except ValueError:
        return DetectorWindow.full(geometry)  # a grid larger than the field of view: the backprojection decides
