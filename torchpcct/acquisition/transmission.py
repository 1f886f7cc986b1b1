"""Expected detector readings of analytic bodies: exact chords, polychromatic, averaged over the
finite beam.

For one reading (bin i, view, row, column) the expected signal is

    N_i = Σ_E S_i(column, E) · ⟨exp(−Σ_b chord_b · Δμ_b(E))⟩ · row factor,

where ⟨·⟩ is the mean over sub-rays from points of the focal spot to points of the cell at moments
of the view, and Δμ_b is the attenuation of body b minus that of the body around it (see
:mod:`torchpcct.scene.scene`). Two exact or controlled reductions make this fast:

* the matrix Δμ (bodies × energies) has a low numerical rank: chords are carried in ``rank``
  components instead of ``bodies × energies`` products (:func:`compress`, residual below 1e-9 in the
  line integral);
* the mean of the exponential over the sub-rays of ONE cell is taken to second order in the spread
  of the line integral inside the cell, ``exp(−mean + variance / 2)`` per energy. The neglected
  third cumulant is below 1e-6 for tissue and iodine edges and is measured in the tests against the
  full sum. Where the spread is large (edges of metal, soft rays) the full sum is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.acquisition.bodies import BodySet
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam
from torchpcct.kernel_cache import forget_outdated
from torchpcct.scene.chord_kernels import chords_from, may_meet
from torchpcct.scene.chords import PARAMETERS
from torchpcct.threads import run
from torchpcct.validate import shaped

Floats = NDArray[np.float64]


class Beam(NamedTuple):
    """The finite, polychromatic beam of one reading.

    Attributes:
        spectra: ``(bins, columns, energies)`` expected signal of an unattenuated reading per
            energy.
        row_factor: ``(rows,)`` relative intensity of the rows.
        focal_spot: ``(width, length)`` in mm, along ``e_t`` and z.
        points: ``(sub-rays, 5)`` of :func:`sub_rays`.
    """

    spectra: Floats
    row_factor: Floats
    focal_spot: tuple[float, float]
    points: Floats


SUB_RAY_COUNTS = (1, 16, 32, 64, 128, 256)
"""Numbers of sub-rays that :func:`sub_rays` knows."""

LARGE_VARIANCE = 0.01
"""Variance of a line integral inside a cell beyond which the mean to second order gives way to the
full sum (the third cumulant reaches 1e-4)."""

_PLASTIC = 1.0 / 1.32471795724474602596
"""Plastic-number sequence (Roberts 2018): two coordinates that fill the square evenly at any
length."""


def sub_rays(count: int, active: Sequence[bool] = (True,) * 5) -> Floats:
    """Sub-ray coordinates, ``(count, 5)`` in −½…½: focal width, focal length, column, row, view.

    What blurs a thin object in the plane is the sum of three boxes: cell, focal spot and the
    gantry's turn. A body's edge makes a kink along that sum, so it is sampled finely: many
    equidistant points across the cell, shifted by the few Gauss points of the two others. Along z
    the blur is gentle and gets two coordinates of a low-discrepancy sequence. The mean over all
    points is 0 on every axis, so no reading is shifted. Inactive axes stay at 0.

    Raises:
        ValueError: ``count`` is not one of :data:`SUB_RAY_COUNTS`.
    """
    if count not in SUB_RAY_COUNTS:
        raise ValueError(f"the number of sub-rays must be one of {SUB_RAY_COUNTS}, got {count}")
    if count == 1 or not any(active):
        return np.zeros((1, 5))
    shifts = 2 if count <= 64 else 4
    focal = _nodes(shifts if active[0] else 1)
    view = _nodes(shifts if active[4] else 1)
    across = count // (focal.size * view.size)
    column = (np.arange(across) + 0.5) / across - 0.5 if active[2] else np.zeros(across)
    points = np.zeros((count, 5))
    points[:, 0], points[:, 4], points[:, 2] = (
        a.ravel() for a in np.meshgrid(focal, view, column, indexing="ij")
    )
    order = np.arange(1.0, count + 1)
    for axis, step in ((1, _PLASTIC), (3, _PLASTIC**2)):
        if active[axis]:
            sequence = (order * step) % 1.0
            points[:, axis] = sequence - sequence.mean()
    return points


def _nodes(count: int) -> Floats:
    """Equally weighted points in −½…½: Gauss for 1 and 2, midpoints beyond."""
    if count == 2:
        return np.array([-0.5, 0.5]) / 3.0**0.5
    return (np.arange(count) + 0.5) / count - 0.5


def compress(
    contrast: Floats, longest_mm: float = 1000.0, tolerance: float = 1e-9
) -> tuple[Floats, Floats]:
    """Factor ``contrast`` (bodies, energies) = coefficients (bodies, rank) @ basis (rank,
    energies).

    The rank is the smallest for which a chord of ``longest_mm`` changes the line integral by less
    than ``tolerance``; 0 without bodies.
    """
    u, s, vt = np.linalg.svd(contrast, full_matrices=False)
    for rank in range(s.size + 1):
        coefficients, basis = u[:, :rank] * s[:rank], vt[:rank]
        if np.abs(contrast - coefficients @ basis).max(initial=0.0) * longest_mm <= tolerance:
            break
    return np.ascontiguousarray(coefficients), np.ascontiguousarray(basis)


_FAST = {"contract", "arcp", "nsz"}
"""What the compiler may change in sums: fusing a product and a sum, a reciprocal for a division."""
_LANES = 32
"""Readings computed side by side at least, so that their loops fill the processor's vectors."""
_MOST_LANES = 64
"""Readings computed side by side at most, so that what is held of them stays in the cache."""


@njit(inline="always", fastmath=_FAST, error_model="numpy")
def _exp(x: float) -> float:
    """``exp(x)`` to 2.3e-16 for x below 700, without branches; 3e-308 in place of anything less.

    ``x = k ln 2 + r`` with ``|r| <= ln(2) / 2``: a Taylor series for ``exp(r)``, and ``k`` as the
    exponent of a double. Adding 1.5 · 2^52 rounds to a whole number, which is then in the low bits.
    """
    x = max(x, -708.0)
    shifted = x * 1.4426950408889634 + 6755399441055744.0
    k = shifted - 6755399441055744.0
    r = (x - k * 0.693147180369123816490) - k * 1.90821492927058770002e-10
    series = 1.0 / 479001600.0
    series = series * r + 1.0 / 39916800.0
    series = series * r + 1.0 / 3628800.0
    series = series * r + 1.0 / 362880.0
    series = series * r + 1.0 / 40320.0
    series = series * r + 1.0 / 5040.0
    series = series * r + 1.0 / 720.0
    series = series * r + 1.0 / 120.0
    series = series * r + 1.0 / 24.0
    series = series * r + 1.0 / 6.0
    series = series * r + 0.5
    series = series * r + 1.0
    series = series * r + 1.0
    bits = (np.float64(shifted).view(np.int64) + 1023) << 52
    return series * np.int64(bits).view(np.float64)


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _moments(samples: Floats, count: int, lanes: int, mean: Floats, spread: Floats) -> None:
    """Mean ``(rank, lanes)`` and covariance, ``(pairs, lanes)`` with both of a mixed pair, of
    ``samples (count, rank, lanes)``; samples become deviations from the first one."""
    rank = samples.shape[1]
    for a in range(rank):
        for n in range(lanes):
            mean[a, n] = 0.0
    for pair in range(spread.shape[0]):
        for n in range(lanes):
            spread[pair, n] = 0.0
    # Sums relative to the first sub-ray keep the digits of the small spread.
    for k in range(1, count):
        pair = 0
        for a in range(rank):
            for n in range(lanes):
                samples[k, a, n] -= samples[0, a, n]
                mean[a, n] += samples[k, a, n]
            for c in range(a + 1):
                for n in range(lanes):
                    spread[pair, n] += samples[k, a, n] * samples[k, c, n]
                pair += 1
    inverse = 1.0 / count
    pair = 0
    for a in range(rank):
        for n in range(lanes):
            mean[a, n] *= inverse
        for c in range(a + 1):
            twice = 1.0 if c == a else 2.0
            for n in range(lanes):
                spread[pair, n] = twice * (spread[pair, n] * inverse - mean[a, n] * mean[c, n])
            pair += 1
    for a in range(rank):
        for n in range(lanes):
            mean[a, n] += samples[0, a, n]


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _transmitted(
    samples: Floats,
    count: int,
    lanes: int,
    mean: Floats,
    spread: Floats,
    basis: Floats,
    e: int,
    out: Floats,
) -> None:
    """Mean transmission of each reading at energy ``e``: to second order, or the full sum."""
    rank = basis.shape[0]
    exponent, variance = out[0], out[1]
    for n in range(lanes):
        exponent[n] = 0.0
        variance[n] = 0.0
    pair = 0
    for a in range(rank):
        share, line = basis[a, e], mean[a]
        for n in range(lanes):
            exponent[n] -= share * line[n]
        for c in range(a + 1):
            product, both = 0.5 * basis[a, e] * basis[c, e], spread[pair]
            for n in range(lanes):
                variance[n] += product * both[n]
            pair += 1
    for n in range(lanes):
        exponent[n] = _exp(exponent[n] + variance[n])
    large = 0
    for n in range(lanes):
        large += variance[n] > 0.5 * LARGE_VARIANCE
    if not large:
        return
    for n in range(lanes):
        if variance[n] <= 0.5 * LARGE_VARIANCE:
            continue
        total = 0.0
        for k in range(count):
            path = 0.0
            for a in range(rank):
                path += (samples[0, a, n] + (samples[k, a, n] if k else 0.0)) * basis[a, e]
            total += _exp(-path)
        exponent[n] = total / count


@njit(nogil=True, cache=True, fastmath=_FAST, error_model="numpy")
def _readings(
    begin: int,
    end: int,
    cos_b: Floats,
    sin_b: Floats,
    view_step: Floats,
    sod: float,
    across: Floats,
    v0: float,
    dv: float,
    focal_w: float,
    focal_l: float,
    points: Floats,
    kinds: NDArray[np.int64],
    params: Floats,
    coefficients: Floats,
    basis: Floats,
    offsets: Floats,
    drift: Floats,
    circle: Floats,
    reach: float,
    spectra: Floats,
    row_factor: Floats,
    first_column: NDArray[np.int64],
    first_row: int,
    exterior: Floats,
    out: Floats,
) -> None:
    bins, _, rows, columns = out.shape
    rank, energies = basis.shape
    bodies = kinds.size
    count = points.shape[0]
    has_exterior = exterior.shape[0] > 0
    # Readings side by side: some columns, and for each of them some rows, which follow each other.
    high = min(rows, _MOST_LANES)
    wide = max(1, _LANES // high)
    most = high * wide
    seen = np.empty(columns, np.int64)
    source = np.empty((count, 5))
    dx, dy, dz, stretch = np.empty(most), np.empty(most), np.empty(most), np.empty(most)
    chord = np.empty(most)
    samples = np.empty((count, rank, most))
    mean = np.empty((rank, most))
    spread = np.empty((rank * (rank + 1) // 2, most))
    transmitted = np.empty((2, most))
    totals = np.empty((bins, most))
    for view in range(begin, end):
        cb, sb = cos_b[view], sin_b[view]
        for k in range(count):
            turn = points[k, 4] * view_step[view]
            ct, st = math.cos(turn), math.sin(turn)
            cos_v, sin_v = cb * ct - sb * st, sb * ct + cb * st
            # Source in the turning frame: sod along e_r, sy along e_t.
            sy = points[k, 0] * focal_w
            source[k, 0], source[k, 1] = cos_v, sin_v
            source[k, 2] = sod * cos_v - sy * sin_v
            source[k, 3] = sod * sin_v + sy * cos_v
            source[k, 4] = points[k, 1] * focal_l
        found = 0
        for j in range(columns):
            column = first_column[view] + j
            if has_exterior:
                # Distance of the centre ray from the bodies' circle: most readings pass far
                # outside.
                lx, ly = across[count, column, 0], across[count, column, 1]
                sx = circle[0] + offsets[0, view, 0] - sod * cb
                sy = circle[1] + offsets[0, view, 1] - sod * sb
                if abs(sx * (lx * sb + ly * cb) - sy * (lx * cb - ly * sb)) > circle[2] + reach:
                    for b in range(bins):
                        for row in range(rows):
                            out[b, view, row, j] = exterior[b, first_row + row, column]
                    continue
            seen[found] = j
            found += 1
        for block in range(0, found, wide):
            across_block = min(wide, found - block)
            for row0 in range(0, rows, high):
                up = min(high, rows - row0)
                lanes = across_block * up
                for k in range(count):
                    cos_v, sin_v = source[k, 0], source[k, 1]
                    ox, oy, oz = source[k, 2], source[k, 3], source[k, 4]
                    bottom = v0 + points[k, 3] * dv - oz + (first_row + row0) * dv
                    for i in range(across_block):
                        column = first_column[view] + seen[block + i]
                        lx, ly = across[k, column, 0], across[k, column, 1]
                        inverse = across[k, column, 2]
                        x, y = lx * cos_v - ly * sin_v, lx * sin_v + ly * cos_v
                        low, step = bottom * inverse, dv * inverse
                        for r in range(up):
                            dx[i * up + r] = x
                            dy[i * up + r] = y
                            dz[i * up + r] = low + r * step
                    for n in range(lanes):
                        stretch[n] = math.sqrt(1.0 + dz[n] * dz[n])
                    for a in range(rank):
                        for n in range(lanes):
                            samples[k, a, n] = 0.0
                    for b in range(bodies):
                        t = points[k, 4]
                        bx = ox - offsets[b, view, 0] - t * drift[b, view, 0]
                        by = oy - offsets[b, view, 1] - t * drift[b, view, 1]
                        bz = oz - offsets[b, view, 2] - t * drift[b, view, 2]
                        meets = False
                        for i in range(across_block):
                            meets |= may_meet(params, b, bx, by, dx[i * up], dy[i * up])
                        if not meets:
                            continue
                        chords_from(
                            kinds[b], params, b, bx, by, bz, dx, dy, dz, stretch, lanes, chord
                        )
                        for a in range(rank):
                            share = coefficients[b, a]
                            for n in range(lanes):
                                samples[k, a, n] += share * chord[n]
                _moments(samples, count, lanes, mean, spread)
                for b in range(bins):
                    for n in range(lanes):
                        totals[b, n] = 0.0
                for e in range(energies):
                    _transmitted(samples, count, lanes, mean, spread, basis, e, transmitted)
                    for b in range(bins):
                        for i in range(across_block):
                            weight = spectra[b, first_column[view] + seen[block + i], e]
                            for r in range(up):
                                totals[b, i * up + r] += weight * transmitted[0, i * up + r]
                for b in range(bins):
                    for i in range(across_block):
                        for r in range(up):
                            out[b, view, row0 + r, seen[block + i]] = (
                                totals[b, i * up + r] * row_factor[first_row + row0 + r]
                            )


def _across(geometry: ConeBeam, focal_width: float, points: Floats) -> Floats:
    """Directions in the plane of the rays to every column, ``(sub-rays + 1, columns, 3)``: unit
    vector along e_r and e_t, and 1 over the length in mm; the last are those of the centre rays."""
    aim = np.concatenate([points[:, [0, 2]], np.zeros((1, 2))])
    u = geometry.column_positions + aim[:, 1:] * geometry.pitch[1]
    if geometry.detector == "curved":
        along = -geometry.sdd * np.cos(u / geometry.sdd)
        u = geometry.sdd * np.sin(u / geometry.sdd)
    else:
        along = np.full_like(u, -geometry.sdd)
    across = u - aim[:, :1] * focal_width
    inverse = 1.0 / np.hypot(along, across)
    return np.stack([along * inverse, across * inverse, inverse], axis=-1)


def expected_readings(
    geometry: ConeBeam,
    window: DetectorWindow,
    bodies: BodySet,
    beam: Beam,
    view_step: Floats,
    exterior: Floats | None = None,
) -> Tensor:
    """Expected readings on a window of the detector.

    Args:
        geometry: cone beam; its views are those to compute.
        window: the cells to compute, for the same views.
        bodies: packed bodies; their first entry moves as the circle does.
        beam: spectra, focal spot and sub-rays.
        view_step: ``(views,)`` rad the gantry turns while a view is read.
        exterior: ``(bins, rows, columns)`` readings of the rays that miss the bodies' circle; None
            computes all.

    Returns:
        ``(bins, views, window.rows, window.columns)`` float64.

    Raises:
        ValueError: arrays that do not belong to the detector, the views or the bodies.
    """
    window.check(geometry)
    bins, energies = len(beam.spectra), bodies.contrast.shape[-1]
    count = len(bodies.kinds)
    shaped("spectra", beam.spectra, (None, geometry.columns, energies))
    shaped("row_factor", beam.row_factor, (geometry.rows,))
    shaped("points", beam.points, (None, 5))
    shaped("view_step", view_step, (geometry.views,))
    shaped("params", bodies.params, (count, PARAMETERS))
    shaped("contrast", bodies.contrast, (count, energies))
    for name, way in (("offsets", bodies.offsets), ("drift", bodies.drift)):
        shaped(name, way, (count, geometry.views, 3))
    if exterior is not None:
        shaped("exterior", exterior, (bins, geometry.rows, geometry.columns))
    coefficients, basis = compress(bodies.contrast)
    out = np.empty((len(beam.spectra), *window.shape))
    dv, du = geometry.pitch
    # Half the beam's width anywhere between source and detector, and the drift during a view.
    nearest = math.hypot(bodies.circle[0], bodies.circle[1])
    reach = (
        math.hypot(*beam.focal_spot) / 2
        + math.hypot(du, dv) / 2
        + float(np.abs(view_step).max()) * nearest / 2
        + float(np.abs(bodies.drift).max(initial=0.0))
    )
    empty = np.empty((0, 0, 0))
    run(
        _readings,
        geometry.views,
        np.cos(geometry.angles),
        np.sin(geometry.angles),
        np.ascontiguousarray(view_step),
        geometry.sod,
        _across(geometry, beam.focal_spot[0], beam.points),
        geometry.row_positions[0],
        dv,
        *beam.focal_spot,
        np.ascontiguousarray(beam.points),
        bodies.kinds,
        bodies.params,
        coefficients,
        basis,
        bodies.offsets,
        bodies.drift,
        np.array(bodies.circle),
        reach,
        np.ascontiguousarray(beam.spectra),
        np.ascontiguousarray(beam.row_factor),
        window.first_column,
        window.first_row,
        empty if exterior is None else np.ascontiguousarray(exterior),
        out,
    )
    return torch.from_numpy(out)


forget_outdated(__name__)
