"""A vessel as tissues with outlines: fat, wall, fibrous layer, lumen; drawn on the grid, and fitted
to the data.

    x = fat + (wall − fat) O + (fibrous − wall) I + (lumen − fibrous) L + Σ δ_k B_k

O, I and L are the shares at each voxel inside the vessel, inside its wall and in the lumen, B_k
those of plaque bodies in the fibrous layer. The wall is of one thickness; a lumen may cross it in
the model, so that a layer of no thickness is estimated without bias.

A voxel's mean, projected as a box, is averaged twice: a lumen of 2 mm on voxels of 0.2 mm then
reads 5 HU too much. So an outline is drawn as an error function, soft enough for the voxels to hold
it without aliasing, and what it and the operator's box average is taken off again
(:func:`recon.vessel.kernels.sharpened`): x is what the operator takes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import ndtr

from recon.data_term import Quadratic
from recon.vessel.centreline import Centreline, Coordinates
from recon.vessel.data import grid_of
from recon.vessel.kernels import sharpened
from recon.vessel.local_gram import LocalGram
from recon.vessel.outline import Outline, OutlineAt
from recon.vessel.prior import VesselPrior

Floats = NDArray[np.float64]

FAT = 0
"""Position of fat's value among the parameters."""
WALL = 1
"""Of the wall's value."""
FIBROUS = 2
"""Of the fibrous tissue's value."""
LUMEN = 3
"""Of the lumen's value."""
THICKNESS = 4
"""Of the logarithm of the wall's thickness."""
BLUR = 5
"""Of the logarithm of the edges' blur."""
ENDS = 6
"""Of the first of six: position and two tilts of the plane at either end."""
_FIRST = 12
"""Of the first coefficient of the lumen's outline; those of the outer outline follow."""

_FAT_SD = 100.0
"""Standard deviation of fat's prior about what the start reads, HU."""
_LUMEN_SD = 300.0
"""Standard deviation of the lumen's prior about what the start reads, HU."""
_EXPECTED_SD = (10.0, 15.0)
"""Of wall and fibrous tissue, HU, in a fit that expects them to be what they usually are."""
_EXPECTED_ROUND = 4.0
"""So much less than else the outlines leave an ellipse in such a fit: a calcification beside the
lumen would otherwise be taken for a bulge of it, and leave no trace."""
_WALL_MM = 0.2
"""Median of the wall thickness' prior, mm."""
_WALL_LOG_SD = 0.2
"""Standard deviation of its logarithm."""
_BLUR_MM2 = 0.004
"""Median of the prior of the variance by which edges are softer than the operator's, mm²: a focal
spot of 0.5 mm makes 0.004 mm² at half of the distance to the detector, one of 1 mm makes 0.016."""
_BLUR_LOG_SD = 0.7
"""Standard deviation of its logarithm."""
SOFT = 0.5
"""Standard deviation of an outline as drawn, in voxels: narrower aliases, wider needs more of
what noise hides."""
_LEFT = 0.06
"""Squared voxels that sharpening to second order leaves of an outline's softness in the plane: fits
of vessels painted on finer voxels, without any blur, ask for outlines so much harder (0.058 on
voxels of 0.2 mm, 0.068 on 0.3 mm)."""
BOX = 1 / 12
"""Variance of a voxel's box, in squared voxels: the operator takes a value for that of a whole
voxel."""
EXCESS = SOFT**2 + BOX
"""Variance of outline and operator together, in squared voxels."""
_END_SD_MM = (1.0, 0.1, 0.1)
"""Standard deviations of the prior of an end: its position in mm, and the two tilts of its plane.
"""
_FAR = 15.0
"""A step that gains more of the log posterior than this, or less than half of what its linear model
says, makes the curvature worth computing again."""
_SHORTER = 3
"""Lengths of a step that are tried: the noise of single voxels bends the energy more than its
linear model says."""
_DAMPING = 0.03
"""First share of the Hessian's diagonal that is added where no length of a step leads down."""
_MARGIN_MM = 0.6
"""Voxels so far outside of the outer wall's start may still become vessel."""
_TAIL = 9.0
"""Standard deviations at which the tail of an edge ends."""
_BODY_SD = 300.0
"""Prior of a body's contrast in a fit that is given its shape, HU."""


@dataclass(frozen=True, eq=False)
class Start:
    """Where a vessel is, roughly.

    Attributes:
        lumen, outer: lines.
        ends: ``(2,)`` positions on the lumen's line, mm; infinite where it leaves the volume.
        radii: (positions, radii) of lumen and outer wall.
        values: fat and lumen, HU.
    """

    lumen: Centreline
    outer: Centreline
    ends: Floats
    radii: tuple[tuple[Floats, Floats], tuple[Floats, Floats]]
    values: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Drawing:
    """A vessel drawn on its voxels.

    Attributes:
        soft: ``(n,)`` HU above fat, outlines of ``SOFT``.
        fractions: ``(3, n)`` of each voxel's volume: inside of the vessel, inside of its wall, and
            in the lumen.
        image: ``(n,)`` HU above fat, as the operator takes it.
        jacobian: ``(n, parameters)`` float32, of ``image``, HU per unit; None where it was not
            asked for.
        lumen_distance, inner_distance: ``(n,)`` mm, negative inside.
        lumen_sd: ``(n,)`` mm, softness of the lumen's outline; lumen_normal: ``(n, 3)``.
    """

    soft: Floats
    fractions: Floats
    image: Floats
    jacobian: NDArray[np.float32] | None
    lumen_distance: Floats
    inner_distance: Floats
    lumen_sd: Floats
    lumen_normal: Floats


@dataclass(frozen=True, eq=False)
class Fit:
    """A vessel at the mode of its posterior.

    Attributes:
        parameters: ``(p,)``; the bodies' contrasts last.
        drawing: there.
        energy: ½ xᵀGx − bᵀx − log prior, without constants.
        residual: ``(n,)`` b − Gx on the voxels, HU⁻¹.
        gradient: ``(p,)`` of −energy, about 0.
        precision: ``(p, p)`` of the prior.
        bodies: shares of the fibrous layer, ``(k, n)``.
        vessel: that was fitted.
    """

    parameters: Floats
    drawing: Drawing
    energy: float
    residual: Floats
    gradient: Floats
    precision: Floats
    bodies: Floats
    vessel: VesselModel

    @cached_property
    def hessian(self) -> Floats:
        """``(p, p)``, Gauss and Newton's."""
        return self.vessel.hessian(self.drawing, self.precision, self._seen)

    @cached_property
    def factor(self) -> tuple[Floats, bool]:
        """Cholesky factor of the Hessian."""
        return cho_factor(self.hessian, lower=True)

    @cached_property
    def _seen(self) -> NDArray[np.float32]:
        """``(n, p)``, G times the Jacobian on the vessel's voxels."""
        assert self.drawing.jacobian is not None
        return np.asarray(self.vessel.gram.apply(self.drawing.jacobian))

    @cached_property
    def curved(self) -> NDArray[np.float32]:
        """``(n, p)``, G times the Jacobian (that of fat: of the whole volume)."""
        curved = self._seen.copy()
        curved[:, FAT] += self.vessel.ones.astype(np.float32)
        return curved

    @cached_property
    def covariance(self) -> Floats:
        """``(p, p)``, of the Laplace approximation."""
        return np.asarray(cho_solve(self.factor, np.eye(len(self.parameters))))

    @property
    def image(self) -> NDArray[np.float32]:
        """``grid.shape`` HU, the vessel as means over the voxels."""
        fat, vessel = self.parameters[FAT], self.vessel
        return vessel.on_grid(fat + vessel.voxel_means(self.drawing.soft), fat)

    @property
    def layer(self) -> Floats:
        """``(n,)`` share of each voxel in the fibrous layer, less its bodies."""
        _, inner, lumen = self.drawing.fractions
        share: Floats = np.clip(inner - lumen, 0.0, 1.0) * np.clip(
            1.0 - self.bodies.sum(0), 0.0, 1.0
        )
        return share


def _behind(distance: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Share behind a soft edge at a signed distance (negative: behind), and its derivative by
    −distance."""
    sd = np.sqrt(variance)
    t = distance / sd
    # Beyond, 1e-18 of an edge is left. It counts for nothing, but as float32 becomes numbers so
    # small that products with them take a hundred times as long.
    near = np.abs(t) < _TAIL
    return np.where(near | (t < 0.0), ndtr(-t), 0.0), near * np.exp(-0.5 * t * t) / (
        math.sqrt(2.0 * math.pi) * sd
    )


T = TypeVar("T", bound=np.floating)


class VesselModel:
    """The model of one vessel and its data.

    Args:
        data: in HU (:func:`recon.vessel.data.in_hu`).
        start: where the vessel is.
        prior: of tissue values and outlines.
    """

    def __init__(self, data: Quadratic, start: Start, prior: VesselPrior | None = None) -> None:
        grid = self.grid = grid_of(data)
        self.data, self.start, self.prior = data, start, prior or VesselPrior()
        low = max(start.ends[0], -1.0) - 1.0
        high = min(start.ends[1], start.lumen.length + 1.0) + 1.0
        points = np.stack(np.meshgrid(*grid.axes, indexing="ij"), -1).reshape(-1, 3)
        close = start.outer.within(points, start.radii[1][1].max() + 1.5 * _MARGIN_MM)
        near = start.outer.coordinates(points[close])
        reach = np.interp(near.s, *start.radii[1])
        # Voxels of the vessel, and some beyond its ends, if it has any inside.
        beside = near.rho < reach + _MARGIN_MM
        wide = close[beside]
        along = start.lumen.coordinates(points[wide]).s
        kept = (along > start.ends[0] - _MARGIN_MM) & (along < start.ends[1] + _MARGIN_MM)
        flat, own = wide[kept], np.flatnonzero(beside)[kept]
        self.index = np.stack(np.unravel_index(flat, grid.shape), 1).astype(np.int64)
        # position of each of the grid's voxels in the index
        self.lookup = np.full(grid.shape, -1, np.int64)
        self.lookup.ravel()[flat] = np.arange(len(flat))
        self.points = points[flat]
        self.sd = SOFT * np.array(grid.spacing)
        self.outer_at = Coordinates(near.s[own], near.rho[own], near.theta[own], near.frame[own])
        self.lumen_at = start.lumen.coordinates(self.points)
        low, high = min(low, float(self.lumen_at.s.min())), max(high, float(self.lumen_at.s.max()))
        self.lumen_outline = Outline(low, high, self.prior.orders)
        self.outer_outline = Outline(
            float(self.outer_at.s.min()), float(self.outer_at.s.max()), self.prior.orders
        )
        self._lumen, self._outer = (
            self.lumen_outline.at(self.lumen_at),
            self.outer_outline.at(self.outer_at),
        )
        c = self.lumen_at
        self._planes = np.stack(
            [np.ones(len(flat)), c.rho * np.cos(c.theta), c.rho * np.sin(c.theta)], 1
        )
        self.gram = LocalGram.of(data.operator, self.index, float(data.scale))
        ones = data.apply(torch.ones(1, *grid.shape))[0].double()
        self.ones = ones.numpy()[tuple(self.index.T)]
        self.ones_energy = float(ones.sum())
        self.b = data.b[0].double().numpy()[tuple(self.index.T)]
        self.b_sum = float(data.b.double().sum())
        self._radius = float(np.median(start.radii[1][1]))
        self._prior_mean, self._prior = self._prior_of()
        # Beyond the rim of the volume it goes on as it ends, elsewhere there is fat beside the
        # vessel's voxels.
        beside = np.pad(self.lookup, 1, mode="edge")
        steps = np.concatenate([np.eye(3, dtype=int), -np.eye(3, dtype=int)])
        self.neighbours = np.stack([beside[tuple((self.index + 1 + step).T)] for step in steps], 1)

    body_precision = _BODY_SD**-2.0

    # -- parameters --------------------------------------------------------------------------------

    @property
    def size(self) -> int:
        """Number of parameters without bodies."""
        return _FIRST + self.lumen_outline.size + self.outer_outline.size

    @property
    def lumen_part(self) -> slice:
        """The lumen's coefficients."""
        return slice(_FIRST, _FIRST + self.lumen_outline.size)

    @property
    def outer_part(self) -> slice:
        """The outer outline's coefficients."""
        return slice(_FIRST + self.lumen_outline.size, self.size)

    def lumen_shape(self, parameters: Floats) -> Floats:
        """``(splines, orders)``."""
        return parameters[self.lumen_part].reshape(self.lumen_outline.splines, -1)

    def outer_shape(self, parameters: Floats) -> Floats:
        """``(splines, orders)``."""
        return parameters[self.outer_part].reshape(self.outer_outline.splines, -1)

    def _prior_of(self) -> tuple[Floats, Floats]:
        fat, blood = self.start.values
        ends = [v for e in self.start.ends for v in (e if math.isfinite(e) else 0.0, 0.0, 0.0)]
        (wall, wall_sd), (fibrous, fibrous_sd) = self.prior.wall, self.prior.fibrous
        first = [fat, wall, fibrous, blood, math.log(_WALL_MM), math.log(_BLUR_MM2), *ends]
        mean = np.concatenate([first, np.zeros(self.size - _FIRST)])
        precision = np.zeros((self.size, self.size))
        values = (_FAT_SD, wall_sd, fibrous_sd, _LUMEN_SD)
        sd = np.array([*values, _WALL_LOG_SD, _BLUR_LOG_SD, *_END_SD_MM, *_END_SD_MM])
        precision[range(_FIRST), range(_FIRST)] = sd**-2.0
        parts = ((self.lumen_part, self.lumen_outline), (self.outer_part, self.outer_outline))
        for (part, outline), (_, radii) in zip(parts, self.start.radii, strict=True):
            shape = np.zeros((outline.splines, outline.size // outline.splines))
            shape[:, 0] = np.median(radii)
            mean[part] = shape.ravel()
            precision[part, part] = outline.precision(self._radius, self.prior.freedom)
        return mean, precision

    def first_guess(self) -> Floats:
        """Parameters at the start."""
        guess = self._prior_mean.copy()
        (at, r), (at2, r2) = self.start.radii
        guess[self.lumen_part] = self.lumen_outline.constant(r, at).ravel()
        guess[self.outer_part] = self.outer_outline.constant(r2, at2).ravel()
        return guess

    # -- drawing -----------------------------------------------------------------------------------

    def as_projected(self, soft: NDArray[T]) -> NDArray[T]:
        """What the operator must be given of ``(n,)`` or ``(n, k)`` values that are drawn as
        softly as outlines."""
        return self._less(soft, EXCESS)

    def voxel_means(self, soft: Floats) -> Floats:
        """Means over the voxels of ``(n,)`` values that are drawn as softly as outlines."""
        return np.asarray(self._less(soft, SOFT**2 - BOX))

    def on_grid(self, values: Floats, outside: float = 0.0) -> NDArray[np.float32]:
        """``(n,)`` values on the vessel's voxels, ``grid.shape``, with another elsewhere."""
        out = np.full(self.grid.shape, outside, np.float32)
        out[tuple(self.index.T)] = values
        return out

    def _less(self, soft: NDArray[T], excess: float) -> NDArray[T]:
        columns = np.ascontiguousarray(soft).reshape(len(soft), -1)
        out = np.empty_like(columns)
        sharpened(columns, self.neighbours, excess, out)
        return out.reshape(soft.shape)

    def softer_by(self, parameters: Floats) -> float:
        """Variance in mm² that the edges' blur adds to that of an outline, in the plane."""
        return math.exp(parameters[BLUR]) - _LEFT * self.grid.spacing[1] * self.grid.spacing[2]

    def _distance(
        self, at: OutlineAt, c: Coordinates, shape: Floats
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Signed distance, unit normal, change of the distance per change of the radius, and
        half the curvature."""
        r, turn, slope = at.radius(shape)
        around = turn / np.maximum(c.rho, 0.3 * np.abs(r) + 0.05)
        length = np.sqrt(1 + around**2 + slope**2)
        normal = (
            c.frame[:, 0] - around[:, None] * c.frame[:, 1] - slope[:, None] * c.frame[:, 2]
        ) / length[:, None]
        return (c.rho - r) / length, normal, 1.0 / length, 0.5 / np.maximum(np.abs(r), 0.2)

    def draw(self, parameters: Floats, bodies: Floats, *, jacobian: bool = True) -> Drawing:
        """The vessel with parameters ``(p,)`` and bodies ``(k, n)``, shares of the fibrous
        layer."""
        fat, wall, fibrous, blood = parameters[:4]
        thickness, blur = math.exp(parameters[THICKNESS]), math.exp(parameters[BLUR])
        softer_by = self.softer_by(parameters)
        contrasts = parameters[self.size :]
        n = len(self.index)
        lumen_d, lumen_n, lumen_rate, lumen_bend = self._distance(
            self._lumen, self.lumen_at, self.lumen_shape(parameters)
        )
        outer_d, outer_n, outer_rate, outer_bend = self._distance(
            self._outer, self.outer_at, self.outer_shape(parameters)
        )
        share, slope, softer = np.empty((3, n)), np.empty((3, n)), np.empty((3, n))
        outlines = (
            (outer_d, outer_n, outer_bend),
            (outer_d + thickness, outer_n, outer_bend),
            (lumen_d, lumen_n, lumen_bend),
        )
        for k, (d, normal, bend) in enumerate(outlines):
            # Focal spot and gantry blur in the plane, not along z.
            flat = 1.0 - normal[:, 0] ** 2
            variance = (normal**2) @ self.sd**2 + softer_by * flat
            # A bent outline's mean distance grows with the blur.
            mean = d + bend * variance
            share[k], slope[k] = _behind(mean, variance)
            softer[k] = slope[k] * (0.5 * mean / variance - bend) * flat * blur
        lumen_d, lumen_sd = mean, np.sqrt(variance)
        end_share, end_slope = np.ones((2, n)), np.zeros((2, n))
        along = (self.lumen_at.frame[:, 2] ** 2) @ self.sd**2
        for k, sign in enumerate((1.0, -1.0)):
            if math.isfinite(self.start.ends[k]):
                plane = self._planes @ parameters[ENDS + 3 * k : ENDS + 3 * k + 3]
                end_share[k], end_slope[k] = _behind(sign * (plane - self.lumen_at.s), along)
        inside = end_share.prod(0)
        mixed = contrasts @ bodies if len(contrasts) else np.zeros(n)
        steps = np.stack([np.full(n, wall - fat), fibrous - wall + mixed, blood - fibrous - mixed])
        whole = (steps * share).sum(0)
        soft = inside * whole
        fractions = share * inside
        single = None
        if jacobian:
            single = np.zeros((n, self.size + len(contrasts)), np.float32)
            single[:, FAT] = -fractions[0]
            single[:, WALL] = fractions[0] - fractions[1]
            single[:, FIBROUS] = fractions[1] - fractions[2]
            single[:, LUMEN] = fractions[2]
            single[:, THICKNESS] = -inside * steps[1] * slope[1] * thickness
            single[:, BLUR] = inside * (steps * softer).sum(0)
            single[:, ENDS : ENDS + 3] = (-whole * end_slope[0] * end_share[1])[
                :, None
            ] * self._planes
            single[:, ENDS + 3 : ENDS + 6] = (whole * end_slope[1] * end_share[0])[
                :, None
            ] * self._planes
            self._lumen.spread(
                inside * steps[2] * slope[2] * lumen_rate, single[:, self.lumen_part]
            )
            outward = inside * (steps[0] * slope[0] + steps[1] * slope[1]) * outer_rate
            self._outer.spread(outward, single[:, self.outer_part])
            for k, body in enumerate(bodies):
                single[:, self.size + k] = body * (fractions[1] - fractions[2])
            single = self.as_projected(single)
        return Drawing(
            soft,
            fractions,
            self.as_projected(soft),
            single,
            lumen_d,
            outer_d + thickness,
            lumen_sd,
            lumen_n,
        )

    # -- fitting -----------------------------------------------------------------------------------

    def _prior_with(self, k: int, expected: bool) -> Floats:
        """``(p, p)`` precision with ``k`` bodies."""
        precision = np.zeros((self.size + k, self.size + k))
        precision[: self.size, : self.size] = self._prior
        sd = np.array([self.prior.wall[1], self.prior.fibrous[1]])
        if expected:
            sd = np.minimum(_EXPECTED_SD, sd)
            for part, outline in (
                (self.lumen_part, self.lumen_outline),
                (self.outer_part, self.outer_outline),
            ):
                rounder = outline.precision(self._radius, self.prior.freedom, least_order=3)
                precision[part, part] += (_EXPECTED_ROUND**2 - 1) * rounder
        precision[WALL : FIBROUS + 1, WALL : FIBROUS + 1] = np.linalg.inv(
            np.diag(sd**2) + self.prior.shift**2
        )
        precision[range(self.size, self.size + k), range(self.size, self.size + k)] = _BODY_SD**-2.0
        return precision

    def _off(self, parameters: Floats) -> Floats:
        """``(p,)`` how far the parameters lie from the prior's mean; that of bodies is 0."""
        off = parameters.copy()
        off[: self.size] -= self._prior_mean
        return off

    def energy(self, parameters: Floats, v: Floats, precision: Floats) -> tuple[float, Floats]:
        """½ xᵀGx − bᵀx − log prior without constants, and G times the image above fat on the
        voxels, ``(n,)``.

        Args:
            parameters: ``(p,)``.
            v: ``(n,)`` HU above fat, as the operator takes it.
            precision: ``(p, p)`` of the prior.
        """
        f = parameters[FAT]
        curved = self.gram.apply(v.astype(np.float32)[:, None])[:, 0].astype(np.float64)
        data = (
            0.5 * f * f * self.ones_energy
            + f * (self.ones @ v)
            + 0.5 * v @ curved
            - f * self.b_sum
            - self.b @ v
        )
        off = self._off(parameters)
        return float(data + 0.5 * off @ precision @ off), curved

    def fit(
        self,
        parameters: Floats,
        bodies: Floats | None = None,
        *,
        expected: bool = False,
        steps: int = 20,
        tolerance: float = 0.03,
    ) -> Fit:
        """Gauss and Newton's steps, shortened or damped where they lead up, from given parameters
        to the mode.

        Args:
            parameters: where to begin, ``(size + k,)``.
            bodies: shares of the fibrous layer, ``(k, n)``.
            expected: wall and fibrous tissue hardly leave their prior's mean, the outlines hardly
                an ellipse. A core that the model does not have yet would otherwise pull the fibrous
                value to its own, and make wall of the fibrous tissue.
            steps: largest number of them.
            tolerance: stop where the next step would gain less than this of the log posterior by
                its linear model: a shortened step may gain as little far from the mode.
        """
        bodies = np.zeros((0, len(self.index))) if bodies is None else bodies
        precision = self._prior_with(len(bodies), expected)
        theta = np.concatenate([parameters, np.zeros(len(precision) - len(parameters))])
        drawing = self.draw(theta, bodies)
        energy, curved_image = self.energy(theta, drawing.image, precision)
        hessian = self.hessian(drawing, precision)
        damping = 0.0
        for _ in range(steps):
            gradient = self._gradient(theta, drawing, curved_image, precision)
            step = cho_solve(
                cho_factor(hessian + damping * np.diag(np.diag(hessian)), lower=True), gradient
            )
            along, share = float(gradient @ step), 1.0
            if 0.5 * along < tolerance:
                break
            for _ in range(_SHORTER):
                tried = theta + share * step
                other = self.draw(tried, bodies)
                lower, curved_other = self.energy(tried, other.image, precision)
                gain = energy - lower
                if gain > 0.0:
                    break
                # The top of the parabola through the slope and both ends.
                share *= min(max(0.5 * share * along / (share * along - gain), 0.1), 0.5)
            else:
                damping = max(10.0 * damping, _DAMPING)
                continue
            damping *= 0.1
            theta, drawing, energy, curved_image = tried, other, lower, curved_other
            if gain > _FAR or gain < 0.25 * along:
                hessian = self.hessian(drawing, precision)
        gradient = self._gradient(theta, drawing, curved_image, precision)
        residual = self.b - theta[FAT] * self.ones - curved_image
        return Fit(theta, drawing, energy, residual, gradient, precision, bodies, self)

    def _gradient(
        self, theta: Floats, drawing: Drawing, curved_image: Floats, precision: Floats
    ) -> Floats:
        """Of −energy."""
        assert drawing.jacobian is not None
        residual = self.b - theta[FAT] * self.ones - curved_image
        gradient: Floats = drawing.jacobian.T @ residual.astype(np.float32) - precision @ self._off(
            theta
        )
        # Fat fills the whole volume, beside what it leaves to the vessel.
        gradient[FAT] += self.b_sum - theta[FAT] * self.ones_energy - self.ones @ drawing.image
        return gradient

    def hessian(
        self, drawing: Drawing, precision: Floats, seen: NDArray[np.float32] | None = None
    ) -> Floats:
        """Gauss and Newton's, ``(p, p)``, with the prior's.

        Args:
            drawing: with its Jacobian.
            precision: ``(p, p)`` of the prior.
            seen: G times the Jacobian on the vessel's voxels, where it is known already.
        """
        jacobian = drawing.jacobian
        assert jacobian is not None
        hessian = (self.gram.curvature(jacobian) if seen is None else jacobian.T @ seen).astype(
            np.float64
        )
        # Fat fills the whole volume.
        across = self.ones.astype(np.float32) @ jacobian
        hessian[FAT] += across
        hessian[:, FAT] += across
        hessian[FAT, FAT] += self.ones_energy
        return np.asarray(0.5 * (hessian + hessian.T) + precision)
