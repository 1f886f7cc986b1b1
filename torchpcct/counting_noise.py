"""Quantum noise that is a pure function of (seed, reading): the same for any thread count, crop or
order.

Each reading owns a random stream, keyed by the seed and by the reading's index on the full
detector. So a window of a scan carries exactly the noise that the full scan has there, and
realisations can be spread over machines. The stream is SplitMix64 (Steele, Lea, Flood 2014);
Poisson numbers come from Hörmann's transformed rejection PTRS (1993) for means of 10 and more, and
from inversion below; normal numbers from Box and Muller (1958).

An energy-integrating detector adds up the energies of a Poisson number of quanta:
:func:`compound_poisson`. A lower dose of counts that are there already is drawn by :func:`thinned`.
Other kernels that need random numbers take them from here too: :func:`seed_key`, :func:`stream` and
:func:`draw`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from numba import njit
from torch import Tensor

from torchpcct.threads import run
from torchpcct.validate import number

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike

    from torchpcct.typing import Ints, Reals

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""2⁶⁴ over the golden ratio: the increment of SplitMix64 (Steele, Lea and Flood 2014, OOPSLA)."""
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
"""First multiplier of its mixing (Stafford's variant 13)."""
_MIX2 = np.uint64(0x94D049BB133111EB)
"""Second multiplier."""
_S30 = np.uint64(30)
"""First shift of its mixing, bits."""
_S27 = np.uint64(27)
"""Second shift, bits."""
_S31 = np.uint64(31)
"""Third shift, bits."""
_S11 = np.uint64(11)
"""Bits that a float64 in 0 … 1 has no room for."""
_OPERATIONS = 50  # about those of a random number
"""Operations of a random number, about: for the choice of threads."""
_TO_UNIT = 1.0 / 9007199254740992.0  # 2**-53
"""2⁻⁵³: from 53 random bits to 0 … 1."""
_BELOW_ONE = 1.0 - _TO_UNIT
"""The largest float64 below 1."""
_NORMAL = 1e12
"""Mean from which on Poisson numbers are drawn as normal ones: their skewness is a millionth, and
the logarithms of probabilities would lose their last digit to rounding."""
_RARE = 1e-6
"""Of so many events, the probability below which those that happen are Poisson, to as much."""


@njit(inline="always", cache=True)
def _mix(z: np.uint64) -> np.uint64:
    z = (z ^ (z >> _S30)) * _MIX1
    z = (z ^ (z >> _S27)) * _MIX2
    return z ^ (z >> _S31)


@njit(inline="always", cache=True)
def stream(key: np.uint64, index: int) -> np.uint64:
    """State at which the random stream of an index begins, for a key of :func:`seed_key`."""
    return _mix(key ^ _mix(np.uint64(index) * _GOLDEN + _MIX2))


@njit(inline="always", cache=True)
def draw(state: np.uint64) -> tuple[np.uint64, float]:
    """Next state of a stream and a uniform number in the open interval (0, 1)."""
    state = state + _GOLDEN
    # The largest of them is rounded up to 1 before it is scaled.
    return state, min((np.float64(_mix(state) >> _S11) + 0.5) * _TO_UNIT, _BELOW_ONE)


@njit(inline="always", cache=True)
def _normal_variate(state: np.uint64) -> float:
    state, u = draw(state)
    state, v = draw(state)
    return math.sqrt(-2.0 * math.log(u)) * math.cos(2.0 * math.pi * v)


@njit(cache=True)
def _poisson_variate(mean: float, state: np.uint64) -> float:
    # Whole numbers stay floats: math.floor gives int64, which ends at 9e18.
    if mean >= _NORMAL:
        return np.floor(mean + math.sqrt(mean) * _normal_variate(state) + 0.5)
    if mean < 10.0:
        state, u = draw(state)
        p = math.exp(-mean)
        k = 0.0
        # P(k ≥ 200 | mean < 10) < 1e-180: a guard against round-off only
        while u > p and k < 200.0:
            u -= p
            k += 1.0
            p *= mean / k
        return k
    b = 0.931 + 2.53 * math.sqrt(mean)
    a = -0.059 + 0.02483 * b
    v_r = 0.9277 - 3.6224 / (b - 2.0)
    while True:
        state, u = draw(state)
        u -= 0.5
        state, v = draw(state)
        us = 0.5 - abs(u)
        k = np.floor((2.0 * a / us + b) * u + mean + 0.43)
        if us >= 0.07 and v <= v_r:
            return k
        if k < 0.0 or (us < 0.013 and v > us):
            continue
        # Nine in ten are done: the logarithms of the rest wait until here.
        inv_alpha = 1.1239 + 1.1328 / (b - 3.4)
        if math.log(v) + math.log(inv_alpha) - math.log(a / (us * us) + b) <= (
            k * math.log(mean) - mean - math.lgamma(k + 1.0)
        ):
            return k


@njit(cache=True)
def _binomial_variate(n: float, p: float, state: np.uint64) -> float:
    """Of ``n`` events those that happen, each with the probability ``p`` ≤ ½."""
    q = 1.0 - p
    ratio = p / q
    if n >= _NORMAL:
        if p < _RARE:
            return min(_poisson_variate(n * p, state), n)
        return min(
            max(np.floor(n * p + math.sqrt(n * p * q) * _normal_variate(state) + 0.5), 0.0), n
        )
    if n * p < 10.0:
        state, u = draw(state)
        share = math.exp(n * math.log1p(-p))
        k = 0.0
        while u > share and k < n:
            u -= share
            share *= ratio * (n - k) / (k + 1.0)
            k += 1.0
        return k
    sd = math.sqrt(n * p * q)
    b = 1.15 + 2.53 * sd
    a = -0.0873 + 0.0248 * b + 0.01 * p
    v_r = 0.92 - 4.2 / b
    alpha = (2.83 + 5.1 / b) * sd
    mode = np.floor((n + 1.0) * p)
    top = math.lgamma(mode + 1.0) + math.lgamma(n - mode + 1.0)
    while True:
        state, u = draw(state)
        u -= 0.5
        state, v = draw(state)
        us = 0.5 - abs(u)
        k = np.floor((2.0 * a / us + b) * u + n * p + 0.5)
        if us >= 0.07 and v <= v_r:
            return k
        if k < 0.0 or k > n:
            continue
        if math.log(v * alpha / (a / (us * us) + b)) <= (
            top - math.lgamma(k + 1.0) - math.lgamma(n - k + 1.0) + (k - mode) * math.log(ratio)
        ):
            return k


@njit(nogil=True, cache=True)
def _thinned_rows(
    begin: int, end: int, counts: Reals, first: Ints, fraction: float, key: np.uint64, out: Reals
) -> None:
    for i in range(begin, end):
        for j in range(counts.shape[1]):
            given = np.float64(counts[i, j])
            state = stream(key, first[i] + j)
            n = np.floor(given)
            if n < given:
                # A gain has made them no whole numbers: up or down, so that the mean stays.
                state, u = draw(state)
                n += 1.0 if u < given - n else 0.0
            if not abs(given) < math.inf:
                out[i, j] = np.nan
            elif n <= 0.0:
                out[i, j] = fraction * min(given, 0.0)
            elif fraction <= 0.5:
                out[i, j] = _binomial_variate(n, fraction, state)
            else:
                out[i, j] = n - _binomial_variate(n, 1.0 - fraction, state)


@njit(nogil=True, cache=True)
def _split_rows(
    begin: int, end: int, counts: Reals, chance: Reals, first: Ints, key: np.uint64, out: Reals
) -> None:
    for i in range(begin, end):
        for j in range(counts.shape[1]):
            n, p = np.float64(counts[i, j]), np.float64(chance[i, j])
            if not (0.0 <= n < math.inf and 0.0 <= p <= 1.0):
                out[i, j] = np.nan
            elif p <= 0.5:
                out[i, j] = (
                    0.0 if n * p == 0.0 else _binomial_variate(n, p, stream(key, first[i] + j))
                )
            else:
                out[i, j] = n - (
                    0.0 if p == 1.0 else _binomial_variate(n, 1.0 - p, stream(key, first[i] + j))
                )


@njit(nogil=True, cache=True)
def _poisson_rows(
    begin: int, end: int, mean: Reals, first: Ints, scale: float, key: np.uint64, out: Reals
) -> None:
    for i in range(begin, end):
        for j in range(mean.shape[1]):
            lam = np.float64(mean[i, j]) * scale
            if 0.0 < lam < math.inf:
                out[i, j] = _poisson_variate(lam, stream(key, first[i] + j))
            elif lam == 0.0:
                out[i, j] = 0.0
            else:
                out[i, j] = np.nan


@njit(nogil=True, cache=True)
def _normal_rows(begin: int, end: int, first: Ints, key: np.uint64, out: Reals) -> None:
    for i in range(begin, end):
        for j in range(out.shape[1]):
            out[i, j] = _normal_variate(stream(key, first[i] + j))


@njit(nogil=True, cache=True, error_model="numpy")
def _compound_rows(
    begin: int,
    end: int,
    mean: Reals,
    quantum: Reals,
    first: Ints,
    scale: float,
    key: np.uint64,
    out: Reals,
) -> None:
    for i in range(begin, end):
        for j in range(mean.shape[1]):
            q = np.float64(quantum[i, j])
            lam = np.float64(mean[i, j]) * scale / q
            if 0.0 < lam < math.inf and q > 0.0:
                out[i, j] = q * _poisson_variate(lam, stream(key, first[i] + j))
            elif lam == 0.0 and q > 0.0:
                out[i, j] = 0.0
            else:
                out[i, j] = np.nan


_QUANTA = 0
"""Stream of the random numbers of a reading's quanta; each purpose has its own."""
_ELECTRONICS = 1
"""Of its electronic noise."""
_THINNING = 2
"""Of the photons that a scan of lower dose loses."""
_THINNED_ELECTRONICS = 3
"""Of the electronic noise that is added to it."""
_SPLIT = 4
"""This and all after it: of the bins of :func:`split`."""


def seed_key(seed: int, purpose: int = _QUANTA) -> np.uint64:
    """Key of a seed's streams; ``TypeError`` or ``ValueError`` unless the seed is a whole number
    in 0 … 2**63 − 1."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer):
        raise TypeError(f"seed must be a whole number, got {seed!r}")
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed must lie in 0 … 2**63 - 1, got {seed}")
    with np.errstate(over="ignore"):
        start = (np.uint64(seed) ^ (np.uint64(purpose) << np.uint64(63))) * _GOLDEN + _MIX1
        return np.uint64(_mix.py_func(start + np.uint64(purpose >> 1) * _MIX2))


def _first(first: ArrayLike, rows: int) -> Ints:
    given = np.asarray(first)
    if given.dtype.kind not in "iu" and given.size:
        raise TypeError(f"first_index must hold whole numbers, got {given.dtype}")
    index = np.ascontiguousarray(given, dtype=np.int64).reshape(-1)
    if index.size != rows:
        raise ValueError(
            f"first_index must hold one index per row of the last axis, {rows}, got {index.size}"
        )
    return index


def _like(name: str, values: Tensor, other: str, like: Tensor) -> None:
    """Refuse readings of another shape than those they belong to."""
    if values.shape != like.shape:
        raise ValueError(
            f"{name} has shape {tuple(values.shape)}, {other} {tuple(like.shape)}: they must be "
            "equal"
        )


def _drawn(
    kernel: Callable[..., None],
    readings: tuple[Tensor, ...],
    first_index: ArrayLike,
    *parameters: object,
) -> Tensor:
    """What a kernel draws for readings ``(..., n)``, of the shape and dtype of the first."""
    like = readings[0]
    for values in readings:
        if not isinstance(values, Tensor) or values.dtype not in (torch.float32, torch.float64):
            kind = values.dtype if isinstance(values, Tensor) else type(values).__name__
            raise TypeError(
                f"readings must be float32 or float64 tensors, got {kind}: use .float() or "
                ".double()"
            )
        if values.shape != like.shape or values.dtype != like.dtype or not values.ndim:
            raise ValueError(
                f"readings must have one shape (..., n) and one dtype, got {tuple(values.shape)} "
                f"{values.dtype} beside {tuple(like.shape)} {like.dtype}"
            )
    shape = like.shape
    rows = [values.detach().cpu().contiguous().reshape(-1, shape[-1]) for values in readings]
    out = torch.empty_like(rows[0])
    arrays = [values.numpy() for values in rows]
    first, work = _first(first_index, len(out)), _OPERATIONS * shape[-1]
    run(kernel, len(out), *arrays, first, *parameters, out.numpy(), operations=work)
    return out.reshape(shape)


def poisson(mean: Tensor, first_index: ArrayLike, seed: int, scale: float = 1.0) -> Tensor:
    """Poisson counts with expectation ``scale * mean``.

    Args:
        mean: ``(..., n)`` float32 or float64 expectations ≥ 0 on the CPU.
        first_index: ``(...)`` whole numbers, the global index of the first reading of each row of
            ``n``.
        seed: realisation number, ≥ 0.
        scale: factor on ``mean`` (exposure).

    Returns:
        Tensor of the shape and dtype of ``mean``. A negative, infinite or NaN expectation gives
        NaN. From 10¹² counts on the numbers are normal ones, rounded.

    Raises:
        TypeError, ValueError: a seed that is no whole number ≥ 0, indices that do not match
            ``mean``, a mean of another kind, a scale that is negative or not finite.
    """
    return _drawn(
        _poisson_rows, (mean,), first_index, number("scale", scale, low=0.0), seed_key(seed)
    )


def compound_poisson(
    mean: Tensor,
    quantum: Tensor,
    first_index: ArrayLike,
    seed: int,
    scale: float = 1.0,
    electronic: float = 0.0,
) -> Tensor:
    """Signal of an energy-integrating detector: energies of a Poisson number of quanta, and
    electronic noise.

    With N(E) Poisson quanta of signal s(E), a reading Σ s(E) N(E) has the mean m = Σ s N̄ and the
    variance v = Σ s² N̄ (a compound Poisson law). It is drawn as q · Poisson(m / q) with q = v / m,
    the signal of an average quantum weighted by its signal: mean and variance are exact, readings
    are never negative and go to zero together with their mean. The third cumulant comes out as v² /
    m, short of the true Σ s³ N̄ by the factor Σ s² N̄ · Σ s² N̄ / (Σ s N̄ · Σ s³ N̄), which is 0.94
    in air and 0.96 behind 24 cm of fat at 100 kVp.

    Args:
        mean: ``(..., n)`` float32 or float64 expectations ≥ 0 on the CPU.
        quantum: the shape of ``mean``, q > 0 in the unit of ``mean``.
        first_index, seed, scale: as for :func:`poisson`; ``scale`` multiplies ``mean``, not
            ``quantum``.
        electronic: standard deviation of normal noise added to every reading, in the unit of
            ``mean``.

    Returns:
        Tensor of the shape and dtype of ``mean``; negative values only through ``electronic``. A
        negative or NaN expectation, or q ≤ 0, gives NaN.

    Raises:
        TypeError, ValueError: as :func:`poisson`; a ``quantum`` of another shape; ``electronic`` <
            0.
    """
    _like("quantum", quantum, "mean", mean)
    number("electronic", electronic, low=0.0)
    scale = number("scale", scale, low=0.0)
    out = _drawn(_compound_rows, (mean, quantum), first_index, scale, seed_key(seed))
    if electronic:
        added = normal(tuple(mean.shape), first_index, seed, mean.dtype, purpose=_ELECTRONICS)
        out.add_(added, alpha=float(electronic))
    return out


def thinned(
    counts: Tensor,
    first_index: ArrayLike,
    seed: int,
    fraction: float,
    quantum: Tensor | None = None,
    electronic: float = 0.0,
) -> Tensor:
    """Counts at a fraction of the dose: each event stays with that probability (binomial thinning).

    Of Poisson counts of mean λ the result is Poisson of mean ``fraction`` · λ, exactly. Readings
    that are no whole number of quanta are rounded up or down at random first. The signal of an
    energy-integrating detector is thinned as if all its quanta had the one size ``quantum``, and
    electronic noise is added until it is what it was: mean and variance are right, higher moments
    are approximate.

    Args:
        counts: ``(..., n)`` noisy readings, float32 or float64, on the CPU.
        first_index: ``(...)`` whole numbers, the global index of the first reading of each row of
            ``n``.
        seed: realisation number, ≥ 0.
        fraction: in (0, 1].
        quantum: the shape of ``counts``; None: 1.
        electronic: standard deviation of the electronic noise in ``counts``, which no dose changes.

    Returns:
        Shape and dtype of ``counts``; NaN where the counts are not finite.

    Raises:
        TypeError, ValueError: as :func:`poisson`; a fraction outside of (0, 1], a ``quantum`` of
            another shape or dtype, ``electronic`` < 0.
    """
    fraction = number("fraction", fraction, positive=True, high=1.0)
    number("electronic", electronic, low=0.0)
    if quantum is not None:
        _like("quantum", quantum, "counts", counts)
    quanta = counts if quantum is None else counts / quantum
    out = _drawn(_thinned_rows, (quanta,), first_index, fraction, seed_key(seed, _THINNING))
    if quantum is not None:
        out *= quantum
    if electronic:
        added = normal(
            tuple(counts.shape), first_index, seed, counts.dtype, purpose=_THINNED_ELECTRONICS
        )
        out.add_(added, alpha=float(electronic) * math.sqrt(1.0 - fraction**2))
    return out


def split(counts: Tensor, expected: Tensor, first_index: ArrayLike, seed: int) -> Tensor:
    """Counts of energy bins whose sum is given: multinomial with the shares that the bins have of
    the expected counts.

    Poisson counts that are split so are independent Poisson counts of the bins, exactly: what was
    drawn of the sum and what is read of the bins are then one realisation.

    Args:
        counts: ``(..., n)`` whole numbers ≥ 0, float32 or float64, on the CPU.
        expected: ``(bins, ..., n)`` ≥ 0, of each bin, in any unit; dtype of ``counts``.
        first_index: ``(...)`` whole numbers, the global index of the first reading of each row of
            ``n``.
        seed: realisation number, ≥ 0.

    Returns:
        ``(bins, ..., n)`` of the dtype of ``counts``; NaN where nothing is expected or a value is
        negative or not finite.

    Raises:
        TypeError, ValueError: as :func:`poisson`; ``expected`` of another shape, or without bins.
    """
    if expected.ndim != counts.ndim + 1 or not len(expected):
        raise ValueError(
            f"expected must have the shape (bins, …) of counts {tuple(counts.shape)}, got "
            f"{tuple(expected.shape)}"
        )
    out = torch.empty_like(expected)
    left, rest = counts.clone(), expected.sum(0, dtype=torch.float64)
    for k, own in enumerate(expected[:-1]):
        chance = (own / rest).clamp_(max=1.0).to(counts.dtype)
        # Nothing is left to share where all that is expected lies in the bins before.
        chance = torch.where((rest <= 0) & (left == 0) & (own == 0), 0.0, chance)
        key = seed_key(seed, _SPLIT + k)
        out[k] = _drawn(_split_rows, (left, chance), first_index, key)
        left -= out[k]
        rest -= own
    out[-1] = left
    return out


def normal(
    shape: tuple[int, ...],
    first_index: ArrayLike,
    seed: int,
    dtype: torch.dtype = torch.float32,
    purpose: int = _QUANTA,
) -> Tensor:
    """Standard normal numbers keyed like :func:`poisson`; ``shape`` is ``(..., n)``."""
    out = torch.empty((math.prod(shape[:-1]), shape[-1]), dtype=dtype)
    first, row = _first(first_index, len(out)), _OPERATIONS * shape[-1]
    run(_normal_rows, len(out), first, seed_key(seed, purpose), out.numpy(), operations=row)
    return out.reshape(shape)
