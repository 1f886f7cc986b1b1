"""Resolution at a task's own contrast.

The edge-spread function (ESF) is the mean of a (noise-free or ensemble-mean) image over voxels of
equal distance from a known surface; its derivative is the line-spread function, whose spectrum is
the task transfer function (TTF). For a non-linear method it holds for this contrast, noise and
object only: measure it on the core itself, at −60 HU. A curved surface changes the ESF a little
when the blur is not small against its radius; two methods compared on the same surface share this.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchpcct.metrics.roi import as_array
from torchpcct.validate import checked

__all__ = ["TransferFunction", "edge_profile", "task_transfer"]

Floats = NDArray[np.float64]

_SECTORS = 12
"""Parts of an edge whose scatter gives the standard error."""
_SEEN = 5.0
"""Least contrast of an edge, in standard errors."""
_UNCERTAIN = 0.08
"""Largest standard error of its transfer at f50."""


@checked
def edge_profile(
    image: ArrayLike, distance: ArrayLike, reach: tuple[float, float], bin_mm: float
) -> tuple[Floats, Floats]:
    """Edge-spread function on equidistant positions.

    Args:
        image: ensemble mean in HU, any shape.
        distance: signed distance of every voxel from the surface in mm, negative inside, same
            shape; of drawn masks ``scipy.ndimage.distance_transform_edt`` gives it.
        reach: how far inside and outside the surface, mm, both positive: not beyond the next edge.
        bin_mm: width of a bin of distances; a fifth of a voxel or more, so that most bins are
            filled.

    Returns:
        positions (bin centres from −reach[0] to reach[1]) in mm and ESF in HU. A bin's mean is
        moved to its centre by linear interpolation between the bins' mean distances; this also
        fills empty bins.

    Raises:
        ValueError: shapes that differ, a bin or reach that is not positive, more empty than filled
            bins, NaN or Inf.
    """
    x, r = as_array(image), as_array(distance)
    if x.shape != r.shape:
        raise ValueError(
            f"image and distance must have the same shape, got {x.shape} and {r.shape}"
        )
    if not (bin_mm > 0 and reach[0] > 0 and reach[1] > 0):
        raise ValueError(f"bin_mm and reach must be greater than 0 mm, got {bin_mm} and {reach}")
    count = round((reach[0] + reach[1]) / bin_mm)
    if count < 8:
        raise ValueError(
            f"reach {reach} mm holds {count} bins of {bin_mm} mm, at least 8 are needed: use "
            "finer bins"
        )
    use = (r >= -reach[0]) & (r < -reach[0] + count * bin_mm)
    r, x = r[use].astype(np.float64), x[use].astype(np.float64)
    if not np.isfinite(x).all():
        raise ValueError("image holds NaN or Inf near the edge: check the reconstruction")
    index = np.minimum(((r + reach[0]) / bin_mm).astype(np.int64), count - 1)
    number = np.bincount(index, minlength=count)
    filled = number > 0
    if 2 * filled.sum() < count:
        raise ValueError(
            f"{count - filled.sum()} of {count} bins are empty: widen bin_mm ({bin_mm} mm)"
        )
    mean_r = np.bincount(index, r, count)[filled] / number[filled]
    mean_x = np.bincount(index, x, count)[filled] / number[filled]
    positions = -float(reach[0]) + (np.arange(count, dtype=np.float64) + 0.5) * float(bin_mm)
    return positions, np.interp(positions, mean_r, mean_x)


def first_below(x: Floats, values: Floats, level: float, never: float) -> float:
    """First x at which a sampled curve falls to ``level``, by linear interpolation; ``never``
    where it does not."""
    below = np.flatnonzero(values <= level)
    if not below.size:
        return never
    k = int(below[0])
    if k == 0:
        return float(x[0])
    return float(
        x[k - 1] + (values[k - 1] - level) / (values[k - 1] - values[k]) * (x[k] - x[k - 1])
    )


@dataclass(frozen=True, eq=False)
class TransferFunction:
    """Task transfer function of an edge.

    Attributes:
        frequencies: cycles per mm, from 0.
        values: normalised to 1 at 0.
        positions, profile: the edge-spread function, mm and HU.
    """

    frequencies: Floats
    values: Floats
    positions: Floats
    profile: Floats

    def frequency(self, level: float) -> float:
        """Lowest frequency (cycles per mm) at which the TTF falls to ``level``; Inf where it
        never does."""
        if not 0 < level < 1:
            raise ValueError(f"level must lie in (0, 1), got {level}")
        return first_below(self.frequencies, self.values, level, math.inf)

    @property
    def f50(self) -> float:
        """Frequency of half the contrast, cycles per mm."""
        return self.frequency(0.5)


@checked
def task_transfer(
    image: ArrayLike, distance: ArrayLike, reach: tuple[float, float], bin_mm: float
) -> TransferFunction:
    """Task transfer function from the ensemble mean of an edge.

    The bins' width and the difference of neighbouring bins each multiply the spectrum by sinc(f ·
    bin); both are divided out, and frequencies up to half the bins' Nyquist frequency are returned.

    Args:
        image, distance, reach, bin_mm: as in :func:`edge_profile`.

    Raises:
        ValueError: as in :func:`edge_profile`; an edge without contrast, or one that noise hides:
            its contrast is less than 5 standard errors, or the transfer at f50 is uncertain by more
            than 0.08.
    """
    positions, profile, frequencies, values = _transfer(image, distance, reach, bin_mm)
    found = TransferFunction(frequencies, values, positions, profile)
    _require_seen(found, as_array(image), as_array(distance), reach, bin_mm)
    return found


def _transfer(
    image: ArrayLike, distance: ArrayLike, reach: tuple[float, float], bin_mm: float
) -> tuple[Floats, ...]:
    """Positions, edge-spread function, frequencies, transfer."""
    positions, profile = edge_profile(image, distance, reach, bin_mm)
    spread = np.diff(profile)
    total = float(spread.sum())
    if total == 0:
        raise ValueError("the edge has no contrast within the reach")
    frequencies = np.fft.rfftfreq(8 * spread.size, bin_mm).astype(np.float64)
    values = np.abs(np.fft.rfft(spread, 8 * spread.size)) / abs(total)
    keep = frequencies <= 0.25 / bin_mm
    frequencies, values = frequencies[keep], values[keep]
    return positions, profile, frequencies, values / np.sinc(frequencies * bin_mm) ** 2


def _require_seen(
    found: TransferFunction,
    image: NDArray[np.float64],
    distance: NDArray[np.float64],
    reach: tuple[float, float],
    bin_mm: float,
) -> None:
    """Refuse an edge that noise hides (ValueError): by a jackknife over sectors, so that
    correlated noise counts."""
    use = (distance >= -reach[0]) & (distance < reach[1])
    sector = _sectors(use)
    steps, transfers = [], []
    for k in range(_SECTORS):
        rest = np.where(use & (sector == k), np.inf, distance)
        try:
            _, profile, _, values = _transfer(image, rest, reach, bin_mm)
        except ValueError:  # bins that this sector alone fills
            continue
        steps.append(_step(profile))
        transfers.append(values)
    n = len(steps)
    if n < _SECTORS // 2:
        return
    step, error = _step(found.profile), _spread_of(np.array(steps))
    if abs(step) < _SEEN * error:
        raise ValueError(
            f"the edge is lost in noise: its contrast is {step:.3g} ± {error:.2g} (standard error "
            "over sectors): take the mean of more realisations, or a noise-free image"
        )
    at = found.f50 if math.isfinite(found.f50) else float(found.frequencies[-1])
    uncertain = float(np.interp(at, found.frequencies, _spread_of(np.array(transfers))))
    if uncertain > _UNCERTAIN:
        raise ValueError(
            f"noise hides the sharpness of the edge: at {at:.3g}/mm its transfer is uncertain by "
            f"{uncertain:.2g} of the contrast (standard error over sectors, {_UNCERTAIN} at most): "
            "take the mean of more realisations, or a noise-free image"
        )


def _sectors(use: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Number of the sector of every voxel, about the middle of those that are used; of a line
    its parts."""
    if use.ndim < 2:
        return np.broadcast_to(np.arange(use.size) * _SECTORS // max(use.size, 1), use.shape)
    at = np.nonzero(use)
    y, x = (
        np.arange(n) - (np.mean(i) if i.size else 0.0)
        for n, i in zip(use.shape[-2:], at[-2:], strict=True)
    )
    angle = np.arctan2(y[:, None], x)
    found = np.minimum(((angle + np.pi) / (2 * np.pi) * _SECTORS).astype(np.int64), _SECTORS - 1)
    return np.broadcast_to(found, use.shape)


def _step(profile: Floats) -> float:
    """Contrast of an edge: the difference of its ends, a quarter of the reach each."""
    n = max(1, profile.size // 4)
    return float(profile[-n:].mean() - profile[:n].mean())


def _spread_of(left_out: Floats) -> Floats:
    """Jackknife standard error of figures with one sector left out each."""
    n = len(left_out)
    return np.sqrt((n - 1) / n * np.square(left_out - left_out.mean(0)).sum(0))
