"""Draws of every figure from the posterior: over the shapes of the core, its contrast, and the
vessel's parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.vessel.core import AXES, CAP, CENTRE, CoreSpace
from recon.vessel.model import FAT, FIBROUS, LUMEN, THICKNESS, WALL, Fit, VesselModel
from recon.vessel.quality import ResidualTexture

__all__ = ["TissueEstimate"]

Floats = NDArray[np.float64]

_EACH = 20
"""Draws of all else for every shape."""
_SURFACE = 96
"""Points on a core's surface, for its distance from the lumen."""


@dataclass(frozen=True)
class TissueEstimate:
    """A figure.

    Attributes:
        value: posterior mean; low, high: 95 % interval; sd: posterior standard deviation.
        unit: of all four.
    """

    value: float
    low: float
    high: float
    sd: float
    unit: str


def estimate(draws: Floats, unit: str) -> TissueEstimate:
    """Mean, 95 % interval and standard deviation of draws."""
    low, high = np.quantile(draws, (0.025, 0.975))
    return TissueEstimate(float(draws.mean()), float(low), float(high), float(draws.std()), unit)


def draws_of(
    vessel: VesselModel,
    fit: Fit,
    space: CoreSpace,
    shapes: Floats,
    fractions: NDArray[np.float32],
    texture: ResidualTexture,
    rng: np.random.Generator,
) -> dict[str, Floats]:
    """Draws ``(shapes · 20,)`` of each figure, those of the core given that it is there.

    Args:
        vessel, fit, space: the fitted vessel, and the space of its core.
        shapes: ``(m, 8)`` draws of the core's shape; fractions: ``(m, n)``.
        texture: of the tissues; widens the draws of tissue values.
        rng: of all randomness.
    """
    seen = space.evidence(fractions)
    m = len(shapes)
    delta = seen.mean[:, None] + np.sqrt(seen.variance)[:, None] * rng.standard_normal((m, _EACH))
    inverse = np.linalg.inv(space.lower @ space.lower.T)
    base = fit.parameters[space.kept] + inverse @ space.gradient

    def linear(value: Floats, gradient: Floats) -> Floats:
        """Draws of figures that change by ``gradient`` ``(m or 1, p)`` with the parameters,
        ``value`` at the fit's."""
        gradient = np.atleast_2d(gradient)
        sd = np.sqrt(np.einsum("mp,pq,mq->m", gradient, inverse, gradient))
        mean = value + gradient @ (base - fit.parameters[space.kept])
        lost = (gradient * seen.shift).sum(1)
        out = np.broadcast_to(mean, (m,))[:, None] - lost[:, None] * delta
        return out + sd[:, None] * rng.standard_normal((m, _EACH))

    count = len(base)
    unit = np.eye(count)
    values = {
        name: linear(np.array([fit.parameters[k]]), unit[k])
        for name, k in (("fat", FAT), ("wall", WALL), ("fibrous", FIBROUS), ("lumen", LUMEN))
    }
    noise = {name: rng.standard_normal((m, _EACH)) for name in ("contrast", "fibrous")}
    # The texture's own mean over a tissue is not the tissue's value.
    values["core"] = (
        values["fibrous"] + delta + texture.sd_of("core") * rng.standard_normal((m, _EACH))
    )
    values["fibrous"] = values["fibrous"] + texture.sd_of("fibrous") * noise["fibrous"]
    values["contrast"] = -delta + texture.sd_of("contrast") * noise["contrast"]
    values["wall thickness"] = np.exp(
        linear(np.array([fit.parameters[THICKNESS]]), unit[THICKNESS])
    )
    centre = shapes[:, CENTRE].mean(0)
    s = float(vessel.start.lumen.coordinates(centre[None]).s[0])
    value, gradient = _area(vessel, fit, np.array([s]), count)
    values["lumen area"] = linear(value, gradient)
    low = max(vessel.start.ends[0], 0.0) + 0.3
    high = min(vessel.start.ends[1], vessel.start.lumen.length) - 0.3
    if high > low:
        along = np.linspace(low, high, 40)
        areas, slopes = _area(vessel, fit, along, count)
        k = int(np.argmin(areas))
        values["least lumen area"] = linear(areas[k : k + 1], slopes[k])
    values["core volume"] = np.repeat(seen.volume[:, None], _EACH, 1)
    distance, gradient = _caps(vessel, fit, space, shapes, count)
    values["cap thickness"] = np.maximum(linear(distance, gradient), 0.0)
    return {name: v.ravel() for name, v in values.items()}


def _area(vessel: VesselModel, fit: Fit, s: Floats, count: int) -> tuple[Floats, Floats]:
    """Areas mm² of the lumen at positions ``(k,)``, and their gradients ``(k, count)``."""
    angles = np.arange(48) * (2 * math.pi / 48)
    at = vessel.lumen_outline.at_angles(np.repeat(s, 48), np.tile(angles, len(s)))
    r = at.radius(vessel.lumen_shape(fit.parameters))[0]
    waves = np.zeros((len(r), vessel.lumen_outline.size))
    at.spread(r * (2 * math.pi / 48), waves)
    gradient = np.zeros((len(s), count))
    gradient[:, vessel.lumen_part] = waves.reshape(len(s), 48, -1).sum(1)
    return 0.5 * (r**2).reshape(len(s), 48).sum(1) * (2 * math.pi / 48), gradient


def _caps(
    vessel: VesselModel, fit: Fit, space: CoreSpace, shapes: Floats, count: int
) -> tuple[Floats, Floats]:
    """Smallest distance of each core from the lumen, mm ``(m,)``, and its gradient ``(m,
    count)``."""
    k = np.arange(_SURFACE) + 0.5
    polar, around = np.arccos(1 - 2 * k / _SURFACE), math.pi * (1 + math.sqrt(5)) * k
    sphere = np.stack(
        [np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], 1
    )
    m = len(shapes)
    local = sphere[None] * np.exp(shapes[:, None, AXES])
    points = shapes[:, None, CENTRE] + np.einsum("mka,maz->mkz", local, space.axes(shapes))
    c = vessel.start.lumen.coordinates(points.reshape(-1, 3))
    at = vessel.lumen_outline.at(c)
    r, turn, slope = at.radius(vessel.lumen_shape(fit.parameters))
    length = np.sqrt(1 + (turn / np.maximum(c.rho, 0.3)) ** 2 + slope**2)
    distance = ((c.rho - r) / length).reshape(m, _SURFACE)
    nearest = distance.argmin(1) + _SURFACE * np.arange(m)
    waves = np.zeros((len(r), vessel.lumen_outline.size))
    pick = np.zeros(len(r))
    pick[nearest] = -1.0 / length[nearest]
    at.spread(pick, waves)
    gradient = np.zeros((m, count))
    gradient[:, vessel.lumen_part] = waves[nearest]
    return np.maximum(distance.ravel()[nearest], np.exp(shapes[:, CAP])), gradient
