"""From what was measured to figures of merit: exactly, or from realisations with linear controls of the same draws."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.dose_factor.controls import Controls
from recon.study.dose_factor.measure import Measured
from recon.study.dose_factor.measures import DOG_CHANNELS, OBSERVERS
from recon.study.dose_factor.merit import Figures
from recon.study.dose_factor.readings import BIN_MM, DIRECTIONS, REACH_MM
from recon.study.dose_factor.settings import FBP_BASE, MAIN_SCENES, RELATIVES, ROIS
from torchpcct.metrics import (
    Jackknifed,
    NoisePower,
    RegionNoise,
    controlled_mean,
    jackknifed_f50,
    task_transfer,
)
from torchpcct.metrics.jackknife import log_of_sum

__all__ = ["drawn_figures", "exact_figures", "log_detectability"]

Floats = NDArray[np.float64]

_SHELL_LP_MM = 0.5
"""Of the radial noise power spectrum."""

_CHANNELS = 1 + DOG_CHANNELS


def _rows(observer: str) -> slice:
    first = 2 * len(ROIS) + OBSERVERS.index(observer) * _CHANNELS
    return slice(first, first + _CHANNELS)


def _combinations() -> tuple[list[Floats], list[Floats], list[Floats]]:
    """Core, fibrous tissue and contrast of every ROI as rows over the readings of the ROIs."""
    unit = np.eye(2 * len(ROIS))
    core, fibrous = list(unit[0::2]), list(unit[1::2])
    return core, fibrous, [b - f for f, b in zip(core, fibrous, strict=True)]


def exact_figures(
    found: dict[str, Any], m: Measured, kind: str, truth: dict[str, Floats], dose: float = 1.0
) -> Figures:
    """Figures of FBP or a linear method.

    Args:
        found: :mod:`recon.study.dose_factor.exact_figures`.
        m: what was measured.
        kind: ``"fbp"`` or ``"method"``: the grid.
        truth: scene → true values of core and fibrous tissue.
        dose: exposure relative to that of ``found``.
    """
    spacing = FBP_BASE[1] if kind == "fbp" else m.settings.voxel_mm
    covariance, readings = found["covariance"] / dose, found["readings"]
    rois = slice(0, 2 * len(ROIS))
    core, fibrous, contrast = (
        [math.log(h @ covariance[rois, rois] @ h) for h in rows] for rows in _combinations()
    )  # fmt: skip
    seen = {}
    for observer in OBSERVERS:
        use = _rows(observer)
        delta = readings[0, use] - readings[1, use]
        seen[observer] = math.log(delta @ np.linalg.solve(covariance[use, use], delta))
    values = readings[:, 1] - readings[:, 0]
    true = np.array([np.diff(truth[name])[0] for name in MAIN_SCENES])
    return Figures(
        realizations=None,
        noise=_exact_noise(found["row"] / dose, spacing, m.fat_shape[kind]),
        log_variance=math.log(found["variance"][0] / dose),
        log_edge=math.log(found["variance"][2] / dose),
        means={name: list(map(float, row[rois])) for name, row in zip(MAIN_SCENES, readings, strict=True)},
        slopes={
            name: float((values[k] - values[1]) / (true[k] - true[1])) for k, name in enumerate(MAIN_SCENES) if k != 1
        },
        log_core=core, log_fibrous=fibrous, log_contrast=contrast, log_detectability=seen,
        log_error=[
            math.log(b + v / dose) for b, v in zip(found["square"], found["variance"][1::-1], strict=True)
        ],
        f50={d: _f50(found[d], m.distances[kind, d]) for d in DIRECTIONS},
    )  # fmt: skip


def _f50(profile: Floats, distance: Floats) -> float | None:
    try:
        value = float(task_transfer(profile, distance, REACH_MM, BIN_MM).f50)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _exact_noise(row: Floats, spacing: float, shape: tuple[int, int]) -> RegionNoise:
    """What realisations of a region would show on average, from the covariance of one voxel with its neighbours."""
    plane = row[row.shape[0] // 2]
    wrapped = np.zeros(shape)
    lags = [np.arange(-(n // 2), n // 2 + 1) for n in plane.shape]
    use = [np.abs(lag) < n for lag, n in zip(lags, shape, strict=True)]
    y, x = (lag[u] for lag, u in zip(lags, use, strict=True))
    weight = (shape[0] - np.abs(y))[:, None] * (shape[1] - np.abs(x))
    np.add.at(wrapped, (y[:, None] % shape[0], x % shape[1]), plane[np.ix_(*use)] * weight)
    power = np.fft.fft2(wrapped).real.clip(0.0) * spacing**2 / (shape[0] * shape[1])
    frequencies, radial = NoisePower(power, (spacing, spacing), 3).radial(_SHELL_LP_MM)
    variance = float(plane[plane.shape[0] // 2, plane.shape[1] // 2])
    # Three realisations that do not vary: their figures are these.
    return RegionNoise(frequencies, np.tile(radial * 2 / 3, (3, 1)), np.full(3, variance * 2 / 3), np.full(3, variance))


def drawn_figures(m: Measured, method: str, dose: float, truth: dict[str, Floats]) -> Figures:
    """Figures of a method that is not linear, each with all that the linear controls of the same draws tell."""
    samples = {name: m.samples[method, name, dose] for name in MAIN_SCENES}
    control = _Control(m, method, dose)
    means, logs = {}, {}
    for name in MAIN_SCENES[:2]:
        found = samples[name]
        means[name] = [control.mean(found["readings"], h) for h in _combinations()[0] + _combinations()[1]]
        means[name] = [means[name][k + len(ROIS) * j] for k in range(len(ROIS)) for j in (0, 1)]
    readings = samples["paper"]["readings"]
    for key, rows in zip(("core", "fibrous", "contrast"), _combinations(), strict=True):
        logs[key] = [control.log_variance(readings, h) for h in rows]
    values = {name: found["readings"][:, 1] - found["readings"][:, 0] for name, found in samples.items()}
    true = {name: float(np.diff(truth[name])[0]) for name in MAIN_SCENES}
    absent = "absent_core"
    slopes = {}
    for name, v in values.items():
        if name != absent:
            change = (v - values[absent][: len(v)]) / (true[name] - true[absent])
            slopes[name] = controlled_mean(change, None, None)
    noise = RegionNoise.of(samples["paper"]["fat"], m.settings.voxel_mm, _SHELL_LP_MM)
    edge = samples["paper"]["edge"].astype(np.float64)
    f50: dict[str, Any] = {}
    for d in DIRECTIONS:
        try:
            difference = samples["paper"][d] - samples[absent][d]
            f50[d] = jackknifed_f50(difference, m.distances["method", d], REACH_MM, BIN_MM)
        except ValueError:
            f50[d] = None
    return Figures(
        realizations=len(readings), noise=noise, log_variance=noise.log_variance, means=means, slopes=dict(slopes),
        log_edge=log_of_sum(np.square(edge - edge.mean(0)).mean(1), lost=1),
        log_core=list(logs["core"]), log_fibrous=list(logs["fibrous"]), log_contrast=list(logs["contrast"]),
        log_detectability={
            o: control.detectability(readings[:, _rows(o)], samples[absent]["readings"][:, _rows(o)], o)
            for o in OBSERVERS
        },
        log_error=[log_of_sum(s) for s in samples["paper"]["square"].T],
        f50=f50,
    )  # fmt: skip


class _Control:
    """The linear controls of a method at one exposure: its own response or a relative's if known, else the study's.

    All scenes have the same noise, so their deviations are those of one.
    """

    def __init__(self, m: Measured, method: str, dose: float) -> None:
        own = "mbir" if method in RELATIVES else method
        c = m.responses.get((own, dose), m.controls[dose])
        self.count = len(c["covariance"]) // (2 * len(ROIS) + len(OBSERVERS) * _CHANNELS)
        shape = (-1, self.count, c["covariance"].shape[0] // self.count)
        self.mean_readings = c["mean"].reshape(shape)  # (scenes, controls, rows)
        covariance = c["covariance"].reshape(shape[1], shape[2], shape[1], shape[2])
        self.known = Controls(c["readings"].reshape(shape), self.mean_readings[0], covariance)
        self.fbp, self.exact_fbp = m.controls[dose].get("fbp"), m.fbp[_base()]
        self.dose = dose

    def mean(self, readings: Floats, h: Floats) -> Jackknifed:
        """Expectation of a combination of ROI readings."""
        return self.known.expectation(readings[:, : len(h)] @ h, h)

    def log_variance(self, readings: Floats, h: Floats) -> Jackknifed:
        """ln of its variance."""
        return self.known.log_variance(readings[:, : len(h)] @ h, h)

    def detectability(self, present: Floats, absent: Floats, observer: str) -> Jackknifed | None:
        """ln d′² of the observer, less what the controls' own, of the same draws and training, differ from theirs."""
        n, use = len(present), _rows(observer)
        try:
            own = log_detectability(present, absent)
        except ValueError:
            return None
        controls, exact = [], []
        for k in range(self.count):
            delta = self.mean_readings[0, k, use] - self.mean_readings[1, k, use]
            seen = self.known.readings[:n, k, use]
            controls.append(log_detectability(seen, seen - delta))
            exact.append(_log_exact(delta, self.known.covariance[k, use, k, use]))
        if self.fbp is not None:
            readings = self.exact_fbp["readings"]
            delta = readings[0, use] - readings[1, use]
            first = use.start - 2 * len(ROIS)
            seen = self.fbp[:n, first : first + _CHANNELS]
            controls.append(log_detectability(seen, seen - delta))
            exact.append(_log_exact(delta, self.exact_fbp["covariance"][use, use] / self.dose))
        replicates = np.stack([c.left_out for c in controls], 1)
        centred = replicates - replicates.mean(0)
        beta = np.linalg.lstsq(centred, own.left_out - own.left_out.mean(), rcond=None)[0]
        values = np.array([c.value for c in controls])
        left_out = own.left_out - (replicates - np.array(exact)) @ beta
        # The error of the coefficients, as in any regression.
        spread = math.sqrt((n - 1) / max(n - 1 - len(controls), 1))
        left_out = left_out.mean() + (left_out - left_out.mean()) * spread
        return Jackknifed(own.value - float((values - np.array(exact)) @ beta), left_out)


def _base() -> str:
    return f"{FBP_BASE[0]} {FBP_BASE[1]:.2f} mm"


def _log_exact(delta: Floats, covariance: Floats) -> float:
    return math.log(delta @ np.linalg.solve(covariance, delta))


def log_detectability(present: Floats, absent: Floats) -> Jackknifed:
    """ln d′² = ln Δᵀ K⁻¹ Δ of the Hotelling observer on its channels, free of the bias of few realisations.

    Both classes have the same draws. That is right for this estimate: nothing is scored, so no score can know its pair.
    d′² asks for the difference Δ of the expectations, which common noise leaves less uncertain (exact for a linear
    method), and for the covariance K, which counts n independent draws, not 2 n: as n − 1 degrees of freedom in the
    factor of the inverse Wishart matrix, (n − c − 2) / (n − 1) for c channels, and as n in the intervals. What is left
    of the noise in Δ, tr(K⁻¹ Cov(present − absent)) / n, is taken off.

    Args:
        present, absent: ``(n, channels)``.

    Raises:
        ValueError: too few realisations for the channels; a signal below its own noise.
    """
    n, c = present.shape
    if n < c + 5:
        raise ValueError(f"{n} realisations are too few for {c} channels: use at least {c + 5}")

    def of(a: Floats, b: Floats) -> float:
        count = len(a)
        da, db = a - a.mean(0), b - b.mean(0)
        k = (da.T @ da + db.T @ db) / (2 * (count - 1))
        delta, both = a.mean(0) - b.mean(0), da - db
        inverse = np.linalg.inv(k)
        noise = np.trace(inverse @ (both.T @ both)) / ((count - 1) * count)
        value = (delta @ inverse @ delta - noise) * (count - c - 2) / (count - 1)
        if not value > 0:
            raise ValueError("the core's signal is below its own noise: take more realisations")
        return math.log(value)

    keep = ~np.eye(n, dtype=bool)
    return Jackknifed(of(present, absent), np.array([of(present[k], absent[k]) for k in keep]))
