"""The figures of merit of a reconstruction at one exposure, exact or of realisations, and its dose factors.

A figure is a number where it is exact (FBP, linear methods), else a :class:`torchpcct.metrics.jackknife.Jackknifed`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.dose_factor.measures import OBSERVERS
from recon.study.dose_factor.readings import DIRECTIONS
from recon.study.dose_factor.settings import ROIS
from torchpcct.metrics import (
    Jackknifed,
    LinearReference,
    RegionNoise,
    combined,
    matched_noise_ratio,
)

__all__ = ["FACTOR_NAMES", "Figures", "attempt", "entry_of", "factors_of", "joint", "json_of", "none"]

Floats = NDArray[np.float64]
Figure = float | Jackknifed

FACTOR_NAMES = {
    "noise": "pixel noise",
    "noise_matched": "edge, matched",
    "d_prime_axial": "d′ axial",
    "d_prime_volume": "d′ volume",
    "contrast_paper": "σ² paper",
    "contrast_section": "σ² section",
    "contrast_tissue": "σ² tissue",
    "paper_cnr": "CNR",
    "error_vessel": "RMSE vessel",
    "error_fat": "RMSE fat",
}
"""Figures that have a dose factor, as tables call them; σ²: slope-corrected variance of the contrast in an ROI."""


@dataclass(frozen=True, eq=False)
class Figures:
    """Attributes:
    realizations: None: exact.
    noise: in fat; ``log_variance``: ln of a voxel's variance there, HU²; ``log_edge``: at the core's edge.
    means: scene (with and without the core) → expectations of core and fibrous tissue of every ROI, HU.
    slopes: scene → contrast slope between it and the absent core in the paper's ROI.
    log_core, log_fibrous, log_contrast: ln of the variance in every ROI, HU².
    log_detectability: observer → ln d′².
    log_error: ln of the mean square error in vessel and fat, HU².
    f50: direction → cycles per mm of the core's edge; None where it cannot be told.
    """

    realizations: int | None
    noise: RegionNoise
    log_variance: Figure
    log_edge: Figure
    means: Mapping[str, Sequence[Figure]]
    slopes: Mapping[str, Figure]
    log_core: Sequence[Figure]
    log_fibrous: Sequence[Figure]
    log_contrast: Sequence[Figure]
    log_detectability: Mapping[str, Figure | None]
    log_error: Sequence[Figure]
    f50: Mapping[str, Figure | None]

    def moment(self, order: int, limit: float) -> Figure:
        """ln ∫ f^order NPS df in fat."""
        found = self.noise.moment(order, limit)
        return found.value if self.realizations is None else found

    def contrast(self, scene: str, roi: int) -> Figure:
        """Expected contrast, HU."""
        fg, bg = self.means[scene][2 * roi : 2 * roi + 2]
        return joint(lambda f, b: b - f, fg, bg)

    def slope(self, roi: int, true_difference: float) -> Figure:
        """Contrast with the core less that without it, over the true difference."""
        with_core, without = (self.contrast(scene, roi) for scene in ("paper", "absent_core"))
        return joint(lambda a, b: (a - b) / true_difference, with_core, without)

    def log_corrected(self, roi: int, true_difference: float) -> Figure:
        """ln of the slope-corrected variance of the contrast."""
        slope = self.slope(roi, true_difference)
        if not np.min(slope.left_out if isinstance(slope, Jackknifed) else slope) > 0:
            raise ValueError("the contrast has the wrong sign: it cannot be corrected")
        return joint(lambda v, s: v - 2 * np.log(s), self.log_contrast[roi], slope)

    @property
    def log_cnr(self) -> Figure:
        """ln of the paper's CNR, squared."""
        fg, bg = self.means["paper"][:2]
        return joint(
            lambda f, b, vf, vb: np.log(np.square(b - f) / (np.exp(vf) + np.exp(vb))),
            fg, bg, self.log_core[0], self.log_fibrous[0],
        )  # fmt: skip


def joint(function: Callable[..., Any], *figures: Figure) -> Figure:
    """A smooth function of figures."""
    if any(isinstance(f, Jackknifed) for f in figures):
        return combined(function, *figures)
    return float(function(*figures))


def json_of(figure: Figure, scale: float | None = None) -> dict[str, Any]:
    """Value and 95 % interval of a figure; with ``scale`` of exp(scale · figure)."""
    if isinstance(figure, Jackknifed):
        found = figure.estimate() if scale is None else figure.exponential(scale=scale)
        return {"value": found.value, "low": found.low, "high": found.high}
    return {"value": figure if scale is None else math.exp(scale * figure)}


def none(why: str) -> dict[str, Any]:
    """No figure, and the reason."""
    return {"value": None, "low": None, "high": None, "why": why}


def attempt(compute: Callable[[], Any]) -> Any:
    """The figure, or why there is none."""
    try:
        return compute()
    except ValueError as error:
        return none(str(error))


def _root_of(bias: Figure, log_variance: Figure) -> dict[str, Any]:
    """Root mean square error of a value."""
    return json_of(joint(lambda b, v: np.log(np.square(b) + np.exp(v)), bias, log_variance), 0.5)


def _seen(log_detectability: Figure | None) -> dict[str, Any]:
    return none("too little is seen") if log_detectability is None else json_of(log_detectability, 0.5)


def _corrected_sd(figures: Figures, roi: int, difference: float) -> dict[str, Any]:
    return json_of(figures.log_corrected(roi, difference), 0.5)


def entry_of(figures: Figures, reference: Figures, truth: dict[str, Floats]) -> dict[str, Any]:
    """All figures of a method as JSON values.

    Args:
        figures: of the method.
        reference: of FBP.
        truth: scene → true values of core and fibrous tissue, HU.
    """
    core, fibrous = truth["paper"]
    difference = float(fibrous - core) - float(np.diff(truth["absent_core"])[0])
    rois = {}
    for k, name in enumerate(ROIS):
        bias = joint(lambda v: v - core, figures.means["paper"][2 * k])
        fibrous_bias = joint(lambda v: v - fibrous, figures.means["paper"][2 * k + 1])
        contrast = figures.contrast("paper", k)
        contrast_bias = joint(lambda v: v - (fibrous - core), contrast)
        rois[name] = {
            "core_bias_hu": json_of(bias), "core_sd_hu": json_of(figures.log_core[k], 0.5),
            "core_rmse_hu": _root_of(bias, figures.log_core[k]),
            "fibrous_bias_hu": json_of(fibrous_bias), "fibrous_sd_hu": json_of(figures.log_fibrous[k], 0.5),
            "fibrous_rmse_hu": _root_of(fibrous_bias, figures.log_fibrous[k]),
            "contrast_hu": json_of(contrast), "contrast_bias_hu": json_of(contrast_bias),
            "contrast_sd_hu": json_of(figures.log_contrast[k], 0.5),
            "contrast_rmse_hu": _root_of(contrast_bias, figures.log_contrast[k]),
            "slope": json_of(figures.slope(k, difference)),
            "corrected_sd_hu": attempt(partial(_corrected_sd, figures, k, difference)),
            "false_contrast_hu": json_of(figures.contrast("absent_core", k)),
        }  # fmt: skip
    limit = float(min(figures.noise.frequencies[-1], reference.noise.frequencies[-1]))
    moments = [f.moment(order, limit) for f in (figures, reference) for order in (1, 0)]
    return {
        "realizations": figures.realizations,
        "fat_sd_hu": json_of(figures.log_variance, 0.5),
        "edge_sd_hu": json_of(figures.log_edge, 0.5),
        "fat_nps": {
            "frequency_lp_mm": figures.noise.frequencies.tolist(), "hu2_mm2": figures.noise.radial.tolist(),
        },
        "noise_magnitude_ratio": json_of(joint(np.subtract, moments[1], moments[3]), 0.5),
        "central_frequency_ratio": json_of(joint(lambda a, b, c, d: (a - b) - (c - d), *moments)  , 1.0),
        "d_prime": {o: _seen(figures.log_detectability[o]) for o in OBSERVERS},
        "paper_cnr": json_of(figures.log_cnr, 0.5),
        "rmse_hu": {k: json_of(v, 0.5) for k, v in zip(("vessel", "fat"), figures.log_error, strict=True)},
        "f50_lp_mm": {k: none("no edge") if v is None else json_of(v) for k, v in figures.f50.items()},
        "slopes": {k: json_of(v) for k, v in figures.slopes.items()},
        "rois": rois,
    }  # fmt: skip


def factors_of(
    figures: Figures, reference: Figures, difference: float, sharper: dict[str, LinearReference], fbp_bias2: Floats
) -> dict[str, Any]:
    """The dose at which FBP reaches each figure, relative to the method's.

    Args:
        figures, reference: of the method and of FBP at the same exposure.
        difference: true contrast with the core less that without, HU.
        sharper: FBP variants that the method's resolution may be matched to, the reference first.
        fbp_bias2: mean square error of FBP without noise, vessel and fat, HU².
    """

    def ratio(of: Callable[[Figures], Figure | None], sign: float) -> Any:
        def compute() -> Any:
            own, base = of(figures), of(reference)
            if own is None or base is None:
                return none("too little is seen")
            return json_of(joint(lambda a, b: sign * (a - b), own, base), 1.0)

        return attempt(compute)

    found = {"noise": ratio(lambda f: f.log_variance, -1.0), "noise_matched": _matched(figures, sharper)}
    for observer in OBSERVERS:
        found[f"d_prime_{observer}"] = ratio(partial(_detectability, observer), 1.0)
    for k, name in enumerate(ROIS):
        found[f"contrast_{name}"] = ratio(partial(_log_corrected, k, difference), -1.0)
    found["paper_cnr"] = ratio(lambda f: f.log_cnr, 1.0)
    for k, name in enumerate(("vessel", "fat")):
        bias2 = float(fbp_bias2[k])
        variance = math.exp(float(_value(reference.log_error[k]))) - bias2
        found[f"error_{name}"] = _error_factor(figures.log_error[k], bias2, variance)
    return found


def _detectability(observer: str, figures: Figures) -> Figure | None:
    return figures.log_detectability[observer]


def _log_corrected(roi: int, difference: float, figures: Figures) -> Figure:
    return figures.log_corrected(roi, difference)


def _value(figure: Figure) -> float:
    return figure.value if isinstance(figure, Jackknifed) else figure


def _error_factor(log_error: Figure, bias2: float, variance: float) -> Any:
    """FBP's square error is bias² + variance / dose: below its bias² no dose reaches it."""
    if math.exp(_value(log_error)) <= bias2:
        return none("FBP's blur alone errs more: no dose reaches this")
    return attempt(lambda: json_of(joint(lambda e: np.log(variance / (np.exp(e) - bias2)), log_error), 1.0))


def _matched(figures: Figures, sharper: dict[str, LinearReference]) -> Any:
    """Factor by the variance at the core's edge against FBP filtered to the same f50 there, in plane and along z: of
    one place, for a method that adapts to the image is sharp at an edge, quiet in plain fat, and nowhere both."""
    plane, along_z = (figures.f50[d] for d in DIRECTIONS)
    if plane is None or along_z is None:
        return none("the edge's transfer function cannot be told")
    log_variance = figures.log_edge
    if not isinstance(log_variance, Jackknifed):
        log_variance = Jackknifed(log_variance, np.full(3, log_variance))
    why = "no FBP"
    for label, reference in sharper.items():
        try:
            m = matched_noise_ratio(log_variance, plane, along_z, reference)
        except ValueError as error:
            why = str(error)
            continue
        low, high = m.ratio.high**-2, m.ratio.low**-2
        found = {"value": m.ratio.value**-2, "against": label, "kernel": label.split()[0],
                 "sigma_mm": m.sigma_mm, "sigma_z_mm": m.sigma_z_mm, "fbp_sd_hu": m.reference_sd_hu}  # fmt: skip
        return found if figures.realizations is None else {**found, "low": low, "high": high}
    return none(why)
