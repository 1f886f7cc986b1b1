"""Rays through tubes of changing section: the kernels behind :func:`torchpcct.scene.chords.interval`.

In the section's own coordinates ``u = X s_x - 1``, ``v = y s_y`` with ``X = x + R`` both tubes are the unit circle:
``s_x = 1 / (R + d), s_y = 1 / R`` for the bulged one, ``s_x = s_y = (R + d) / R²`` for the narrowed one, with the
profile ``d(z)``. The implicit function along a ray is ``h(t) = u² + v² - 1``.
"""

from __future__ import annotations

import math
from typing import Any

import numba

from torchpcct.scene.tubes import NarrowedTube

# Contraction to FMA is safe; reassociation would undo the cancellation-free order of the operations below.
_FAST = {"contract", "arcp", "nsz"}
# Largest phase of the profile that the series of cos and sin below carry to 1e-11.
_SERIES = 0.7
# Pieces a steep ray is cut into over the bulge; each is searched for one extremum and its crossings.
_PIECES = 64


def slope_limit(shape: Any) -> float:
    """Largest ``|dz|`` for which ``h`` is convex along the ray and the phase stays in the series' range.

    In the section's coordinates the ray is a curve of acceleration ``P''`` and speed ``|P'|``.
    ``h'' = 2 |P'|² + 2 P·P''`` is positive while ``|P| |P''| < |P'|²``; the bounds hold in the whole bounding disc, and
    a factor 2 is in hand.
    """
    r, a = shape.radius, shape.amplitude
    if a == 0.0:
        return math.inf
    reach = 2.0 * (r + a)
    steepest, bend = math.pi * a / shape.bulge_length, 2.0 * (math.pi / shape.bulge_length) ** 2 * a
    if isinstance(shape, NarrowedTube):
        first, second = steepest / r**2, bend / r**2
        scale = 1.0 / r
    else:
        first, second = steepest / r**2, bend / r**2 + 2.0 * steepest**2 / r**3
        scale = 1.0 / (r + a)
    farthest = 2.0 * ((r + a) / r) ** 2
    low, high = 0.0, 1.0
    for _ in range(40):
        s = 0.5 * (low + high)
        acceleration = s * (2.0 * first + reach * second * s)
        speed = math.sqrt(1.0 - s * s) * scale - s * reach * first
        phase = 2.0 * math.pi / shape.bulge_length * s * reach
        if speed > 0 and 2.0 * farthest * acceleration <= speed * speed and phase <= _SERIES:
            low = s
        else:
            high = s
    return low


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def unit_circle(lx: float, ly: float, ux: float, uy: float) -> Any:
    """Interval of a line inside the unit circle (its height does not matter); ``t1 <= t0`` for a miss."""
    a = ux * ux + uy * uy
    if a == 0.0:
        if lx * lx + ly * ly < 1.0:
            return -math.inf, math.inf
        return 0.0, 0.0
    # Measured from the point of closest approach: no difference of large numbers for a far source.
    t = -(lx * ux + ly * uy) / a
    x, y = lx + t * ux, ly + t * uy
    rest = 1.0 - (x * x + y * y)
    if rest <= 0.0:
        return 0.0, 0.0
    half = math.sqrt(rest / a)
    return t - half, t + half


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def clip(t0: float, t1: float, lz: float, uz: float, half_length: float) -> Any:
    """The part of ``(t0, t1)`` with ``|lz + t uz| <= half_length``."""
    if half_length == math.inf:
        return t0, t1
    if uz == 0.0:
        if abs(lz) > half_length:
            return 0.0, 0.0
        return t0, t1
    near, far = (-half_length - lz) / uz, (half_length - lz) / uz
    if near > far:
        near, far = far, near
    return (near if near > t0 else t0), (far if far < t1 else t1)


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _level(
    narrowed: bool, X: float, y: float, ux: float, uy: float, radius: float, d: float, slope: float
) -> tuple[float, float]:
    """``h`` and ``dh/dt`` where the profile is ``d`` and changes by ``slope`` per mm of the ray."""
    if narrowed:
        inverse = 1.0 / (radius * radius)
        s, ds = (radius + d) * inverse, slope * inverse
        u, v = X * s - 1.0, y * s
        return u * u + v * v - 1.0, 2.0 * (u * (ux * s + X * ds) + v * (uy * s + y * ds))
    s, inverse = 1.0 / (radius + d), 1.0 / radius
    u, v = X * s - 1.0, y * inverse
    return u * u + v * v - 1.0, 2.0 * (u * s * (ux - X * s * slope) + v * uy * inverse)


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _shallow_level(
    narrowed: bool, t: float, X: float, y: float, z: float, ux: float, uy: float, uz: float,
    radius: float, amplitude: float, omega: float, reach: float, c0: float, s0: float,
) -> tuple[float, float]:  # fmt: skip
    """``h`` and ``dh/dt`` at ``t`` from the point (X, y, z) whose phase has the cosine ``c0`` and the sine ``s0``."""
    d, slope = 0.0, 0.0
    if abs(z + t * uz) < reach:
        phase = omega * uz * t
        q = phase * phase
        # Taylor series: the phase is small, and a call of sin and cos would cost more than all the rest.
        s = phase * (1.0 - q * (1 / 6 - q * (1 / 120 - q * (1 / 5040 - q * (1 / 362880 - q / 39916800)))))
        c = 1.0 - q * (0.5 - q * (1 / 24 - q * (1 / 720 - q * (1 / 40320 - q * (1 / 3628800 - q / 479001600)))))
        d = 0.5 * amplitude * (1.0 + (c0 * c - s0 * s))
        slope = -0.5 * amplitude * omega * uz * (s0 * c + c0 * s)
    return _level(narrowed, X + t * ux, y + t * uy, ux, uy, radius, d, slope)


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def shallow(
    narrowed: bool, lx: float, ly: float, lz: float, ux: float, uy: float, uz: float,
    radius: float, amplitude: float, omega: float, reach: float,
) -> Any:  # fmt: skip
    """Interval of a ray of small slope inside the endless tube; ``t1 <= t0`` for a miss."""
    flat = ux * ux + uy * uy
    if flat == 0.0:  # only for a tube without a bulge, whose slope is not limited
        return unit_circle(lx / radius, ly / radius, 0.0, 0.0)
    start = -(lx * ux + ly * uy) / flat
    x, y, z = lx + start * ux, ly + start * uy, lz + start * uz
    if amplitude == 0.0 or abs(z) - 2.5 * (radius + amplitude) * abs(uz) >= reach:
        inverse = 1.0 / radius
        rest = 1.0 - (x * x + y * y) * (inverse * inverse)
        if rest <= 0.0:
            return 0.0, 0.0
        half = radius * math.sqrt(rest / flat)
        return start - half, start + half
    X = x + radius
    c0, s0 = math.cos(omega * z), math.sin(omega * z)
    d = 0.5 * amplitude * (1.0 + c0) if abs(z) < reach else 0.0
    if narrowed:
        curvature = flat * ((radius + d) / (radius * radius)) ** 2
    else:
        curvature = (ux / (radius + d)) ** 2 + (uy / radius) ** 2
    # The minimum of h; the frozen section's curvature is within a few per cent of the true one.
    t, lowest = 0.0, 0.0
    for _ in range(12):
        h, slope = _shallow_level(narrowed, t, X, y, z, ux, uy, uz, radius, amplitude, omega, reach, c0, s0)
        step = 0.5 * slope / curvature
        lowest = h - 0.5 * slope * step
        t -= step
        if step * step < 1e-12 or lowest > 0.5:
            break
    if lowest >= 0.0:
        return 0.0, 0.0
    half = math.sqrt(-lowest / curvature)
    t0, t1 = t - half, t + half
    # Quadratic convergence: after a step s the error is about s² / half.
    enough = 1e-12 * half
    for _ in range(30):
        h, slope = _shallow_level(narrowed, t0, X, y, z, ux, uy, uz, radius, amplitude, omega, reach, c0, s0)
        step = h / slope
        t0 -= step
        if not step * step > enough:
            break
    for _ in range(30):
        h, slope = _shallow_level(narrowed, t1, X, y, z, ux, uy, uz, radius, amplitude, omega, reach, c0, s0)
        step = h / slope
        t1 -= step
        if not step * step > enough:
            break
    return start + t0, start + t1


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _bulge_level(
    narrowed: bool, t: float, lx: float, ly: float, lz: float, ux: float, uy: float, uz: float,
    radius: float, amplitude: float, omega: float,
) -> tuple[float, float]:  # fmt: skip
    phase = omega * (lz + t * uz)
    d = 0.5 * amplitude * (1.0 + math.cos(phase))
    slope = -0.5 * amplitude * omega * uz * math.sin(phase)
    return _level(narrowed, lx + radius + t * ux, ly + t * uy, ux, uy, radius, d, slope)


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _bisect(
    want_slope: bool, narrowed: bool, ta: float, tb: float, lx: float, ly: float, lz: float,
    ux: float, uy: float, uz: float, radius: float, amplitude: float, omega: float,
) -> float:  # fmt: skip
    """Zero of ``h`` (or of ``dh/dt``) between ``ta`` and ``tb``, where it has opposite signs."""
    h, slope = _bulge_level(narrowed, ta, lx, ly, lz, ux, uy, uz, radius, amplitude, omega)
    rising = (slope if want_slope else h) < 0.0
    for _ in range(60):
        tm = 0.5 * (ta + tb)
        h, slope = _bulge_level(narrowed, tm, lx, ly, lz, ux, uy, uz, radius, amplitude, omega)
        if ((slope if want_slope else h) < 0.0) == rising:
            ta = tm
        else:
            tb = tm
    return 0.5 * (ta + tb)


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def steep(
    narrowed: bool, lx: float, ly: float, lz: float, ux: float, uy: float, uz: float,
    radius: float, amplitude: float, omega: float, reach: float, half_length: float,
) -> Any:  # fmt: skip
    """First entry of any ray into the tube and, added to it, the total length inside."""
    total, first = 0.0, math.inf
    bulge0, bulge1 = (-reach - lz) / uz, (reach - lz) / uz
    end0, end1 = (-half_length - lz) / uz, (half_length - lz) / uz
    if uz < 0.0:
        bulge0, bulge1, end0, end1 = bulge1, bulge0, end1, end0
    straight0, straight1 = unit_circle(lx / radius, ly / radius, ux / radius, uy / radius)
    if straight1 > straight0:
        for side in range(2):
            t0 = max(straight0, end0 if side == 0 else bulge1)
            t1 = min(straight1, min(bulge0, end1) if side == 0 else end1)
            if t1 > t0:
                total += t1 - t0
                first = min(first, t0)
    # Both deformed sections lie in the disc about (amplitude, 0) that touches x = -radius.
    disc = radius + amplitude
    near, far = unit_circle((lx - amplitude) / disc, ly / disc, ux / disc, uy / disc)
    near, far = max(near, max(bulge0, end0)), min(far, min(bulge1, end1))
    if far > near:
        ta = near
        ha, sa = _bulge_level(narrowed, ta, lx, ly, lz, ux, uy, uz, radius, amplitude, omega)
        for k in range(1, _PIECES + 1):
            tb = near + (far - near) * k / _PIECES
            hb, sb = _bulge_level(narrowed, tb, lx, ly, lz, ux, uy, uz, radius, amplitude, omega)
            # Where both ends lie on one side of the surface, an extremum between them may lie on the other.
            tm, hm = tb, hb
            if (ha > 0.0 and hb > 0.0 and sa < 0.0 and sb > 0.0) or (ha < 0.0 and hb < 0.0 and sa > 0.0 and sb < 0.0):
                tm = _bisect(True, narrowed, ta, tb, lx, ly, lz, ux, uy, uz, radius, amplitude, omega)
                hm, _ = _bulge_level(narrowed, tm, lx, ly, lz, ux, uy, uz, radius, amplitude, omega)
            for part in range(2):
                t0, h0 = (ta, ha) if part == 0 else (tm, hm)
                t1, h1 = (tm, hm) if part == 0 else (tb, hb)
                if t1 <= t0:
                    continue
                if (h0 < 0.0) != (h1 < 0.0):
                    root = _bisect(False, narrowed, t0, t1, lx, ly, lz, ux, uy, uz, radius, amplitude, omega)
                    if h0 < 0.0:
                        t1 = root
                    else:
                        t0 = root
                if h0 < 0.0 or h1 < 0.0:
                    total += t1 - t0
                    first = min(first, t0)
            ta, ha, sa = tb, hb, sb
    if total == math.inf:
        return -math.inf, math.inf
    if total <= 0.0:
        return 0.0, 0.0
    return first, first + total
