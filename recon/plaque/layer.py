"""What the fibrous layer of a fitted vessel holds beside fibrous tissue: the best linear estimate.

The contents are a Gaussian field s in HU, times the share L of each voxel in the layer. The vessel's parameters move
with it by one step δ of Gauss and Newton's, since a core that the fit did not know has bent the outlines:

    x = T + J δ + L s,      (δ, s) least in ½ xᵀGx − bᵀx − log prior.

Nothing is known of what s is, so nothing pulls it towards a shape or a value but 0, and its noise is that of a linear
estimate in a known place: less than FBP's, for all that the data say of fat, wall and lumen is used up.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.linalg import cho_solve
from torch import Tensor

from recon.conjugate_gradient import conjugate_gradient
from recon.plaque.vessel import FAT, Fit, Vessel

__all__ = ["SD_HU", "LayerEstimate", "correlating"]

Floats = NDArray[Any]

SD_HU = 100.0
"""Prior standard deviation of the contents; larger: more of the contrast, at more noise. In four held-out vessels 60 HU
have a contrast slope of the core of 0.75 at 2 s and 0.54 at 0.35 s, 100 HU 0.83 and 0.68; for the same noise of the
contrast soft FBP needs 1.17 and 1.54 times the dose, or 1.12 and 1.47."""
_LENGTH_MM = 0.5
"""ℓ of their correlation exp(−r² / 2ℓ²). 0.5 to 1 mm and sums of two: none has both more slope and less noise."""
_STEPS, _TOLERANCE = 60, 3e-3
"""Conjugate gradients at most, and the residual's norm over the first: half an HU of the limit."""


def correlating(vessel: Vessel, length_mm: float) -> Callable[[Floats], Floats]:
    """A symmetric function that makes of white noise one of unit variance with the correlation exp(−r² / 2ℓ²).

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

    def smooth(v: Floats) -> Floats:
        out: Floats = np.empty(v.shape)
        for k in range(v.shape[1]):
            volume = np.zeros(box)
            volume[place] = v[:, k]
            out[:, k] = ndimage.gaussian_filter(volume, sd, mode="constant")[place] / norm_of
        return out

    return smooth


class LayerEstimate:
    """The vessel of a fit, moved by what its layer holds, and the contents of the layer.

    Args:
        fit: without a core, the tissues as expected.
        sd_hu: prior standard deviation of the contents, HU.

    Attributes:
        fit: with parameters and drawing moved; its other attributes are those of the fit that was given.
        image: ``grid.shape`` float32 HU, the vessel with the contents.
        share: ``(n,)`` of each of the vessel's voxels in the layer, L.
    """

    def __init__(self, fit: Fit, sd_hu: float = SD_HU) -> None:
        vessel = fit.vessel
        self._fit, self._sd_hu, self._smooth = fit, sd_hu, correlating(vessel, _LENGTH_MM)
        self.share, self._held = fit.layer, False
        contents, step, prior = self._solved(fit.residual, fit.gradient)
        parameters = fit.parameters + step
        drawing = vessel.draw(parameters, fit.bodies, jacobian=False)
        energy = vessel.energy(parameters, drawing.image + contents, fit.precision)[0] + prior
        if energy < fit.energy:
            self.fit = replace(fit, parameters=parameters, drawing=drawing)
        else:
            # The step is too long for its linear model: where metal or a calcification is in the layer.
            self._held, self.fit = True, fit
            contents = self._solved(fit.residual, fit.gradient)[0]
        self.image = self.fit.image + vessel.on_grid(contents)

    def change(self, b: Floats) -> Floats:
        """The map from a small change of b to that of ``image``, ``grid.shape`` float64; it is symmetric.

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
        """Contents ``(n,)``, step of the parameters ``(p,)``, and −log prior of both for b − Gx and its projection."""
        fit, sd, share, smooth = self._fit, self._sd_hu, self.share, self._smooth
        gram, moves = fit.vessel.gram, not self._held

        def field(w: Floats) -> Floats:
            found: Floats = (sd * share) * smooth(w[:, None])[:, 0]
            return found

        def back(v: Floats) -> Floats:
            found: Floats = sd * smooth((share * v)[:, None])[:, 0]
            return found

        def freed(v: Floats, pull: Floats) -> Floats:
            """Of ``v`` what the parameters cannot explain."""
            return v - fit.curved @ cho_solve(fit.factor, pull).astype(np.float32) if moves else v

        def apply(w: Tensor) -> Tensor:
            white = w[0].numpy()
            x = field(white).astype(np.float32)
            seen = back(freed(gram.apply(x[:, None])[:, 0], x @ fit.curved if moves else x))
            return torch.from_numpy(white + seen)[None]

        right = torch.from_numpy(back(freed(residual, gradient)))[None]
        w = conjugate_gradient(apply, right, lambda v: v, iterations=_STEPS, tolerance=_TOLERANCE)[0].numpy()
        contents = field(w)
        if not moves:
            return contents, np.zeros(len(fit.parameters)), 0.5 * float(w @ w)
        step = cho_solve(fit.factor, gradient - contents.astype(np.float32) @ fit.curved)
        return contents, step, 0.5 * float(w @ w)
