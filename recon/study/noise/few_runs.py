"""What a few noise realisations can and cannot establish about CNR tables.

The ROI means of all settings (kernels × voxel sizes) of one realisation come from one scan, so they are jointly normal
with a covariance that :mod:`recon.analytic.exact_noise` gives exactly. That makes three things computable: the truth
(exact CNR of every setting), what an experiment of n realisations would report (drawn from the joint law), and how sure
a measured table is (paired bootstrap over its realisations).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpcct.metrics.intervals import bca_interval, leave_one_out, resampling

__all__ = [
    "Pair",
    "Table",
    "exact_table",
    "few_run_tables",
    "kendall",
    "measured_table",
    "pair_differences",
    "resampled_tables",
]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Table:
    """Statistics of ROI means for every setting, any number of leading axes.

    Attributes:
        mean, sd: ``(..., settings, 2)`` HU: core, fibrous.
    """

    mean: Floats
    sd: Floats

    @property
    def cnr(self) -> Floats:
        """``(..., settings)``."""
        return np.asarray((self.mean[..., 1] - self.mean[..., 0]) / self.noise)

    @property
    def noise(self) -> Floats:
        """The CNR's denominator in HU, ``(..., settings)``."""
        return np.asarray(np.hypot(self.sd[..., 0], self.sd[..., 1]))


def exact_table(mean: Any, covariance: Any) -> Table:
    """The truth: expectation ``(settings, 2)`` and joint covariance ``(2 · settings, 2 · settings)`` of ROI means."""
    mean = np.asarray(mean, dtype=np.float64)
    return Table(mean, np.sqrt(np.diag(np.asarray(covariance))).reshape(mean.shape))


def measured_table(means: Any) -> Table:
    """From realisations: ``(..., n, settings, 2)`` ROI means."""
    values = np.asarray(means, dtype=np.float64)
    return Table(values.mean(-3), values.std(-3, ddof=1))


def few_run_tables(
    mean: Any, covariance: Any, realizations: int, draws: int, seed: int, groups: Sequence[int] | None = None
) -> Table:
    """Tables that experiments of a few realisations would report.

    Args:
        mean, covariance: as for :func:`exact_table`.
        realizations: noise realisations per experiment, at least 2.
        draws: number of experiments.
        seed: of the random numbers.
        groups: for every setting a label; settings of different labels are given noise of their own (as if every
            voxel size had been scanned anew). None: all settings are reconstructed from the same scans.

    Raises:
        ValueError: fewer than 2 realisations.
    """
    if realizations < 2:
        raise ValueError(f"realizations must be at least 2, got {realizations}")
    mean = np.asarray(mean, dtype=np.float64)
    matrix = np.array(covariance, dtype=np.float64)
    if groups is not None:
        label = np.repeat(np.asarray(groups), 2)
        matrix *= label[:, None] == label[None, :]
    values, vectors = np.linalg.eigh(matrix)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    rng = np.random.default_rng(seed)
    parts = []
    for start in range(0, draws, 1000):
        count = min(1000, draws - start)
        runs = rng.standard_normal((count, realizations, matrix.shape[0])) @ root.T
        parts.append(measured_table(mean + runs.reshape(count, realizations, *mean.shape)))
    return Table(np.concatenate([p.mean for p in parts]), np.concatenate([p.sd for p in parts]))


def resampled_tables(means: Any, draws: int, seed: int) -> Table:
    """Paired bootstrap of ``(n, settings, 2)`` ROI means: tables of ``draws`` resamples of the realisations."""
    return _tables(np.asarray(means, dtype=np.float64), resampling(len(means), draws, seed))


def _tables(values: Floats, indices: NDArray[np.int64]) -> Table:
    """Tables of resamples, by counts: moments are linear in how often each realisation was drawn."""
    n = len(values)
    size = indices.shape[1]
    counts = np.zeros((len(indices), n))
    np.add.at(counts, (np.arange(len(indices))[:, None], indices), 1.0)
    centre = values.mean(0)
    flat = (values - centre).reshape(n, -1)
    first, second = counts @ flat / size, counts @ flat**2 / size
    variance = np.clip(second - first**2, 0.0, None) * size / (size - 1)
    shape = (-1, *values.shape[1:])
    return Table(first.reshape(shape) + centre, np.sqrt(variance).reshape(shape))


@dataclass(frozen=True)
class Pair:
    """CNR of one setting minus that of another, from paired realisations.

    Attributes:
        first, second: indices of the settings.
        difference, low, high: measured, with its interval.
        exact: without sampling error.
    """

    first: int
    second: int
    difference: float
    low: float
    high: float
    exact: float

    @property
    def established(self) -> bool:
        """Whether the interval excludes zero."""
        return self.low > 0 or self.high < 0


def pair_differences(
    means: Any, exact: Table, pairs: Sequence[tuple[int, int]], *, level: float = 0.95, draws: int = 4000, seed: int = 0
) -> list[Pair]:
    """Differences of CNR between settings with paired bootstrap intervals (BCa).

    Args:
        means: ``(n, settings, 2)`` ROI means.
        exact: the truth.
        pairs: of settings.
        level: coverage of each interval.
        draws, seed: of the bootstrap; the same resamples serve all pairs.
    """
    values = np.asarray(means, dtype=np.float64)
    measured = measured_table(values).cnr
    boot = resampled_tables(values, draws, seed).cnr
    jackknife = _tables(values, leave_one_out(len(values))).cnr
    result = []
    for a, b in pairs:
        value = float(measured[a] - measured[b])
        low, high = bca_interval(value, boot[:, a] - boot[:, b], jackknife[:, a] - jackknife[:, b], level)
        result.append(Pair(a, b, value, low, high, float(exact.cnr[a] - exact.cnr[b])))
    return result


def kendall(a: Any, b: Any) -> Floats:
    """Kendall's τ_a between rankings ``(..., settings)`` (broadcast): 1 the same order, 0 unrelated, −1 reversed."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    i, j = np.triu_indices(a.shape[-1], 1)
    return np.asarray(np.sign((a[..., i] - a[..., j]) * (b[..., i] - b[..., j])).mean(-1))
