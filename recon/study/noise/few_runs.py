"""What a few noise realisations can and cannot establish about CNR tables.

The ROI means of all settings (kernels × voxel sizes) of one realisation come from one scan, so they are jointly normal
with a covariance that :mod:`recon.fbp.exact_noise` gives exactly. That makes three things computable: the truth (exact
CNR of every setting), what an experiment of n realisations would report (drawn from the joint law), and how sure a
measured table is (paired bootstrap over its realisations).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpcct.metrics.bootstrap import bca_interval, leave_one_out, resampling

__all__ = [
    "CLAIMS",
    "Claim",
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


# --- what the paper concludes from its tables -----------------------------------------------------------------------

Setting = tuple[str, float]
Holds = Callable[[Table, Sequence[Setting]], NDArray[np.bool_]]


@dataclass(frozen=True)
class Claim:
    """A statement of the paper about its tables, as a function of a table.

    Attributes:
        text: what it says.
        needs: settings that must be among those studied.
        holds: ``holds(table, settings)`` → booleans of the table's leading axes.
    """

    text: str
    needs: tuple[Setting, ...]
    holds: Holds


def _at(settings: Sequence[Setting], *wanted: Setting) -> list[int]:
    return [list(settings).index(w) for w in wanted]


def _best(settings: Sequence[Setting], table: Table, wanted: Setting) -> NDArray[np.bool_]:
    return np.asarray(table.cnr.argmax(-1) == _at(settings, wanted)[0])


def _top_two(table: Table, settings: Sequence[Setting]) -> NDArray[np.bool_]:
    order = np.argsort(-table.cnr, axis=-1)[..., :2]
    return np.asarray(np.isin(order, _at(settings, ("soft", 0.25), ("standard", 0.25))).all(-1))


def _groups(settings: Sequence[Setting], axis: int) -> list[list[int]]:
    """Indices of the settings that share their kernel (axis 0) or their voxel size (axis 1)."""
    return [
        [i for i, s in enumerate(settings) if s[axis] == value] for value in dict.fromkeys(s[axis] for s in settings)
    ]


def _smallest_at_quarter(
    figure: Floats, settings: Sequence[Setting], kernels: Sequence[str] | None = None
) -> NDArray[np.bool_]:
    """Whether, for every kernel (or those given), ``figure`` is smallest at 0.25 mm."""
    result = np.ones(figure.shape[:-1], dtype=bool)
    for members in _groups(settings, 0):
        if kernels is not None and settings[members[0]][0] not in kernels:
            continue
        sizes = [settings[i][1] for i in members]
        result &= figure[..., members].argmin(-1) == sizes.index(0.25)
    return result


def _soft_quietest(table: Table, settings: Sequence[Setting]) -> NDArray[np.bool_]:
    result = np.ones(table.noise.shape[:-1], dtype=bool)
    for members in _groups(settings, 1):
        names = [settings[i][0] for i in members]
        result &= table.noise[..., members].argmin(-1) == names.index("soft")
    return result


def _kernel_order(table: Table, settings: Sequence[Setting]) -> NDArray[np.bool_]:
    index = _at(settings, *((k, 0.25) for k in ("soft", "standard", "detail", "bone")))
    return np.asarray((np.diff(table.cnr[..., index], axis=-1) < 0).all(-1))


def _closest(table: Table, settings: Sequence[Setting]) -> NDArray[np.bool_]:
    from recon.study.paper import facts as paper

    reference = np.array([paper.NOISE_FREE_ROI_HU["foreground"], paper.NOISE_FREE_ROI_HU["background"]])
    return _smallest_at_quarter(np.abs(table.mean - reference).sum(-1), settings, ("soft", "standard"))


def _worst(table: Table, settings: Sequence[Setting]) -> NDArray[np.bool_]:
    return np.asarray(table.cnr.argmin(-1) == _at(settings, ("bone", 0.30))[0])


_SOFT, _QUARTER = ("soft", 0.25), tuple((k, 0.25) for k in ("soft", "standard", "detail", "bone"))

CLAIMS = (
    Claim("soft, 0.25 mm has the highest CNR", (_SOFT,), lambda t, s: _best(s, t, _SOFT)),
    Claim("soft and standard at 0.25 mm have the two highest CNRs", _QUARTER[:2], _top_two),
    Claim("at 0.25 mm the CNR falls from soft over standard and detail to bone", _QUARTER, _kernel_order),
    Claim("the soft kernel has the least noise at every voxel size", _QUARTER[:2], _soft_quietest),
    Claim(
        "the SD of the core's mean is smallest at 0.25 mm with every kernel",
        _QUARTER[:1],
        lambda t, s: _smallest_at_quarter(t.sd[..., 0], s),
    ),
    Claim("the means come closest to 40 and 92 HU at 0.25 mm (soft and standard)", _QUARTER[:2], _closest),
    Claim("bone, 0.30 mm has the lowest CNR", (("bone", 0.30),), _worst),
)
"""What the paper reads from its tables. All but the last are stated in its text; the last one is read off its table."""
