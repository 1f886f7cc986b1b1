"""Preparation of scans: rotation axis, stripes, outliers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchpcct.checks.defects import repair_defects
from torchpcct.checks.rotation_axis import RotationAxis, at_axis, rotation_axis
from torchpcct.readings import MEDIAN_TO_SD, interpolate_dead
from torchpcct.scan import Scan
from torchpcct.validate import checked

__all__ = ["centred", "cleaned", "find_axis", "without_outliers", "without_stripes"]


@checked
def find_axis(scan: Scan) -> RotationAxis:
    """The column of the rotation axis with its error: of a full turn of any beam, or half a turn of
    parallel rays.

    Of several slices the one with the most to be seen is looked at
    (:mod:`torchpcct.checks.rotation_axis`).

    Raises:
        ValueError: a part of the detector, a geometry view by view, energy bins; too few conjugate
            rays, or nothing to be seen.
    """
    g = scan.geometry
    if not g.on_circle or scan.window is not None or scan.counts.ndim > 3:
        raise ValueError(
            "the axis is found from all columns of a parallel, fan or cone beam on a circle"
        )
    lines = scan.line_integrals()
    if lines.ndim > len(g.shape):
        lines = lines[int(lines.flatten(1).var(1).argmax())]
    return rotation_axis(lines, g)


@checked
def centred(scan: Scan, axis: float | RotationAxis | None = None) -> Scan:
    """The same scan with its rotation axis at a column; None: :func:`find_axis`, noted in
    ``info``."""
    found = find_axis(scan) if axis is None else axis
    if not isinstance(found, RotationAxis):
        return replace(scan, geometry=at_axis(scan.geometry, found))
    found_axis = {"column": found.column, "error": found.error, "found_from": found.how}
    return replace(
        scan, geometry=at_axis(scan.geometry, found.column), info={**scan.info, "axis": found_axis}
    )


@checked
def cleaned(scan: Scan) -> Scan:
    """The same parallel or fan-beam scan without outliers and stripes (:func:`without_outliers`,
    :func:`without_stripes`).

    Readings that no object can cause (:func:`torchpcct.checks.defects.repair_defects`) are
    interpolated before. The others are changed by the factor that their logarithms ask for, so that
    the scan keeps its weights.

    Raises:
        ValueError: a cone beam, or a scan of a part of the detector.
    """
    if scan.geometry.has_rows:
        raise ValueError(
            "stripes are taken from sinograms (views, columns): of a parallel or fan beam, "
            "without window"
        )
    # cells without signal for part of the turn are no stripes: nothing is left of them
    scan = repair_defects(scan)[0]
    lines = scan._logarithm()  # before the water correction, which belongs to the true readings
    if scan.dead is not None:
        lines = interpolate_dead(lines, scan.dead, rows=False)
    corrected = without_stripes(without_outliers(lines))
    return replace(scan, counts=scan.counts * torch.exp(lines - corrected))


_LASTING = (0.4, 0.2, 0.1)
"""Parts of the views over which stripes are looked for, relative to all."""
_LEAST_VIEWS = 30
"""The fewest views of such a part."""
_BLOCKS = 360
"""Averages that many views are reduced to."""


@checked
def without_stripes(lines: Tensor, *, snr: float = 3.0) -> Tensor:
    """Line integrals ``(..., views, columns)`` without the stripes of cells whose gain is off:
    rings in the image.

    Cells that are wrong for part of the views stand out of the median of the nine columns about
    them, in the median over :data:`_LASTING` of the views. Then the mean over the views runs
    smoothly along the columns, or steps: a cell that stands out of the median of its five
    neighbours is wrong by a constant, which is taken off (Rivers 1998; Boin and Haibel, Opt.
    Express 14, 12071, 2006). Details of the object stay in one column for a while, too, near the
    axis and where their paths turn back; there neighbours stand out as well, and the columns stay
    as they are. Partial stripes beside steep edges stay, therefore, and those of more than three
    columns. (Vo's filters, Opt. Express 26, 28396, 2018, in algotom's remove_all_stripe, change all
    columns: on a neutron scan without stripes they triple the error.)

    Args:
        snr: standard deviations, of all columns, that a stripe must stand out to be taken for one.
    """
    from scipy.ndimage import binary_opening, median_filter, percentile_filter

    flat = lines.reshape(-1, *lines.shape[-2:]).double().numpy()
    clean = flat.copy()
    views = flat.shape[1]
    block = max(1, views // _BLOCKS)
    starts = np.arange(0, views, block)
    which = np.minimum(np.arange(views) // block, starts.size - 1)
    for part in _LASTING:
        size = 2 * round(part * starts.size / 2) + 1
        if size * block < _LEAST_VIEWS:
            break
        for k, sinogram in enumerate(clean):  # a slice at a time: medians need memory
            means = np.add.reduceat(sinogram, starts) / np.bincount(which)[:, None]
            stands = means - median_filter(means, size=(1, 9), mode="nearest")
            stands = median_filter(stands, size=(size, 1), mode="nearest")
            usual = MEDIAN_TO_SD * np.median(np.abs(stands))
            strong = percentile_filter(np.abs(stands), 80, size=(1, 13), mode="nearest")
            partial = np.abs(stands) > np.maximum((snr + 1.0) * usual, 3.0 * strong)
            # What moves a median of so many views lasts for half of them.
            partial = binary_opening(partial, np.ones((size // 2, 1)))
            clean[k] = sinogram - np.where(partial, stands, 0.0)[which]
    mean = clean.mean(1)
    off = mean - median_filter(mean, size=(1, 5), mode="nearest")
    spread = MEDIAN_TO_SD * np.median(np.abs(off), axis=1, keepdims=True)
    clean -= np.where(np.abs(off) > snr * spread, off, 0.0)[:, None]
    return torch.from_numpy(clean).to(lines.dtype).reshape(lines.shape)


@checked
def without_outliers(lines: Tensor, *, threshold: float = 0.08) -> Tensor:
    """Line integrals ``(..., views, columns)`` without single outliers (cosmic rays, "zingers").

    A reading that differs from the median of its 3 × 3 neighbourhood in views and columns by more
    than ``threshold`` and by more than eight standard deviations of such differences (from their
    median) takes that median.
    """
    from scipy.ndimage import median_filter

    flat = lines.reshape(-1, *lines.shape[-2:]).double().numpy()
    middle = median_filter(flat, size=(1, 3, 3), mode="nearest")
    off = np.abs(flat - middle)
    spread = MEDIAN_TO_SD * np.median(off[off > 0]) if bool((off > 0).any()) else 0.0
    clean = np.where(off > max(threshold, 8.0 * spread), middle, flat)
    return torch.from_numpy(clean).to(lines.dtype).reshape(lines.shape)
