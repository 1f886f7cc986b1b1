"""Energy bins summed with weights: one channel of line integrals that shows a given contrast best.

A photon-counting scanner whose bins are added up gives every photon the weight 1. With weights w_k
the reading is S = Σ_k w_k N_k; a contrast of the attenuation δμ(E) over a short length changes ln S
by Σ w_k s_k / Σ w_k N_k with s_k = Σ_E n_k(E) δμ(E), n_k(E) the photons of energy E that bin k
counts, and counts are Poisson and independent, so that ln S has the variance Σ w_k² N_k / (Σ w_k
N_k)². The squared signal-to-noise ratio (Σ w_k s_k)² / Σ w_k² N_k is largest for

    w_k ∝ s_k / N_k,                                                                            (1)

the mean contrast of the photons in the bin (Tapiovaara and Wagner, Phys. Med. Biol. 30, 519, 1985,
for photons of known energy; Schmidt, Med. Phys. 36, 3018, 2009, for bins). Where the contrast
changes its sign between bins, the best of the weights that are not negative are those of (1) with
0 for the others: the logarithm of a sum needs a sum that stays above 0.

The weights are 1 in the mean over the photons that are counted, so that a weighted reading is as
large as the counts it was made of.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torchpcct.readings import smoothed
from torchpcct.scanner.linearisation import THICKEST_MM, WaterLinearisation
from torchpcct.scanner.scanner import PILE_UP_ORDER, Scanner
from torchpcct.scene.materials import MATERIALS, Material, material
from torchpcct.validate import checked, choice, number, reals

__all__ = ["BinWeights", "bin_weights", "contrast_information", "weighting_gain"]

Floats = NDArray[np.float64]

_NEVER = 1e-9
"""A bin with a smaller share of the counts never counts: its weight would be a ratio of
round-off."""
_SAME_AIR = 1e-3
"""Relative difference of the air readings of one scanner, of float32 and of interpolated maps."""
_SAMPLES = 400
"""Water thicknesses at which pile-up is known for the water correction."""


M = TypeVar("M", bound=Material | str)
"""Materials or their names: the keys of a mapping of the one kind, of the other, or of both."""


class BinWeights(np.ndarray[tuple[int, int], np.dtype[np.float64]]):
    """An array ``(bins, columns)`` of weights that knows what it was made for.

    Attributes:
        scanner: whose bins they are; None: not known (of an array that was not made by
            :func:`bin_weights`).
        contrast: names of the two materials.
        behind: material's name → mm.
    """

    scanner: Scanner | None
    contrast: tuple[str, ...]
    behind: dict[str, float]

    def __new__(
        cls,
        values: ArrayLike,
        scanner: Scanner | None = None,
        contrast: Sequence[str] = (),
        behind: Mapping[str, float] | None = None,
    ) -> BinWeights:
        self = np.array(values, np.float64).view(cls)
        self.scanner, self.contrast, self.behind = scanner, tuple(contrast), dict(behind or {})
        return self

    def __array_finalize__(self, source: object) -> None:
        self.scanner = getattr(source, "scanner", None)
        self.contrast = getattr(source, "contrast", ())
        self.behind = getattr(source, "behind", {})

    def __reduce__(self) -> tuple[object, ...]:
        return BinWeights, (np.asarray(self), self.scanner, self.contrast, self.behind)


@checked
def bin_weights(
    scanner: Scanner,
    contrast: Sequence[Material | str],
    behind: Mapping[M, float] | None = None,
) -> BinWeights:
    """Weights of the energy bins that show a small contrast best, column by column.

    They differ between the columns because the bowtie hardens the beam; the energies of the
    scanner's own photons and responses are known, nothing is fitted.

    Args:
        scanner: with a photon-counting detector of two bins or more.
        contrast: ``(a, b)``, materials or their names: a instead of b.
        behind: material or name → mm that the rays cross besides; None: nothing.

    Returns:
        ``(bins, columns)`` float64 ≥ 0, with the mean 1 over the photons that are counted behind
        these materials; for :meth:`torchpcct.Scan.weighted`.

    Raises:
        ValueError: a detector of one bin or one that integrates energy, materials that attenuate
            alike, a length < 0, a bin that never counts behind these materials.
        TypeError: values of the wrong kind.
    """
    counted, change, names, paths = _photons(scanner, contrast, behind)
    return BinWeights(_best(counted.sum(-1), counted @ change), scanner, names, paths)


@checked
def weighting_gain(
    scanner: Scanner,
    contrast: Sequence[Material | str],
    behind: Mapping[M, float] | None = None,
    weights: object = "bins",
) -> Floats:
    """What weights bring: squared signal-to-noise ratio of a small contrast over that of the summed
    counts, which is the factor in dose.

    Args:
        scanner, contrast, behind: of :func:`bin_weights`.
        weights: ``(bins, columns)``; ``"bins"``: the best ones; ``"energies"``: the best weight for
            every counted photon by its own energy, which no detector reports: the limit of any
            number of bins.

    Returns:
        ``(columns,)`` float64.

    Raises:
        ValueError, TypeError: as of :func:`bin_weights`; weights of another shape, negative or not
            finite.
    """
    counted, change, _, _ = _photons(scanner, contrast, behind)
    counts, signal = counted.sum(-1), counted @ change
    if isinstance(weights, str):
        if choice("weights", weights, ("bins", "energies")) == "energies":
            photons = counted.sum(0)
            return np.asarray((photons @ change**2) * photons.sum(-1) / np.square(photons @ change))
        weights = _best(counts, signal)
    w = _values(weights, counts.shape)
    return np.asarray(
        np.square((w * signal).sum(0) / signal.sum(0)) * counts.sum(0) / (w**2 * counts).sum(0)
    )


@checked
def contrast_information(
    scanner: Scanner,
    contrast: Sequence[Material | str],
    behind: Mapping[M, float] | None = None,
    weights: object = "bins",
) -> Floats:
    """Squared signal-to-noise ratio of a small contrast that is larger than a cell, per mm² of its
    thickness and mAs: what detectors with other thresholds, resolution or charge sharing are
    compared by.

    A photon whose charge is shared between two cells may count in both. Over many cells that is one
    photon read twice, with the variance of :meth:`SiliconDetector.joint_counts
    <torchpcct.scanner.SiliconDetector.joint_counts>`; simulated scans draw all cells and bins
    independently, which takes it for two.

    Args:
        scanner: with silicon in energy bins.
        contrast, behind: of :func:`bin_weights`.
        weights: ``(bins, columns)``; ``"bins"``: the best ones, M⁻¹ s of the variances M of the
            counts of all cells together; ``"sum"``: 1 in all bins.

    Returns:
        ``(columns,)`` float64, mm⁻² mAs⁻¹.

    Raises:
        ValueError, TypeError: as of :func:`weighting_gain`.
    """
    counted, change, _, _ = _photons(scanner, contrast, behind)
    signal = counted @ change
    detector: Any = scanner.detector
    energies, quanta = scanner.quanta()
    depth = sum(
        (material(m).attenuation(energies) * t for m, t in (behind or {}).items()),
        np.zeros(energies.size),
    )
    variance = np.einsum(
        "kle,ce->ckl", detector.joint_counts(energies), quanta * np.exp(-depth), optimize=True
    )
    if isinstance(weights, str):
        if choice("weights", weights, ("bins", "sum")) == "bins":
            best = np.linalg.solve(variance, signal.T[..., None])[..., 0]
            return np.asarray((best * signal.T).sum(-1))
        weights = np.ones(signal.shape)
    w = _values(weights, signal.shape)
    return np.asarray((w * signal).sum(0) ** 2 / np.einsum("kc,ckl,lc->c", w, variance, w))


def _photons(
    scanner: Scanner,
    contrast: Sequence[Material | str],
    behind: Mapping[M, float] | None,
) -> tuple[Floats, Floats, tuple[str, ...], dict[str, float]]:
    """Photons ``(bins, columns, E)`` that are counted behind the materials, the contrast ``(E,)``
    in mm⁻¹, and the names."""
    _require_bins(scanner)
    if isinstance(contrast, str) or len(contrast) != 2:
        raise ValueError(
            f"contrast must be two materials, (a, b) for a instead of b, got {contrast!r}"
        )
    first, second = map(material, contrast)
    paths = {
        material(m): number(f"behind[{m!r}]", t, low=0.0, unit="mm")
        for m, t in (behind or {}).items()
    }
    energies, _ = scanner.weights()
    change = first.attenuation(energies) - second.attenuation(energies)
    counted = scanner.behind(paths)
    if not np.abs(change).max() > 1e-9 * first.attenuation(energies).max():
        raise ValueError(
            f"contrast: {first.name} and {second.name} attenuate alike at all energies: name two "
            "different materials"
        )
    counts = counted.sum(-1)
    share = counts / np.maximum(counts.sum(0), np.finfo(float).tiny)
    if not share.min() > _NEVER:
        bad, column = np.unravel_index(int(share.argmin()), share.shape)
        raise ValueError(
            f"energy bin {bad} of {len(share)} ({_bin_text(scanner, int(bad))}) never counts in "
            f"column {column} behind these materials ({share[bad, column]:.1g} of the counts): "
            "leave its threshold out of the detector, or set a higher tube voltage"
        )
    return counted, change, (first.name, second.name), {m.name: t for m, t in paths.items()}


def _best(counts: Floats, signal: Floats) -> Floats:
    """Weights ``(bins, columns)`` ≥ 0 of the least relative noise, with the mean 1 over the counts;
    both arguments of that shape."""
    per_photon = signal / counts
    # Of the two signs that whose bins hold more; with independent bins the others weigh nothing.
    positive, negative = (
        (np.maximum(sign * per_photon, 0.0) ** 2 * counts).sum(0) for sign in (1.0, -1.0)
    )
    best = np.maximum(np.where(positive >= negative, 1.0, -1.0) * per_photon, 0.0)
    best *= counts.sum(0) / (best * counts).sum(0)
    return best


def _require_bins(scanner: Scanner) -> None:
    if scanner.detector.energy_integrating or scanner.detector.bins < 2:
        raise ValueError(
            f"{scanner.name!r} reads {scanner.detector.bins} bin(s): weights need photon counts in "
            "at least 2 energy bins, such as presets.pcct(mode='spectral')"
        )


def _bin_text(scanner: Scanner, index: int) -> str:
    thresholds: Sequence[float] = getattr(scanner.detector, "thresholds_kev", ())
    if index >= len(thresholds):
        return "counted from 0"
    upper = f"…{thresholds[index + 1]:g}" if index + 1 < len(thresholds) else " and more"
    return f"counted from 0; {thresholds[index]:g}{upper} keV"


def _values(weights: object, shape: tuple[int, ...]) -> Floats:
    values = np.asarray(reals("weights", weights), np.float64)
    if values.shape != shape:
        raise ValueError(
            f"weights must have the shape (bins, columns) {shape} of the scanner, got "
            f"{values.shape}: make them with bin_weights(scanner, …) of this scanner"
        )
    if not (np.isfinite(values).all() and (values >= 0).all()):
        raise ValueError(
            "weights must be finite and not negative: the logarithm needs a sum above 0"
        )
    if not (values.sum(0) > 0).all():
        raise ValueError(
            f"all weights of column {int(values.sum(0).argmin())} are 0: no reading would be left "
            "there"
        )
    return values


# --- scans ----------------------------------------------------------------------------------------


def weighted_scan(scan: Any, weights: Any, scanner: Scanner | None = None) -> Any:
    """The :class:`torchpcct.Scan` of the weighted sum; see its method ``weighted``, which calls
    this."""
    if scan.counts.ndim != 4 or not scan.counting or scan.logged:
        raise ValueError(
            f"weights sum photon counts in energy bins (bins, views, rows, columns), this is "
            f"{scan!r}: acquire with presets.pcct(mode='spectral'), and weight it once"
        )
    bins, columns = scan.counts.shape[0], scan.geometry.columns
    values = _values(weights, (bins, columns))
    scanner = scanner or getattr(weights, "scanner", None)
    if scanner is None:
        raise ValueError(
            "the water correction needs the scanner that these weights belong to: give scanner=, "
            "or make the weights with bin_weights"
        )
    if not isinstance(scanner, Scanner):
        raise TypeError(f"scanner must be a Scanner, got {type(scanner).__name__}")
    _require_scanner(scan, scanner)
    silent = [k for k in range(bins) if values[k].any() and not float(scan.counts[k].amax()) > 0]
    if silent:
        raise ValueError(
            f"energy bin {silent[0]} of {bins} ({_bin_text(scanner, silent[0])}) has not counted "
            "a photon in the whole scan: give it the weight 0 in all columns, or leave it out of "
            "the detector"
        )

    first, second = (weighted_sum(scan, scan.counts, values**power) for power in (1, 2))
    dead = scan.dead
    if dead is not None:
        used = torch.from_numpy(values > 0).any(1)
        dead = dead[used].any(0)
    if not scan.noise_free:
        # Of expected readings: a quantum from the noisy reading itself would go up where it does.
        moments = (smoothed(m, dead, scan.geometry.has_rows) for m in (first, second))
        mean, square = moments
    else:
        mean, square = first, second
    air, air_square = (_summed_cells(scan.air, values**power) for power in (1, 2))
    in_air = scan._at_window(air_square / air).expand(first.shape)
    quantum = torch.where((mean > 0) & (square > 0), square / mean, in_air)
    made = {
        "contrast": list(getattr(weights, "contrast", ())),
        "behind_mm": dict(getattr(weights, "behind", {})),
        "weights": [round(float(w), 4) for w in values[:, columns // 2]],
    }
    return replace(
        scan,
        counts=first,
        air=air,
        exterior=None if scan.exterior is None else _summed_cells(scan.exterior, values),
        linearisation=_linearisation(scanner, values),
        counting=False,
        quantum=quantum,
        electronic_noise=0.0,
        dead=dead,
        info={**scan.info, "energies": made},
    )


def weighted_sum(scan: Any, readings: Tensor, weights: Floats) -> Tensor:
    """Σ_k w_k N_k of readings ``(bins, views, r, c)`` of a scan's cells, ``(views, r, c)``."""
    total = torch.zeros_like(readings[0])
    for values, w in zip(readings, _per_cell(weights, readings), strict=True):
        total.addcmul_(values, scan._at_window(w.expand(scan.air.shape[1:])))
    return total


def _summed_cells(cells: Tensor, weights: Floats) -> Tensor:
    """Σ_k w_k N_k of ``(bins, rows, columns)``."""
    return (cells * _per_cell(weights, cells)).sum(0)


def _per_cell(weights: Floats, like: Tensor) -> Tensor:
    """``(bins, 1, columns)``, to broadcast over rows."""
    return torch.from_numpy(weights)[:, None].to(like.dtype)


def _require_scanner(scan: Any, scanner: Scanner) -> None:
    """Refuse weights of another scanner than the scan's: its readings in air tell."""
    _require_bins(scanner)
    _, spectra = scanner.weights()
    air = spectra.sum(-1)
    found = scan.air.double().numpy()
    if air.shape == (found.shape[0], found.shape[-1]):
        if (pile_up := scanner.pile_up()) is not None:
            true = torch.from_numpy(air)
            air = pile_up.apply(true, true, np.arange(air.shape[-1])).numpy()
        # The exposure is free, and which rows were read: each may have a level of its own.
        ratio = found / np.maximum(air, np.finfo(float).tiny)[:, None]
        level = np.median(ratio, axis=(0, 2), keepdims=True)
        difference = float(np.abs(ratio / level - 1.0).max())
    else:
        difference = np.inf
    if not difference < _SAME_AIR:
        reason = (
            f"{100 * difference:.3g} %"
            if np.isfinite(difference)
            else f"{(found.shape[0], found.shape[-1])} and {air.shape} (bins, columns)"
        )
        raise ValueError(
            f"the weights are of another scanner than the scan (readings in air differ: {reason}): "
            "make them with bin_weights of the scanner, the tube voltage and the thresholds of "
            "the scan"
        )


def _linearisation(scanner: Scanner, weights: Floats) -> WaterLinearisation:
    """Water correction of the weighted sum: on what the detector records, pile-up with it."""
    energies, spectra = scanner.weights()
    water = MATERIALS["water"].attenuation(energies)
    combined = np.einsum("bc,bce->ce", weights, spectra)
    pile_up = scanner.pile_up()
    if pile_up is None:
        return WaterLinearisation.calibrate(combined, water)
    # dense where the rate is high
    t = THICKEST_MM * np.linspace(0.0, 1.0, _SAMPLES) ** 1.5
    transmitted = np.exp(-np.outer(water, t))
    bins = spectra @ transmitted  # (bins, columns, t)
    total = bins.sum(0)
    true = np.log(total[:, :1] / total)
    columns = np.arange(spectra.shape[1])[:, None]
    recorded = np.einsum("bc,bct->ct", weights, bins * np.exp(pile_up.at(true, columns)))
    free = np.einsum("bc,bct->ct", weights, bins)
    free, recorded = (np.log(s[:, :1] / s) for s in (free, recorded))

    def shift(p: Floats) -> Floats:
        found = [np.interp(p_, x, y) for p_, x, y in zip(p, free, recorded - free, strict=True)]
        return np.stack(found)

    return WaterLinearisation.calibrate(combined, water, PILE_UP_ORDER, shift)
