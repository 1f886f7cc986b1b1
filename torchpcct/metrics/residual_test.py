"""Does a volume explain its data? Tests of the residual y − A x that know their own rate of false
alarms.

χ² per reading alone sees little: an error of the rotation centre by half a column moves an image by
25 HU and χ² by a few per cent. What an error of the scanner does to the readings is known, however,
up to its size. The score test (Rao 1948) of one cause projects the residual onto that pattern t,

    s = ⟨t, W r⟩ / √⟨t, W t⟩,

which is normal with variance 1 if only noise is left; several patterns of one cause are tested
together by their χ². What the reconstruction has taken up of the pattern makes s smaller, never
larger, so the rate of false alarms stays below the stated one. Blur by a prior is symmetric about
an edge, and does not look like a shift.

Voxels do not draw edges where they are: readings at a step of the fitted ones miss by a part of it,
in clear data by many times their noise. χ² is tested in the other readings, which no voxel's size
moves, gains with that part of a step as noise of its own; what is left at steps is a finding where
it is more than the noise itself.

What voxels leave of a sound scan also lies off by whole views and rows: an object that ends within
a row covers more of it in views in which it is nearer to the source, and a fit spreads what it
cannot explain. It differs from column to column, however, where a gain, or an angle, does the same
to all columns of a view. Their common part is therefore compared with that in which blocks of
columns differ (analysis of variance; Fisher 1925, Statistical Methods for Research Workers), after
what looks like the object itself has been taken out where nobody knows where it ends: in the
outermost rows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from scipy import special, stats
from torch import Tensor

from torchpcct.metrics.residual_sums import TINY, Weighted, level_weights, readings, sums
from torchpcct.validate import checked, coverage, number

__all__ = ["ResidualTest", "residual_test"]

FALSE_ALARMS = 0.005
"""Share of faultless scans for which any of the tests raises an alarm."""
MISFIT = 0.03
"""Part of χ² that voxels and prior may add or take away without being an error: discretisation and
blur of edges that the data see; 1 % on the paper's plaque."""
COARSE = 1.0
"""Part of χ² that voxels may add at edges without being a finding: as much as noise itself."""
_FEWEST_QUIET = 200
"""Readings without edges below which χ² beside edges is not tested."""
_FEWEST_BENDS = 8
"""Cells with two neighbours from which the variance of their gains is known."""
GAIN_TOLERANCE = 0.001
"""Gain error (rms over views or rows) that a sound scan may have: calibration, and what voxels
cannot show."""
CENTRE_TOLERANCE = 0.05
"""Columns beside their place that are no finding: noise in millions of readings tells a hundredth,
which voxels and interpolation leave. A reconstruction takes most of an error up: a column off
leaves the more."""
ANGLE_TOLERANCE = 0.05
"""Steps (rms) by which views may lie beside their angles."""
LEAK = (0.02, 0.06)
"""Part of what voxels leave at edges, in χ², that looks like a shift of the columns, or that the
fit spreads over the other readings of whole views or rows, where nothing is wrong: of thin plates
and caps between two slices 2 % and up to 4 %; and what is added of it beyond :data:`COARSE`, where
a finding says that voxels are too coarse."""
_ROWS = 10
"""Rows of which this part, and of rows :data:`GAIN_TOLERANCE`, are so much; of fewer they are
more."""
_DENSE = 0.8
"""Quantile of the line integrals from which on rays are dense: the densest fifth."""
_DENSE_SHARE = 2.0
"""How many times more the dense rays must lie off than the others for beam hardening."""
_HARMONICS = 3
"""Harmonics of the turn that are fitted to the views."""
_BLOCKS = 8
"""Blocks of columns whose gains are compared."""
COMMON = 5.0
"""How many times larger than by what blocks of columns differ their common gain must be: what
voxels leave is alike in neighbouring blocks, in 220 sound cone scans up to 4 times (tubes that
drift by 2 %: 7 to 145 times)."""
COMMON_SLOW = 8.0
"""The same of slow drifts: in sound scans up to 30 times in seven patterns together (drifts by 2 %:
54 times and more)."""
_LARGE = 1e5
"""Mean from which on the tails of χ² are those of a transformed normal."""


@dataclass(frozen=True)
class ResidualTest:
    """Result of :func:`residual_test`.

    Attributes:
        chi2: weighted squared residual per reading.
        p_values: cause → probability that noise alone looks like it at least so much.
        sizes: cause → its estimated size where it has one: ``centre`` in columns, ``angles`` in
            steps between views (rms).
        findings: what was found, in words; empty: nothing at the stated rate of false alarms.
    """

    chi2: float
    p_values: Mapping[str, float]
    sizes: Mapping[str, float]
    findings: tuple[str, ...]


@checked
def residual_test(
    residual: Tensor,
    weights: Tensor,
    fitted: Tensor,
    *,
    unknowns: int = 0,
    false_alarms: float = FALSE_ALARMS,
) -> ResidualTest:
    """Test what a reconstruction has left of its data.

    Args:
        residual: y − A x ``(views, rows, columns)``, views in the order of their angles.
        weights: inverse variances of y, the same shape; 0 for readings to leave out.
        fitted: A x, the same shape: an error of the centre shifts its columns.
        unknowns: number of values that were fitted, by which χ² may be lower.
        false_alarms: share of faultless scans with any finding, shared among the tests.

    Returns:
        The tests ``level`` (χ² itself, at edges and beside them), ``centre`` (a shift of the
        columns), ``angles`` (views beside their angles), ``views`` (gain from view to view and its
        slow drift over the scan), ``rows`` (gain from row to row).

    Raises:
        ValueError: shapes that differ or have not three axes, negative weights or none at all, NaN
            or Inf where the weight is not 0, a rate outside (0, 1).
    """
    coverage("false_alarms", false_alarms)
    number("unknowns", unknowns, low=0)
    if residual.ndim != 3 or residual.shape != weights.shape or residual.shape != fitted.shape:
        raise ValueError(
            "residual, weights and fitted must have one shape (views, rows, columns), got "
            f"{tuple(residual.shape)}, {tuple(weights.shape)} and {tuple(fitted.shape)}"
        )
    of = sums(residual, weights, fitted)
    few = of.quiet < min(_FEWEST_QUIET, of.count / 2)
    if few or not of.level:
        of = sums(residual, weights, fitted, all_quiet=few, all_level=not of.level)
    count, chi2 = of.count, of.chi2 / of.count
    level = false_alarms / 5.0
    p_values, sizes, findings = {}, {}, []

    # χ²: too low only if the noise is less than stated, by more than what the unknowns have taken
    # up.
    chi2_calm = of.quiet_chi2 / of.quiet
    spread, spread_calm = math.sqrt(2.0 / count), math.sqrt(2.0 / of.quiet)
    calm = of.quiet_cells
    gains = _gains(calm, _gain_variance(calm, of.quiet)) / of.quiet
    # Of edges alone nobody knows what voxels leave.
    above = -math.inf if few else (chi2_calm - 1.0 - MISFIT - gains) / spread_calm
    below = (1.0 - MISFIT - min(unknowns / count, 1.0) - chi2) / spread
    coarse = (chi2 - 1.0 - MISFIT - COARSE) / spread
    p_values["level"] = float(min(1.0, 3.0 * stats.norm.sf(max(above, below, coarse))))
    if p_values["level"] < level:
        if coarse > max(above, below):
            findings.append(
                f"at edges the data differ from the volume by many times their noise ({chi2:.4g} "
                f"times their stated noise variance over all readings, {chi2_calm:.4g} beside "
                "edges): the voxels are too coarse for data as clear as these, so that edges "
                "ring, or the geometry is not that of the scan; smaller voxels show which"
            )
        else:
            size, error = (chi2_calm, spread_calm) if above >= below else (chi2, spread)
            findings.append(
                f"the data differ from the volume by {size:.4g} times their stated noise variance "
                f"(1 ± {error:.2g} expected): exposure, geometry or exterior are not those of the "
                "scan, or something outside of the grid was left out"
            )

    # Of few rows those between two slices are many, of one row none are.
    rows = max(1.0, _ROWS / residual.shape[1]) if residual.shape[1] > 1 else 1.0
    leaks = rows * sum(
        part * min(max(chi2 - 1.0 - least, 0.0) * count, of.of_voxels)
        for part, least in zip(LEAK, (0.0, COARSE), strict=True)
    )

    score, power = of.shift
    if power > 0.0:
        score /= math.sqrt(power)
        p_values["centre"], sizes["centre"] = (
            float(2.0 * stats.norm.sf(abs(score))),
            score / math.sqrt(power),
        )
        large = abs(sizes["centre"]) > CENTRE_TOLERANCE and score * score > leaks
        if p_values["centre"] < level and large:
            findings.append(
                f"the readings lie {abs(sizes['centre']):.2g} columns or more beside what the "
                f"volume projects to ({abs(score):.1f} standard deviations): the rotation centre "
                "(the detector's column offset) is wrong"
            )

    total, weight = of.turned
    if bool((weight > 0).any()):
        tolerated = ANGLE_TOLERANCE**2 * float(weight.sum())
        p_values["angles"] = _in_common(total, weight, None, tolerated)
        known = weight.sum(1) > 0
        off = total.sum(1)[known] / weight.sum(1)[known]
        excess = float((off.square() * weight.sum(1)[known] - 1.0).sum() / weight.sum())
        sizes["angles"] = math.sqrt(max(excess, 0.0))
        # A wrong centre moves views, too.
        if p_values["angles"] < level and not any("rotation centre" in text for text in findings):
            findings.append(
                f"the views lie about {sizes['angles']:.1g} of a step or more beside the described "
                "angles: the gantry does not turn evenly, or the object trembles; give the "
                "measured angle of each view"
            )

    of_cells = _gain_variance(of.level_cells, of.level)
    for name, axes, parts in (("views", (1, 2), 4), ("rows", (0, 2), 2)):
        gain = GAIN_TOLERANCE * (rows if name == "rows" else 1.0)
        patterns: list[Tensor | None] = [None]
        # Every view alone, and the slow drifts over all of them, which add up what single views
        # cannot tell.
        if name == "views" and len(residual) > 4 * _HARMONICS:
            patterns.append(_slow(len(residual)))
        # Whatever lies off in rows that end in others, by more than all that voxels leave.
        some = of.views if name == "views" else of.rows
        total, weight = some.inner
        noisier = 1.0 + (some.of_voxels + of_cells * some.inner_squared) / weight.clamp_min(TINY)
        weight, total = weight / noisier, total / noisier
        tolerated = gain**2 * float(weight.sum()) + leaks
        tails = [_upper_tail(*_alike(total, weight, p), tolerated) for p in patterns]
        # What all columns have in common, by more than voxels leave: that differs among them.
        total, weight = some.beside
        noise = of_cells * some.beside_squared[:, None]
        noisier = 1.0 + noise / weight.sum(1, keepdim=True).clamp_min(TINY)
        weight, total = weight / noisier, total / noisier
        # Faces in some rows leave gains of others, alike in all columns; of views they do not.
        tolerated = gain**2 * float(weight.sum()) + (leaks if name == "rows" else 0.0)
        tails += [_in_common(total, weight, p, tolerated) for p in patterns]
        p_values[name] = float(min(1.0, parts * min(tails)))
        if p_values[name] < level:
            w, r, lines = readings(residual, weights, fitted)
            w = w if of.all_level else level_weights(w, lines)
            weight = _sum(w, axes)
            known = weight > 0
            size = float((_sum(w * r, axes)[known] / weight[known]).square().mean().sqrt())
            findings.append(
                f"the readings of some {name} lie above or below what the volume projects to, "
                f"{100 * size:.2g} % of intensity (root mean square): "
                f"{_cause(name, w, w * r, lines, axes)}"
            )
    return ResidualTest(chi2, p_values, sizes, tuple(findings))


def _sum(values: Tensor, axes: int | tuple[int, ...]) -> Tensor:
    return values.sum(axes).double()


def _gain_variance(of: Weighted, readings: int) -> float:
    """Variance of the gains of single cells, which the noise of air leaves: constant over the
    views, and independent from column to column. At most that of one frame of air at the scan's own
    exposure, whose noise is that of a reading.

    Args:
        of: of the cells ``(rows, columns)``.
        readings: of positive weight, from which the sums are.
    """
    cells = of.weight
    gains = of.total / cells
    bend = gains[:, :-2] - 2.0 * gains[:, 1:-1] + gains[:, 2:]
    of_noise = (1.0 / cells[:, :-2]) + 4.0 / cells[:, 1:-1] + 1.0 / cells[:, 2:]
    known = torch.isfinite(bend) & torch.isfinite(of_noise)
    if int(known.sum()) < _FEWEST_BENDS:
        return 0.0
    bend, of_noise = bend[known], of_noise[known]
    # ⟨bend² / v⟩ = 1 + 6 σ² / v of bends whose noise has the variance v.
    found = float((bend.square() / of_noise - 1.0).sum() / (6.0 / of_noise).sum())
    return min(max(found, 0.0), readings / float(cells.sum()))


def _gains(of: Weighted, variance: float) -> float:
    """What gains of cells add to the sum of χ²: those of this variance, and of all that are
    constant over the views as far as :data:`GAIN_TOLERANCE` goes."""
    known = of.weight > 0
    excess = float((of.total[known].square() / of.weight[known] - 1.0).sum())
    return min(max(excess, 0.0), max(GAIN_TOLERANCE**2, variance) * float(of.weight.sum()))


def _upper_tail(value: float, degrees: int, noncentrality: float) -> float:
    """Probability that a non-central χ² exceeds ``value``.

    SciPy's own function overflows far below the mean, where the other tail is the small one, and
    takes seconds, or fails, at the non-centralities of large scans. There the cube root of χ² is
    normal, to 2e-4 of a probability (Abdel-Aty 1954, Biometrika 41:538).
    """
    if degrees == 0:
        return 1.0
    mean = degrees + noncentrality
    if mean > _LARGE:
        variance = 2.0 / 9.0 * (1.0 + noncentrality / mean) / mean
        cube_root = math.exp(math.log(value / mean) / 3.0) if value > 0.0 else 0.0
        return float(stats.norm.sf((cube_root - 1.0 + variance) / math.sqrt(variance)))
    if value < mean:
        return float(1.0 - special.chndtr(max(value, 0.0), degrees, noncentrality))
    return float(stats.ncx2.sf(value, degrees, noncentrality))


def _cause(name: str, w: Tensor, wr: Tensor, lines: Tensor, axes: tuple[int, int]) -> str:
    """The likeliest causes of what some views or rows have in common, the likeliest first.

    A gain changes all rays of a view or row alike. What only the dense ones show was done to them
    on their way.
    """
    gain = f"the gain changed from {name[:-1]} to {name[:-1]}, or the object moved"
    seen = lines[w > 0]
    limit = torch.quantile(seen[:: max(1, seen.numel() // 10**6)], _DENSE)
    sizes = []
    for part in (lines <= limit, lines > limit):
        weight = _sum(w * part, axes)
        known = weight > 0
        off = _sum(wr * part, axes)[known] / weight[known]
        sizes.append(
            math.sqrt(max(float((off.square() - 1.0 / weight[known]).mean()), 0.0))
            if known.any()
            else 0.0
        )
    light, dense = sizes
    if dense <= _DENSE_SHARE * light:
        return gain
    return (
        f"beam hardening by bone or metal, or scatter, as the densest rays lie {100 * dense:.2g} % "
        f"off and the others {100 * light:.2g} %; or {gain}"
    )


def _slow(views: int) -> Tensor:
    """Slow additive changes over the views, ``(patterns, views)``: a line, and a few harmonics."""
    t = torch.linspace(-math.pi, math.pi, views, dtype=torch.float64)
    return torch.stack(
        [
            t / math.pi,
            *(f(k * t) for k in range(1, _HARMONICS + 1) for f in (torch.cos, torch.sin)),
        ]
    )


def _alike(total: Tensor, weight: Tensor, patterns: Tensor | None) -> tuple[float, int]:
    """χ² of the gains of views or rows, and its degrees of freedom.

    Args:
        total: weight times residual of each.
        weight: of each.
        patterns: ``(patterns, views)`` that they follow; None: each has its own.
    """
    if patterns is None:
        known = weight > 0
        return float((total[known].square() / weight[known]).sum()), int(known.sum())
    score = patterns @ total
    gram = (patterns * weight) @ patterns.T
    return float(score @ torch.linalg.pinv(gram, hermitian=True) @ score), len(patterns)


def _in_common(total: Tensor, weight: Tensor, patterns: Tensor | None, tolerated: float) -> float:
    """Probability that what all columns of a view or row have in common is of noise, or of what
    voxels leave.

    What a gain does is the same in all columns, what voxels leave is not: its size is seen from
    what blocks of columns differ by (an analysis of variance), but for a part
    :data:`COMMON` or :data:`COMMON_SLOW` that neighbouring blocks share.

    Args:
        total: weight times residual ``(views or rows, columns)``.
        weight: the same shape.
        patterns: as of :func:`_alike`.
        tolerated: χ² that is none.
    """
    information = weight.sum(0)
    blocks = min(_BLOCKS, int((information > 0).sum()) // 2)
    if blocks < 2:
        return 1.0
    # As much information in each.
    so_far = information.cumsum(0) - information / 2.0
    at = (so_far / information.sum() * blocks).long().clamp_max(blocks - 1)
    members = torch.nn.functional.one_hot(at, blocks).to(weight.dtype)
    w, s = weight @ members, total @ members
    together, degrees = _alike(s.sum(1), w.sum(1), patterns)
    if patterns is None:
        sizes = s.sum(1) / w.sum(1).clamp_min(TINY)
        off = s - sizes[:, None] * w
        apart = float((off.square() / w.clamp_min(TINY)).sum())
        others = int((w > 0).sum()) - degrees
    else:
        grams = torch.einsum("kv,vb,lv->bkl", patterns, w, patterns)
        scores = patterns @ s
        sizes = torch.linalg.pinv(grams.sum(0), hermitian=True) @ scores.sum(1)
        left = scores.T - grams @ sizes
        inverse = torch.linalg.pinv(grams, hermitian=True)
        apart = float(torch.einsum("bk,bkl,bl->", left, inverse, left))
        others = degrees * (blocks - 1)
    if degrees == 0 or others <= 0:
        return 1.0
    alike = COMMON if patterns is None else COMMON_SLOW
    ratio = together / degrees / (alike * max(apart / others, 1.0))
    of_voxels = float(stats.f.sf(ratio, degrees, others))
    return max(of_voxels, _upper_tail(together, degrees, tolerated))
