"""Counts of the detector at its rates; what pile-up and charge sharing cost in counts, energy, CT numbers, noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchpcct.scanner import Scanner, SiliconDetector, presets
from torchpcct.scanner.pileup import recorded_rates
from torchpcct.scanner.silicon_transport import efficiency, follow
from torchpcct.scene.materials import PLAQUE_MATERIALS, material

__all__ = ["EXPOSURE_S", "FAT_MM", "beam_behind", "charge_sharing", "counts", "hu_shift", "pile_up"]

Floats = NDArray[np.float64]

EXPOSURE_S = 0.35
FAT_MM = 240.0
INSET_MM = 3.36
"""Vessel diameter: the path of the contrast that pile-up and charge sharing may change."""


def beam_behind(scanner: Scanner, name: str = "pericoronary_fat", path_mm: float = FAT_MM) -> tuple[Floats, Floats]:
    """Energies and photons per mAs that reach the central cell behind a slab."""
    energies, quanta = scanner.quanta()
    centre = scanner.geometry.columns // 2
    return energies, np.asarray(quanta[centre] * np.exp(-material(name).attenuation(energies) * path_mm))


def hu_shift(energies: Floats, before: Floats, after: Floats) -> dict[str, float]:
    """How far the CT numbers of the plaque's materials move between two weightings of the energies."""
    return {n: material(n).hu(energies, after) - material(n).hu(energies, before) for n in PLAQUE_MATERIALS}


def counts() -> list[dict[str, Any]]:
    """Photons that reach and count in the central cell, in air and behind the patient."""
    scanner = presets.pcct()
    load, area = scanner.mas_per_view(EXPOSURE_S), float(np.prod(scanner.geometry.pitch))
    rows = []
    for name, path in (("air", 0.0), (f"{FAT_MM / 10:.0f} cm fat", FAT_MM)):
        energies, photons = beam_behind(scanner, path_mm=path)
        counted, incident = float(scanner.detector.response(energies)[0] @ photons), photons.sum()
        rows.append(
            {
                "behind": name,
                "incident_per_view": load * incident,
                "counted_per_view": load * counted,
                "share": counted / incident,
                "incident_mcps_mm2": incident * scanner.source.current_ma / area / 1e6,
            }
        )
    return rows


def _mean_energy(thresholds: Any, binned: Any) -> float:
    """Mean energy of the bins (their middle; the open one by the width of its neighbour), weighted by counts."""
    edges = np.append(thresholds, 2 * thresholds[-1] - thresholds[-2])
    return float((edges[:-1] + edges[1:]) @ binned / 2 / binned.sum())


def charge_sharing(share: float, photons: int, rng: np.random.Generator) -> dict[str, Any]:
    """Counts (both parts may count), photons (or none), energies, CT numbers and efficiency if pulses split between two
    strips."""
    energies, beam = beam_behind(presets.pcct())
    pure, split = SiliconDetector("spectral"), SiliconDetector("spectral", charge_sharing=share)
    before, after = pure.response(energies) @ beam, split.response(energies) @ beam
    lowest = pure.thresholds_kev[:1]
    seen = [float(d.photons_above(energies, lowest)[0] @ beam) for d in (pure, split)]
    deposits = follow(SiliconDetector(), energies, beam, photons, rng)
    thresholds, sigma = pure.thresholds_kev, pure.sigma_kev
    dqe = [efficiency(deposits.counts(thresholds[0], sigma, rng, charge_sharing=c))[0] for c in (0.0, share)]
    return {
        "share": share,
        "counts_percent": 100 * float(after.sum() / before.sum() - 1),
        "photons_percent": 100 * (seen[1] / seen[0] - 1),
        "bins": (after / after.sum()).tolist(),
        "bins_without": (before / before.sum()).tolist(),
        "energy_shift_kev": _mean_energy(thresholds, after) - _mean_energy(thresholds, before),
        "hu_shift": hu_shift(energies, pure.response(energies).sum(0) * beam, split.response(energies).sum(0) * beam),
        "dqe_without": dqe[0],
        "dqe": dqe[1],
        "dqe_percent": 100 * float(dqe[1] / dqe[0] - 1),
    }


def pile_up(dead_ns: float) -> dict[str, Any]:
    """Losses, spectra and CT numbers with a dead time, in air and behind the body."""
    result: dict[str, Any] = {"dead_time_ns": dead_ns, "merge_ns": dead_ns / 2}
    spectral = SiliconDetector("spectral", dead_time_ns=dead_ns, merge_ns=dead_ns / 2)
    free, scanner = presets.pcct(), presets.pcct(detector=SiliconDetector(dead_time_ns=dead_ns, merge_ns=dead_ns / 2))
    current = scanner.source.current_ma
    for key, path in (("air", 0.0), ("body", FAT_MM)):
        energies, beam = beam_behind(scanner, path_mm=path)
        true = spectral.response(energies) @ beam * current
        recorded = recorded_rates(spectral, energies, beam * current)
        thresholds = spectral.thresholds_kev
        result[key] = {
            "true_mcps": float(true.sum()) / 1e6,
            "lost_percent": 100 * float(1 - recorded.sum() / true.sum()),
            "energy_shift_kev": _mean_energy(thresholds, recorded) - _mean_energy(thresholds, true),
            "top_bin_percent": [100 * float(v[-1] / v.sum()) for v in (true, recorded)],
        }
    # Line integrals of the central ray: air and body as recorded, with the correction of the ideal detector and with
    # one that was calibrated in water with pile-up on.
    body, reference = _lines(free, free), free.water_linearisation().mu_ref
    for name, corrected in (("uncorrected", free), ("calibrated", scanner)):
        lines, mu = _lines(scanner, corrected), corrected.water_linearisation().mu_ref
        result[f"{name}_body_hu"] = 1000 * float(lines[0] / mu - body[0] / reference) / FAT_MM
        contrast = (lines[1] - lines[0]) / mu - (body[1] - body[0]) / reference
        result[f"{name}_contrast_hu"] = 1000 * float(contrast) / INSET_MM
    result["true_contrast_hu"] = 1000 * float(body[1] - body[0]) / reference / INSET_MM
    return result


def _lines(scanner: Scanner, corrected: Scanner) -> Floats:
    """Corrected line integrals of the central ray: 24 cm of fat, and with 3.36 mm of it replaced by blood."""
    energies, air = beam_behind(scanner, path_mm=0.0)
    fat, blood = (material(n).attenuation(energies) for n in ("pericoronary_fat", "blood_iodine"))
    depths = np.array([0 * fat, fat * FAT_MM, fat * (FAT_MM - INSET_MM) + blood * INSET_MM])
    detector: Any = scanner.detector
    rates = recorded_rates(detector, energies, air * scanner.source.current_ma * np.exp(-depths))[0]
    linearisation = corrected.water_linearisation()
    columns = linearisation.scale.size
    spread = torch.from_numpy(np.repeat(np.log(rates[0] / rates[1:])[:, None], columns, axis=1))
    return linearisation.apply(spread).numpy()[:, columns // 2]
