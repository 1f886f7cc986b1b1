"""How well the model explains the data: the residual's size, and texture inside the tissues."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.stats import norm

from recon.plaque.vessel import FIBROUS, Fit, Vessel

__all__ = ["Texture", "misfit", "texture"]

Floats = NDArray[np.float64]

LENGTH_MM = 0.3
"""Correlation length of the texture: exp(−r² / 2 · 0.3²)."""
PRIOR_VARIANCE_HU2 = 50.0
"""Mean of the exponential prior of the texture's variance, HU²."""
_PROBES = 16
_ENDS_MM = 0.8


@dataclass(frozen=True, eq=False)
class Texture:
    """A Gaussian texture of the soft tissues.

    Attributes:
        variance_hu2: posterior mean of its variance; high_hu2: its 95 % limit.
        responses: figure → standard deviation of its estimate by a texture of 1 HU.
    """

    variance_hu2: float
    high_hu2: float
    responses: dict[str, float]

    @property
    def sd_hu(self) -> float:
        """√ of the posterior mean of the variance."""
        return math.sqrt(self.variance_hu2)

    @property
    def high_hu(self) -> float:
        """95 % limit of the standard deviation."""
        return math.sqrt(self.high_hu2)

    def sd_of(self, name: str) -> float:
        """What the texture adds to the uncertainty of a tissue's value (or of ``"contrast"``), HU."""
        return self.sd_hu * self.responses.get(name, 0.0)


def misfit(vessel: Vessel, fit: Fit) -> tuple[float, float]:
    """Mean square of the standardised residual over its expectation, and its standard deviation under the model."""
    at = vessel.gram.slices
    variance = np.concatenate([
        np.diag(vessel.gram.blocks[z, 0]) for z in range(len(at) - 1) if at[z + 1] > at[z]
    ])  # fmt: skip
    low, high = vessel.start.ends
    # Where a vessel ends is no part of what is read of it.
    kept = (vessel.lumen_at.s > low + _ENDS_MM) & (vessel.lumen_at.s < high - _ENDS_MM)
    scale = kept / np.sqrt(variance)
    z = fit.residual * scale
    # What the fit takes away: Gram times Jacobian, in the metric of the covariance.
    white = fit.curved * scale[:, None].astype(np.float32)
    taken = np.sum(fit.covariance * (white.T @ white))
    total = 0.0
    for (k, b), block in vessel.gram.blocks.items():
        here, there = slice(at[k], at[k + 1]), slice(at[k + b], at[k + b + 1])
        correlation = (block * scale[there, None].astype(np.float32)) * scale[here].astype(np.float32)
        total += (2.0 if b else 1.0) * float((correlation**2).sum())
    expected = int(kept.sum()) - float(taken)
    return float((z**2).sum() / expected), math.sqrt(2.0 * total) / expected


def texture(vessel: Vessel, fit: Fit, rng: np.random.Generator) -> Texture:
    """Variance of a texture in wall, fibrous layer and core, by the moment rᵀTr of the residual r (T its covariance).

    With Q the residual's covariance under the model, E[rᵀTr] = tr TQ + τ² tr TQTQ and its variance is 2 tr TQTQ; the
    traces are estimated with random signs (Hutchinson).
    """
    outer, _, lumen = fit.drawing.shares
    soft = np.clip(outer - lumen, 0.0, 1.0)
    for body in fit.bodies[:-1]:
        soft = soft * (1.0 - np.clip(body, 0.0, 1.0))
    grid = vessel.grid
    # White noise through a kernel of unit norm and σ = ℓ/√2 has unit variance and the correlation exp(−r²/2ℓ²).
    sd = [LENGTH_MM / math.sqrt(2.0) / step for step in grid.spacing]
    spike = np.zeros([2 * math.ceil(4 * s) + 1 for s in sd])
    spike[tuple(n // 2 for n in spike.shape)] = 1.0
    norm_of = math.sqrt(float((ndimage.gaussian_filter(spike, sd, mode="constant") ** 2).sum()))
    low, high = vessel.index.min(0), vessel.index.max(0) + 1
    box, place = tuple(high - low), tuple((vessel.index - low).T)

    def smooth(v: Any) -> Floats:
        """Columns ``(n, k)``."""
        out: Floats = np.empty(v.shape)
        for k in range(v.shape[1]):
            volume = np.zeros(box)
            volume[place] = v[:, k]
            out[:, k] = ndimage.gaussian_filter(volume, sd, mode="constant")[place] / norm_of
        return out

    signs = rng.integers(0, 2, (len(soft), _PROBES)) * 2.0 - 1.0
    probes = soft[:, None] * smooth(signs)
    single = probes.astype(np.float32)
    taken = fit.curved.T @ single
    left = vessel.gram.apply(single).astype(np.float64) - fit.curved @ (fit.covariance @ taken).astype(np.float32)
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
    figures = {"fibrous": {FIBROUS: 1.0}, "core": {FIBROUS: 1.0, p - 1: 1.0}, "contrast": {p - 1: -1.0}}
    for name, wanted in figures.items():
        v = np.zeros(p)
        for k, factor in wanted.items():
            v[k] = factor
        # An estimate is wᵀb with w = J C v; an image t adds (G w)ᵀ t.
        response = fit.curved @ (fit.covariance @ v).astype(np.float32)
        responses[name] = float(np.linalg.norm(smooth((soft * response)[:, None])))
    return Texture(max(float(mean), 0.0), max(float(top), 0.0), responses)
