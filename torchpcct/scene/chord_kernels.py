"""The kernels behind :mod:`torchpcct.scene.chords`: one ray, or many from one point, through one
packed shape.

:func:`interval` finds both ends of a chord of any ray. :func:`chords_from` gives the chords of many
rays of one source at once, as loops without branches that the compiler turns into SIMD; the few
rays that need more care (grazing, steep) go the way of :func:`interval`.

In a tube's section coordinates ``u = X s_x - 1``, ``v = y s_y`` with ``X = x + R`` both tubes are
the unit circle: ``s_x = 1 / (R + d), s_y = 1 / R`` for the bulged one, ``s_x = s_y = (R + d) / R²``
for the narrowed one, with the profile ``d(z)``. The implicit function along a ray is ``h(t) = u² +
v² - 1``.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

# Kinds of packed shapes.
ELLIPSOID, CYLINDER, BOX, BULGED, NARROWED = range(5)
_FAST = {"contract", "arcp", "nsz"}
"""Contraction to FMA is safe; reassociation would undo the cancellation-free order of the
operations below. Functions that take a row are inlined: else numba counts references to it, and all
threads would fight for the counter."""
_PIECES = 64
"""Pieces a steep ray is cut into over the bulge; each is searched for one extremum and its
crossings."""


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def unit_circle(lx: float, ly: float, ux: float, uy: float) -> tuple[float, float]:
    """Interval of a line inside the unit circle (its height does not matter); ``t1 <= t0`` for a
    miss."""
    a = ux * ux + uy * uy
    if a == 0.0:
        if lx * lx + ly * ly < 1.0:
            return -math.inf, math.inf
        return 0.0, 0.0
    # Measured from the point of closest approach: no difference of large numbers for a far source.
    inverse = 1.0 / a
    t = -(lx * ux + ly * uy) * inverse
    x, y = lx + t * ux, ly + t * uy
    rest = 1.0 - (x * x + y * y)
    if rest <= 0.0:
        return 0.0, 0.0
    half = math.sqrt(rest * inverse)
    return t - half, t + half


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def clip(t0: float, t1: float, lz: float, uz: float, half_length: float) -> tuple[float, float]:
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


# Inlined and without branches, so that loops over many rays can hold them.
@numba.njit(inline="always", fastmath=_FAST, error_model="numpy")
def _level(
    narrowed: bool, X: float, y: float, ux: float, uy: float, radius: float, d: float, slope: float
) -> tuple[float, float]:
    """``h`` and ``dh/dt`` where the profile is ``d`` and changes by ``slope`` per mm of the ray."""
    inverse = 1.0 / radius
    widened, thinned = 1.0 / (radius + d), (radius + d) * inverse * inverse
    sx = thinned if narrowed else widened
    sy = thinned if narrowed else inverse
    dsx = slope * inverse * inverse if narrowed else -slope * widened * widened
    dsy = slope * inverse * inverse if narrowed else 0.0
    u, v = X * sx - 1.0, y * sy
    return u * u + v * v - 1.0, 2.0 * (u * (ux * sx + X * dsx) + v * (uy * sy + y * dsy))


@numba.njit(inline="always", fastmath=_FAST, error_model="numpy")
def _cos_sin(phase: float) -> tuple[float, float]:
    """Cosine and sine of a phase within ±4 to 1e-12: a quarter of the time of two library calls."""
    half = 0.5 * phase
    q = half * half
    c = 1.0 - q * (
        1 / 2
        - q
        * (
            1 / 24
            - q
            * (
                1 / 720
                - q
                * (
                    1 / 40320
                    - q
                    * (
                        1 / 3628800
                        - q
                        * (
                            1 / 479001600
                            - q
                            * (1 / 87178291200 - q * (1 / 20922789888000 - q / 6402373705728000))
                        )
                    )
                )
            )
        )
    )
    s = half * (
        1.0
        - q
        * (
            1 / 6
            - q
            * (
                1 / 120
                - q
                * (
                    1 / 5040
                    - q
                    * (
                        1 / 362880
                        - q
                        * (
                            1 / 39916800
                            - q * (1 / 6227020800 - q * (1 / 1307674368000 - q / 355687428096000))
                        )
                    )
                )
            )
        )
    )
    return 2.0 * c * c - 1.0, 2.0 * s * c


@numba.njit(inline="always", fastmath=_FAST, error_model="numpy")
def _shallow_level(
    narrowed: bool,
    t: float,
    X: float,
    y: float,
    z: float,
    ux: float,
    uy: float,
    uz: float,
    radius: float,
    half_amplitude: float,
    omega: float,
    reach: float,
    c0: float,
    s0: float,
) -> tuple[float, float]:
    """``h`` and ``dh/dt`` at ``t`` from the point (X, y, z) whose phase has the cosine ``c0``
    and the sine ``s0``."""
    phase = omega * uz * t
    q = phase * phase
    # Taylor series: the phase is small, and a call of sin and cos would cost more than all the
    # rest.
    s = phase * (
        1.0 - q * (1 / 6 - q * (1 / 120 - q * (1 / 5040 - q * (1 / 362880 - q / 39916800))))
    )
    c = 1.0 - q * (
        1 / 2 - q * (1 / 24 - q * (1 / 720 - q * (1 / 40320 - q * (1 / 3628800 - q / 479001600))))
    )
    bulge = half_amplitude if abs(z + t * uz) < reach else 0.0
    d = bulge * (1.0 + (c0 * c - s0 * s))
    slope = -bulge * omega * uz * (s0 * c + c0 * s)
    return _level(narrowed, X + t * ux, y + t * uy, ux, uy, radius, d, slope)


@numba.njit(inline="always", fastmath=_FAST, error_model="numpy")
def _newton(
    narrowed: bool,
    t: float,
    X: float,
    y: float,
    z: float,
    ux: float,
    uy: float,
    uz: float,
    radius: float,
    half_amplitude: float,
    omega: float,
    reach: float,
    c0: float,
    s0: float,
    curvature: float,
) -> tuple[float, float]:
    """A step of Newton's method towards ``h = 0`` with ``curvature`` as half the second derivative:
    where it leads, and its length."""
    h, slope = _shallow_level(
        narrowed, t, X, y, z, ux, uy, uz, radius, half_amplitude, omega, reach, c0, s0
    )
    inverse = 1.0 / slope
    step = h * inverse
    step *= 1.0 + curvature * step * inverse
    return t - step, step


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def shallow(
    narrowed: bool,
    lx: float,
    ly: float,
    lz: float,
    ux: float,
    uy: float,
    uz: float,
    radius: float,
    amplitude: float,
    omega: float,
    reach: float,
) -> tuple[float, float]:
    """Interval of a ray of small slope inside the endless tube; ``t1 <= t0`` for a miss."""
    flat = ux * ux + uy * uy
    if flat == 0.0:  # only for a tube without a bulge, whose slope is not limited
        return unit_circle(lx / radius, ly / radius, 0.0, 0.0)
    start = -(lx * ux + ly * uy) / flat
    x, y, z = lx + start * ux, ly + start * uy, lz + start * uz
    if amplitude == 0.0 or abs(z) - 2.5 * (radius + amplitude) * abs(uz) >= reach:
        rest = radius * radius - (x * x + y * y)
        if rest <= 0.0:
            return 0.0, 0.0
        half = math.sqrt(rest / flat)
        return start - half, start + half
    X = x + radius
    c0, s0 = _cos_sin(omega * z)
    half_amplitude = 0.5 * amplitude
    d = half_amplitude * (1.0 + c0) if abs(z) < reach else 0.0
    # The section at the closest approach, held fixed along the ray: curvature t² + 2 b t + c = 0.
    if narrowed:
        sx = (radius + d) / (radius * radius)
        sy = sx
    else:
        sx, sy = 1.0 / (radius + d), 1.0 / radius
    u0, v0, du, dv = X * sx - 1.0, y * sy, ux * sx, uy * sy
    curvature = du * du + dv * dv
    t = -(u0 * du + v0 * dv) / curvature
    u0, v0 = u0 + t * du, v0 + t * dv
    lowest = u0 * u0 + v0 * v0 - 1.0
    grazing = False
    if uz == 0.0:
        if lowest >= 0.0:
            return 0.0, 0.0
    elif lowest > -0.02 - 12.0 * half_amplitude * omega * abs(uz):
        if lowest > 1.0:
            return 0.0, 0.0
        grazing = True
        # The true minimum of h. The fixed section's curvature is within a few per cent of the true
        # one.
        for _ in range(12):
            h, slope = _shallow_level(
                narrowed, t, X, y, z, ux, uy, uz, radius, half_amplitude, omega, reach, c0, s0
            )
            step = 0.5 * slope / curvature
            lowest = h - 0.5 * slope * step
            t -= step
            if not step * step > 1e-12:
                break
        if lowest >= 0.0:
            return 0.0, 0.0
    half = math.sqrt(-lowest / curvature)
    t0, t1 = t - half, t + half
    if uz != 0.0:
        # First the change of the profile on the way to either end, to first order where the fixed
        # section has h = 0.
        if not grazing and abs(z) < reach:
            phase = omega * uz
            turn, bend = half_amplitude * phase * s0, 0.5 * half_amplitude * phase * phase * c0
            u0, u1 = (X + t0 * ux) * sx - 1.0, (X + t1 * ux) * sx - 1.0
            scale = 1.0 / (curvature * half)
            if narrowed:
                scale /= radius + d
                t0 -= scale * (1.0 + u0) * (turn + bend * t0) * t0
                t1 += scale * (1.0 + u1) * (turn + bend * t1) * t1
            else:
                scale *= sx
                t0 += scale * u0 * (1.0 + u0) * (turn + bend * t0) * t0
                t1 -= scale * u1 * (1.0 + u1) * (turn + bend * t1) * t1
        # Newton's method at both ends at once, with the fixed section's curvature as second
        # derivative. After a step s the error is less than s² / (20 half).
        enough = 2e-10 * half
        for _ in range(30):
            t0, step0 = _newton(
                narrowed,
                t0,
                X,
                y,
                z,
                ux,
                uy,
                uz,
                radius,
                half_amplitude,
                omega,
                reach,
                c0,
                s0,
                curvature,
            )
            t1, step1 = _newton(
                narrowed,
                t1,
                X,
                y,
                z,
                ux,
                uy,
                uz,
                radius,
                half_amplitude,
                omega,
                reach,
                c0,
                s0,
                curvature,
            )
            if not step0 * step0 + step1 * step1 > enough:
                break
    return start + t0, start + t1


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _bulge_level(
    narrowed: bool,
    t: float,
    lx: float,
    ly: float,
    lz: float,
    ux: float,
    uy: float,
    uz: float,
    radius: float,
    amplitude: float,
    omega: float,
) -> tuple[float, float]:
    phase = omega * (lz + t * uz)
    d = 0.5 * amplitude * (1.0 + math.cos(phase))
    slope = -0.5 * amplitude * omega * uz * math.sin(phase)
    return _level(narrowed, lx + radius + t * ux, ly + t * uy, ux, uy, radius, d, slope)


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _bisect(
    want_slope: bool,
    narrowed: bool,
    ta: float,
    tb: float,
    lx: float,
    ly: float,
    lz: float,
    ux: float,
    uy: float,
    uz: float,
    radius: float,
    amplitude: float,
    omega: float,
) -> float:
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
    narrowed: bool,
    lx: float,
    ly: float,
    lz: float,
    ux: float,
    uy: float,
    uz: float,
    radius: float,
    amplitude: float,
    omega: float,
    reach: float,
    half_length: float,
) -> tuple[float, float]:
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
            # Where both ends lie on one side of the surface, an extremum between them may lie on
            # the other.
            tm, hm = tb, hb
            if (ha > 0.0 and hb > 0.0 and sa < 0.0 and sb > 0.0) or (
                ha < 0.0 and hb < 0.0 and sa > 0.0 and sb < 0.0
            ):
                tm = _bisect(
                    True, narrowed, ta, tb, lx, ly, lz, ux, uy, uz, radius, amplitude, omega
                )
                hm, _ = _bulge_level(narrowed, tm, lx, ly, lz, ux, uy, uz, radius, amplitude, omega)
            for part in range(2):
                t0, h0 = (ta, ha) if part == 0 else (tm, hm)
                t1, h1 = (tm, hm) if part == 0 else (tb, hb)
                if t1 <= t0:
                    continue
                if (h0 < 0.0) != (h1 < 0.0):
                    root = _bisect(
                        False, narrowed, t0, t1, lx, ly, lz, ux, uy, uz, radius, amplitude, omega
                    )
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


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _ellipsoid(
    lx: float, ly: float, lz: float, ux: float, uy: float, uz: float
) -> tuple[float, float]:
    a = ux * ux + uy * uy + uz * uz
    # Measured from the point of closest approach: no difference of large numbers for a far source.
    inverse = 1.0 / a
    t = -(lx * ux + ly * uy + lz * uz) * inverse
    x, y, z = lx + t * ux, ly + t * uy, lz + t * uz
    rest = 1.0 - (x * x + y * y + z * z)
    if rest <= 0.0:
        return 0.0, 0.0
    half = math.sqrt(rest * inverse)
    return t - half, t + half


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _box(lx: float, ly: float, lz: float, ux: float, uy: float, uz: float) -> tuple[float, float]:
    t0, t1 = -math.inf, math.inf
    for axis in range(3):
        p = lx if axis == 0 else (ly if axis == 1 else lz)
        u = ux if axis == 0 else (uy if axis == 1 else uz)
        if u == 0.0:
            if abs(p) >= 1.0:
                return 0.0, 0.0
        else:
            near, far = (-1.0 - p) / u, (1.0 - p) / u
            if near > far:
                near, far = far, near
            # Written so that a NaN replaces the bound instead of being skipped.
            t0 = t0 if t0 >= near else near
            t1 = t1 if t1 <= far else far
    return t0, t1


@numba.njit(inline="always", cache=True, fastmath=_FAST, error_model="numpy")
def interval(
    kind: int,
    row: NDArray[np.float64],
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
) -> tuple[float, float]:
    """Where the straight line ``o + t d`` is inside one packed shape.

    Args:
        kind, row: one element of each of the arrays of ``pack`` (``kinds[b]``, ``params[b]``).
        ox, oy, oz: a point of the line, usually the source, in mm. Subtract a body's displacement
            from it.
        dx, dy, dz: unit direction.

    Returns:
        ``(t0, t1)`` in mm along the line, not clipped to ``t > 0``; ``t1 <= t0`` where the line
        misses the shape. A line inside an endless shape and parallel to it gives ``(-inf, inf)``.
    """
    qx, qy = row[0] - ox, row[1] - oy
    cross = qx * dy - qy * dx
    p2 = dx * dx + dy * dy
    if cross * cross > row[3] * p2:
        return 0.0, 0.0
    if abs((oz - row[2]) * p2 + (qx * dx + qy * dy) * dz) > row[5] * p2 + row[4] * abs(dz):
        return 0.0, 0.0
    x, y, z = ox - row[6], oy - row[7], oz - row[8]
    lx = row[9] * x + row[10] * y + row[11] * z
    ly = row[12] * x + row[13] * y + row[14] * z
    lz = row[15] * x + row[16] * y + row[17] * z
    ux = row[9] * dx + row[10] * dy + row[11] * dz
    uy = row[12] * dx + row[13] * dy + row[14] * dz
    uz = row[15] * dx + row[16] * dy + row[17] * dz
    if kind == ELLIPSOID:
        return _ellipsoid(lx, ly, lz, ux, uy, uz)
    if kind == CYLINDER:
        t0, t1 = unit_circle(lx, ly, ux, uy)
        if t1 <= t0:
            return 0.0, 0.0
        return clip(t0, t1, lz, uz, row[18])
    if kind == BOX:
        return _box(lx, ly, lz, ux, uy, uz)
    narrowed = kind == NARROWED
    if abs(uz) <= row[23]:
        t0, t1 = shallow(narrowed, lx, ly, lz, ux, uy, uz, row[19], row[20], row[21], row[22])
        if t1 <= t0:
            return 0.0, 0.0
        return clip(t0, t1, lz, uz, row[18])
    return steep(narrowed, lx, ly, lz, ux, uy, uz, row[19], row[20], row[21], row[22], row[18])


@numba.njit(nogil=True, cache=True, fastmath=_FAST, error_model="numpy")
def chords(
    begin: int,
    end: int,
    kinds: NDArray[np.int64],
    params: NDArray[np.float64],
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Chord of the lines ``begin … end`` in every shape, ``out (B, N)``."""
    for n in range(begin, end):
        ox, oy, oz = origins[n, 0], origins[n, 1], origins[n, 2]
        dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
        for b in range(kinds.shape[0]):
            t0, t1 = interval(kinds[b], params[b], ox, oy, oz, dx, dy, dz)
            out[b, n] = 0.0 if t1 <= t0 else t1 - t0


# --- many rays of one source ----------------------------------------------------------------------
# A ray is given by its unit direction (dx, dy) in the plane and its climb dz per mm of that plane:
# all rows of a detector column share dx and dy. Lengths are measured in the plane, and stretched by
# sqrt(1 + dz²) at the end.


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def may_meet(
    params: NDArray[np.float64], b: int, ox: float, oy: float, dx: float, dy: float
) -> bool:
    """Whether rays from a point whose unit direction in the plane is (dx, dy) may meet shape
    ``b``: they pass through its bounding cylinder, whatever their climb."""
    cross = (params[b, 0] - ox) * dy - (params[b, 1] - oy) * dx
    return cross * cross <= params[b, 3]


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def chords_from(
    kind: int,
    params: NDArray[np.float64],
    b: int,
    ox: float,
    oy: float,
    oz: float,
    dx: NDArray[np.float64],
    dy: NDArray[np.float64],
    dz: NDArray[np.float64],
    stretch: NDArray[np.float64],
    count: int,
    out: NDArray[np.float64],
) -> None:
    """Chords of ``count`` rays from one point in one packed shape.

    Args:
        kind: of the shape; params, b: row ``b`` of ``params`` is the shape's, see ``pack``.
        ox, oy, oz: where the rays start, in mm; far outside of the shape, or the part of the chord
            behind it counts too. Subtract a body's displacement from it.
        dx, dy, dz: ``(count,)`` or longer, unit direction in the plane and climb.
        stretch: ``sqrt(1 + dz²)``.
        count: number of rays.
        out: chords in mm, 0 for a miss.
    """
    x, y, z = ox - params[b, 6], oy - params[b, 7], oz - params[b, 8]
    lx = params[b, 9] * x + params[b, 10] * y + params[b, 11] * z
    ly = params[b, 12] * x + params[b, 13] * y + params[b, 14] * z
    lz = params[b, 15] * x + params[b, 16] * y + params[b, 17] * z
    if kind == ELLIPSOID:
        _ellipsoid_chords(params, b, lx, ly, lz, dx, dy, dz, stretch, count, out)
    elif kind == CYLINDER:
        _cylinder_chords(params, b, lx, ly, lz, dx, dy, dz, stretch, count, out)
    elif kind == BOX:
        _box_chords(params, b, lx, ly, lz, dx, dy, dz, stretch, count, out)
    else:
        _tube_chords(kind == NARROWED, params, b, lx, ly, lz, dx, dy, dz, stretch, count, out)


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _ellipsoid_chords(
    params: NDArray[np.float64],
    b: int,
    lx: float,
    ly: float,
    lz: float,
    dx: NDArray[np.float64],
    dy: NDArray[np.float64],
    dz: NDArray[np.float64],
    stretch: NDArray[np.float64],
    count: int,
    out: NDArray[np.float64],
) -> None:
    xx, xy, xz = params[b, 9], params[b, 10], params[b, 11]
    yx, yy, yz = params[b, 12], params[b, 13], params[b, 14]
    zx, zy, zz = params[b, 15], params[b, 16], params[b, 17]
    for n in range(count):
        ux = xx * dx[n] + xy * dy[n] + xz * dz[n]
        uy = yx * dx[n] + yy * dy[n] + yz * dz[n]
        uz = zx * dx[n] + zy * dy[n] + zz * dz[n]
        inverse = 1.0 / (ux * ux + uy * uy + uz * uz)
        t = -(lx * ux + ly * uy + lz * uz) * inverse
        x, y, z = lx + t * ux, ly + t * uy, lz + t * uz
        rest = max(1.0 - (x * x + y * y + z * z), 0.0)
        out[n] = 2.0 * math.sqrt(rest * inverse) * stretch[n]


@numba.njit(inline="always", fastmath=_FAST, error_model="numpy")
def _clipped(t0: float, t1: float, lz: float, uz: float, half_length: float) -> float:
    """Length of ``(t0, t1)`` with ``|lz + t uz| <= half_length``, at least 0, without branches."""
    inverse = 1.0 / uz
    near, far = (-half_length - lz) * inverse, (half_length - lz) * inverse
    low, high = min(near, far), max(near, far)
    inside = abs(lz) <= half_length
    low = low if uz != 0.0 else (-math.inf if inside else math.inf)
    high = high if uz != 0.0 else (math.inf if inside else -math.inf)
    return max(min(t1, high) - max(t0, low), 0.0)


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _cylinder_chords(
    params: NDArray[np.float64],
    b: int,
    lx: float,
    ly: float,
    lz: float,
    dx: NDArray[np.float64],
    dy: NDArray[np.float64],
    dz: NDArray[np.float64],
    stretch: NDArray[np.float64],
    count: int,
    out: NDArray[np.float64],
) -> None:
    half_length = params[b, 18]
    endless = half_length == math.inf
    xx, xy, xz = params[b, 9], params[b, 10], params[b, 11]
    yx, yy, yz = params[b, 12], params[b, 13], params[b, 14]
    zx, zy, zz = params[b, 15], params[b, 16], params[b, 17]
    for n in range(count):
        ux = xx * dx[n] + xy * dy[n] + xz * dz[n]
        uy = yx * dx[n] + yy * dy[n] + yz * dz[n]
        uz = zx * dx[n] + zy * dy[n] + zz * dz[n]
        a = ux * ux + uy * uy
        inverse = 1.0 / a
        t = -(lx * ux + ly * uy) * inverse
        x, y = lx + t * ux, ly + t * uy
        rest = max(1.0 - (x * x + y * y), 0.0)
        half = math.sqrt(rest * inverse)
        # A ray along the axis is inside of the section from end to end, or nowhere.
        along = math.inf if lx * lx + ly * ly < 1.0 else 0.0
        t, half = (t if a > 0.0 else 0.0), (half if a > 0.0 else along)
        clipped = 2.0 * half if endless else _clipped(t - half, t + half, lz, uz, half_length)
        out[n] = clipped * stretch[n]


@numba.njit(inline="always", fastmath=_FAST, error_model="numpy")
def _slab(p: float, u: float) -> tuple[float, float]:
    """Where a line is between two faces of the unit box, without branches."""
    inverse = 1.0 / u
    near, far = (-1.0 - p) * inverse, (1.0 - p) * inverse
    low, high = min(near, far), max(near, far)
    inside = abs(p) < 1.0
    low = low if u != 0.0 else (-math.inf if inside else math.inf)
    high = high if u != 0.0 else (math.inf if inside else -math.inf)
    return low, high


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _box_chords(
    params: NDArray[np.float64],
    b: int,
    lx: float,
    ly: float,
    lz: float,
    dx: NDArray[np.float64],
    dy: NDArray[np.float64],
    dz: NDArray[np.float64],
    stretch: NDArray[np.float64],
    count: int,
    out: NDArray[np.float64],
) -> None:
    xx, xy, xz = params[b, 9], params[b, 10], params[b, 11]
    yx, yy, yz = params[b, 12], params[b, 13], params[b, 14]
    zx, zy, zz = params[b, 15], params[b, 16], params[b, 17]
    for n in range(count):
        ux = xx * dx[n] + xy * dy[n] + xz * dz[n]
        uy = yx * dx[n] + yy * dy[n] + yz * dz[n]
        uz = zx * dx[n] + zy * dy[n] + zz * dz[n]
        x0, x1 = _slab(lx, ux)
        y0, y1 = _slab(ly, uy)
        z0, z1 = _slab(lz, uz)
        out[n] = max(min(min(x1, y1), z1) - max(max(x0, y0), z0), 0.0) * stretch[n]


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _tube_chords(
    narrowed: bool,
    params: NDArray[np.float64],
    b: int,
    lx: float,
    ly: float,
    lz: float,
    dx: NDArray[np.float64],
    dy: NDArray[np.float64],
    dz: NDArray[np.float64],
    stretch: NDArray[np.float64],
    count: int,
    out: NDArray[np.float64],
) -> None:
    """As :func:`shallow`, two steps of Newton's method for every ray; what they do not settle is
    left to :func:`shallow` and :func:`steep`."""
    half_length, radius, amplitude = params[b, 18], params[b, 19], params[b, 20]
    omega, reach, steepest = params[b, 21], params[b, 22], params[b, 23]
    endless = half_length == math.inf
    half_amplitude = 0.5 * amplitude
    farthest = 4.0 / omega
    straight = 1.0 / radius
    xx, xy, xz = params[b, 9], params[b, 10], params[b, 11]
    yx, yy, yz = params[b, 12], params[b, 13], params[b, 14]
    zx, zy, zz = params[b, 15], params[b, 16], params[b, 17]
    for n in range(count):
        ux = xx * dx[n] + xy * dy[n] + xz * dz[n]
        uy = yx * dx[n] + yy * dy[n] + yz * dz[n]
        uz = zx * dx[n] + zy * dy[n] + zz * dz[n]
        flat = ux * ux + uy * uy
        start = -(lx * ux + ly * uy) / flat
        x, y, z = lx + start * ux, ly + start * uy, lz + start * uz
        X = x + radius
        bent = (amplitude > 0.0) & (abs(z) - 2.5 * (radius + amplitude) * abs(uz) < reach)
        # Farther from the bulge the phase does not matter.
        c0, s0 = _cos_sin(omega * min(max(z, -farthest), farthest))
        near = abs(z) < reach
        d = half_amplitude * (1.0 + c0) if near else 0.0
        bulged = 1.0 / (radius + d)
        thinned = (radius + d) * straight * straight
        sx = thinned if narrowed else bulged
        sy = thinned if narrowed else straight
        u0, v0, du, dv = X * sx - 1.0, y * sy, ux * sx, uy * sy
        curvature = du * du + dv * dv
        flatness = 1.0 / curvature
        t = -(u0 * du + v0 * dv) * flatness
        u0, v0 = u0 + t * du, v0 + t * dv
        lowest = u0 * u0 + v0 * v0 - 1.0
        half = math.sqrt(max(-lowest, 0.0) * flatness)
        t0, t1 = t - half, t + half
        # The change of the profile on the way to either end, to first order.
        phase = omega * uz
        turn, bend = half_amplitude * phase * s0, 0.5 * half_amplitude * phase * phase * c0
        u0, u1 = (X + t0 * ux) * sx - 1.0, (X + t1 * ux) * sx - 1.0
        scale = flatness / half * bulged
        scale0 = -scale if narrowed else scale * u0
        scale1 = -scale if narrowed else scale * u1
        step0 = scale0 * (1.0 + u0) * (turn + bend * t0) * t0
        step1 = scale1 * (1.0 + u1) * (turn + bend * t1) * t1
        t0 = t0 + step0 if near else t0
        t1 = t1 - step1 if near else t1
        # Written out: the compiler makes no SIMD of a loop inside of a loop.
        t0, step0 = _newton(
            narrowed,
            t0,
            X,
            y,
            z,
            ux,
            uy,
            uz,
            radius,
            half_amplitude,
            omega,
            reach,
            c0,
            s0,
            curvature,
        )
        t1, step1 = _newton(
            narrowed,
            t1,
            X,
            y,
            z,
            ux,
            uy,
            uz,
            radius,
            half_amplitude,
            omega,
            reach,
            c0,
            s0,
            curvature,
        )
        t0, step0 = _newton(
            narrowed,
            t0,
            X,
            y,
            z,
            ux,
            uy,
            uz,
            radius,
            half_amplitude,
            omega,
            reach,
            c0,
            s0,
            curvature,
        )
        t1, step1 = _newton(
            narrowed,
            t1,
            X,
            y,
            z,
            ux,
            uy,
            uz,
            radius,
            half_amplitude,
            omega,
            reach,
            c0,
            s0,
            curvature,
        )
        # Written so that a NaN settles nothing.
        gentle = abs(uz) <= steepest * stretch[n]
        deep = lowest <= (-0.02 - 12.0 * half_amplitude * abs(phase) if bent else 0.0)
        settled = gentle & deep & (step0 * step0 + step1 * step1 <= 2e-10 * half)
        missed = gentle & (lowest >= (1.0 if bent else 0.0))
        length = t1 - t0 if endless else _clipped(t0, t1, z, uz, half_length)
        length = max(length, 0.0) * stretch[n]
        out[n] = 0.0 if missed else (length if settled else -1.0)
    for n in range(count):
        if out[n] >= 0.0:
            continue
        inverse = 1.0 / stretch[n]
        ex, ey, ez = dx[n] * inverse, dy[n] * inverse, dz[n] * inverse
        ux = xx * ex + xy * ey + xz * ez
        uy = yx * ex + yy * ey + yz * ez
        uz = zx * ex + zy * ey + zz * ez
        if abs(uz) <= steepest:
            t0, t1 = shallow(narrowed, lx, ly, lz, ux, uy, uz, radius, amplitude, omega, reach)
            if t1 > t0:
                t0, t1 = clip(t0, t1, lz, uz, half_length)
        else:
            t0, t1 = steep(
                narrowed, lx, ly, lz, ux, uy, uz, radius, amplitude, omega, reach, half_length
            )
        out[n] = t1 - t0 if t1 > t0 else 0.0
