"""What a reconstruction has left in the data although it is no noise.

A prior takes away what looks like noise to it, and a pattern that it has not learned may look so:
fine bars, a weave, a thread. But the noise of the data is known, so whether the difference between
data and volume is noise can be asked. The step d = (H_c + δ)⁻¹ (β − H u) towards the data is cut
into overlapping blocks under a sine window, and each block is transformed. A coefficient counts as
structure if its size is more than :data:`_STRIKING` times what noise has there. So does a weaker
one that goes on from it: in a block nearby at the same frequency (:data:`_CONTINUED`), or at the
next frequency of the block (:data:`_BESIDE`; hysteresis, as for edges: Canny 1986, IEEE Trans.
Pattern Anal. Mach. Intell. 8:679). Their sum is what the volume lacks; all else stays noise
(thresholds: Donoho, Johnstone 1994, Biometrika 81:425). What is little beyond a threshold counts in
part (:data:`_WHOLE`): so the volume is a continuous function of the data, and its gradient says
what a small change of them does.

Noise alone passes the first threshold in one of six billion coefficients. A pattern that fills a
block is found while it is far too weak to be seen in a voxel, and from there on followed.

A compact body is no pattern: it spreads over many coefficients. So the volume is also asked for the
ball that it lacks most (:func:`missing_body`), by the matched filter ⟨t, β − H u⟩ over its noise
(Barrett, Myers 2004, Foundations of Image Science, 13.2.12). It is not put back, as what stands out
that far is denser than what the prior knows, and half of it comes back by that; a warning says so.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from recon.data_term import Quadratic
from recon.mbir.frequencies import (
    filtered,
    from_frequencies,
    squared_frequencies,
    to_frequencies,
)
from torchpcct.readings import MEDIAN_TO_SD

_BLOCK = 16
"""Edge of a block in voxels: at 0.2 mm 3.2 mm, some periods of the finest lines."""
_STEP = 4
"""Distance of neighbouring blocks in voxels."""
_STRIKING = 4.75
"""Threshold in root mean squares of a coefficient of noise from which a pattern is put back."""
_CONTINUED = 2.5
"""The same from which a pattern is that goes on from a striking one."""
_BESIDE = 1.5
"""The same from which it goes on beside one."""
_WHOLE = 1.1
"""What is so many times a threshold counts as a whole."""
_REACH = 2
"""Blocks on either side that a pattern may go on in."""
_AXES = (-3, -2, -1)
"""Of a volume."""
_DIAMETERS = (3.5, 5.0, 7.5)
"""Of the balls, in voxels: below, the data of an edge differ from those of its voxels by as much;
beyond, the data decide themselves."""
_STANDS_OUT = 7.0
"""Standard deviations of noise from which a ball is missing: noise alone has five in one of a
hundred insets, edges of sound vessels have 5.4 at 2 s."""
_LEAST_NOISE_HU = 36.5
"""Standard deviation of the smallest ball's contrast, estimated from the data alone, below which no
ball is asked for: what sharp edges leave in the data of voxels, up to 200 HU at the end of a lumen,
stands out of less noise."""
_MOST_NOISE = 1.5
"""What is left of the data in most places is taken for noise up to so many times their noise:
sound vessels have 1.34 at most. Beyond, it is what is missing."""


class MissingBody(NamedTuple):
    """A ball that the data hold and a volume does not.

    Attributes:
        diameter_mm: of the ball.
        contrast_hu: what is missing of its contrast, if it is a ball: of a thread or an edge it is
            up to three times too much.
        deviations: that, in standard deviations of noise.
        voxel: its place, (z, y, x) from 0.
    """

    diameter_mm: float
    contrast_hu: float
    deviations: float
    voxel: tuple[int, int, int]


def significant_residual(problem: Quadratic, spectrum: Tensor, u: Tensor, damping: float) -> Tensor:
    """What ``u`` lacks, ``(batch, z, y, x)``: 0 where nothing but noise is left, and in slices
    smaller than a block.

    Args:
        problem: normalised problem.
        spectrum: of H, :meth:`recon.data_term.Quadratic.spectrum`.
        u: the reconstruction, ``(batch, z, y, x)``.
        damping: δ of the step towards the data.
    """
    shape = u.shape[-3:]
    if min(shape[-2:]) < _BLOCK:
        return torch.zeros_like(u)
    inverse = 1.0 / (spectrum + damping)
    step = filtered(problem.left(u), inverse)
    correlation = from_frequencies(spectrum * inverse.square(), shape)
    # Slices of a stack that is thinner than a block are looked at one by one.
    edges = [_BLOCK if n >= _BLOCK else 1 for n in shape]
    along = [torch.sin(math.pi * (torch.arange(e) + 0.5) / e).to(u) for e in edges]
    window = along[0][:, None, None] * along[1][:, None] * along[2]
    noise = _noise(correlation, window)
    return torch.stack([_significant(v, window, n) for v, n in zip(step, noise, strict=True)])


@torch.no_grad()
def missing_body(problem: Quadratic, left: Tensor, kept: Tensor) -> list[MissingBody | None]:
    """Of each volume the ball that it lacks most, None where none stands out of noise, or where
    there is so little noise that edges do.

    Args:
        problem: normalised problem.
        left: β − H u, ``(batch, z, y, x)``.
        kept: how much of a frequency of β is left there where the prior has lost it, ``(batch, z,
            y, x//2 + 1)``: a data consistency takes low ones away.
    """
    shape = left.shape[-3:]
    f2 = squared_frequencies(shape, problem.voxel_mm, left)
    spectrum = to_frequencies(left)
    middle = torch.zeros_like(left)
    middle[..., shape[0] // 2, shape[1] // 2, shape[2] // 2] = 1.0
    at_middle = to_frequencies(middle)
    found: list[MissingBody | None] = [None] * len(left)
    noise_hu: list[float] = []
    for voxels in _DIAMETERS:
        rim = math.ceil(voxels / 2.0) + 1
        if 2 * rim >= min(shape):
            continue
        ball = _of_ball(f2, voxels * problem.voxel_mm)
        template = from_frequencies(at_middle * ball, shape)
        seen = from_frequencies(at_middle * ball * kept, shape)
        # In the middle of the volume, with H itself; towards the rim both are smaller.
        response = problem.apply(seen)
        deviation = (seen * response).sum(_AXES).sqrt()
        signal = (template * response).sum(_AXES)
        inside = (slice(None), *(slice(rim, n - rim) for n in shape))
        score = from_frequencies(spectrum * ball, shape)[inside]
        # A prior that sharpens leaves more in the data than their noise.
        typical = MEDIAN_TO_SD * score.abs().flatten(1).median(1).values
        unit = typical.clamp(deviation, _MOST_NOISE * deviation).clamp_min(
            torch.finfo(typical.dtype).tiny
        )
        unit_contrast = problem.unit_hu / ((math.pi / 6.0) * voxels**3)
        contrast = unit_contrast / signal
        if not noise_hu:
            in_data = (template * problem.apply(template)).sum(_AXES)
            noise_hu = (unit_contrast * in_data.rsqrt()).tolist()
        for k, own in enumerate(score):
            at = int(own.abs().argmax())
            z, y, x = (int(n) + rim for n in torch.unravel_index(torch.tensor(at), own.shape))
            most = float(own.flatten()[at])
            body = MissingBody(
                voxels * problem.voxel_mm,
                most * float(contrast[k]),
                abs(most) / float(unit[k]),
                (z, y, x),
            )
            before = found[k]
            if before is None or body.deviations > before.deviations:
                found[k] = body
    return [
        body if body and body.deviations >= _STANDS_OUT and noise >= _LEAST_NOISE_HU else None
        for body, noise in zip(found, noise_hu or [0.0] * len(left), strict=True)
    ]


def _of_ball(f2: Tensor, diameter: float) -> Tensor:
    """Fourier transform of a ball at squared frequencies, 1 at 0."""
    x = math.pi * diameter * f2.sqrt().clamp_min(1e-3 / diameter)
    return 3.0 * (torch.sin(x) - x * torch.cos(x)) / x**3


def _significant(step: Tensor, window: Tensor, noise: Tensor) -> Tensor:
    """The structure in one volume ``(z, y, x)``, given the mean square of noise of a block's
    coefficients."""
    edges = window.shape
    hops = [_STEP if e > 1 else 1 for e in edges]
    # Every voxel lies in as many blocks as the window's squares need to add up to a constant.
    before, after = [], []
    for e, hop, n in zip(edges, hops, step.shape, strict=True):
        extra = (e - n) % hop
        before.append(e - hop + extra // 2)
        after.append(e - hop + extra - extra // 2)
    padded = F.pad(step, [p for pair in zip(before[::-1], after[::-1], strict=True) for p in pair])
    counts = [(n - e) // hop + 1 for n, e, hop in zip(padded.shape, edges, hops, strict=True)]

    def row(volume: Tensor, z: int, y: int) -> Tensor:
        """What the blocks of a row along x hold of it."""
        return volume[z * hops[0] : z * hops[0] + edges[0], y * hops[1] : y * hops[1] + edges[1]]

    def blocks(z: int, y: int) -> Tensor:
        """Those of a row, ``(count, z, y, x)``."""
        return row(padded, z, y).unfold(-1, edges[2], hops[2]).movedim(-2, 0)

    rows = list(itertools.product(range(counts[0]), range(counts[1])))
    found, shares = [], [step.new_zeros(0)]
    for z, y in rows:
        # Most rows hold nothing striking: gradients go through those alone that do.
        with torch.no_grad():
            _, power = _transformed(blocks(z, y), window, noise)
            of_row = torch.nonzero(power > _STRIKING**2)
        found.append(torch.cat([of_row.new_tensor([z, y]).expand(len(of_row), 2), of_row], 1))
        if len(of_row):
            which, at = of_row[:, 0].unique(return_inverse=True)
            _, power = _transformed(blocks(z, y)[which], window, noise)
            shares.append(_beyond(_STRIKING, power[(at, *of_row[:, 1:].T)]))
    striking, share = torch.cat(found), torch.cat(shares)
    out = torch.zeros_like(padded)
    for z, y in rows:
        chosen = ((striking[:, :2] - striking.new_tensor([z, y])).abs() <= _REACH).all(1)
        near, of_near = striking[chosen, 2:], share[chosen]
        apart = torch.arange(counts[2], device=near.device)[:, None] - near[:, 0]
        which, pair = torch.nonzero(apart.abs() <= _REACH).T
        own = which.unique()
        if not len(own):
            continue
        coefficients, power = _transformed(blocks(z, y)[own], window, noise)
        place = _flat((torch.searchsorted(own, which), *near[pair, 1:].T), power.shape)
        largest = (
            torch.zeros_like(power)
            .flatten()
            .scatter_reduce(0, place, of_near[pair], "amax")
            .reshape(power.shape)
        )
        kept = coefficients * _structure(largest * _beyond(_CONTINUED, power), power)
        made = torch.fft.irfftn(kept, s=edges, dim=_AXES) * window
        for k, block in zip(own.tolist(), made, strict=True):
            row(out, z, y)[..., k * hops[2] : k * hops[2] + edges[2]] += block
    times = math.prod(e / (2 * hop) if e > 1 else 1.0 for e, hop in zip(edges, hops, strict=True))
    inside = tuple(slice(b, b + n) for b, n in zip(before, step.shape, strict=True))
    return out[inside] / times


def _transformed(blocks: Tensor, window: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Coefficients of windowed blocks ``(count, z, y, x // 2 + 1)``, and their squares over
    those of noise."""
    coefficients = torch.fft.rfftn(blocks * window, dim=_AXES)
    return coefficients, torch.view_as_real(coefficients).square().sum(-1) / noise


def _beyond(threshold: float, power: Tensor) -> Tensor:
    """How much coefficients of such a power count: 0 up to a threshold, 1 from :data:`_WHOLE`
    times it on."""
    share: Tensor = ((power / threshold**2 - 1.0) / (_WHOLE**2 - 1.0)).clamp(0.0, 1.0)
    return share


def _flat(place: tuple[Tensor, ...], shape: torch.Size) -> Tensor:
    """Positions in a flattened array of ``shape``."""
    at = torch.zeros_like(place[0])
    for index, n in zip(place, shape, strict=True):
        at = at * n + index
    return at


def _structure(striking: Tensor, power: Tensor) -> Tensor:
    """How much coefficients count: striking ones, and neighbours in frequency that are not small.

    Args:
        striking: ``(count, z, y, x // 2 + 1)``, 0 to 1; power: likewise, over that of noise.
    """
    # Frequencies are periodic, and those that rfftn leaves out are mirror images.
    mirrored = striking.flip((-3, -2)).roll((1, 1), (-3, -2))
    around = torch.cat([mirrored[..., 1:2], striking, mirrored[..., -2:-1]], -1)
    around = torch.cat([around[..., -1:, :], around, around[..., :1, :]], -2)
    around = torch.cat([around[..., -1:, :, :], around, around[..., :1, :, :]], -3)
    return F.max_pool3d(around[None], 3, 1)[0] * _beyond(_BESIDE, power)


def _noise(correlation: Tensor, window: Tensor) -> Tensor:
    """Mean square of the coefficients of windowed noise, ``(batch, z, y, x // 2 + 1)``.

    Args:
        correlation: of the noise, ``(batch, z, y, x)``, lag 0 first, periodic.
        window: of a block.
    """
    edges = window.shape
    both = tuple(2 * e for e in edges)
    overlap = from_frequencies(torch.fft.rfftn(window, s=both).abs().square(), both)
    lags = [torch.arange(1 - e, e) for e in edges]
    at = [lag % n for lag, n in zip(lags, correlation.shape[-3:], strict=True)]
    product = correlation[:, at[0][:, None, None], at[1][:, None], at[2]]
    product = product * overlap[lags[0][:, None, None], lags[1][:, None], lags[2]]
    for axis, (e, lag) in enumerate(zip(edges, lags, strict=True)):
        # The product is even under inversion, so the transform is real; along one axis it is not.
        phase = torch.exp(-2j * math.pi / e * torch.outer(torch.arange(e), lag)).to(product.device)
        product = torch.movedim(
            torch.tensordot(product.to(phase.dtype), phase, ([axis + 1], [1])), -1, axis + 1
        )
    noise = product.real[..., : edges[2] // 2 + 1].clamp_min(torch.finfo(correlation.dtype).tiny)
    # A coefficient that is its own mirror image is real, and reaches a threshold as often as a
    # complex one reaches that over √2: it counts as half of its square.
    own = [2 * torch.arange(e) % e == 0 for e in edges]
    real = own[0][:, None, None] & own[1][:, None] & own[2][: edges[2] // 2 + 1]
    return torch.where(real.to(noise.device), 2.0 * noise, noise)
