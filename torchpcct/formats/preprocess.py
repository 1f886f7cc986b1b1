"""Preparation of parallel-beam sinograms: rotation axis (by algotom), stripes, outliers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.dead_cells import bridge
from torchpcct.formats.damage import needed
from torchpcct.geometry import ParallelBeam
from torchpcct.robust import MEDIAN_TO_SD
from torchpcct.scan import Scan

__all__ = ["centred", "cleaned", "find_axis", "without_outliers", "without_stripes"]


def _algotom(module: str) -> object:
    needed("algotom")
    return needed(f"algotom.prep.{module}")


def find_axis(scan: Scan) -> float:
    """Column of the rotation axis, of the middle slice, by Vo's method (Opt. Express 22, 19078, 2014).

    Vo's search is good to a quarter of a column. If air is seen beside the object in all views, the object's centroid
    refines it: it runs through the views as a sine about the axis (Helgason and Ludwig's condition of first order).

    Raises:
        ValueError: not a parallel beam, or views that do not cover 180°.
    """
    g = scan.geometry
    if not isinstance(g, ParallelBeam):
        raise ValueError(f"the axis is found from parallel rays, this is a {type(g).__name__}")
    turn = np.mod(g.angles - g.angles[0], 2 * math.pi)
    half = np.flatnonzero(turn <= math.pi + 1e-6)
    order = half[np.argsort(turn[half])]
    step = float(np.median(np.diff(turn[order]))) if order.size > 1 else math.pi
    if turn[order[-1]] < math.pi - 2 * step:
        raise ValueError(f"the views cover {math.degrees(turn[order[-1]]):.0f}° of the 180° that the search needs")
    lines = scan.line_integrals()
    middle = (lines[lines.shape[0] // 2] if lines.ndim == 3 else lines).double().numpy()
    found = float(_algotom("calculation").find_center_vo(middle[order], dsp=False, ncore=1))  # type: ignore[attr-defined]
    finer = _by_centroid(middle, g.angles)
    return finer if finer is not None and abs(finer - found) <= 1.0 else found


def _by_centroid(lines: NDArray[np.float64], angles: NDArray[np.float64]) -> float | None:
    """Axis of a sinogram ``(views, columns)`` whose object is seen whole, else None."""
    columns = lines.shape[1]
    margin = max(1, columns // 50)
    mass = lines.sum(1)
    edges = np.abs(np.concatenate([lines[:, :margin], lines[:, -margin:]], 1).mean(1))
    if columns < 8 or mass.min() <= 0 or float((edges > 0.05 * lines.max(1)).mean()) > 0.02:
        return None
    centroid = (lines @ np.arange(columns)) / mass
    waves = np.stack([np.ones_like(angles), np.cos(angles), np.sin(angles)], 1)
    kept = np.ones(len(angles), bool)
    for _ in range(5):  # views that a lost reading has pulled aside are left out
        fit = np.linalg.lstsq(waves[kept], centroid[kept], rcond=None)[0]
        off = np.abs(centroid - waves @ fit)
        kept = off <= 5.0 * MEDIAN_TO_SD * np.median(off) + 1e-9
    return float(fit[0])


def centred(scan: Scan, axis: float | None = None) -> Scan:
    """The same parallel scan with its rotation axis at a column (None: :func:`find_axis`)."""
    g: ParallelBeam = scan.geometry
    column = find_axis(scan) if axis is None else axis
    return replace(scan, geometry=replace(g, offset=((g.columns - 1) / 2 - column) * g.pitch))


def cleaned(scan: Scan, *, snr: float = 3.0, threshold: float = 0.08) -> Scan:
    """The same parallel or fan-beam scan without outliers and stripes (:func:`without_outliers`,
    :func:`without_stripes`).

    Readings are changed by the factor that their logarithms ask for, so that the scan keeps its weights.

    Raises:
        ValueError: a cone beam, or a scan of a part of the detector.
    """
    if scan.geometry.has_rows:
        raise ValueError("stripes are taken from sinograms (views, columns): of a parallel or fan beam, without window")
    lines = scan._logarithm()  # before the water correction, which belongs to the true readings
    if scan.dead is not None:
        lines = bridge(lines, scan.dead, rows=False)
    corrected = without_stripes(without_outliers(lines, threshold=threshold), snr=snr)
    return replace(scan, counts=scan.counts * torch.exp(lines - corrected))


def without_stripes(lines: Tensor, *, snr: float = 3.0) -> Tensor:
    """Line integrals ``(..., views, columns)`` without the stripes of cells whose gain is off: rings in the image.

    The mean over the views runs smoothly along the columns, or steps; a cell that stands out of the median of its five
    neighbours is wrong by a constant, which is taken off (Rivers 1998; Boin and Haibel, Opt. Express 14, 12071, 2006).
    All other columns stay as they are. Stripes of more than two columns, or that change with the views, stay too.

    Args:
        snr: standard deviations, of all columns, that a stripe must stand out to be taken for one.
    """
    from scipy.ndimage import median_filter

    flat = lines.reshape(-1, *lines.shape[-2:]).double().numpy()
    mean = flat.mean(1)
    off = mean - median_filter(mean, size=(1, 5), mode="nearest")
    spread = MEDIAN_TO_SD * np.median(np.abs(off), axis=1, keepdims=True)
    clean = flat - np.where(np.abs(off) > snr * spread, off, 0.0)[:, None]
    return torch.from_numpy(clean).to(lines.dtype).reshape(lines.shape)


def without_outliers(lines: Tensor, *, threshold: float = 0.08) -> Tensor:
    """Line integrals ``(..., views, columns)`` without single outliers (cosmic rays, "zingers").

    A reading that differs from the median of its 3 × 3 neighbourhood in views and columns by more than ``threshold``
    and by more than eight standard deviations of such differences (from their median) takes that median.
    """
    from scipy.ndimage import median_filter

    flat = lines.reshape(-1, *lines.shape[-2:]).double().numpy()
    middle = median_filter(flat, size=(1, 3, 3), mode="nearest")
    off = np.abs(flat - middle)
    spread = MEDIAN_TO_SD * np.median(off[off > 0]) if bool((off > 0).any()) else 0.0
    clean = np.where(off > max(threshold, 8.0 * spread), middle, flat)
    return torch.from_numpy(clean).to(lines.dtype).reshape(lines.shape)
