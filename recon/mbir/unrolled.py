"""The unrolled reconstruction: data steps and one network in turn, and a final data consistency at
low frequencies.

In the normalised problem (:mod:`recon.data_term`), f in line pairs per mm:

1. Start: the Wiener filter v = (H + λ + μ f²)⁻¹ β; linear, and the same at every dose.
2. K times: d = v + (H_c + δ)⁻¹ (β − H v), a step towards the data with the circulant H_c for H in
   its inverse, and v ← N(v, d), the same prior N each time: the network
   (:mod:`recon.mbir.network`), or another one (:mod:`recon.mbir.priors`).
3. Data consistency: the u that minimises ½ uᵀH u − βᵀu + ½ (u − v)ᵀ Q (u − v) with Q = H_c (1/L −
   1) and a Gaussian low-pass L of half height at f_c. Below f_c the volume is the data's own linear
   estimate, unbiased whatever the network has learned; above, the network decides.
4. Beside strong edges overshoot is cut off (:func:`limited`), if the network has a filtered view of
   the data.
5. What of the data is still no noise is put back (:mod:`recon.mbir.residual`): patterns that no
   training has shown.

Both solves are a few conjugate gradients with the circulant H_c for H as preconditioner. (A fixed
step with it is not safe: at the rim of the inset its eigenvalues reach 2.2.)

f_c is the *fidelity*, the one trade-off that a user cares about: 0 for viewing, quiet images; 1 for
measuring, more of the contrast at more noise. The network knows it, so the noise that it must leave
alone does not surprise it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from recon.conjugate_gradient import conjugate_gradient
from recon.data_term import Quadratic
from recon.mbir.frequencies import filtered, squared_frequencies
from recon.mbir.network import (
    GUIDE_VOXELS,
    REFERENCE_SCALE_HU,
    Network,
    NetworkConfig,
    edge_preserved,
    extremes_nearby,
)
from recon.mbir.priors import PlugAndPlay, Prior, prior_of, same_kind
from recon.mbir.residual import significant_residual
from torchpcct.switches import undisturbed
from torchpcct.validate import number, whole

__all__ = ["Unrolled"]

Views = tuple[Tensor, Tensor, Tensor | None]
DEFAULT_FIDELITY = 0.5
"""Between the least error, at fidelity 0, and contrast, which a higher fidelity gives and noise
pays for."""

_START = (0.01, 0.8)
"""λ and μ of the start: the Wiener filter whose contrast slope is that of soft FBP (the study's
``linear``)."""
_SOLVES = (4, 3)
"""Conjugate gradients of start and data consistency: within 1 HU of the limit on the paper's
inset."""
_LINEAR_SOLVES = (12, 12)
"""The same for a reconstruction without network steps: then the whole of it is linear, within
1e-4 of its noise."""
_TOWARDS = 0.1
"""δ: higher frequencies than the data determine are not amplified."""
_LEAST = 1e-4
"""Of L: beyond, the network is held as firmly as float32 allows."""
_CUTOFFS = (0.2, 0.8)
"""f_c in line pairs per mm of fidelity 0 and 1."""
_NEARBY = 5
"""Voxels that count as near an edge: 1 mm."""
_EDGE = 10.0
"""Differences of the guide, in its noise, from which on overshoot is not let through; with the
reach chosen on held-out vessels (``tests/bench/prior_parts.md``)."""


def fidelity_frequency(fidelity: float) -> float:
    """f_c in line pairs per mm, of half height of the low-pass of the final data consistency.

    Raises:
        ValueError: a fidelity outside of 0 … 1.
    """
    fidelity = number("fidelity", fidelity, low=0.0, high=1.0)
    return _CUTOFFS[0] + (_CUTOFFS[1] - _CUTOFFS[0]) * fidelity


class Unrolled(nn.Module):
    """K steps with one prior.

    Args:
        network: the package's, or any other prior or denoiser (:func:`recon.mbir.priors.prior_of`);
            its configuration, or None for the usual one, makes the package's.
        steps: K.
        voxel_mm: cubic voxels that another prior works on; the package's network knows them.
        bilateral: whether another prior is given the filtered view of the data; if it is, overshoot
            is cut off by it.

    Raises:
        ValueError, TypeError: what is no prior; other voxels than those of the package's network.
    """

    def __init__(
        self,
        network: Prior | str | NetworkConfig | None = None,
        steps: int = 2,
        *,
        voxel_mm: float | None = None,
        bilateral: bool = True,
    ) -> None:
        super().__init__()
        own = network is None or isinstance(network, NetworkConfig)
        prior: Any = Network(network) if own else prior_of(network)  # type: ignore[arg-type]
        config = prior.config if isinstance(prior, Network) else NetworkConfig(bilateral=bilateral)
        if isinstance(prior, Network) and voxel_mm not in (None, config.voxel_mm):
            raise ValueError(
                f"the network is for voxels of {config.voxel_mm:g} mm, got voxel_mm={voxel_mm!r}"
            )
        self.network = prior
        self.voxel_mm = number(
            "voxel_mm", config.voxel_mm if voxel_mm is None else voxel_mm, positive=True, unit="mm"
        )
        self.bilateral = config.bilateral
        self.steps = whole("steps", steps)
        self.seen_scale_hu: Tensor
        # What the training has seen, so that the weights know themselves where they may be trusted.
        self.register_buffer("seen_scale_hu", torch.zeros(2))

    @undisturbed
    def forward(
        self,
        problem: Quadratic,
        fidelity: float | Tensor = DEFAULT_FIDELITY,
        callback: Callable[[int, Tensor], None] | None = None,
        steps: int | None = None,
        views: Views | None = None,
        final_data_consistency: bool = True,
        prior: Prior | None = None,
        cut_overshoot: bool = True,
        restore: bool = True,
        solves: tuple[int, int] | None = None,
    ) -> Tensor:
        """The reconstruction ``(batch, z, y, x)`` in noise units (times ``problem.unit_hu``: HU
        above background).

        Args:
            problem: normalised problem.
            fidelity: 0 … 1, one for all or ``(batch,)``.
            callback: called with the number of each step and the volume after it.
            steps: fewer than K; None: K. With 0 the reconstruction is linear, and the solves go on
                until it is.
            views: :func:`first_views` of the problem, where they are known already.
            final_data_consistency: whether that step is taken; without it the network's last volume
                is the result.
            prior: in the place of the network: block by block (:mod:`recon.mbir.field`), or another
                one (:func:`recon.mbir.priors.prior_of` makes it).
            cut_overshoot: whether :func:`limited` is applied, if the network has a filtered view.
            restore: whether what the data still hold is put back. A training does not, and a linear
                reconstruction has no need to.
            solves: conjugate gradients of start and data consistency; None: those of an inset's
                model.

        Raises:
            ValueError, TypeError: the prior returns something else than a volume like the one that
                it is given.
        """
        scale = problem.unit_hu
        if self.training:
            low, high = self.seen_scale_hu.unbind()
            least = torch.minimum(torch.where(low > 0, low, math.inf), scale.min())
            self.seen_scale_hu = torch.stack([least, torch.maximum(high, scale.max())])
        fidelities = torch.as_tensor(fidelity, dtype=scale.dtype, device=scale.device).expand(
            scale.shape
        )
        level = torch.log(scale / REFERENCE_SCALE_HU).clamp(-3.0, 3.0)
        spectrum = problem.spectrum()
        solves = solves or (_LINEAR_SOLVES if steps == 0 else _SOLVES)
        noise = guide_noise(spectrum, problem.b.shape[-3:], problem.voxel_mm)
        v = start(problem, spectrum, solves[0]) if views is None else views[0]
        if callback is not None:
            callback(0, v)
        used = bound(self.network if prior is None else prior, problem, spectrum)
        smoothed = None
        for k in range(self.steps if steps is None else steps):
            _, towards, smoothed = (
                views if views and k == 0 else _views(problem, spectrum, v, noise, self.bilateral)
            )
            condition = torch.stack([level, fidelities - 0.5, torch.full_like(level, float(k))], 1)
            v = same_kind(used(v, towards, condition, smoothed), v, used)
            if callback is not None:
                callback(k + 1, v)
        u = consistent(problem, spectrum, v, fidelities, solves[1]) if final_data_consistency else v
        if smoothed is not None and cut_overshoot:
            u = limited(u, smoothed, noise)
        if steps == 0 or self.training or not restore:
            return u
        return u + significant_residual(problem, spectrum, u, _TOWARDS)


def bound(prior: Prior, problem: Quadratic, spectrum: Tensor) -> Prior:
    """A prior that is given the noise of a problem, if it asks for it; ``spectrum`` is that of
    the problem."""
    if not isinstance(prior, PlugAndPlay):
        return prior
    noise = guide_noise(spectrum, problem.b.shape[-3:], problem.voxel_mm, prior.smoothed_by)
    return prior.with_noise(noise, problem.zero_hu)


def first_views(problem: Quadratic, bilateral: bool) -> Views:
    """What a network sees in its first step: start, step towards the data, and its filtered view,
    if it has one.

    No weight takes part in it, so a training may keep it.
    """
    spectrum = problem.spectrum()
    noise = guide_noise(spectrum, problem.b.shape[-3:], problem.voxel_mm)
    return _views(problem, spectrum, start(problem, spectrum), noise, bilateral)


def _views(
    problem: Quadratic, spectrum: Tensor, v: Tensor, noise: Tensor, bilateral: bool
) -> Views:
    towards = v + filtered(problem.left(v), 1.0 / (spectrum + _TOWARDS))
    return v, towards, edge_preserved(towards, noise) if bilateral else None


def start(problem: Quadratic, spectrum: Tensor, iterations: int = _SOLVES[0]) -> Tensor:
    """The Wiener filter of the data, ``(batch, z, y, x)``; ``spectrum`` is that of the problem."""
    prior = _START[0] + _START[1] * squared_frequencies(
        problem.b.shape[-3:], problem.voxel_mm, problem.b
    )
    inverse = 1.0 / (spectrum + prior)
    return conjugate_gradient(
        lambda w: problem.apply(w) + filtered(w, prior),
        problem.b,
        lambda w: filtered(w, inverse),
        iterations=iterations,
    )


def guide_noise(
    spectrum: Tensor, shape: Sequence[int], voxel_mm: float, smoothed_by: float = GUIDE_VOXELS
) -> Tensor:
    """Standard deviation of the first step towards the data smoothed by a Gaussian, in noise units,
    ``(batch,)``.

    That step is linear in β, whose noise has the spectrum of H.

    Args:
        spectrum: of H, ``(batch, z, y, x//2 + 1)``.
        shape: of the volume; voxel_mm: its voxels.
        smoothed_by: standard deviation of the Gaussian in voxels; 0: of the step itself.
    """
    f2 = squared_frequencies(shape, voxel_mm, spectrum)
    prior = _START[0] + _START[1] * f2
    passed = (1.0 + prior / (spectrum + _TOWARDS)) / (spectrum + prior)
    blur = torch.exp(-2.0 * (math.pi * smoothed_by * voxel_mm) ** 2 * f2)
    power = (passed * blur).square() * spectrum
    # Frequencies of a real volume come in pairs, but for the first along x and, of an even number,
    # the last.
    pairs = torch.full((spectrum.shape[-1],), 2.0, dtype=spectrum.dtype, device=spectrum.device)
    pairs[0] = 1.0
    if shape[-1] % 2 == 0:
        pairs[-1] = 1.0
    return ((power * pairs).sum((-3, -2, -1)) / math.prod(shape)).sqrt()


def low_pass(problem: Quadratic, fidelities: Tensor) -> Tensor:
    """L on the frequencies of ``rfftn``, ``(batch, z, y, x//2 + 1)``."""
    cut = _CUTOFFS[0] + (_CUTOFFS[1] - _CUTOFFS[0]) * fidelities.reshape(-1, 1, 1, 1)
    f2 = squared_frequencies(problem.b.shape[-3:], problem.voxel_mm, problem.b)
    return torch.exp(-math.log(2.0) * f2 / cut.square())


def consistent(
    problem: Quadratic,
    spectrum: Tensor,
    v: Tensor,
    fidelities: Tensor,
    iterations: int = _SOLVES[1],
) -> Tensor:
    """``v`` with its low frequencies replaced by the data's, ``(batch, z, y, x)``; ``fidelities``
    ``(batch,)`` in 0 … 1."""
    passed = low_pass(problem, fidelities).clamp_min(_LEAST)
    hold = (spectrum + _TOWARDS) * (1.0 / passed - 1.0)
    inverse = 1.0 / (spectrum + hold)
    return v + conjugate_gradient(
        lambda w: problem.apply(w) + filtered(w, hold),
        problem.left(v),
        lambda w: filtered(w, inverse),
        iterations=iterations,
    )


def limited(u: Tensor, smoothed: Tensor, noise: Tensor) -> Tensor:
    """``u`` without overshoot beside strong edges, ``(batch, z, y, x)``.

    Sharpening and the data's low frequencies leave ripples there: a dark rim about a bright lumen,
    where a reader looks for a lipid core. A bilateral filter makes none. So where its values span
    much more than noise within 1 mm, ``u`` does not go beyond them (:data:`_EDGE`); where they span
    less, it may by as much as is missing, and a weak structure that the filter has flattened stays
    as it is.

    Args:
        u: volumes.
        smoothed: :func:`recon.mbir.network.edge_preserved` of the same data.
        noise: ``(batch,)``, :func:`guide_noise`.
    """
    high, low = extremes_nearby(smoothed, _NEARBY)
    slack = (_EDGE * noise.reshape(-1, 1, 1, 1) - (high - low)).clamp_min(0.0)
    return torch.minimum(torch.maximum(u, low - slack), high + slack)


def low_residual(problem: Quadratic, left: Tensor, fidelity: float) -> Tensor:
    """‖L (β − H u)‖ over ‖L β‖, ``(batch,)``: 0 where the low frequencies are wholly the data's
    own.

    Args:
        problem: normalised problem.
        left: β − H u, ``(batch, z, y, x)``.
        fidelity: 0 … 1.
    """
    passed = low_pass(problem, torch.full_like(problem.unit_hu, fidelity))
    sizes = [filtered(v, passed).flatten(1).norm(dim=1) for v in (left, problem.b)]
    return sizes[0] / sizes[1].clamp_min(torch.finfo(sizes[1].dtype).tiny)
