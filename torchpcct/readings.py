"""From the raw readings of any scanner to what a :class:`torchpcct.scan.Scan` holds: dark, gain,
air, dead cells.

Called by ``Scan.from_counts`` and ``Scan.from_line_integrals``. What a scan makes of its readings
is here, too: weights, the bias of the logarithm, and :func:`interpolate_dead`, which interpolates
dead readings from their neighbours, so that they do not spread over the image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.geometry import Geometry
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.validate import number

if TYPE_CHECKING:
    from torchpcct.detector_window import DetectorWindow
    from torchpcct.geometry import VolumeGrid

__all__ = ["dispersion", "interpolate_dead", "inverse_variance", "log_bias"]

_PSEUDO_DEPTH = 5.0
"""Line integral through as much water as all columns see at the axis, where a scan is not in HU.
The attenuation that so stands for water (0.02 mm⁻¹ where they see 25 cm) sets the scale of priors,
nothing else; it scales as lengths do."""
_SILENT_VIEWS = 8
"""Cells that read nothing in so many views, or more, are dead."""
_DARK = 1e-3
"""Cells that read no more in air than this share of the median cell are dead."""
FEWEST = 0.3
"""Expected counts from which on the logarithm is corrected: see :func:`log_bias`."""
MANY = 10.0
"""Expected counts up to which it is."""
_MUCH_NOISE = 50.0
"""Electronic noise in counts beside which that of photons is as good as normal, too."""
_AVERAGED = 10.0
"""Readings that :func:`smoothed` averages over in effect, of a sinogram; of a cone beam 26."""
_FEW = 1000.0
"""Readings in air below which half a photon matters."""
_NO_PHOTONS = 0.1
"""Variance over mean below which what was read are no photons."""
_NO_COUNTS = 2.0
"""Readings in air that cannot be counts: transmissions."""
_MUCH = 0.3
"""Standard deviation of readings over those in air that ten photons have, and no transmissions."""
DIM = 20.0
"""Photons of a reading below which its noise is far from normal."""
TRANSFER_FRAMES = 4
"""Air frames that a photon transfer needs at least."""


class ReadingFields(TypedDict):
    """Fields of :class:`torchpcct.scan.Scan` that have a value for each reading."""

    counts: Tensor
    quantum: Tensor | None
    dead: Tensor | None


class ScanFields(TypedDict, total=False):
    """Fields of :class:`torchpcct.scan.Scan`, which describes them; a source of scans fills those
    that it knows."""

    counts: Tensor
    air: Tensor
    geometry: Geometry
    linearisation: WaterLinearisation
    exposure_s: float | None
    seed: int | None
    window: DetectorWindow | None
    exterior: Tensor | None
    counting: bool
    info: dict[str, object]
    quantum: Tensor | None
    electronic_noise: float
    flux: Tensor | None
    dead: Tensor | None
    logged: bool
    unit: str
    region: VolumeGrid | None


_TRANSFER_SIGMAS = 3.0
"""Standard errors by which a photon transfer must differ from 1: less, and readings are counts."""
MEDIAN_TO_SD = 1.4826
"""Standard deviation over median absolute deviation, of normal values."""
QUARTILES_TO_SD = 1.0 / 1.349
"""Standard deviation over the distance of the quartiles, of normal values."""
_BLOCK = 2**20
"""Readings that are interpolated at a time, about."""
MOST_DEAD = 0.25
"""Largest share of a view's readings that may be dead: beyond it the neighbours say too little."""


def _tensor(name: str, values: object) -> Tensor:
    """Float32 tensor of numbers in any array.

    Raises:
        TypeError: no array of real numbers.
    """
    if isinstance(values, Tensor):
        if values.is_complex() or values.dtype == torch.bool:
            raise TypeError(f"{name} must be real numbers, got {values.dtype}")
        return values.detach().to("cpu", torch.float32)
    array = np.asarray(values)
    if array.dtype.kind not in "iuf":  # bool is a mask, and no reading
        raise TypeError(
            f"{name} must be an array of real numbers, got {type(values).__name__} of {array.dtype}"
        )
    return torch.from_numpy(np.array(array, dtype=np.float32, order="C"))


def _frame(name: str, values: object, cells: tuple[int, ...]) -> tuple[Tensor, Tensor | None]:
    """Mean over frames ``cells``, and the frames ``(frames, *cells)`` if there are several."""
    given = _tensor(name, values)
    if given.ndim <= len(cells) and tuple(given.shape) == cells[len(cells) - given.ndim :]:
        return given.expand(cells), None
    if tuple(given.shape[1:]) == cells and len(given):
        return given.mean(0), given
    raise ValueError(
        f"{name} must be one number, or have the shape {cells} of one frame or (frames, *{cells}), "
        f"got {tuple(given.shape)}"
    )


def _shapes(name: str, readings: Tensor, geometry: Geometry) -> tuple[int, ...]:
    """Shape of what all views share, ``(*lead, [rows,] columns)``."""
    axes = len(geometry.shape)
    if tuple(readings.shape[-axes:]) != geometry.shape or readings.ndim not in (axes, axes + 1):
        expected = "bins" if geometry.has_rows else "slices"
        raise ValueError(
            f"{name} have the shape {tuple(readings.shape)}, the geometry needs ([{expected},] "
            f"{', '.join(map(str, geometry.shape))}): views first, columns last"
        )
    return (*readings.shape[:-axes], *geometry.shape[1:])


def _correction(
    linearisation: object, geometry: Geometry, mu_water: float | None
) -> tuple[WaterLinearisation, str]:
    """The map of line integrals, and the unit of volumes."""
    columns = geometry.columns
    if mu_water is None:
        mu = _PSEUDO_DEPTH / (columns * geometry.cell)
    else:
        mu = number("mu_water", mu_water, positive=True, unit="mm⁻¹")
    unit = "mm^-1" if mu_water is None else "HU"
    if isinstance(linearisation, WaterLinearisation):
        if linearisation.scale.size != columns:
            raise ValueError(
                f"linearisation has {linearisation.scale.size} columns, the detector {columns}"
            )
        return linearisation, "HU"
    if linearisation is not None and (
        not isinstance(linearisation, Sequence) or isinstance(linearisation, str)
    ):
        raise TypeError(
            f"linearisation must be None, coefficients c₁, c₂, …, or a map, got {linearisation!r}"
        )
    coefficients = (1.0,) if linearisation is None else tuple(linearisation)
    return WaterLinearisation.polynomial(coefficients, columns, mu), unit


def _views(cells: Tensor, geometry: Geometry) -> Tensor:
    """What all views share, with an axis of views."""
    return cells.unsqueeze(-len(geometry.shape))


def _of_views(flux: Tensor, geometry: Geometry) -> Tensor:
    """What all cells of a view share, ``(views,)``, with axes of cells."""
    return flux.reshape(-1, *(1,) * (len(geometry.shape) - 1))


def _dead(mask: object, readings: Tensor, air: Tensor, geometry: Geometry) -> Tensor:
    """Dead readings, ``readings.shape`` or the shape of one frame with an axis of views of
    length 1."""
    cells = tuple(air.shape)
    # Of a cell without signal the mean over frames is noise about 0, not 0.
    dead = _views(~(air > _DARK * air.nanmedian().clamp(min=0.0)) | ~torch.isfinite(air), geometry)
    if geometry.views >= _SILENT_VIEWS:
        dead = dead | (readings == 0).all(-len(geometry.shape), keepdim=True)
    if mask is not None:
        given = torch.as_tensor(np.asarray(mask))
        if given.dtype != torch.bool:
            raise TypeError(
                f"dead must be a mask of bool, True where a cell is dead, got {given.dtype}"
            )
        if given.shape == readings.shape:
            dead = dead | given
        elif given.ndim <= len(cells) and tuple(given.shape) == cells[len(cells) - given.ndim :]:
            dead = dead | _views(given.expand(cells), geometry)
        else:
            raise ValueError(
                f"dead must have the shape {cells} or that of the readings, got "
                f"{tuple(given.shape)}"
            )
    bad = ~torch.isfinite(readings)
    return dead | bad if bool(bad.any()) else dead


def _photon_transfer(frames: Tensor, dark: Tensor) -> float | None:
    """Signal per photon from the variance of air frames over their mean (Janesick 2007); 1, of
    readings that are counts, where it is 1 within its error: of 13 frames of 100 cells that is 5 %.

    None: the frames do not differ, as of averages that were stored several times.
    """
    signal = frames - dark
    # The tube may have drifted. In an uneven field the median of a frame is the reading of one
    # cell; that of its shares of the mean frame is known from all.
    usual = signal.mean(0)
    lit = usual > 0.2 * usual.median()
    level = (signal[:, lit] / usual[lit]).median(1).values
    signal = signal / level.view(-1, *(1,) * (signal.ndim - 1)) * level.mean()
    mean = signal.mean(0)
    # One degree of freedom goes into the mean; the median of a χ² of n - 1 degrees is below its
    # mean.
    ratio = (signal.var(0) / mean)[mean > 0.2 * mean.median()]
    n = len(frames) - 1
    gain = float(ratio.median()) / (1.0 - 2.0 / (9.0 * n)) ** 3
    if not (math.isfinite(gain) and gain > 0):
        return None
    # Of the median of so many χ², π / 2 times the variance of their mean.
    error = gain * math.sqrt(math.pi / (n * ratio.numel()))
    return 1.0 if abs(gain - 1.0) < _TRANSFER_SIGMAS * error else gain


def _gain_of_noise(signal: Tensor, air: Tensor, geometry: Geometry) -> float:
    """Signal per photon that explains the noise of the readings between neighbouring columns
    (:func:`_photons`)."""
    level = _views(air, geometry)
    bad = ~((signal > 0) & (level > 0) & torch.isfinite(signal) & torch.isfinite(level))
    lines = torch.log(torch.where(bad, 1.0, level) / torch.where(bad, 1.0, signal))
    return float(air[air > 0].nanmedian()) / _photons(lines, bad, geometry)


def _gain(
    given: object,
    signal: Tensor,
    air: Tensor,
    frames: Tensor | None,
    dark: Tensor,
    geometry: Geometry,
    electronic_noise: float | None,
) -> tuple[float, str]:
    """Signal of one photon, and where it is from; see ``Scan.from_counts``."""
    if given is None and (frames is None or len(frames) < TRANSFER_FRAMES):
        level = float(air.nanmedian())
        noise = dispersion(signal, geometry.has_rows) if 0 < level < _FEW else 1.0
        if noise < _NO_PHOTONS:
            return max(noise, 1e-8 * level), "noise between neighbours"
        if math.isnan(noise) and 0 < level < _NO_COUNTS and not _whole(signal):
            if electronic_noise or _of_few_photons(signal, level):
                return 1.0, "assumed"
            return 1e-6 * level, "assumed of transmissions"
        return 1.0, "assumed"
    if given is None:
        found = _photon_transfer(frames, dark) if frames is not None else None
        if found is not None:
            return found, "photon transfer of the air frames"
    if given is None or (isinstance(given, str) and given == "noise"):
        return _gain_of_noise(signal, air, geometry), "noise between neighbouring columns"
    return number("gain", given, positive=True), "given"


def counted(
    readings: object,
    geometry: Geometry,
    air: object,
    dark: object,
    gain: object,
    flux: object,
    dead: object,
    electronic_noise: float | None,
    linearisation: object,
    mu_water: float | None,
) -> ScanFields:
    """Fields of a scan from raw readings; see ``Scan.from_counts``."""
    raw = _tensor("readings", readings)
    cells = _shapes("readings", raw, geometry)
    bright, bright_frames = _frame("air", air, cells)
    black, black_frames = _frame("dark", dark, cells)
    if not float((bright - black).nanmedian()) > 0:
        raise ValueError("air is not brighter than dark: are the two exchanged?")
    signal = raw - _views(black, geometry)
    gain, source = _gain(
        gain, signal, bright - black, bright_frames, black, geometry, electronic_noise
    )
    if electronic_noise is None:
        frames = black_frames if black_frames is not None and len(black_frames) > 2 else None
        electronic_noise = 0.0 if frames is None else float(frames.var(0).mean().sqrt()) / gain
    number("electronic_noise", electronic_noise, low=0.0)
    offset = bool((black != 0).any())
    counts, bright = signal / gain, (bright - black) / gain
    mask = _dead(dead, counts, bright, geometry)
    counts = counts.masked_fill(mask, 0.0)
    bright = torch.where((bright > 0) & torch.isfinite(bright), bright, 1.0)
    low = float(counts.min())
    if low < 0 and not offset and not electronic_noise:
        raise ValueError(
            f"counts must not be negative, the lowest is {low:g}: give dark=, or use "
            "from_line_integrals"
        )
    correction, unit = _correction(linearisation, geometry, mu_water)
    integrating = offset or electronic_noise > 0
    fields: ScanFields = {
        "counts": counts,
        "air": bright,
        "linearisation": correction,
        "unit": unit,
        "dead": mask.expand(counts.shape) if bool(mask.any()) else None,
        "counting": not integrating,
        "electronic_noise": electronic_noise,
        "quantum": torch.ones(1).expand(counts.shape) if integrating else None,
        "info": {
            "dead_readings": int(mask.expand(counts.shape).sum()),
            "signal_of_one_photon": gain,
            "signal_of_one_photon_from": source,
        },
    }
    if flux is not None:
        fields["flux"] = _flux(flux, geometry)
    return fields


def _of_few_photons(signal: Tensor, level: float) -> bool:
    """Whether neighbours scatter by so much of the ``level`` in air as a handful of photons do, or
    electronics beside them, and no transmissions."""
    second = (signal[..., 2:] - 2.0 * signal[..., 1:-1] + signal[..., :-2]).abs()
    second = second[torch.isfinite(second)]
    if second.numel() < 8:
        return False
    return float(second.median()) * MEDIAN_TO_SD / math.sqrt(6.0) > _MUCH * level


def _whole(signal: Tensor) -> bool:
    """Whether readings are whole numbers, some of them above 1, as counts are and transmissions
    are not."""
    finite = signal[torch.isfinite(signal)]
    return bool(torch.equal(finite, finite.round())) and bool((finite > 1.0).any())


def _flux(flux: object, geometry: Geometry) -> Tensor:
    given = _tensor("flux", flux)
    if tuple(given.shape) != (geometry.views,):
        raise ValueError(
            f"flux must have one number per view, ({geometry.views},), got {tuple(given.shape)}"
        )
    if not bool(((given > 0) & torch.isfinite(given)).all()):
        raise ValueError(
            "flux must be finite and greater than 0 in every view: leave out views without beam"
        )
    return given


def logged(
    lines: object,
    geometry: Geometry,
    photons: object,
    flux: object,
    dead: object,
    linearisation: object,
    mu_water: float | None,
) -> ScanFields:
    """Fields of a scan from line integrals; see ``Scan.from_line_integrals``."""
    p = _tensor("lines", lines)
    cells = _shapes("lines", p, geometry)
    # a line integral of 0 is air, not a silent cell
    mask = _dead(dead, p + 1.0, torch.ones(cells), geometry)
    p = p.masked_fill(mask, 0.0)
    low, high = float(p.min()), float(p.max())
    if high > _HIGHEST or low < -_HIGHEST:
        raise ValueError(
            f"lines reach from {low:g} to {high:g}, no line integrals (−ln of the transmission): "
            "are they counts, percentages or HU? Use from_counts for readings"
        )
    estimated = photons is None
    current = None if flux is None else _flux(flux, geometry)
    # Along the rays, with what the source sends more or less in each view.
    bright = p if current is None else p - _of_views(current, geometry).log()
    air = (
        torch.tensor(_photons(bright, mask, geometry))
        if photons is None
        else _frame("photons", photons, cells)[0]
    )
    air = air.expand(cells).clone()
    if not bool(((air > 0) & torch.isfinite(air)).all()):
        raise ValueError("photons must be finite and greater than 0 in every cell")
    correction, unit = _correction(linearisation, geometry, mu_water)
    fields: ScanFields = {
        "counts": torch.exp(-bright).mul_(_views(air, geometry)),
        "air": air,
        "linearisation": correction,
        "unit": unit,
        "dead": mask.expand(p.shape) if bool(mask.any()) else None,
        "logged": True,
        "info": {
            "dead_readings": int(mask.expand(p.shape).sum()),
            "photons": f"estimated, {float(air.flatten()[0]):.3g}" if estimated else "given",
        },
    }
    if current is not None:
        fields["flux"] = current
    return fields


_HIGHEST = 40.0
"""No reading of a line integral this large exists: exp(-40) of 1e12 photons is less than one."""


def _photons(p: Tensor, mask: Tensor, geometry: Geometry) -> float:
    """Photons of an unattenuated reading that explain the noise between neighbouring columns.

    The second difference of smooth rows is noise of variance 6 / N; with N = N₀ e^−p, its product
    with e^(−p/2) is alike everywhere. Edges are outliers to the median. Noise-free data give a
    large number, at most 1e8.
    """
    if p.shape[-1] < 8:
        return 1e6
    second = (
        (p[..., 2:] - 2.0 * p[..., 1:-1] + p[..., :-2])
        * torch.exp(-0.5 * p[..., 1:-1])
        / math.sqrt(6.0)
    )
    dead = mask.expand(p.shape)
    live = second[~(dead[..., 2:] | dead[..., 1:-1] | dead[..., :-2])]
    live = live[:: max(1, live.numel() // 1_000_000)]
    if not live.numel():
        return 1e6
    sd = MEDIAN_TO_SD * float(live.abs().median())
    return float(min(max(1.0 / max(sd, 1e-4) ** 2, 1.0), 1e8))


def second_differences(
    values: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Second differences along the last axis, and the means of their three values: white noise has
    six times its variance in the former."""
    before, here, after = values[..., :-2], values[..., 1:-1], values[..., 2:]
    return after - 2.0 * here + before, (after + here + before) / 3.0


def quartile_sd(values: NDArray[np.float64]) -> float:
    """Standard deviation of normal values, from their quartiles: edges among them count little."""
    return float(np.subtract(*np.quantile(values, (0.75, 0.25)))) * QUARTILES_TO_SD


def dispersion(readings: Tensor, rows: bool) -> float:
    """Variance over mean of the noise between neighbours: the reading of one photon; 1 of Poisson
    counts.

    The second difference of smooth readings is noise of six times the variance. Edges are outliers
    to the median; details everywhere raise it, so that the smaller one counts of those along the
    columns and along the views. Readings of a handful of photons do not tell, and are left out, as
    those of 0.

    Args:
        readings: ``(..., views, [rows,] columns)``, the dark taken off.
        rows: whether the last axis but one is the detector's rows.

    Returns:
        NaN if it cannot be determined.
    """
    found = [_dispersion(values) for values in (readings, readings.movedim(-3 if rows else -2, -1))]
    known = [f for f in found if math.isfinite(f)]
    return min(known) if known else math.nan


def _dispersion(readings: Tensor) -> float:
    n = readings.reshape(-1, readings.shape[-1])
    n = n[:: max(1, readings.numel() // 2_000_000)].double()
    second = n[:, 2:] - 2.0 * n[:, 1:-1] + n[:, :-2]
    level = (n[:, 2:] + n[:, 1:-1] + n[:, :-2]) / 3.0
    live = n > 0
    live = live[:, 2:] & live[:, 1:-1] & live[:, :-2]
    del n
    level, ratio = _those(live, level, second.square_().div_(6.0 * level))
    if ratio.numel() < 8:
        return math.nan
    # a first guess from all, then without the dim ones, whose noise is not normal
    guess = float(ratio.median()) * MEDIAN_TO_SD**2
    (ratio,) = _those(level > DIM * guess, ratio)
    return math.nan if ratio.numel() < 8 else float(ratio.median()) * MEDIAN_TO_SD**2


def _those(which: Tensor, *values: Tensor) -> list[Tensor]:
    """Values where a mask says so; all of them, which is often, are not copied."""
    every = bool(which.all())
    return [v.flatten() if every else v[which] for v in values]


def inverse_variance(mean: Tensor, quantum: Tensor, electronic_noise: float) -> Tensor:
    """Inverse variance of the logarithm of readings, by the delta method: mean² / (quantum · mean +
    electronic noise²).

    For readings of few photons the variance of the reading is at least that of half a quantum, as
    their logarithm is bounded in the same way.

    Args:
        mean: expected readings, of any shape; negative ones count as 0.
        quantum: reading of one photon, a shape that broadcasts to that of ``mean``.
        electronic_noise: standard deviation of the electronic noise, in units of the readings.

    Returns:
        Tensor of the shape and dtype of ``mean``.
    """
    mean = mean.clamp(min=0.0)
    return mean.square().div_(
        torch.maximum(mean * quantum + electronic_noise**2, quantum * quantum / 2)
    )


def expected(
    mean: NDArray[np.float64],
    noise: float,
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Expectation of a function of Poisson counts to which electronics add normal noise, from the
    sum over all of them.

    Args:
        mean: ``(k,)`` expected counts, greater than 0.
        noise: standard deviation of the electronics, in counts.
        function: of an array of counts, elementwise.
    """
    z, weight = normal_nodes(6.0, 121) if noise else (np.zeros(1), np.ones(1))
    found: NDArray[np.float64]
    if noise > _MUCH_NOISE:
        spread = np.sqrt(mean + noise**2)[:, None]
        found = function(mean[:, None] + spread * z) @ weight
        return found
    most = float(mean.max())
    n = np.arange(int(most + 12.0 * math.sqrt(most)) + 12)
    factorial = np.concatenate([[0.0], np.cumsum(np.log(n[1:]))])
    probability = np.exp(n * np.log(mean)[:, None] - mean[:, None] - factorial)
    found = probability @ (function(n[:, None] + noise * z) @ weight)
    return found


def normal_nodes(reach: float, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Values of a standard normal variable, up to ``reach`` on either side, and their weights."""
    z = np.linspace(-reach, reach, count)
    weight = np.exp(-z * z / 2.0)
    return z, weight / weight.sum()


def fewest(noise: float) -> float:
    """Expected counts from which on the logarithm is corrected: half of what some ten readings with
    so much electronic noise must expect to be known to a half; ``FEWEST`` without any."""
    return (FEWEST + math.sqrt(FEWEST**2 + 4.0 * FEWEST * noise**2)) / 2.0


def many(noise: float) -> float:
    """Expected counts up to which the logarithm is corrected, where electronics add noise; ``MANY``
    where they do not."""
    return max(MANY, 6.0 * noise + 6.0) if noise else MANY


def shifted(counts: NDArray[np.float64], noise: float) -> NDArray[np.float64]:
    """What the logarithm is taken of, so that few counts bias it little: see
    :meth:`torchpcct.scan.Scan.line_integrals`."""
    more = noise**2 / 2.0 / np.maximum(counts, noise) if noise else 0.0
    return np.maximum(counts + 0.5 + more, 0.5)


@lru_cache(maxsize=16)
def _log_bias(noise: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """ln m, and what the logarithm of Poisson counts, E ln(n + ½), lies above it."""
    m = np.geomspace(fewest(noise), many(noise), 200)
    mean = expected(m, noise, lambda n: np.log(shifted(n, noise)))
    return np.log(m), mean - np.log(m)


def log_bias(mean: Tensor, noise: float = 0.0) -> Tensor:
    """Mean of ln(n + ½) less the logarithm of the mean, of Poisson counts n; with electronic noise
    that of :func:`shifted` counts.

    0.03 at two counts, 0.17 at one, 0.8 at ``FEWEST``: it takes the darkest rays for brighter than
    they are. With a noise of four counts 0.1 at five, 0.36 at 2.4.

    Args:
        mean: expected counts, estimated from some ten readings (:func:`smoothed`). Above
            :func:`many` the bias is 0; below :func:`fewest` it is that of so many, for the
            estimate itself says no more.
        noise: standard deviation of the electronics, in counts.
    """
    known, bias = _log_bias(noise)
    least, most = fewest(noise), many(noise)
    # The logarithm of the estimate is biased, too: ½ a count in those that it was made of.
    m = mean + 0.5 / _AVERAGED
    if noise:
        m += 0.5 / _AVERAGED * noise**2 / mean.clamp(min=least)
    if mean.device.type != "cpu":
        return _of_table(m.clamp(min=least).log(), known, bias, math.log(most))
    dim = m < most
    found = np.interp(np.log(m[dim].double().clamp(least, most).numpy()), known, bias)
    return torch.zeros_like(mean).masked_scatter_(dim, torch.from_numpy(found).to(mean.dtype))


def _of_table(
    at: Tensor, known: NDArray[np.float64], values: NDArray[np.float64], end: float
) -> Tensor:
    """``numpy.interp`` with torch, 0 from ``end`` on: on any device, for all readings alike."""
    x, y = (torch.from_numpy(v).to(at.device) for v in (known, values))
    place = at.double().clamp(known[0], known[-1])
    right = torch.searchsorted(x, place).clamp(1, len(known) - 1)
    low, high = y[right - 1], y[right]
    found = low + (high - low) * (place - x[right - 1]) / (x[right] - x[right - 1])
    return torch.where(at < end, found, 0.0).to(at.dtype)


def smoothed(values: Tensor, dead: Tensor | None, rows: bool, own: bool = True) -> Tensor:
    """Mean over the neighbourhood of every reading, the dead left out: an estimate of the expected
    readings.

    Binomial weights over five columns, three views and, of a cone beam, three rows. Weights made
    from a noisy reading itself go up where the noise does and bias the result; the mean of 45 (15)
    readings hardly knows its own noise.

    Args:
        values: ``(..., views, [rows,] columns)``.
        dead: bool of the same shape, or None.
        rows: whether the last axis but one is the detector's rows.
        own: whether the reading itself is one of them. Without it the mean knows nothing of its
            noise.
    """
    out = values.clone()
    share = None if dead is None else (~dead).to(values.dtype)
    if share is not None:
        out *= share
    alone = None if own else (out.clone(), share)
    axes = ((-1, (1, 4, 6, 4, 1)), (-2, (1, 2, 1)), *(((-3, (1, 2, 1)),) if rows else ()))
    for axis, weights in axes:
        out = _filtered(out, axis, weights)
        share = None if share is None else _filtered(share, axis, weights)
    if alone is not None:
        middle = math.prod(max(weights) / sum(weights) for _, weights in axes)
        out = out.sub_(alone[0], alpha=middle)
        if share is None or alone[1] is None:
            return out.div_(1.0 - middle)
        share = share - middle * alone[1]
    return out if share is None else out / share.clamp(min=1e-6)


def _filtered(values: Tensor, axis: int, weights: tuple[int, ...]) -> Tensor:
    """Weighted mean over neighbours along an axis; the outermost value is repeated."""
    n, half = values.shape[axis], len(weights) // 2
    out = torch.zeros_like(values)
    index = torch.arange(n, device=values.device)
    for k, w in enumerate(weights):
        out.add_(
            values.index_select(axis, (index + k - half).clamp(0, n - 1)), alpha=w / sum(weights)
        )
    return out


def interpolate_dead(lines: Tensor, dead: Tensor, rows: bool, most: float = MOST_DEAD) -> Tensor:
    """Replace dead readings by linear interpolation between the nearest live ones.

    Along the columns of a row where live readings stand on both sides, else along the rows; beyond
    the outermost live column (then row) its value is repeated. Views without any live reading are
    interpolated between the nearest live ones, in the order given.

    Args:
        lines: ``(..., views, [rows,] columns)``.
        dead: bool of the same shape, or one that broadcasts to it.
        rows: whether the last axis but one is the detector's rows (cone beams), so that a lost row
            can be interpolated.
        most: largest share of a view's readings that may be dead; 1: any, as long as a reading is
            left.

    Returns:
        Tensor of the shape and dtype of ``lines``: linear in the live readings, differentiable, and
        independent of what the dead ones hold.

    Raises:
        ValueError: a view of which more than ``most`` is dead; no live reading at all.
    """
    dead = dead.expand(lines.shape)
    axes = (-2, -1) if rows else (-1,)
    share = dead.float().mean(axes)
    if float(share.max()) > most:
        worst = torch.unravel_index(share.argmax(), share.shape)
        raise ValueError(
            f"{100 * float(share.max()):.0f} % of the readings of view {int(worst[-1])} are dead "
            f"(NaN, Inf or masked), at most {100 * most:.0f} % can be interpolated: leave bad "
            "views out with geometry.select"
        )
    if bool(dead.all()):
        raise ValueError(
            "all readings are dead (NaN, Inf or masked): check the mask dead= and the file"
        )
    across = (
        ((-1, True), (-2, True), (-1, False), (-2, False)) if rows else ((-1, True), (-1, False))
    )
    view = -3 if rows else -2
    # What a dead cell holds must not reach anything, not as 0 × NaN either. Block by block: indices
    # need memory.
    split = max(view, -lines.ndim)
    step = (
        lines.shape[split]
        if split != view
        else max(1, _BLOCK * lines.shape[view] // max(lines.numel(), 1))
    )
    blocks = [
        _interpolated_along(torch.where(d, 0.0, v), d, across)
        for v, d in zip(lines.split(step, split), dead.split(step, split), strict=True)
    ]
    values, left = (torch.cat(parts, split) for parts in zip(*blocks, strict=True))
    return _interpolated_along(values, left, ((view, True), (view, False)))[0]


def _interpolated_along(
    values: Tensor, dead: Tensor, axes: Sequence[tuple[int, bool]]
) -> tuple[Tensor, Tensor]:
    """:func:`_filled_along_axis` along one axis after the other, until nothing is dead."""
    for axis, between in axes:
        if not bool(dead.any()):
            break
        values, dead = _filled_along_axis(values, dead, axis, between)
    return values, dead


def _filled_along_axis(
    values: Tensor, dead: Tensor, axis: int, between: bool
) -> tuple[Tensor, Tensor]:
    """Linear interpolation over the dead along one axis, and what stays dead.

    Args:
        values: any shape, finite.
        dead: of the same shape.
        axis: of both.
        between: only between two live readings; else beyond the outermost live one, too, which is
            repeated there.
    """
    n = values.shape[axis]
    values, dead = values.movedim(axis, -1), dead.movedim(axis, -1).clone()
    touched = dead.any(-1) & ~dead.all(-1)
    lost = dead[touched]
    place = torch.arange(n, device=values.device).expand(lost.shape)
    left = torch.where(lost, -1, place).cummax(-1).values
    right = torch.where(lost, n, place).flip(-1).cummin(-1).values.flip(-1)
    if between:
        reached = lost & (left >= 0) & (right < n)
        left, right = left.clamp(min=0), right.clamp(max=n - 1)
    else:
        reached = lost
        left, right = torch.where(left < 0, right, left), torch.where(right == n, left, right)
    share = (place - left) / (right - left).clamp(min=1)
    old = values[touched]
    filled = torch.lerp(old.gather(-1, left), old.gather(-1, right), share.to(values.dtype))
    out = values.clone()
    out[touched] = torch.where(reached, filled, old)
    dead[touched] = lost & ~reached
    return out.movedim(-1, axis), dead.movedim(-1, axis)
