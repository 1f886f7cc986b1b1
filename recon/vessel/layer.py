"""What the fibrous layer of a fitted vessel holds beside fibrous tissue: the best linear estimate.

The contents are a Gaussian field s in HU, times the share L of each voxel in the layer. The
vessel's parameters move with it by one step δ of Gauss and Newton's, since a core that the fit did
not know has bent the outlines:

    x = T + J δ + L s,      (δ, s) least in ½ xᵀGx − bᵀx − log prior.

Nothing is known of what s is, so nothing pulls it towards a shape or a value but 0, and its noise
is that of a linear estimate in a known place: less than FBP's, for all that the data say of fat,
wall and lumen is used up.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_solve, eigh
from torch import Tensor

from recon.conjugate_gradient import conjugate_gradient
from recon.vessel.model import FAT, Fit, VesselModel

Floats = NDArray[Any]

SD_HU = 100.0
"""Prior standard deviation of the contents; larger: more of the contrast, at more noise. In four
held-out vessels 60 HU have a contrast slope of the core of 0.75 at 2 s and 0.54 at 0.35 s, 100 HU
0.82 and 0.68; for the same noise of the contrast soft FBP needs 1.14 and 1.52 times the dose, or
1.09 and 1.44."""
LENGTHS_MM = (0.7, 0.7, 0.4)
"""Of their correlation along the vessel, around it and across the layer: a core is flat. In the
held-out vessels 0.5 mm in all directions have the same slope, but need 1.23 (2 s) and 1.15 times
(0.35 s) the dose for the same noise of a core's centre."""
_LEAST_SHARE = 1e-3
"""Volume fraction of the layer from which on a voxel takes part."""
_STEPS = 60
"""Conjugate gradients at most."""
_TOLERANCE = 2e-3
"""Norm of the residual relative to the first at which they end: half an HU of the limit."""


class LayerField:
    """A Gaussian field of unit variance in a vessel's fibrous layer, as a linear map of white
    noise.

    Correlated as exp(−Δs²/2ℓ₁² − Δa²/2ℓ₂² − Δρ²/2ℓ₃²) along the vessel, around it and across the
    layer, with a the arc at the layer's mean radius. It lives on nodes half a length apart, each
    direction with the symmetric root of its own matrix; between the nodes it is interpolated
    linearly.

    Args:
        vessel: whose voxels are meant.
        share: ``(n,)`` of them in the layer; without any of it a voxel's value is 0.
        lengths_mm: ℓ along, around and across.

    Attributes:
        size: number of nodes, m.
    """

    def __init__(
        self,
        vessel: VesselModel,
        share: Floats,
        lengths_mm: tuple[float, float, float] = LENGTHS_MM,
    ) -> None:
        # Where there is no layer at all the field is anything: no voxel takes of it.
        share = np.maximum(share, _LEAST_SHARE if share.max() <= _LEAST_SHARE else 0.0)
        inside = np.flatnonzero(share >= _LEAST_SHARE)
        c = vessel.outer_at
        radius = float(np.average(c.rho[inside], weights=share[inside]))
        turn = 2.0 * math.pi * radius
        where = (c.s[inside], c.theta[inside] % (2.0 * math.pi) * radius, c.rho[inside])
        below, shares, roots, variance = [], [], [], np.ones(len(inside))
        for x, length, period in zip(where, lengths_mm, (None, turn, None), strict=True):
            low, reach = (0.0, turn) if period else (float(x.min()), float(np.ptp(x)))
            count = max(math.ceil(2.0 * reach / length), 3)
            step = reach / count or length
            nodes = step * np.arange(count if period else count + 1)
            first = np.minimum(((x - low) / step).astype(np.int64), count - 1)
            second = (x - low) / step - first
            below.append((first, (first + 1) % len(nodes)))
            shares.append((1.0 - second, second))
            roots.append(_root(nodes, length, period))
            variance *= 1.0 - 2.0 * second * (1.0 - second) * (
                1.0 - math.exp(-0.5 * (step / length) ** 2)
            )
        self._roots, self._shape = roots, tuple(len(root) for root in roots)
        self.size = math.prod(self._shape)
        corners = list(itertools.product((0, 1), repeat=3))
        columns = [
            np.ravel_multi_index([b[k] for b, k in zip(below, at, strict=True)], self._shape)
            for at in corners
        ]
        weights = [
            math.prod(w[k] for w, k in zip(shares, at, strict=True)) / np.sqrt(variance)
            for at in corners
        ]
        entries = np.concatenate(weights), (np.tile(inside, 8), np.concatenate(columns))
        self._between = sparse.csr_array(entries, shape=(len(share), self.size))
        self._back = self._between.T.tocsr()

    def of(self, white: Floats) -> Floats:
        """``(m,)`` white noise on the nodes to ``(n,)`` values of the field on the vessel's
        voxels."""
        return np.asarray(self._between @ self._correlated(white))

    def adjoint(self, values: Floats) -> Floats:
        """The transpose of :meth:`of`, ``(n,)`` to ``(m,)``."""
        return self._correlated(self._back @ values)

    def _correlated(self, white: Floats) -> Floats:
        along, around, across = self._roots
        turned = np.tensordot(along, white.reshape(self._shape), axes=1)
        return np.asarray((around @ turned @ across).ravel())


def _root(nodes: Floats, length: float, period: float | None) -> Floats:
    """Symmetric root of the correlation between nodes (of a circle, where a period is given)."""
    apart = nodes[:, None] - nodes
    if period:
        apart = (apart + 0.5 * period) % period - 0.5 * period
    values, vectors = eigh(np.exp(-0.5 * (apart / length) ** 2))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


class LayerEstimate:
    """The vessel of a fit, moved by what its layer holds, and the contents of the layer.

    Args:
        fit: without a core, the tissues as expected.
        sd_hu: prior standard deviation of the contents, HU.

    Attributes:
        fit: with parameters and drawing moved; its other attributes are those of the fit that was
            given.
        image: ``grid.shape`` float32 HU, the vessel with the contents.
        share: ``(n,)`` of each of the vessel's voxels in the layer, L.
    """

    def __init__(self, fit: Fit, sd_hu: float = SD_HU) -> None:
        vessel = fit.vessel
        self._fit, self._sd_hu = fit, sd_hu
        self.share, self._held = fit.layer, False
        self._field = LayerField(vessel, self.share)
        contents, step, prior = self._solved(fit.residual, fit.gradient)
        parameters = fit.parameters + step
        drawing = vessel.draw(parameters, fit.bodies, jacobian=False)
        energy = vessel.energy(parameters, drawing.image + contents, fit.precision)[0] + prior
        if energy < fit.energy:
            self.fit = replace(fit, parameters=parameters, drawing=drawing)
        else:
            # The step is too long for its linear model: where metal or a calcification is in the
            # layer.
            self._held, self.fit = True, fit
            contents = self._solved(fit.residual, fit.gradient)[0]
        self.image = self.fit.image + vessel.on_grid(contents)

    def change(self, b: Floats) -> Floats:
        """The map from a small change of b to that of ``image``, ``grid.shape`` float64; it is
        symmetric.

        (But for the difference between voxel means and what the operator takes, of a voxel's size.)

        Args:
            b: ``grid.shape`` HU⁻¹.
        """
        vessel, jacobian = self._fit.vessel, self._fit.drawing.jacobian
        assert jacobian is not None
        own = b[tuple(vessel.index.T)]
        gradient = own.astype(np.float32) @ jacobian
        gradient[FAT] += b.sum()
        contents, step, _ = self._solved(own, gradient)
        return vessel.on_grid(contents + jacobian @ step) + step[FAT]

    def _solved(self, residual: Floats, gradient: Floats) -> tuple[Floats, Floats, float]:
        """Contents ``(n,)``, step of the parameters ``(p,)``, and −log prior of both for b − Gx
        and its projection."""
        fit, scale = self._fit, self._sd_hu * self.share
        gram, moves = fit.vessel.gram, not self._held

        def field(w: Floats) -> Floats:
            found: Floats = scale * self._field.of(w)
            return found

        def back(v: Floats) -> Floats:
            return self._field.adjoint(scale * v)

        def freed(v: Floats, pull: Floats) -> Floats:
            """Of ``v`` what the parameters cannot explain."""
            return v - fit.curved @ cho_solve(fit.factor, pull).astype(np.float32) if moves else v

        def apply(w: Tensor) -> Tensor:
            white = w[0].numpy()
            x = field(white).astype(np.float32)
            seen = back(freed(gram.apply(x[:, None])[:, 0], x @ fit.curved if moves else x))
            return torch.from_numpy(white + seen)[None]

        right = torch.from_numpy(back(freed(residual, gradient)))[None]
        w = conjugate_gradient(apply, right, lambda v: v, iterations=_STEPS, tolerance=_TOLERANCE)[
            0
        ].numpy()
        contents = field(w)
        if not moves:
            return contents, np.zeros(len(fit.parameters)), 0.5 * float(w @ w)
        step = cho_solve(fit.factor, gradient - contents.astype(np.float32) @ fit.curved)
        return contents, step, 0.5 * float(w @ w)
