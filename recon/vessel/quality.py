"""How well the model explains the data: the residual's size, what stands out of it, and texture
inside the tissues."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.stats import norm
from torch import Tensor

from recon.data_term import Quadratic
from recon.vessel.data import least_squares, pilot
from recon.vessel.data import scores as scores_in
from recon.vessel.model import FAT, FIBROUS, Fit, VesselModel

if TYPE_CHECKING:
    from torchpcct.typing import Reals


Floats = NDArray[np.float64]

LENGTH_MM = 0.3
"""Correlation length of the texture: exp(−r² / 2 · 0.3²)."""
PRIOR_VARIANCE_HU2 = 50.0
"""Mean of the exponential prior of the texture's variance, HU²."""
_PROBES = 16
"""Random probes of Hutchinson's estimate of a trace."""
_ENDS_MM = 0.8
"""So much at either end of the vessel is not tested, mm."""
_BODY_MM = (0.4, 1.2)
"""Standard deviations of two Gaussians, mm, whose difference finds a body of half a millimetre to
some millimetres, such as a second vessel."""
STRIKING = 6.5
"""Standard deviations of the noise; noise alone reached 4.8 in four volumes, sound readings
reached 5.4."""
_SHARE = 0.25
"""What lies outside of the vessel shows where a smooth estimate exceeds this fraction of its
largest value."""
_SEEN_HU = 60.0
"""And at least so much, HU."""
_APART_MM = 0.2
"""It keeps this distance from the vessel's wall, mm."""
_EDGE_MM = 0.4
"""And reaches so far beyond where it shows, mm."""
_BESIDE_HU = 500.0
"""Prior standard deviation of its voxels, HU."""
_BESIDE_STEPS = 20
"""Conjugate gradients of its estimate."""


@dataclass(frozen=True)
class Leftover:
    """What stands out most of what the fitted tissues leave of the data.

    Attributes:
        score: its height in standard deviations of the noise.
        hu: the height in a smooth linear estimate; 0 where the score is not striking.
        at_mm: z, y, x.
        beside: whether it lies outside of the vessel.
    """

    score: float
    hu: float
    at_mm: tuple[float, float, float]
    beside: bool


@dataclass(frozen=True, eq=False)
class ResidualTexture:
    """A Gaussian texture of the soft tissues.

    Attributes:
        sd_hu: √ of the posterior mean of its variance; high_hu: 95 % limit of its standard
            deviation.
        responses: figure → standard deviation of its estimate by a texture of 1 HU.
    """

    sd_hu: float
    high_hu: float
    responses: dict[str, float]

    def sd_of(self, name: str) -> float:
        """What the texture adds to the uncertainty of a tissue's value (or of ``"contrast"``),
        HU."""
        return self.sd_hu * self.responses.get(name, 0.0)


def _between_ends(vessel: VesselModel) -> NDArray[np.bool_]:
    """``(n,)`` voxels of the vessel but for its ends: where a vessel ends is no part of what is
    read of it."""
    low, high = vessel.start.ends
    kept: NDArray[np.bool_] = (vessel.lumen_at.s > low + _ENDS_MM) & (
        vessel.lumen_at.s < high - _ENDS_MM
    )
    return kept


def residual_of(vessel: VesselModel, fit: Fit, data: Quadratic | None = None) -> Tensor:
    """b − Gx of the whole volume, ``grid.shape`` HU⁻¹; of other data than the fit's if they are
    given."""
    data = data or vessel.data
    image = np.full(vessel.grid.shape, fit.parameters[FAT])
    image[tuple(vessel.index.T)] += fit.drawing.image
    return data.left(torch.from_numpy(image).to(data.b)[None])[0]


def beside(data: Quadratic, vessel: VesselModel, fit: Fit) -> Tensor | None:
    """What stands beside a fitted vessel, ``grid.shape`` HU above the fat; None where nothing is
    striking.

    Least squares over the voxels where the residual shows something, with a prior of no direction
    or shape: what it is does not matter, only what it does to the vessel.

    Args:
        data: all that is known, nothing taken off.
        vessel, fit: of the data, or of the data without what an earlier call has found.
    """
    left = residual_of(vessel, fit, data)
    near = np.zeros(vessel.grid.shape, bool)
    near[tuple(vessel.index[fit.drawing.fractions[0] > 0.02].T)] = True
    step = np.array(vessel.grid.spacing)
    free = ndimage.distance_transform_edt(~near, sampling=step) > _APART_MM
    scores = np.where(free, scores_in(data, left, _BODY_MM), 0.0)
    if np.abs(scores).max() <= STRIKING:
        return None
    shown = pilot(data, left)
    bodies, _ = ndimage.label(
        free & (np.abs(shown) > max(_SHARE * np.abs(shown[free]).max(), _SEEN_HU))
    )
    struck = np.unique(bodies[np.abs(scores) > STRIKING])
    there = np.isin(bodies, struck[struck > 0])
    if not there.any():
        return None
    mask = torch.from_numpy(
        free & (ndimage.distance_transform_edt(~there, sampling=step) <= _EDGE_MM)
    ).to(left)
    return least_squares(data, left, _BESIDE_STEPS, mask, _BESIDE_HU**-2)


def scores_of(vessel: VesselModel, fit: Fit, explained: Tensor | float = 0.0) -> Floats:
    """How far each place stands out of what a fit leaves of the data, ``grid.shape`` standard
    deviations of the noise.

    0 at the vessel's ends: where a vessel ends is no part of what is read of it.

    Args:
        vessel, fit: see :class:`recon.vessel.model.VesselModel`.
        explained: ``grid.shape`` HU⁻¹, G times what is known beside the fit.
    """
    scores = scores_in(vessel.data, residual_of(vessel, fit) - explained, _BODY_MM)
    scores[tuple(vessel.index[~_between_ends(vessel)].T)] = 0.0
    return scores


def leftover(vessel: VesselModel, fit: Fit) -> Leftover:
    """Look through the whole volume for what the tissues do not explain: a second vessel, a branch,
    a stent, muscle.

    The mean square of the residual (:func:`misfit`) averages over a vessel's many voxels, and knows
    nothing of what lies beside it; a bright neighbour still bends the fit, whose plaque bodies then
    stand in for it.
    """
    data, grid = vessel.data, vessel.grid
    scores = scores_of(vessel, fit)
    place = np.unravel_index(int(np.argmax(np.abs(scores))), scores.shape)
    score = float(abs(scores[place]))
    inside = vessel.lookup[place]
    z, y, x = (float(axis[k]) for axis, k in zip(grid.axes, place, strict=True))
    beside = bool(inside < 0 or fit.drawing.fractions[0][inside] < 0.5)
    return Leftover(
        score,
        float(pilot(data, residual_of(vessel, fit))[place]) if score > STRIKING else 0.0,
        (z, y, x),
        beside,
    )


def misfit(vessel: VesselModel, fit: Fit) -> tuple[float, float]:
    """Mean square of the standardised residual over its expectation, and its standard deviation
    under the model."""
    at = vessel.gram.slices
    variance = np.concatenate(
        [np.diag(vessel.gram.blocks[z, 0]) for z in range(len(at) - 1) if at[z + 1] > at[z]]
    )
    kept = _between_ends(vessel)
    scale = kept / np.sqrt(variance)
    z = fit.residual * scale
    # What the fit takes away: Gram times Jacobian, in the metric of the covariance.
    white = fit.curved * scale[:, None].astype(np.float32)
    taken = np.sum(fit.covariance * (white.T @ white))
    total = 0.0
    for (k, b), block in vessel.gram.blocks.items():
        here, there = slice(at[k], at[k + 1]), slice(at[k + b], at[k + b + 1])
        correlation = (block * scale[there, None].astype(np.float32)) * scale[here].astype(
            np.float32
        )
        total += (2.0 if b else 1.0) * float((correlation**2).sum())
    expected = int(kept.sum()) - float(taken)
    if expected <= 0.0:
        raise ValueError(
            f"the vessel has {int(kept.sum())} voxels between its ends, too few to test the fit: "
            "read a longer part"
        )
    return float((z**2).sum() / expected), math.sqrt(2.0 * total) / expected


def texture(vessel: VesselModel, fit: Fit, rng: np.random.Generator) -> ResidualTexture:
    """Variance of a texture in wall, fibrous layer and core, by the moment rᵀTr of the residual r
    (T its covariance).

    With Q the residual's covariance under the model, E[rᵀTr] = tr TQ + τ² tr TQTQ and its variance
    is 2 tr TQTQ; the traces are estimated with random signs (Hutchinson).
    """
    outer, _, lumen = fit.drawing.fractions
    soft = np.clip(outer - lumen, 0.0, 1.0)
    for body in fit.bodies[:-1]:
        soft = soft * (1.0 - np.clip(body, 0.0, 1.0))
    smooth = _correlating(vessel, LENGTH_MM)
    signs = rng.integers(0, 2, (len(soft), _PROBES)) * 2.0 - 1.0
    probes = soft[:, None] * smooth(signs)
    single = probes.astype(np.float32)
    taken = fit.curved.T @ single
    left = vessel.gram.apply(single).astype(np.float64) - fit.curved @ (
        fit.covariance @ taken
    ).astype(np.float32)
    trace = float((probes * left).sum() / _PROBES)
    back = smooth(soft[:, None] * left)
    square = float((back**2).sum() / _PROBES)
    seen = float((smooth((soft * fit.residual)[:, None]) ** 2).sum())
    estimate, error = (seen - trace) / square, math.sqrt(2.0 * (1 + 1 / _PROBES) / square)
    # Exponential prior times a Gaussian likelihood: a Gaussian cut off at 0.
    shifted = estimate - error**2 / PRIOR_VARIANCE_HU2
    cut = norm.sf(-shifted / error)
    if cut > 1e-12:
        mean = shifted + error * norm.pdf(shifted / error) / cut
        top = shifted + error * float(norm.isf(0.05 * cut))
    else:
        mean, top = error**2 / -shifted, 3 * error**2 / -shifted
    responses = {}
    p = len(fit.parameters)
    figures = {
        "fibrous": {FIBROUS: 1.0},
        "core": {FIBROUS: 1.0, p - 1: 1.0},
        "contrast": {p - 1: -1.0},
    }
    for name, wanted in figures.items():
        v = np.zeros(p)
        for k, factor in wanted.items():
            v[k] = factor
        # An estimate is wᵀb with w = J C v; an image t adds (G w)ᵀ t.
        response = fit.curved @ (fit.covariance @ v).astype(np.float32)
        responses[name] = float(np.linalg.norm(smooth((soft * response)[:, None])))
    return ResidualTexture(
        math.sqrt(max(float(mean), 0.0)), math.sqrt(max(float(top), 0.0)), responses
    )


def _correlating(vessel: VesselModel, length_mm: float) -> Callable[[Reals], Floats]:
    """A symmetric function that makes of white noise one of unit variance with the correlation
    exp(−r² / 2ℓ²).

    Args:
        vessel: whose voxels are meant.
        length_mm: ℓ.

    Returns:
        From columns ``(n, k)`` to the same.
    """
    # White noise through a kernel of unit norm and σ = ℓ/√2.
    sd = [length_mm / math.sqrt(2.0) / step for step in vessel.grid.spacing]
    spike = np.zeros([2 * math.ceil(4 * s) + 1 for s in sd])
    spike[tuple(n // 2 for n in spike.shape)] = 1.0
    norm_of = math.sqrt(float((ndimage.gaussian_filter(spike, sd, mode="constant") ** 2).sum()))
    low, high = vessel.index.min(0), vessel.index.max(0) + 1
    box, place = tuple(high - low), tuple((vessel.index - low).T)

    def smooth(v: Reals) -> Floats:
        out: Floats = np.empty(v.shape)
        for k in range(v.shape[1]):
            volume = np.zeros(box)
            volume[place] = v[:, k]
            out[:, k] = ndimage.gaussian_filter(volume, sd, mode="constant")[place] / norm_of
        return out

    return smooth
