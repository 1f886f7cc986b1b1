"""Noise of two methods at equal resolution, in the plane and along z, without a truth: the dose
factor of noise.

A blur buys low noise with resolution, in whatever direction. So the reference, a linear method that
has smoothed nothing, is filtered until it shows what the method shows, and then its noise is
compared with the method's. Given are two volumes by each, of two scans with independent noise
(:mod:`torchpcct.metrics.half_split`).

1. Where. The cosine transforms of the two reference volumes are correlated in cells of one radial
   frequency in the plane and one frequency along z (the Fourier shell correlation, Rosenthal and
   Henderson, J. Mol. Biol. 333, 721, 2003). Only frequencies at which both show the same are looked
   at: elsewhere nobody can tell what of the object a method keeps, and low noise proves nothing. An
   object that does not change along z shows nothing of a blur along z; such a blur then changes
   neither of the two noises that are compared.
2. How sharp. The transfer is exp(k - Σ aᵢ sxⁱ - Σ bᵢ syⁱ - Σ cᵢ szⁱ), i = 1, 2, 3, s = sin²(π f)
   with f in cycles per voxel. (A Gaussian has the first order alone, as long as it is wide.) It
   solves Σ J (M - T R) = 0 in which method and reference are of different scans, so that noise
   drops out: neither low noise nor much of it makes a method sharper.
3. How noisy. The reference's difference is filtered by that transfer, and its variance over that of
   the method's difference is the factor. A linear filter of the reference gives 1, whatever the
   object and the noise.

The reference must not alias noise either: on voxels coarser than the detector's cells FBP does, the
more the sharper its kernel, and then every smoother method seems to save dose. Volumes do not tell;
see :func:`recon.evaluate.evaluate_scans`.

The interval is a jackknife over bricks of the volume, widened by twice what the factor changes
where the borders of the volume count, and by what the match itself may be off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import fft, stats

from torchpcct.metrics.half_split import AGREE, HalfSplit
from torchpcct.metrics.intervals import Estimate
from torchpcct.validate import checked

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


__all__ = ["EqualNoise", "noise_at_equal_resolution"]

Floats = NDArray[np.float64]

_CHANCE = 5.0
"""Standard deviations of a correlation by chance beyond which it counts."""
_RINGS = 0.15
"""Width of the cells over their frequency."""
_ORDERS = 3
"""Highest order of the polynomial in the frequency."""
_STEPS = 40
"""Steps of the fit at most."""
_SETTLED = 1e-5
"""Change of ln(factor) below which they end."""
_DAMPED = 0.03
"""Fraction of the noise's own curvature that shortens them."""
_FAINT = 0.01
"""Frequencies at which the reference has less of its largest noise power count less: no match
there is of use."""
_MOST = 160
"""Voxels along an axis that are looked at: of larger volumes those about the middle of the
region."""
_BRICKS = 5
"""Along each axis of the plane, and along z if there are slices enough."""
_LEAST = 8
"""Voxels: axes that are shorter are not cut into bricks, and have no border that is left out."""
_BORDER = 16
"""Voxels at each border that count less, a third of the axis at most: filters differ in how they
continue a volume."""
_ROUGH = "its transfer relative to the reference is no smooth function of the frequency"
"""Why there is no factor, for messages."""
_SMALL = "the region is too small to tell how certain its noise is"
"""The same."""
_WIDEST = math.log(100.0)
"""Half the interval of ln(factor), above which there is no factor."""
_MATCH = 0.01
"""Relative standard error of a factor by the match: of 1.00 for linear filters at most."""


@dataclass(frozen=True)
class EqualNoise:
    """What :func:`noise_at_equal_resolution` finds.

    Attributes:
        noise: standard deviation of a voxel of one volume by the method, at all frequencies.
        noise_shared: the same at the frequencies that the reference's volumes agree on.
        noise_reference: of the reference there, as sharp as the method.
        dose_factor: the ratio of the last two variances, with its 95 % interval; NaN with ``why``.
        f50_plane, f50_z: frequency at which half of the reference's signal is left, line pairs per
            mm, in the plane of the mean of y and x; inf: it does not fall so far as the object
            shows.
        shown_plane, shown_z: up to where the object shows it, line pairs per mm.
        why: there is no factor; empty if there is one.
    """

    noise: float
    noise_shared: float
    noise_reference: float
    dose_factor: Estimate
    f50_plane: float
    f50_z: float
    shown_plane: float
    shown_z: float
    why: str = ""


@checked
def noise_at_equal_resolution(
    method: HalfSplit, reference: HalfSplit, spacing: Sequence[float], region: object = None
) -> EqualNoise:
    """Compare the noise of a method with that of the reference, filtered to the method's
    resolution.

    Args:
        method: its volumes ``(z, y, x)`` of two scans of one object.
        reference: of the same scans by a linear method that has smoothed nothing: FBP, kernel
            "ram-lak".
        spacing: of the voxels, ``(z, y, x)`` mm.
        region: bool mask of the volume where noise is measured; resolution is that of all of it.
            None: everywhere.

    Raises:
        ValueError: volumes of other shapes or too small; constant volumes, or two that are the
            same, of which nothing can be measured; a region of fewer than two voxels.
    """
    pairs = [
        [np.asarray(v.numpy(), dtype=np.float64) for v in (p.first, p.second)]
        for p in (method, reference)
    ]
    shape = pairs[1][0].shape
    if (
        len(shape) != 3
        or min(shape[1:]) < _LEAST
        or any(v.shape != shape for pair in pairs for v in pair)
    ):
        shapes = ", ".join(str(v.shape) for pair in pairs for v in pair)
        raise ValueError(
            f"volumes (z, y, x) of one shape are needed, {_LEAST} voxels or more in y and x; got "
            f"{shapes}"
        )
    for name, pair in zip(("method", "reference"), pairs, strict=True):
        if any(np.ptp(v) <= 1e-6 * np.abs(v).max() for v in pair):
            raise ValueError(
                f"the {name} has a constant volume, whose noise cannot be measured: check that the "
                "volume was read correctly"
            )
        one, other = pair
        if np.array_equal(one, other):
            raise ValueError(
                f"the {name} has two equal volumes: give those of two scans, or of two halves of "
                "one"
            )
    mask = np.ones(shape, bool) if region is None else np.asarray(region, bool)
    if mask.shape != shape or mask.sum() < 2:
        raise ValueError(
            f"region must be a mask of the shape {shape} with two voxels or more, got "
            f"{mask.shape}, {int(mask.sum())} voxels"
        )
    part = _part(mask)
    pairs = [[v[part] for v in pair] for pair in pairs]
    first, second = (list(pair) for pair in pairs)
    matches = (
        _Match(first, second, tuple(float(s) for s in spacing), orders)
        for orders in range(_ORDERS, 0, -1)
    )
    found = [next(matches).compared(mask[part])]
    while found[-1].why == _ROUGH and len(found) < _ORDERS:
        found.append(next(matches).compared(mask[part]))
    return found[-1]


def _part(mask: NDArray[np.bool_]) -> tuple[slice, ...]:
    """Of a large volume what lies about the middle of the region."""
    cut = []
    for axis, n in enumerate(mask.shape):
        inside = np.flatnonzero(mask.any(tuple(a for a in range(3) if a != axis)))
        first = int(np.clip((inside[0] + inside[-1] + 1 - _MOST) // 2, 0, max(n - _MOST, 0)))
        cut.append(slice(first, first + min(n, _MOST)))
    return tuple(cut)


class _Cells:
    """Cells of a volume's cosine transform: rings in the plane times layers along z."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        z, y, x = (np.arange(n) / (2.0 * n) for n in shape)
        self.plane, self.along = np.hypot(y[:, None], x), z
        rings, layers = (
            self._numbered(f, n) for f, n in ((self.plane, min(shape[1:])), (z, shape[0]))
        )
        self.rings, self.shape = int(rings.max()) + 1, (int(layers.max()) + 1, int(rings.max()) + 1)
        self._ring, self._layer = rings.ravel(), layers

    @staticmethod
    def _numbered(frequency: Floats, voxels: int) -> NDArray[np.int64]:
        """Index of the cell: of one sample each where they are far apart, of a fixed relative
        width beyond."""
        step, edges = 1.0 / (2 * voxels), [0.5 / (2 * voxels)]
        while edges[-1] < frequency.max():
            edges.append(edges[-1] + max(step, _RINGS * edges[-1]))
        return np.searchsorted(edges, frequency, side="right")

    def sums(self, values: Floats) -> Floats:
        """Of every cell, ``shape``."""
        found = np.zeros(self.shape)
        for layer, plane in zip(self._layer, values, strict=True):
            found[layer] += np.bincount(self._ring, plane.ravel(), self.rings)
        return found

    def spread(self, cells: ArrayLike) -> Floats:
        """A value for every sample."""
        return np.asarray(cells)[self._layer][:, self._ring].reshape(
            len(self._layer), *self.plane.shape
        )


class _Match:
    """A method's transfer relative to the reference, and both noises.

    Args:
        method, reference: two volumes each, float64.
        spacing: mm.
        orders: terms for each direction.
    """

    def __init__(
        self, method: list[Floats], reference: list[Floats], spacing: tuple[float, ...], orders: int
    ) -> None:
        self.spacing, self.method, self.orders = spacing, method, orders
        self.shape = shape = method[0].shape
        self.cells = _Cells(shape)
        hats = [fft.dctn(v, norm="ortho") for v in reference]
        number = self.cells.sums(np.ones(shape))
        powers = [self.cells.sums(h * h) for h in hats]
        power = np.maximum(np.sqrt(powers[0] * powers[1]), 1e-300)
        agree = self.cells.sums(hats[0] * hats[1]) / power
        # Fisher's z, which also holds of few samples that agree well.
        z = np.arctanh(np.clip(agree, 0.0, 1.0 - 1e-12)) * np.sqrt(np.maximum(number - 2.0, 0.0))
        known = (agree > AGREE) & (z > _CHANCE)
        known[0, 0] = False  # the mean, which any offset changes
        self.known = known
        self.shared = self.cells.spread(known)
        # White where they are compared, so that every frequency counts.
        loud = self.cells.sums((hats[0] - hats[1]) ** 2) / number
        counts = np.minimum(loud / (_FAINT * loud.max()), 1.0)
        self._white = self.cells.spread(np.where(known, np.sqrt(counts * number / power), 0.0))
        self._hats = hats
        z, y, x = (np.sin(np.pi * np.arange(n) / (2.0 * n)) ** 2 for n in shape)
        axes = [y[None, :, None], x[None, None], *([z[:, None, None]] if shape[0] > 1 else [])]
        self._terms = [-np.ones((1, 1, 1)), *(s**i for s in axes for i in range(1, orders + 1))]
        self._weight = math.prod(np.ix_(*(_taper(n) for n in shape)), start=np.ones(()))
        self._brick = _bricks(shape)

    def transfer(self, theta: Floats) -> Floats:
        """Of every sample of the cosine transform."""
        exponent = sum(
            (t * term for t, term in zip(theta, self._terms, strict=True)), np.zeros((1, 1, 1))
        )
        return np.exp(np.clip(-exponent, -30.0, 3.0))

    def _inverse(self, hat: Floats) -> Floats:
        return fft.idctn(hat, norm="ortho")

    def _start(self) -> Floats | None:
        """By what the method does with the reference's noise: of linear methods the transfer
        itself; None: at the frequencies that the object shows the method keeps nothing."""
        difference = fft.dctn(self.method[0] - self.method[1], norm="ortho")
        own = self._hats[0] - self._hats[1]
        number = self.cells.sums(self.shared.astype(np.float64))
        power = self.cells.sums(own * own)
        ratio = self.cells.sums(difference * own) / np.maximum(power, 1e-300)
        use = (number > 0) & (ratio > 0.02)
        if not use.any():
            return None
        # Terms of the first order alone: those of higher ones follow when the first are right.
        few = [0, *range(1, len(self._terms), self.orders)]
        mean = [self.cells.sums(self._terms[k] * self.shared) / np.maximum(number, 1) for k in few]
        weight = np.sqrt(number[use]) * ratio[use]
        right = -np.log(ratio[use]) * weight
        left = np.stack([m[use] for m in mean], axis=-1) * weight[:, None]
        theta = np.zeros(len(self._terms))
        theta[few] = np.linalg.lstsq(left, right, rcond=1e-6)[0]
        return theta

    def _equations(self, theta: Floats, weight: Floats) -> tuple[Floats, Floats, Floats]:
        """Of Gauss and Newton, of every brick: ``(bricks, terms, terms)`` and ``(bricks, terms)``;
        and the first with both factors of one scan, ``(terms, terms)``, which noise makes larger
        but never indefinite."""
        transfer = self.transfer(theta)
        misfits = [
            self._inverse(self._white * (m - transfer * r))
            for m, r in zip(self._sought, self._hats, strict=True)
        ]
        slopes = [
            [self._inverse(-self._white * term * transfer * r) for term in self._terms]
            for r in self._hats
        ]
        n = len(self._terms)
        left, right = np.zeros((self._brick.max() + 1, n, n)), np.zeros((self._brick.max() + 1, n))
        alone = np.zeros((n, n))
        for i in range(n):
            right[:, i] = (
                self._of_bricks(slopes[0][i] * misfits[1] + slopes[1][i] * misfits[0], weight) / 2
            )
            for j in range(i, n):
                both = slopes[0][i] * slopes[1][j] + slopes[1][i] * slopes[0][j]
                left[:, i, j] = left[:, j, i] = self._of_bricks(both, weight) / 2
                own = slopes[0][i] * slopes[0][j] + slopes[1][i] * slopes[1][j]
                alone[i, j] = alone[j, i] = float((own * weight).sum()) / 2
        return left, right, alone

    def _of_bricks(self, values: Floats, weight: Floats) -> Floats:
        found = np.bincount(self._brick.ravel(), (values * weight).ravel(), self._brick.max() + 1)
        return np.asarray(found, dtype=np.float64)

    def _fitted(self, theta: Floats) -> tuple[Floats, Floats, Floats] | None:
        """Parameters and the last equations; None: no transfer of this form explains what the
        method shows."""
        self._sought = [fft.dctn(v, norm="ortho") for v in self.method]
        own = self._hats[0] - self._hats[1]
        for _ in range(_STEPS):
            left, right, alone = self._equations(theta, self._weight)
            step = _solved(left.sum(0) + _DAMPED * alone, right.sum(0))
            step *= min(1.0, 1.0 / max(np.abs(step).max(), 1e-300))
            before, after = (
                float(np.square(self.shared * self.transfer(t) * own).sum())
                for t in (theta, theta + step)
            )
            theta = theta + step
            if abs(after - before) <= _SETTLED * before:
                return theta, left, right
        return None

    def compared(self, mask: NDArray[np.bool_]) -> EqualNoise:
        """See :func:`noise_at_equal_resolution`."""
        difference = self.method[0] - self.method[1]
        noise = float(difference[mask].std() / math.sqrt(2.0))
        shown = [
            float(np.max(f[at], initial=0.0)) / s
            for f, at, s in (
                (np.broadcast_to(self.cells.plane, self.shape), self.shared, self.spacing[-1]),
                (
                    np.broadcast_to(self.cells.along[:, None, None], self.shape),
                    self.shared,
                    self.spacing[0],
                ),
            )
        ]

        def without(why: str) -> EqualNoise:
            nothing = Estimate(math.nan, math.nan, math.nan)
            return EqualNoise(
                noise, math.nan, math.nan, nothing, math.inf, math.inf, shown[0], shown[1], why
            )

        if not noise > 0.0:
            return without(
                "its two volumes do not differ in the region: does it lie outside of what was "
                "measured?"
            )
        if not self.shared.any():
            return without("the two volumes of the reference have nothing in common but noise")
        start = self._start()
        if start is None:
            return without("the object shows nothing at the frequencies that the method keeps")
        fitted = self._fitted(start)
        if fitted is None:
            return without(_ROUGH)
        theta, left, right = fitted
        transfer = self.transfer(theta)
        own = self._hats[0] - self._hats[1]
        reference = self._inverse(self.shared * transfer * own)
        method = self._inverse(self.shared * fft.dctn(difference, norm="ortho"))
        slopes = [
            -2.0 * reference * self._inverse(self.shared * term * transfer * own)
            for term in self._terms
        ]
        weight = self._weight * mask
        above, below = (self._of_bricks(v * v, weight) for v in (reference, method))
        if not below.sum() > 0:
            return without("its two volumes do not differ where the object shows something")
        value = math.log(above.sum() / below.sum())
        slope = np.stack([self._of_bricks(s, weight) for s in slopes], axis=-1)
        rest = []
        for k in np.flatnonzero(self._of_bricks(np.ones(self.shape), weight) > 0):
            change = _solved(left.sum(0) - left[k], right.sum(0) - right[k])
            up, down = above.sum() - above[k], below.sum() - below[k]
            if not min(up, down) > 0.0:
                return without(_SMALL)
            rest.append(math.log(up / down) + float((slope.sum(0) - slope[k]) @ change) / up)
        if len(rest) < 3:
            return without(_SMALL)
        borders = np.ones(self.shape)
        left, right, _ = self._equations(theta, borders)
        all_ = [float((v * v * mask).sum()) for v in (reference, method)]
        change = _solved(left.sum(0), right.sum(0)) @ [float((s * mask).sum()) for s in slopes]
        moved = math.log(all_[0] / all_[1]) + float(change) / all_[0] - value
        n = len(rest)
        drawn = (n - 1) / n * float(np.square(np.array(rest) - np.mean(rest)).sum())
        error = math.sqrt(drawn + (2.0 * moved) ** 2 + _MATCH**2)
        half = float(stats.t.ppf(0.975, n - 1)) * error
        if not half <= _WIDEST:
            return without(
                "these volumes do not tell its resolution: the interval of its factor would be as "
                f"wide as {math.exp(min(value - half, 700.0)):.2g} to "
                f"{math.exp(min(value + half, 700.0)):.2g}"
            )
        factor = Estimate(*(math.exp(min(v, 700.0)) for v in (value, value - half, value + half)))
        one = float(weight.sum()) * 2.0
        sharp = [
            self._f50(theta, axes, limit) for axes, limit in zip(((0, 1), (2,)), shown, strict=True)
        ]
        return EqualNoise(
            noise,
            math.sqrt(below.sum() / one),
            math.sqrt(above.sum() / one),
            factor,
            sharp[0],
            sharp[1],
            shown[0],
            shown[1],
        )

    def _f50(self, theta: Floats, axes: Sequence[int], limit: float) -> float:
        """Along an axis, or the mean of several; the factor k is no matter of sharpness.

        Args:
            theta: parameters.
            axes: 0, 1: of the plane, y and x; 2: along z.
            limit: up to where the object shows it, line pairs per mm.
        """
        of_axes = theta[1:].reshape(-1, self.orders)
        if max(axes) >= len(of_axes):
            return math.inf
        f = np.linspace(0.0, 0.5, 2001)
        s = np.sin(np.pi * f) ** 2
        exponent = sum(t * s**i for i, t in enumerate(of_axes[list(axes)].mean(0), start=1))
        below = np.flatnonzero(np.asarray(exponent) >= math.log(2.0))
        spacing = self.spacing[0] if axes == (2,) else self.spacing[-1]
        found = float(f[below[0]]) / spacing if below.size else math.inf
        return found if found <= limit else math.inf


def _solved(left: Floats, right: Floats) -> Floats:
    """Least squares of the normal equations; what they do not determine stays as it is."""
    scale = np.sqrt(np.maximum(np.abs(np.diag(left)), 1e-300))
    found: Floats = (
        np.linalg.lstsq(left / np.outer(scale, scale), right / scale, rcond=1e-7)[0] / scale
    )
    return found


def _taper(n: int) -> Floats:
    """From 0 at the borders to 1 within."""
    weight = np.ones(n)
    if n >= _LEAST:
        m = min(n // 3, _BORDER)
        rise = np.sin(np.pi / 2 * (np.arange(m) + 0.5) / m) ** 2
        weight[:m], weight[n - m :] = rise, rise[::-1]
    return weight


def _bricks(shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Number of the brick of every voxel."""
    counts = [2 if shape[0] >= 2 * _LEAST else 1, _BRICKS, _BRICKS]
    parts = [np.arange(n) * k // n for n, k in zip(shape, counts, strict=True)]
    return (parts[0][:, None, None] * _BRICKS + parts[1][:, None]) * _BRICKS + parts[2]
