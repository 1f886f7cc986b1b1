"""Do the views lie at their angles, each for itself? Angles that scatter about the described ones,
by conjugate rays.

A view that was taken α beside its angle differs from its conjugate rays, which other views read, by
α times its slope along the angles. The regression of the difference on that slope, view by view,
gives α of each; what changes slowly with the views (motion, the steps between them) is taken off as
the mean of the two beside it. Of independent angles, normal with standard deviation σ, the mean
square of the rest is 3 σ² / 2. It is estimated without noise, by products of parts of the columns
that share no reading (a U-statistic, Hoeffding 1948, Ann. Math. Stat. 19:293). Neighbouring rests
then have the correlation -2/3; -1 is of views that alternate, which
:mod:`torchpcct.checks.neighbours` names, and 0 of what stays for some views.

Neighbouring views tell scatter, too, where it is large against what changes in one step, and in
short scans; conjugate rays tell less of it, of full turns of fine steps.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from torchpcct.checks.ray_pairs import BLOCKS, RayPairs, varying
from torchpcct.checks.scan_test import UNKNOWN, ScanTest
from torchpcct.geometry import view_step

__all__ = ["view_scatter_test"]

Floats = NDArray[np.float64]

SCATTER_TOLERANCE = 0.2
"""Standard deviation of the angles, in steps, that is no finding: of thin walls interpolation
between views leaves nearly as much."""
FALSE_ALARMS = 5e-5
"""Student's p-value below which a mean square is none of chance. Products have longer tails than
Student's: of 169 sound scans two lay below 1e-3, the lowest of a size beyond the tolerance at 2e-4;
a fifth of them is beyond it, and the correlation has to fit, too."""
_CORRELATION = (-0.85, -0.4)
"""Of neighbouring views, of angles that scatter independently: -2/3 and what noise makes of it."""
_SLOPE_COLUMNS = 5
"""Columns over which slopes are smoothed."""
_GROUP = 4
"""Columns of a part, the last of which is left out."""
_OUTLIER = 20.0
"""Products of one view over their median above which the view is something else than beside its
angle."""
_LEAST = 0.05
"""Power of a view's slopes over the median, below which its angle is not known."""


def view_scatter_test(pairs: RayPairs) -> ScanTest:
    """Test whether the views scatter about their angles.

    Args:
        pairs: of a whole detector.

    Returns:
        The test of ``view_scatter``: the standard deviation of the angles about the described ones,
        in steps. :data:`~torchpcct.checks.scan_test.UNKNOWN` of fewer than 96 views, or where
        nothing is to be seen.
    """
    if pairs.used(_SLOPE_COLUMNS).size < 4 * BLOCKS:
        return UNKNOWN
    smooth, _, known = pairs.slopes("angles", _SLOPE_COLUMNS)
    kept = known[:, 0].double()
    columns = np.arange(kept.shape[1])
    apart = torch.from_numpy(columns % _GROUP < _GROUP - 1).double()
    # Without the mean over the columns, which a change of the exposure leaves.
    slopes = varying((smooth[0] + smooth[1])[:, 0] / 2, kept, 1) * apart
    order = np.argsort(pairs.angles, kind="stable")
    starts = columns[::_GROUP]
    score, power = (
        np.add.reduceat(values.numpy(), starts, axis=1)[order]
        for values in (varying(pairs.residue[:, 0], kept, 1) * slopes, slopes * slopes)
    )
    of_views = power.sum(1)
    if not (of_views > 0.0).any():
        return UNKNOWN
    angles = score / np.maximum(of_views, _LEAST * np.median(of_views[of_views > 0.0]))[:, None]
    rest = angles[1:-1] - (angles[:-2] + angles[2:]) / 2.0
    total = rest.sum(1)
    # All products of two parts, none of a part with itself.
    square = total**2 - (rest**2).sum(1)
    weight = np.minimum.reduce([of_views[1:-1], of_views[:-2], of_views[2:]])
    weight = weight * (np.abs(square) <= _OUTLIER * np.median(np.abs(square)))
    if not weight.sum() > 0.0:
        return UNKNOWN
    mean = float((weight * square).sum() / weight.sum())
    p_value, error = _above(square, weight)
    if mean <= 0.0 or error <= 0.0:
        return UNKNOWN
    along = float((weight[1:] * total[1:] * total[:-1]).sum() / (weight * total**2).sum())
    step = view_step(pairs.rays.geometry.angles)
    size = math.sqrt(mean / 1.5) / step
    sigmas = mean / error
    findings = []
    low, high = _CORRELATION
    if size > SCATTER_TOLERANCE and p_value < FALSE_ALARMS and low < along < high:
        findings.append(
            f"conjugate rays disagree, in each view by itself: the views scatter by about "
            f"{size:.1g} of a step about the described angles ({sigmas:.0f} standard errors): the "
            "gantry does not turn evenly, or the object trembles; give the measured angle of each "
            "view"
        )
    return ScanTest({"view_scatter": size}, {"view_scatter": size / sigmas / 2}, tuple(findings))


def _above(square: Floats, weight: Floats) -> tuple[float, float]:
    """Student's p-value of a weighted mean that is 0 or less, and its standard error.

    The scatter is that of means without one block of views each (the jackknife; MacKinnon and White
    1985, J. Econometrics 29:305), or of single views where that is more; its degrees of freedom
    those of as many equal blocks as the weights are worth (Satterthwaite 1946, Biometrics Bull.
    2:110): slopes may be seen by few views.
    """
    from scipy import special  # loads with its first use

    mean = float((weight * square).sum() / weight.sum())
    off = weight * (square - mean)
    share = np.array([part.sum() for part in np.array_split(weight, BLOCKS)]) / weight.sum()
    parts = np.array([part.sum() for part in np.array_split(off, BLOCKS)])
    left = parts / np.maximum(1.0 - share, 1e-3)
    spread = max(float(np.square(left).sum()), float(np.square(off).sum()))
    error = math.sqrt(spread) / float(weight.sum())
    freedom = 1.0 / float(np.square(share).sum()) - 1.0
    if error <= 0.0 or freedom <= 0.0:
        return 1.0, error
    return float(special.stdtr(freedom, -mean / error)), error
