"""Are the readings line integrals of one object? The first moments of Helgason and Ludwig, which
need no image.

Of parallel rays of the direction θ at the distances t, the sum ∫ p dt is the object's whole
attenuation, the same for all θ; ∫ t p dt is a sinusoid, that of the centre of mass, and ∫ t² p dt
one of twice the frequency and a constant (Helgason 1965, Ludwig 1966, Comm. Pure Appl. Math.
19:49). A fan's rays are sorted into parallel ones first.

Of a cone beam the sum of a row over its columns tells, too, whether the object rises or sinks
during the turn.

The sum tells what conjugate rays cannot, since it happens to both alike: readings that are no
logarithm of the transmission (pile-up, saturation, scatter, a dark signal, beam hardening) lack
more where the path is long, so a body that is not round weighs less along its long axis. The
frequency of the others tells the range of the angles, of a half turn, too.

What the moments cannot show: the same errors in a round body; and of any body a wrong attenuation
of water, a wrong length of the pitch, and gain errors of single columns, which both directions
share.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.checks.orbit_plane import THIN, lack_of_cells, orbit_plane
from torchpcct.checks.scan_test import UNKNOWN, ScanTest, check_lines
from torchpcct.geometry import ConeBeam, Geometry, view_step

__all__ = ["moment_test"]

WEIGHT_TOLERANCE = 0.002
"""Root mean square of the sum's relative change with the direction that is no finding: 0.3 % of a
thorax are some 20 HU (pile-up of 10 %), 0.1 % of it come from its bones at 100 kVp."""
STEP_TOLERANCE = 0.005
"""Relative error of the steps between views that the moments of a sound scan may show."""
CENTRE_CELLS = 0.3
"""Deviation of the centre of mass from its sinusoid that is no finding, root mean square, in cells
at the axis."""
CENTRE_RADII = 0.005
"""The same in radii of the object (0.2 % from the bones of a thorax)."""
AXIAL_ROWS = 0.3
"""Deviation of the height that is no finding, in rows at the axis, beside what the cone's rays
part by."""
_SLOW = 8
"""Harmonics of a turn that a motion is looked for in."""
_SIGMAS = 4.0
"""Standard errors that a finding stands out by."""
_LACKING = 0.25
"""Of what cells lack at the ends of the object at most, how much may change with the direction
besides."""
_FEIGNED = 0.5
"""Of the wrong steps that cells feign which lack the most they can at the ends of the object, how
many may be: 0.45 of 150 boxes drawn at random, without noise, 1 to 6 in line integrals."""
_LARGEST_STEP = 0.2
"""Relative error of the steps beyond which nothing is linear."""
_DIRECTIONS = 24
"""Fewest directions that are tested."""
_LEAST_ARC = 0.8 * math.pi
"""Smallest arc of the directions that are tested, rad."""

Floats = NDArray[np.float64]


def moment_test(lines: Tensor, geometry: Geometry) -> ScanTest:
    """Test the first three moments of a scan whose rows end in air; of a cone beam those of the
    plane of the source.

    Args:
        lines: line integrals ``(views, [rows,] columns)`` of any unit, views in any order.
        geometry: parallel, fan or cone beam.

    Returns:
        The test of ``weight`` (relative change of the sum with the direction, root mean square),
        ``step`` (relative size by which the steps between the views are described too small; of
        less than a full turn), ``centre`` (mm at the axis by which the centre of mass leaves its
        sinusoid, root mean square) and, of a cone beam, ``axial`` (mm at the axis by which the
        object's height changes beyond a wave of one turn).
        :data:`~torchpcct.checks.scan_test.UNKNOWN` where far less than half a turn of directions
        was measured.

    Raises:
        ValueError: a wrong shape, NaN or Inf.
    """
    g: Any = geometry
    check_lines(lines, g.shape)
    values = lines.detach().to("cpu", torch.float64)
    turned, parted, lacking = 0.0, 0.0, torch.zeros(g.views, g.columns, dtype=torch.float64)
    if g.has_rows:
        plane = orbit_plane(values, g)
        # Of a dense disc thinner than a row the readings tell the shadow, not the attenuation.
        if plane is None or plane.part > THIN:
            return UNKNOWN
        closed = bool(np.ptp(g.angles) + view_step(g.angles) > 1.9 * math.pi)
        parted = plane.part
        values, lacking, turned = plane.lines[:, 0], plane.lacking, plane.turned(closed=closed)
    order = np.argsort(g.angles, kind="stable")
    angles, p, lack = g.angles[order], values.numpy()[order], lacking.numpy()[order]
    t = g.ray_distances
    if g.parallel:
        theta = angles
    else:
        # Of a plane nothing lacks.
        theta, p = _parallel(
            angles, g.fan_angles, np.concatenate([p, lack], 1) if g.has_rows else p
        )
        p, lack = np.split(p, 2, axis=1) if g.has_rows else (p, np.zeros_like(p))
    if theta.size < _DIRECTIONS or np.ptp(theta) + view_step(theta) < _LEAST_ARC:
        return UNKNOWN
    width = np.gradient(t)
    scale = float(np.abs(t).max())
    moments = [(p * width * (t / scale) ** k).sum(1) for k in range(3)]
    weight, weight_error = _weight(theta, moments[0])
    step, step_error, amplified = _step(theta, moments[1:])
    lack[:, 1:-1] += lack_of_cells(p[:, 2:] - p[:, :-2])
    # Where faces lie along the rays, whole rows of cells lack: waves that turn with no object.
    blurred = _step(theta, [(lack * width * (t / scale) ** k).sum(1) + moments[k] for k in (1, 2)])
    cell = float(np.median(np.abs(width)))
    mass = float(moments[0].mean())
    centre, centre_error = (
        (math.nan, math.inf) if mass <= 0 else _beyond(theta, moments[1] * (scale / mass), 1)
    )
    axial, axial_error, axial_tolerance = (
        _axial(lines, g) if g.has_rows else (math.nan, math.inf, 0.0)
    )
    edge = _radius(t, p)
    # what ends near the plane is seen by rays on one side of the object alone
    if g.has_rows:
        parted *= min(2.0 * edge / g.sod, 1.0)
    findings = []
    lacks = turned + _edges(theta, lack, p.sum(1))
    stray = turned * amplified + _FEIGNED * abs(blurred[0] - step)
    if _LARGEST_STEP > abs(step) > STEP_TOLERANCE + stray + _SIGMAS * step_error:
        findings.append(
            "the centre of mass and the width of the views do not turn with them: the steps "
            f"between the views are described about {100 * abs(step):.2g} ± {100 * step_error:.1g} "
            f"% too {'small' if step > 0 else 'large'}: the range of the angles is wrong, or the "
            "object moved"
        )
    # Readings that are no line integrals shift the centre of mass by their share of the radius,
    # motion keeps the sum.
    elif centre - _SIGMAS * centre_error > max(
        CENTRE_CELLS * cell, max(CENTRE_RADII + lacks + parted, weight) * edge
    ):
        findings.append(
            "the centre of mass of the views leaves the sinusoid of an object at rest by "
            f"{centre:.2g} ± {centre_error:.1g} mm (root mean square): the object moved "
            "(breathing, a table), or the angles of the views are wrong; edges are double or "
            "smeared; gate the views, or give the motion"
        )
    elif axial - _SIGMAS * axial_error > axial_tolerance:
        findings.append(
            f"the object lies about {axial:.2g} mm higher or lower in the course of the turn (root "
            f"mean square, {axial / axial_error:.0f} standard errors): it moved along the axis, or "
            "the table did (a helix described as a circle); give the motion"
        )
    elif weight - _SIGMAS * weight_error > WEIGHT_TOLERANCE + lacks:
        findings.append(
            f"the sum of a view's line integrals changes with its direction, by {100 * weight:.2g} "
            f"± {100 * weight_error:.1g} % (root mean square), that of any object does not: the "
            "readings lack most where the object is thickest (beam hardening by bone or metal, "
            "scatter, a dark signal left in, pile-up, saturation, or too few photons for a "
            "logarithm), the object moved, or it reaches beyond the rows in some views; values "
            "are wrong by tens of HU, in long shades"
        )
    found = {
        "weight": (weight, weight_error),
        "step": (step, step_error),
        "centre": (centre, centre_error),
        "axial": (axial, axial_error),
    }
    sizes, errors = ({k: v[i] for k, v in found.items() if math.isfinite(v[0])} for i in (0, 1))
    return ScanTest(sizes, errors, tuple(findings))


def _parallel(angles: Floats, gamma: Floats, p: Floats) -> tuple[Floats, Floats]:
    """Directions θ = β − γ that all columns measured, and the readings there, ``(directions,
    columns)``.

    ``p`` may hold several blocks of columns side by side.
    """
    span, usual = float(np.ptp(angles)), view_step(angles)
    if abs(span + usual - 2 * math.pi) < 0.5 * usual:  # a turn that closes
        angles = np.concatenate([angles - 2 * math.pi, angles, angles + 2 * math.pi])
        p = np.tile(p, (3, 1))
        theta = (
            np.linspace(0.0, 2 * math.pi, round(2 * math.pi / usual), endpoint=False)
            + angles[len(angles) // 3]
        )
    else:
        first, last = angles[0] - gamma.min(), angles[-1] - gamma.max()
        theta = np.arange(first, last, usual) if usual > 0 else np.zeros(0)
    parts = p.shape[1] // gamma.size
    sorted_p = np.stack(
        [np.interp(theta + a, angles, p[:, k]) for k, a in enumerate(np.tile(gamma, parts))], 1
    )
    return theta, sorted_p


def _fit(design: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Least squares, and standard errors from the scatter of neighbours: what interpolation
    shares is counted once."""
    found = np.linalg.lstsq(design, y, rcond=None)[0]
    left = y - design @ found
    free = max(y.size - design.shape[1], 1)
    # Residuals of neighbouring directions may be correlated: as if only a third of them counted.
    variance = 3.0 * float((left**2).sum()) / free
    spread = np.diag(variance * np.linalg.pinv(design.T @ design, hermitian=True))
    # Nothing to see, no scatter: rounding alone is below 0.
    return np.asarray(found, np.float64), np.sqrt(np.maximum(spread, 0.0))


def _edges(theta: Floats, lack: Floats, sums: Floats) -> float:
    """Relative change of the sum with the direction that cells may cause in which the object ends.

    Args:
        theta, sums: directions, and the sum of each.
        lack: what readings sorted into parallel ones may lack there, ``(directions, columns)``.
    """
    if sums.mean() <= 0:
        return 0.0
    most = lack[:, 1:-1].sum(1)
    return _weight(theta, most + sums.mean())[0] + _LACKING * float(most.mean() / sums.mean())


def _waves(theta: Floats, orders: tuple[int, ...]) -> Floats:
    return np.stack(
        [np.ones_like(theta), *(f(k * theta) for k in orders for f in (np.cos, np.sin))], 1
    )


def _weight(theta: Floats, sums: Floats) -> tuple[float, float]:
    if sums.mean() <= 0:
        return math.nan, math.inf
    found, error = _fit(_waves(theta, (2, 4)), sums)
    size = math.sqrt(float((found[1:] ** 2).sum()) / 2)
    return size / float(found[0]), float(np.sqrt((error[1:] ** 2).mean())) / float(abs(found[0]))


def _radius(t: Floats, p: Floats) -> float:
    """Where the object's shadow ends, by distance from the axis, mm."""
    highest = p.max(0)
    return float(np.abs(t[highest > 0.05 * highest.max()]).max(initial=0.0))


def _beyond(theta: Floats, y: Floats, order: int) -> tuple[float, float]:
    """Root mean square of the slow changes of ``y`` beyond a constant and waves up to ``order``,
    and its error."""
    own = _waves(theta, tuple(range(1, order + 1)))
    more: NDArray[np.floating]
    if theta.size * view_step(theta) > 1.9 * math.pi:
        more = _waves(theta, tuple(range(order + 1, _SLOW + 1)))[:, 1:]
    else:
        x = np.linspace(-1.0, 1.0, theta.size)
        more = np.polynomial.legendre.legvander(x, _SLOW)[:, 2 * order + 1 :]
    design = np.linalg.qr(np.column_stack([own, more]))[0]
    found = design.T @ y
    left = y - design @ found
    extra = found[own.shape[1] :]
    free = max(y.size - design.shape[1], 1)
    # As in _fit, a third of the directions counts.
    noise = 3.0 * float((left**2).sum()) / free
    size = math.sqrt(max(float((extra**2).sum()) - noise * extra.size, 0.0) / y.size)
    return size, math.sqrt(noise * math.sqrt(2.0 * extra.size) / y.size)


def _axial(lines: Tensor, g: ConeBeam) -> tuple[float, float, float]:
    """Height of the object over the views beyond a wave of one turn, root mean square; its error;
    what the divergence of the rays may feign. All mm at the axis.

    The sum of a row over its columns changes with the views by a factor, by its own slope if the
    object is higher, and by its slope times the row's height if it is nearer to the source.
    """
    if g.rows < 4:
        return math.nan, math.inf, 0.0
    order = np.argsort(g.angles, kind="stable")
    sums = lines.detach().to("cpu").sum(-1, dtype=torch.float64).numpy()[order]
    zoom = g.sdd / g.sod
    v = np.asarray(g.row_positions) / zoom
    mean = sums.mean(0)
    slope = np.asarray(np.gradient(mean, v), np.float64)
    others = np.linalg.qr(np.stack([mean, v * slope], 1))[0]
    own = slope - others @ (others.T @ slope)
    power = float(own @ own)
    if power <= 1e-6 * float(mean @ mean) / float(np.ptp(v)) ** 2:
        return math.nan, math.inf, 0.0
    height = -(sums - mean) @ own / power
    size, error = _beyond(g.angles[order], height, 1)
    reach = g.sod * np.sin(np.abs(g.fan_angles))
    highest = lines.detach().amax(tuple(range(lines.ndim - 1))).to("cpu").double().numpy()
    radius = float(reach[highest > 0.05 * highest.max()].max(initial=0.0))
    parted = float(np.abs(v).max()) * min((radius / g.sod) ** 2, 1.0)
    return size, error, AXIAL_ROWS * g.pitch[0] / zoom + parted


def _step(theta: Floats, moments: list[Floats]) -> tuple[float, float, float]:
    """Gauss and Newton's estimate of s in the frequencies 1 + s and 2 (1 + s), of both moments
    together; its error; and what a relative change of the moments by 1 (root mean square), as a
    wave of one turn, would look like, at least 1."""
    if theta.size * view_step(theta) > 1.9 * math.pi:
        return math.nan, math.inf, 1.0  # conjugate rays tell it better
    parts = []
    for order, y in enumerate(moments, start=1):
        orders = (1, 2)[:order]
        s = 0.0
        for last in (False, False, True):
            turned = (1.0 + s) * theta
            design = _waves(turned, orders)
            found = np.linalg.lstsq(design, y, rcond=None)[0]
            turning = sum(
                k * (found[2 * i + 2] * np.cos(k * turned) - found[2 * i + 1] * np.sin(k * turned))
                for i, k in enumerate(orders)
            )
            pattern = turning * (theta - theta.mean())
            both = np.column_stack([design, pattern])
            if last:
                values, errors = _fit(both, y)
            else:
                values = np.linalg.lstsq(both, y, rcond=None)[0]
            s += float(np.clip(values[-1], -0.1, 0.1))
        own = pattern - design @ np.linalg.lstsq(design, pattern, rcond=None)[0]
        waves = [float(own @ (y * wave(theta))) for wave in (np.cos, np.sin)]
        stray = math.sqrt(2.0) * math.hypot(*waves) / max(float(own @ own), 1e-300)
        parts.append((s, max(float(errors[-1]), 1e-9), stray))
    weights = np.array([1.0 / e**2 for _, e, _ in parts])
    mean, amplified = (
        float((weights * [part[k] for part in parts]).sum() / weights.sum()) for k in (0, 2)
    )
    # Two moments that contradict each other say less than either.
    apart = abs(parts[0][0] - parts[1][0]) if weights.min() > 0.05 * weights.max() else 0.0
    return mean, math.hypot(weights.sum() ** -0.5, apart / 2), max(amplified, 1.0)
