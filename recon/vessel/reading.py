"""The reading of a vessel: tissues, plaque bodies and their figures, each with an interval, or
refused."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp
from threadpoolctl import threadpool_limits

from recon.data_term import Quadratic
from recon.vessel.core import CorePrior, CoreSpace
from recon.vessel.data import grid_of, in_hu, pilot
from recon.vessel.figures import TissueEstimate, draws_of, estimate
from recon.vessel.model import FIBROUS, Fit, VesselModel
from recon.vessel.particles import Cloud, sample_towards
from recon.vessel.prior import VesselPrior
from recon.vessel.quality import STRIKING, Leftover, beside, leftover, misfit, texture
from recon.vessel.start import find_vessel
from torchpcct.geometry import VolumeGrid
from torchpcct.validate import checked, number, numbers, whole

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


__all__ = ["PlaqueReading", "read_plaque"]

Floats = NDArray[np.float64]

CERTAIN = 0.95
"""Presence probability below which no contrast is given."""

_MISFIT = 4.0
"""Standard deviations of the residual's mean square."""
CALCIFIED_HU = 300.0
"""A body of more contrast is a calcification."""
_CALCIFICATION = CorePrior(1000.0, (0.25, 0.25, 0.4), 0.5, 0.25, 0.05, 0.7)
"""Prior of a calcification, as of a core."""
_LOOK = 400
"""Trial bodies that are drawn from the prior to see whether one is worth looking for."""
_LEAST_LOG = 8.0
"""Log evidence of a trial body that makes it worth looking for a calcification."""
_MOST_BODIES = 3
"""Plaque bodies beside the core that are looked for at most."""
_BESIDE = "a second vessel, a branch, muscle"
"""What may be outside of a vessel, for messages."""
_INSIDE = "more plaque bodies, a stent, another shape"
"""What may be inside of it, for messages."""
_ROUNDS = 2
"""Times that what stands beside the vessel is estimated and taken off the data."""
_APART = 0.2
"""Fraction of its volume that a second core shares with the first at most."""
_WORTH = 0.7
"""Probability of a second core, by a few hundred trials, from which on it is looked for with care.
"""
_PURE = 0.95
"""Volume fraction of a tissue in the voxels that are read in other volumes."""
_FEW = 8
"""So many such voxels are enough."""
_LESS_PURE = 0.8
"""The fraction where there are fewer."""


class OtherCore(TypedDict):
    """A core beside the first: how probable it is, where, and what it is like."""

    probability: float
    at_mm: list[float]
    contrast_hu: float
    contrast_sd_hu: float
    volume_mm3: float


@dataclass(frozen=True, eq=False)
class PlaqueReading:
    """What was read of a vessel.

    Attributes:
        grid: of the data.
        presence: probability that there is a plaque body of another value than the fibrous tissue.
        second_core: probability of one more core, apart from the first; 0 where the first is not
            certain. From :data:`CERTAIN` on both are read: one (that at the point) as the core, the
            other's shape is held where it was found, its figure is the ``second contrast``,
            ``info["second_core"]`` tells its place and mm³.
        third_core: one more that the data show after that: ``at_mm``,
            ``volume_mm3``, ``contrast_hu``.
        calcifications: number of calcified bodies.
        figures: name → :class:`recon.vessel.figures.TissueEstimate`; the core's are missing where
            presence is below :data:`CERTAIN`, those of all plaque bodies where the tissues do not
            explain the data.
        refused: name → why a figure is missing.
        given_core: the figures of core and calcifications if they are there, however likely that
            is: for studies of the method, not to be quoted where they are refused.
        regions: tissue → ``grid.shape`` float32 share of each voxel (posterior mean; the core's if
            it is there).
        image: ``grid.shape`` float32 HU, the fitted tissues, the core included.
        chi2: mean square of the residual on the vessel's voxels, but for those at its ends inside
            of the volume, over its expectation; chi2_sd: its standard deviation under the model.
        taken_off_hu: largest value beside the vessel that was taken off the data, 0 where nothing
            was. Otherwise no figure of a plaque body is given: what is left of a neighbour at the
            vessel's wall is too much like one.
        left: what stands out most of what the tissues leave of the data.
        texture_hu: standard deviation of a texture of 0.3 mm that the residual shows;
            texture_high_hu: its 95 % limit.
        info: settings, and how the fit went.
    """

    grid: VolumeGrid
    presence: float
    second_core: float
    calcifications: int
    figures: Mapping[str, TissueEstimate]
    refused: Mapping[str, str]
    given_core: Mapping[str, TissueEstimate]
    regions: Mapping[str, NDArray[np.float32]]
    image: NDArray[np.float32]
    chi2: float
    chi2_sd: float
    left: Leftover
    texture_hu: float
    texture_high_hu: float
    info: Mapping[str, Any] = field(default_factory=dict)
    taken_off_hu: float = 0.0
    third_core: OtherCore | None = None

    @property
    def explained(self) -> bool:
        """Whether the tissues explain the data; where they do not, no figure of a plaque body is
        given."""
        return self.left.score <= STRIKING and abs(self.chi2 - 1.0) <= _MISFIT * self.chi2_sd

    @property
    def certain(self) -> bool:
        """Whether the data prove a core."""
        return self.explained and not self.taken_off_hu and self.presence >= CERTAIN

    @property
    def mean_contrast(self) -> float:
        """Posterior mean of the contrast fibrous − core over a core that is there and one that is
        not, HU.

        A contrast among the figures is given where the data prove a core, so rather where noise has
        enlarged it: on average those are too large. This mean is of every reading.
        """
        return self.presence * self.given_core["contrast"].value

    @property
    def warnings(self) -> list[str]:
        """What speaks against the model."""
        found = []
        if self.left.score > STRIKING:
            z, y, x = self.left.at_mm
            found.append(
                f"{'beside' if self.left.beside else 'in'} the vessel, at ({z:.1f}, {y:.1f}, "
                f"{x:.1f}) mm (z, y, x), the data show {self.left.hu:+.0f} HU "
                f"({self.left.score:.0f} standard deviations of the noise) that one vessel in fat "
                f"does not explain: {_BESIDE if self.left.beside else _INSIDE}? Figures of plaque "
                "bodies are refused; do not trust the others"
            )
        if abs(self.chi2 - 1.0) > _MISFIT * self.chi2_sd:
            found.append(
                f"the residual is {self.chi2:.2f} of what noise leaves ({self.chi2_sd:.2f} "
                "standard deviation): there is something here that the model does not have; do "
                "not trust the intervals"
            )
        if self.third_core is not None:
            z, y, x = self.third_core["at_mm"]
            found.append(
                "one more core is there with a probability of "
                f"{self.third_core['probability']:.2f}, at ({z:.1f}, {y:.1f}, {x:.1f}) mm (z, y, "
                f"x), of about {self.third_core['volume_mm3']:.1f} mm³ and "
                f"{self.third_core['contrast_hu']:.0f} HU of contrast: the fitted tissues show "
                "fibrous tissue in its place; do not trust the intervals"
            )
        return found

    def read(self, volume: object) -> dict[str, float]:
        """Mean HU of another volume on the same grid in each region, and the contrast fibrous −
        core.

        Args:
            volume: ``grid.shape`` HU, tensor or array.

        Raises:
            ValueError: another shape.
        """
        return read_regions(self.regions, volume)


@checked
def core_regions(regions: Mapping[str, object]) -> dict[str, NDArray[np.bool_]]:
    """Voxels wholly inside of each region, from the shares of its voxels; regions without such
    voxels are left out."""
    found = {}
    for name, share in regions.items():
        inside = np.asarray(share) > _PURE
        if inside.sum() < _FEW:
            inside = np.asarray(share) > _LESS_PURE
        if inside.any():
            found[name] = inside
    return found


@checked
def read_regions(regions: Mapping[str, NDArray[np.float32]], volume: object) -> dict[str, float]:
    """See :meth:`PlaqueReading.read`.

    Args:
        regions: name → shares of the voxels.
        volume: of the same shape, HU.
    """
    values = np.asarray(volume, dtype=np.float64)
    for share in regions.values():
        if values.shape != share.shape:
            raise ValueError(
                f"volume must have the reading's shape {share.shape}, got {values.shape}"
            )
    found = {name: float(values[inside].mean()) for name, inside in core_regions(regions).items()}
    if "core" in found and "fibrous" in found:
        found["contrast"] = found["fibrous"] - found["core"]
    return found


# Many small matrices: BLAS threads wait for each other three times longer than one thread computes.
@threadpool_limits.wrap(limits=1, user_api="blas")
def read_plaque(
    term: Quadratic,
    point: ArrayLike | None = None,
    *,
    point_sd: float = 0.4,
    particles: int = 300,
    prior: float = 0.5,
    vessel_prior: VesselPrior | None = None,
    seed: int = 0,
) -> PlaqueReading:
    """Read the vessel in an inset.

    Args:
        term: of the scan, in mm⁻¹ (:meth:`recon.least_squares.inset_problem.InsetProblem.term`).
        point: ``(z, y, x)`` mm where a reader sees the plaque; None: blind, in the largest vessel.
        point_sd: standard deviation of its error along each axis, mm.
        particles: shapes of the core that are followed; fewer than 300 widen the spread of the
            result.
        prior: probability of a core before the data.
        vessel_prior: what is believed of the vessel; None: usual tissues.
        seed: of the Monte Carlo.

    Returns:
        The reading. Given equal arguments it is the same.

    Raises:
        ValueError: no enhanced vessel (at the point), no layer that could hold a plaque, values out
            of range.
        TypeError: values of the wrong kind.
    """
    where = None if point is None else numbers("point", point, 3)
    point_sd = number("point_sd", point_sd, positive=True, unit="mm")
    particles, seed = whole("particles", particles, 50), whole("seed", seed, 0)
    prior = number("prior", prior, low=0.0, high=1.0)
    if not isinstance(vessel_prior, VesselPrior | None):
        raise TypeError(
            f"vessel_prior must be a recon.vessel.VesselPrior, got {type(vessel_prior).__name__}"
        )
    rng = np.random.default_rng(seed)

    def fitted(seen: Quadratic) -> tuple[VesselModel, Fit]:
        start = find_vessel(pilot(seen), grid_of(seen), None if where is None else np.array(where))
        vessel = VesselModel(seen, start, vessel_prior)
        return vessel, vessel.fit(vessel.first_guess(), expected=True)

    data = in_hu(term)
    vessel, fit = fitted(data)
    taken = 0.0
    for _ in range(_ROUNDS):
        foreign = beside(data, vessel, fit)
        if foreign is None:
            break
        taken = float(foreign.abs().max())
        vessel, fit = fitted(data.less(foreign[None]))
    stands = leftover(vessel, fit)
    if stands.score <= STRIKING or not stands.beside:
        # Bodies in the vessel do not explain what lies beside it; they would only stand in for it.
        fit = _calcified(vessel, fit, particles, rng)
    core = CorePrior(
        point=None if where is None else (where[0], where[1], where[2]), point_sd=point_sd
    )
    reading = _read(vessel, fit, core, particles, prior, rng, seed)
    if not taken:
        return reading
    why = (
        f"something of {taken:.0f} HU stands beside the vessel: what is left of it is too much "
        "like a plaque body"
    )
    return replace(
        reading,
        taken_off_hu=taken,
        figures={name: e for name, e in reading.figures.items() if name not in reading.given_core},
        refused=dict.fromkeys(reading.given_core, why) if reading.explained else reading.refused,
    )


def _calcified(vessel: VesselModel, fit: Fit, particles: int, rng: np.random.Generator) -> Fit:
    """The fit with the calcifications that the data show."""
    for _ in range(_MOST_BODIES):
        space = CoreSpace(vessel, fit, _CALCIFICATION)
        tries = space.draw_prior(_LOOK, rng)
        seen = space.evidence(space.fractions(tries))
        if not np.any((seen.log > _LEAST_LOG) & (seen.mean > 0.5 * CALCIFIED_HU)):
            break
        cloud = sample_towards(tries[:particles], space.nothing, space.target, rng)
        found = space.evidence(space.fractions(cloud.points))
        if not (
            found.mean.mean() > 0.5 * CALCIFIED_HU
            and cloud.log_evidence > math.log(CERTAIN / (1 - CERTAIN))
        ):
            break
        # The lumen's outline had taken some of it: its contrast shows in the fit that has the body.
        other = _with_body(vessel, fit, space, cloud, float(found.mean.mean()), expected=True)
        if other.parameters[-1] < CALCIFIED_HU:
            break
        fit = other
    return fit


def _with_body(
    vessel: VesselModel,
    fit: Fit,
    space: CoreSpace,
    cloud: Cloud,
    contrast: float,
    expected: bool = False,
) -> Fit:
    """The vessel fitted again with the mean of a cloud of bodies beside those it has."""
    layer = (fit.drawing.fractions[1] - fit.drawing.fractions[2])[space.chosen]
    body = np.zeros((1, len(vessel.index)))
    mean = space.fractions(cloud.points).mean(0)
    body[0, space.chosen] = np.where(
        layer > 0.02, np.clip(mean / np.maximum(layer, 0.02), 0.0, 1.0), 0.0
    )
    return vessel.fit(
        np.append(fit.parameters, contrast), np.concatenate([fit.bodies, body]), expected=expected
    )


def _doubt(presence: float, contrast: TissueEstimate) -> str:
    """Why the figures of a core must not be given; empty: they may.

    Where two explanations are about as likely (which tissue is the core), the presence is certain
    and the contrast is not: its interval holds 0.
    """
    if presence < CERTAIN:
        return f"a core is there with a probability of {presence:.2f} only"
    if contrast.low <= 0.0 <= contrast.high:
        return (
            f"the contrast lies between {contrast.low:.0f} and {contrast.high:.0f} HU: several "
            "explanations fit"
        )
    return ""


def _read(
    vessel: VesselModel,
    fit: Fit,
    prior_of_core: CorePrior,
    particles: int,
    prior: float,
    rng: np.random.Generator,
    seed: int,
    other_core: OtherCore | None = None,
) -> PlaqueReading:
    others = len(fit.bodies)
    # the other core is the last of the fit's bodies
    calcifications = others - (other_core is not None)
    plain = fit
    space = CoreSpace(vessel, fit, prior_of_core)
    cloud = sample_towards(space.draw_prior(particles, rng), space.nothing, space.target, rng)
    first = cloud.log_evidence
    seen = space.evidence(space.fractions(cloud.points))
    if seen.mean.mean() > 0.5 * CALCIFIED_HU and others < _MOST_BODIES and not other_core:
        # The search with few trial bodies had missed it.
        other = _with_body(vessel, fit, space, cloud, float(seen.mean.mean()), expected=True)
        if other.parameters[-1] > CALCIFIED_HU:
            return _read(vessel, other, prior_of_core, particles, prior, rng, seed)
    # The vessel was fitted without a core, its tissues as expected. Now they are free: without a
    # core, for comparison; with the one that was found; and then the core again.
    without = CoreSpace(vessel, vessel.fit(fit.parameters, fit.bodies), prior_of_core)
    fit = _with_body(vessel, fit, space, cloud, float(seen.mean.mean()))
    again = CoreSpace(vessel, fit, prior_of_core, replaces=others, against=without.none)
    cloud = sample_towards(cloud.points, space.target, again.target, rng, log_evidence=first)
    space = again
    odds = math.log(prior / (1 - prior)) if 0 < prior < 1 else math.copysign(math.inf, prior - 0.5)
    presence = _probability(cloud.log_evidence + odds)
    fractions = space.fractions(cloud.points)
    tau = texture(vessel, fit, rng)
    draws = draws_of(vessel, fit, space, cloud.points, fractions, tau, rng)
    names = {
        "fat": "HU",
        "wall": "HU",
        "fibrous": "HU",
        "lumen": "HU",
        "wall thickness": "mm",
        "lumen area": "mm²",
        "least lumen area": "mm²",
    }
    plaque = {"contrast": "HU", "core": "HU", "core volume": "mm³", "cap thickness": "mm"}
    given = {n: estimate(draws[n], unit) for n, unit in plaque.items()}
    figures = {n: estimate(draws[n], unit) for n, unit in names.items() if n in draws}
    square, spread = misfit(vessel, fit)
    left = leftover(vessel, fit)
    for k in range(calcifications):
        i = vessel.size + k
        sd, value = math.sqrt(fit.covariance[i, i]), fit.parameters[i] + fit.parameters[FIBROUS]
        given[f"calcification {k + 1}"] = TissueEstimate(
            value, value - 1.96 * sd, value + 1.96 * sd, sd, "HU"
        )
    if other_core is not None:
        i = vessel.size + calcifications
        # The fit holds the other core's shape; its uncertainty is that of the shapes which were
        # found.
        sd = math.hypot(
            math.sqrt(fit.covariance[i, i]), tau.sd_of("contrast"), other_core["contrast_sd_hu"]
        )
        value = -float(fit.parameters[i])
        given["second contrast"] = TissueEstimate(
            value, value - 1.96 * sd, value + 1.96 * sd, sd, "HU"
        )
    more, found = (
        (0.0, None)
        if presence < CERTAIN
        else _one_more(vessel, fit, fractions.mean(0), space, particles, rng)
    )
    if found is not None and other_core is None:
        where, cloud_there, contrast_there = found
        second = _other_core(where, cloud_there, contrast_there, more)
        both = _read(
            vessel,
            _with_body(vessel, plain, where, cloud_there, contrast_there, expected=True),
            prior_of_core,
            particles,
            prior,
            rng,
            seed,
            second,
        )
        if both.presence >= CERTAIN:
            return both
    reading = PlaqueReading(
        vessel.grid,
        presence,
        more if other_core is None else other_core["probability"],
        calcifications,
        figures,
        {},
        given,
        _regions(vessel, fit, space, fractions, calcifications),
        fit.image,
        square,
        spread,
        left,
        tau.sd_hu,
        tau.high_hu,
        {
            "particles": particles,
            "seed": seed,
            "log_evidence": cloud.log_evidence,
            "log_evidence_first": first,
            "point": prior_of_core.point,
            "vessel_prior": asdict(vessel.prior),
            "voxels": len(vessel.index),
            "core_center_mm": cloud.points[:, :3].mean(0).tolist(),
            "prior": prior,
            "second_core": other_core,
        },
        third_core=None if found is None else _other_core(*found, more),
    )
    why = "" if reading.explained else "the tissues do not explain the data, see the warning"
    doubt = why or _doubt(presence, given["contrast"])
    refused = {
        name: doubt if name in plaque else why
        for name in given
        if (doubt if name in plaque else why)
    }
    shown = {name: e for name, e in given.items() if name not in refused}
    return replace(reading, figures=figures | shown, refused=refused)


def _probability(log_odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-min(max(log_odds, -700.0), 700.0)))


def _one_more(
    vessel: VesselModel,
    fit: Fit,
    core: NDArray[np.float32],
    space: CoreSpace,
    particles: int,
    rng: np.random.Generator,
) -> tuple[float, tuple[CoreSpace, Cloud, float] | None]:
    """Probability of one more core than the fit has, as likely as none before the data, anywhere in
    the layer.

    Bodies that overlap the first core count as none: they would mend its shape.

    Returns:
        The probability, and of a certain one its space, its shapes and its contrast δ, HU.
    """
    more = CoreSpace(vessel, fit, CorePrior())
    first = np.zeros(len(vessel.index), np.float32)
    first[space.chosen] = core

    def target(shapes: Floats) -> tuple[Floats, Floats]:
        prior, log = more.log_prior(shapes), np.zeros(len(shapes))
        allowed = np.flatnonzero(np.isfinite(prior))
        fractions = more.fractions(shapes[allowed])
        volume = fractions.sum(1)
        apart = (volume > 0.0) & (fractions @ first[more.chosen] < _APART * volume)
        if apart.any():
            log[allowed[apart]] = more.evidence(fractions[apart]).log
        return prior, log

    tries = more.draw_prior(_LOOK, rng)
    log = target(tries)[1]
    probability = _probability(float(logsumexp(log)) - math.log(len(log)))
    if probability < _WORTH:
        return probability, None
    cloud = sample_towards(tries[:particles], more.nothing, target, rng)
    probability = _probability(cloud.log_evidence)
    if probability < CERTAIN:
        return probability, None
    return probability, (
        more,
        cloud,
        float(more.evidence(more.fractions(cloud.points)).mean.mean()),
    )


def _other_core(space: CoreSpace, cloud: Cloud, contrast: float, probability: float) -> OtherCore:
    """Place, size and value of a core beside the first."""
    seen = space.evidence(space.fractions(cloud.points))
    return {
        "probability": probability,
        "at_mm": cloud.points[:, :3].mean(0).tolist(),
        "contrast_hu": -contrast,
        "contrast_sd_hu": math.sqrt(float(seen.mean.var() + seen.variance.mean())),
        "volume_mm3": float(seen.volume.mean()),
    }


def _regions(
    vessel: VesselModel,
    fit: Fit,
    space: CoreSpace,
    fractions: NDArray[np.float32],
    calcifications: int,
) -> dict[str, NDArray[np.float32]]:
    core = np.zeros(len(vessel.index))
    core[space.chosen] = fractions.mean(0)
    soft = fit.bodies[:-1] * np.clip(fit.drawing.fractions[1] - fit.drawing.fractions[2], 0.0, 1.0)
    outer, inner, lumen, core, *bodies = vessel.voxel_means(
        np.stack([*fit.drawing.fractions, core, *soft], 1)
    ).T
    layer, hard = (
        np.clip(inner - lumen, 0.0, 1.0),
        sum(bodies[:calcifications], np.zeros(len(core))),
    )
    core = np.clip(core, 0.0, layer)
    rest = layer - core - sum(bodies, np.zeros(len(core)))
    parts = {"wall": outer - inner, "fibrous": rest, "lumen": lumen, "core": core}
    if calcifications:
        parts["calcification"] = hard
    if len(bodies) > calcifications:
        parts["second core"] = bodies[-1]
    found = {"fat": vessel.on_grid(1.0 - outer, 1.0)}
    found |= {name: vessel.on_grid(np.clip(part, 0.0, 1.0)) for name, part in parts.items()}
    return found
