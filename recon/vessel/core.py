"""Plaque bodies: an ellipsoid inside the fibrous layer, which keeps a cap from the lumen. Shapes,
prior, evidence.

Eight numbers tell a shape: its centre (z, y, x mm), the logarithms of its semi-axes across the
layer, around the lumen and along the vessel, a turn within the section, and the logarithm of the
cap. Given the shape all else is linear or nearly so: its contrast δ to the fibrous tissue and the
vessel's parameters are integrated out (Laplace).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from recon.vessel.kernels import core_fractions, sharpened
from recon.vessel.local_gram import LocalGram
from recon.vessel.model import EXCESS, Fit, VesselModel
from torchpcct.threads import run
from torchpcct.validate import shaped

Floats = NDArray[np.float64]

CENTRE = slice(0, 3)
"""Columns of a shape: its centre in the vessel's coordinates, mm."""
AXES = slice(3, 6)
"""Logarithms of the semi-axes in mm."""
TURN = 6
"""Turn about the vessel, rad."""
CAP = 7
"""Logarithm of the cap's thickness in mm."""


@dataclass(frozen=True)
class CorePrior:
    """What is believed of a body before the data.

    Args:
        contrast_sd: HU, of δ ~ N(0, ·).
        semi_axes: mm, medians across the layer, around the lumen, along the vessel.
        axes_log_sd: of their logarithms.
        turn_sd: rad.
        cap: mm, median; cap_log_sd: of its logarithm.
        point: ``(3,)`` z, y, x mm, where a reader sees it; None: anywhere in the fibrous layer.
        point_sd: mm, of its error along each axis.
    """

    contrast_sd: float = 100.0
    semi_axes: tuple[float, float, float] = (0.5, 0.85, 0.9)
    axes_log_sd: float = 0.5
    turn_sd: float = 0.25
    cap: float = 0.12
    cap_log_sd: float = 0.7
    point: tuple[float, float, float] | None = None
    point_sd: float = 0.4


@dataclass(frozen=True, eq=False)
class Evidence:
    """Of shapes, given the data.

    Attributes:
        log: ``(m,)`` log marginal likelihood against no body, the vessel's parameters integrated
            out of both.
        mean, variance: ``(m,)`` HU, HU² of δ given the shape.
        shift: ``(m, p)`` per HU of δ, what the vessel's parameters lose to the body: mean − δ ·
            shift.
        volume: ``(m,)`` mm³.
    """

    log: Floats
    mean: Floats
    variance: Floats
    shift: Floats
    volume: Floats


class CoreSpace:
    """Where bodies can be in a fitted vessel, and what the data say of them.

    Args:
        vessel, fit: the vessel, fitted with or without bodies. Bodies of the fit stay where they
            are.
        prior: of the body.
        replaces: the body of the fit that is looked for again, so that its own trace counts as
            data; None: none.
        against: log evidence of no body that :meth:`target` compares with (``none`` of another
            space); None: its own.
    """

    def __init__(
        self,
        vessel: VesselModel,
        fit: Fit,
        prior: CorePrior,
        replaces: int | None = None,
        against: float | None = None,
    ) -> None:
        self.vessel, self.fit, self.prior = vessel, fit, prior
        drawing = fit.drawing
        layer = drawing.fractions[1] - drawing.fractions[2]
        reach = 4.0 * float(vessel.sd.max())  # of soft edges, and of the voxels beside them
        inside = (
            (drawing.inner_distance < reach)
            & (drawing.lumen_distance > -reach)
            & (drawing.fractions[0] > 0)
        )
        if prior.point is not None:
            inside &= np.linalg.norm(vessel.points - np.array(prior.point), axis=1) < 3.0
        self.chosen = np.flatnonzero(inside)
        # Where a centre may lie: in the layer, with some of it on both sides.
        deep = (drawing.inner_distance < -0.1) & (drawing.lumen_distance > 0.1) & (layer > 0.3)
        # the last one is that of neighbours which are no voxels
        place = np.full(len(vessel.index) + 1, -1)
        place[self.chosen] = np.arange(len(self.chosen))
        self.neighbours = place[vessel.neighbours[self.chosen]]
        self.points = np.ascontiguousarray(vessel.points[self.chosen])
        self.inner = np.ascontiguousarray(drawing.fractions[1][self.chosen])
        self.lumen = np.ascontiguousarray(drawing.lumen_distance[self.chosen])
        self.lumen_normal = np.ascontiguousarray(drawing.lumen_normal[self.chosen])
        self.lumen_sd = np.ascontiguousarray(drawing.lumen_sd[self.chosen])
        self.blur = fit.vessel.softer_by(fit.parameters)
        self.frames = vessel.lumen_at.frame
        self.deep = deep
        grid = vessel.grid
        self._origin, self._step = np.array([a[0] for a in grid.axes]), np.array(grid.spacing)
        kept = np.ones(len(fit.parameters), bool)
        residual, gradient, hessian, energy = fit.residual, fit.gradient, fit.hessian, fit.energy
        if replaces is not None:
            own = vessel.size + replaces
            kept[own] = False
            # As if the body were not there; its column leaves the parameters.
            delta, certain = fit.parameters[own], vessel.body_precision
            energy += delta * gradient[own] + 0.5 * delta**2 * hessian[own, own]
            residual = residual + delta * fit.curved[:, own]
            gradient = gradient + delta * (hessian[:, own] - np.where(kept, 0.0, certain))
            gradient, hessian = gradient[kept], hessian[np.ix_(kept, kept)]
        self.kept = kept
        self.residual = residual[self.chosen].astype(np.float32)
        self.lower = np.linalg.cholesky(hessian)
        self.gradient = gradient
        self.pull = solve_triangular(self.lower, gradient, lower=True)
        # Log evidence of no body, by the vessel as it stands here. The determinant is left out: the
        # curvature of the outlines changes with the tissues' values, core or not, and its
        # difference between two fits says nothing about the core, but is as large as what does.
        self.none = -energy + 0.5 * float(self.pull @ self.pull)
        self.against = self.none if against is None else against

    @cached_property
    def gram(self) -> LocalGram:
        """Between the chosen voxels."""
        return self.vessel.gram.part(self.chosen)

    @cached_property
    def curved(self) -> NDArray[np.float32]:
        """``(chosen, p)``: G times the Jacobian of the vessel's parameters."""
        return np.ascontiguousarray(self.fit.curved[self.chosen][:, self.kept])

    # -- shapes ------------------------------------------------------------------------------------

    def locate(self, centres: Floats) -> NDArray[np.int64]:
        """Index of the vessel's voxel at each centre ``(m, 3)``; −1 outside of it."""
        index = np.rint((centres - self._origin) / self._step).astype(np.int64)
        inside = np.all((index >= 0) & (index < self.vessel.lookup.shape), axis=1)
        index[~inside] = 0
        return np.where(inside, self.vessel.lookup[tuple(index.T)], -1)

    def log_prior(self, shapes: Floats) -> Floats:
        """``(m,)``, up to the constant that ``log_places`` holds; −inf where there is no layer."""
        p = self.prior
        at = self.locate(shapes[:, CENTRE])
        allowed = (at >= 0) & self.deep[at]
        z = (shapes[:, AXES] - np.log(p.semi_axes)) / p.axes_log_sd
        value = -0.5 * (z**2).sum(1) - 0.5 * (shapes[:, TURN] / p.turn_sd) ** 2
        value -= 0.5 * ((shapes[:, CAP] - math.log(p.cap)) / p.cap_log_sd) ** 2
        if p.point is not None:
            value -= 0.5 * (((shapes[:, CENTRE] - np.array(p.point)) / p.point_sd) ** 2).sum(1)
        return np.where(allowed, value, -np.inf)

    def draw_prior(self, count: int, rng: np.random.Generator) -> Floats:
        """Shapes from the prior, ``(count, 8)``.

        Raises:
            ValueError: no fibrous layer (at the point) is thick enough to hold a body.
        """
        p = self.prior
        places = np.flatnonzero(self.deep)
        weight = np.ones(len(places))
        if p.point is not None:
            off = np.linalg.norm(self.vessel.points[places] - np.array(p.point), axis=1)
            weight = np.exp(-0.5 * (off / p.point_sd) ** 2)
        if not len(places) or not weight.sum() > 1e-6:
            raise ValueError(
                "no fibrous layer thick enough to hold a plaque body"
                + ("" if p.point is None else f" near the point {tuple(p.point)} mm (z, y, x)")
            )
        shapes = np.empty((count, 8))
        at = rng.choice(places, count, p=weight / weight.sum())
        shapes[:, CENTRE] = (
            self.vessel.points[at] + (rng.random((count, 3)) - 0.5) * self._step * 0.99
        )
        shapes[:, AXES] = np.log(p.semi_axes) + p.axes_log_sd * rng.standard_normal((count, 3))
        shapes[:, TURN] = p.turn_sd * rng.standard_normal(count)
        shapes[:, CAP] = math.log(p.cap) + p.cap_log_sd * rng.standard_normal(count)
        return shapes

    def axes(self, shapes: Floats) -> Floats:
        """Unit vectors of the bodies' axes, ``(m, 3, 3)``."""
        frame = self.frames[self.locate(shapes[:, CENTRE])]
        c, s = np.cos(shapes[:, TURN])[:, None], np.sin(shapes[:, TURN])[:, None]
        across, around = frame[:, 0], frame[:, 1]
        return np.stack([c * across + s * around, c * around - s * across, frame[:, 2]], axis=1)

    def fractions(self, shapes: Floats) -> NDArray[np.float32]:
        """Share of each of the chosen voxels in every body, ``(m, n)``; ``ValueError`` for
        shapes not ``(m, 8)``."""
        shaped("shapes", shapes, (None, 8))
        out = np.empty((len(shapes), len(self.chosen)), np.float32)
        run(
            core_fractions,
            len(shapes),
            np.ascontiguousarray(shapes[:, CENTRE]),
            np.ascontiguousarray(self.axes(shapes)),
            np.exp(shapes[:, AXES]),
            np.exp(shapes[:, CAP]),
            self.points,
            self.vessel.sd,
            self.inner,
            self.lumen,
            self.lumen_sd,
            self.lumen_normal,
            self.blur,
            out,
            operations=50 * len(self.points),
        )
        return out

    # -- data --------------------------------------------------------------------------------------

    def evidence(self, fractions: NDArray[np.float32]) -> Evidence:
        """Of bodies ``(m, n)``."""
        image = np.empty(fractions.shape[::-1], np.float32)
        sharpened(np.ascontiguousarray(fractions.T), self.neighbours, EXCESS, image)
        own = self.gram.energies(image.T)
        touched = np.flatnonzero(image.any(1))
        near = image[touched].T
        mixed = (near @ self.curved[touched]).astype(np.float64)
        white = solve_triangular(self.lower, mixed.T, lower=True)
        precision = np.maximum(own - (white**2).sum(0), 1e-3 * own) + self.prior.contrast_sd**-2.0
        # The vessel's parameters follow what the body takes, and what was left of the gradient.
        pull = near @ self.residual[touched] - self.pull @ white
        mean = pull / precision
        log = 0.5 * pull * mean - 0.5 * np.log(precision * self.prior.contrast_sd**2)
        shift = solve_triangular(self.lower, white, lower=True, trans="T").T
        volume = fractions.sum(1, dtype=np.float64) * float(np.prod(self._step))
        return Evidence(log, mean, 1.0 / precision, shift, volume)

    def target(self, shapes: Floats) -> tuple[Floats, Floats]:
        """Log prior and log evidence of shapes ``(m, 8)``, as
        :func:`recon.vessel.particles.sample_towards` takes them."""
        prior = self.log_prior(shapes)
        log = np.zeros(len(shapes))
        allowed = np.isfinite(prior)
        if allowed.any():
            log[allowed] = self.evidence(self.fractions(shapes[allowed])).log + (
                self.none - self.against
            )
        return prior, log

    def nothing(self, shapes: Floats) -> tuple[Floats, Floats]:
        """Log prior, and the log evidence 0 of no body."""
        return self.log_prior(shapes), np.zeros(len(shapes))
