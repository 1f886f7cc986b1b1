"""What a method shows of core and fibrous tissue at a place, exact or controlled, and how that compares with another.

Figures are those of :mod:`recon.study.dose_factor.merit`: a number where it is exact, else jackknifed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.dose_factor.controls import Controls
from recon.study.dose_factor.merit import Figure, joint, json_of
from torchpcct.metrics import Jackknifed, auc_from_d_prime
from torchpcct.metrics.jackknife import log_of_sum

__all__ = ["Seen"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Seen:
    """Of one pair of ROIs.

    Attributes:
        realizations: None: exact.
        core, fibrous, contrast: expectations in HU; log_core, log_fibrous, log_contrast: ln of their variances, HU².
        added: contrast less that without the core, of the first draws; log_absent: ln of the variance without it; both
            None where there is no twin without the core.
        log_fat: ln of a voxel's variance in plain fat; None where it was not read.
    """

    realizations: int | None
    core: Figure
    fibrous: Figure
    contrast: Figure
    log_core: Figure
    log_fibrous: Figure
    log_contrast: Figure
    added: Figure | None
    log_absent: Figure | None
    log_fat: Figure | None

    @classmethod
    def of(cls, found: dict[str, Any], pair: int = 0) -> Seen:
        """Of :meth:`recon.study.dose_factor.places.Places.found`, with the number of the pair of ROIs."""
        return _exact(found, pair) if "covariance" in found else _drawn(found, pair)

    @classmethod
    def of_moments(cls, mean: Any, covariance: Any, without: Any = None, log_fat: float | None = None) -> Seen:
        """Exact: expectations ``(2,)`` and covariance ``(2, 2)`` of core and fibrous mean.

        Args:
            mean, covariance: of the method.
            without: ``(2,)`` expectations without the core; None: no twin.
            log_fat: see the class.
        """
        m, c = np.asarray(mean, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
        h = np.array([-1.0, 1.0])
        log_contrast = float(np.log(h @ c @ h))
        return cls(
            realizations=None, core=float(m[0]), fibrous=float(m[1]), contrast=float(h @ m),
            log_core=float(np.log(c[0, 0])), log_fibrous=float(np.log(c[1, 1])), log_contrast=log_contrast,
            added=None if without is None else float(h @ m - h @ np.asarray(without)),
            # Linear: the noise knows no core.
            log_absent=None if without is None else log_contrast, log_fat=log_fat,
        )  # fmt: skip

    def _among(self, figure: Figure) -> Figure:
        """A figure of the first draws as one of all."""
        if self.realizations is None or not isinstance(figure, Jackknifed):
            return figure
        return figure.among(self.realizations)

    @property
    def absent(self) -> Figure | None:
        """Contrast without the core: on all draws what is seen with it, less what it adds, HU."""
        return None if self.added is None else joint(lambda c, a: c - a, self.contrast, self._among(self.added))

    def slope(self, true_contrast_hu: float) -> Figure:
        """What the core adds over what it should.

        Raises:
            ValueError: no twin.
        """
        if self.added is None:
            raise ValueError("nothing to compare with: there is no twin without the core")
        return joint(lambda a: a / true_contrast_hu, self.added)

    def log_corrected(self, true_contrast_hu: float) -> Figure:
        """ln of the slope-corrected variance of the contrast.

        Raises:
            ValueError: no twin, or a contrast of the wrong sign.
        """
        slope = self._among(self.slope(true_contrast_hu))
        if not np.min(slope.left_out if isinstance(slope, Jackknifed) else slope) > 0:
            raise ValueError("the contrast has the wrong sign: it cannot be corrected")
        return joint(lambda v, s: v - 2.0 * np.log(s), self.log_contrast, slope)

    def cnr(self) -> dict[str, Any]:
        """The paper's CNR."""
        return json_of(
            joint(
                lambda f, b, vf, vb: (b - f) / np.sqrt(np.exp(vf) + np.exp(vb)),
                self.core, self.fibrous, self.log_core, self.log_fibrous,
            )
        )  # fmt: skip

    def auc(self, sign: float) -> dict[str, Any]:
        """Area under the curve of the contrast with the core against that without, for normal readings.

        Args:
            sign: of the true contrast.

        Raises:
            ValueError: no twin.
        """
        if self.added is None or self.log_absent is None:
            raise ValueError("nothing to compare with: there is no twin without the core")
        d_prime = joint(
            lambda a, v, w: sign * a / np.sqrt((np.exp(v) + np.exp(w)) / 2.0),
            self._among(self.added), self.log_contrast, self._among(self.log_absent),
        )  # fmt: skip
        return {k: auc_from_d_prime(v) for k, v in json_of(d_prime).items()}


def _exact(found: dict[str, Any], pair: int) -> Seen:
    rows = slice(2 * pair, 2 * pair + 2)
    mean, fat = found["mean"][:, rows], float(found["fat_variance"])
    log_fat = float(np.log(fat)) if np.isfinite(fat) else None
    return Seen.of_moments(mean[0], found["covariance"][rows, rows], mean[1] if len(mean) > 1 else None, log_fat)


def _drawn(found: dict[str, Any], pair: int) -> Seen:
    controls = Controls(found["controls"], found["control_mean"], found["control_covariance"])
    readings, absent = found["readings"], found["absent"]
    core, fibrous = np.eye(readings.shape[1])[2 * pair : 2 * pair + 2]
    contrast = fibrous - core
    fat = found["fat"].astype(np.float64)

    def mean(h: Floats) -> Jackknifed:
        return controls.expectation(readings @ h, h)

    def log_variance(values: Floats, h: Floats) -> Jackknifed:
        return controls.log_variance(values @ h, h)

    twin = len(absent) > 0
    return Seen(
        realizations=len(readings), core=mean(core), fibrous=mean(fibrous), contrast=mean(contrast),
        log_core=log_variance(readings, core), log_fibrous=log_variance(readings, fibrous),
        log_contrast=log_variance(readings, contrast),
        added=controls.expectation((readings[: len(absent)] - absent) @ contrast, contrast) if twin else None,
        log_absent=log_variance(absent, contrast) if twin else None,
        log_fat=log_of_sum(np.square(fat - fat.mean(0)).mean(1), lost=1) if fat.size else None,
    )  # fmt: skip
