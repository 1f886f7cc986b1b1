"""Charge sharing and pile-up of the detector study: what they cost in counts, energy, CT numbers and noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.study.report import markdown_table
from torchpcct.scanner import Scanner, SiliconDetector, presets
from torchpcct.scanner.pileup import recorded_rates
from torchpcct.scanner.silicon_transport import efficiency, follow
from torchpcct.scene.materials import PLAQUE_MATERIALS, material

__all__ = ["FAT_MM", "beam_behind", "charge_sharing", "charge_sharing_section", "pile_up", "pile_up_section"]

Floats = NDArray[np.float64]

FAT_MM = 240.0
INSET_MM = 3.36
"""Vessel diameter: the path of the contrast that pile-up and charge sharing may change."""


def beam_behind(scanner: Scanner, name: str = "pericoronary_fat", path_mm: float = FAT_MM) -> tuple[Floats, Floats]:
    """Energies and photons per mAs that reach the central cell behind a slab."""
    energies, quanta = scanner.quanta()
    centre = scanner.geometry.columns // 2
    return energies, np.asarray(quanta[centre] * np.exp(-material(name).attenuation(energies) * path_mm))


def _mean_energy(thresholds: Any, counts: Any) -> float:
    """Mean energy of the bins (their middle; the open one by the width of its neighbour), weighted by counts."""
    edges = np.append(thresholds, 2 * thresholds[-1] - thresholds[-2])
    return float((edges[:-1] + edges[1:]) @ counts / 2 / counts.sum())


def charge_sharing(share: float, photons: int, rng: np.random.Generator) -> dict[str, Any]:
    energies, beam = beam_behind(presets.pcct())
    pure, split = SiliconDetector("spectral"), SiliconDetector("spectral", charge_sharing=share)
    before, after = pure.response(energies) @ beam, split.response(energies) @ beam
    counting, sharing = pure.response(energies).sum(0) * beam, split.response(energies).sum(0) * beam
    deposits = follow(SiliconDetector(), energies, beam, photons, rng)
    thresholds, sigma = pure.thresholds_kev, pure.sigma_kev
    dqe = [efficiency(deposits.counts(thresholds[0], sigma, rng, charge_sharing=c))[0] for c in (0.0, share)]
    shift = {n: material(n).hu(energies, sharing) - material(n).hu(energies, counting) for n in PLAQUE_MATERIALS}
    return {
        "share": share,
        "counts_percent": 100 * float(after.sum() / before.sum() - 1),
        "bins": (after / after.sum()).tolist(),
        "bins_without": (before / before.sum()).tolist(),
        "energy_shift_kev": _mean_energy(pure.thresholds_kev, after) - _mean_energy(pure.thresholds_kev, before),
        "hu_shift": shift,
        "dqe_without": dqe[0],
        "dqe": dqe[1],
    }


def charge_sharing_section(rows: list[dict[str, Any]]) -> str:
    table = [
        [
            f"{100 * r['share']:.0f} % of pulses split",
            f"{r['counts_percent']:+.1f} %",
            f"{r['energy_shift_kev']:+.1f} keV",
            f"{r['hu_shift']['fibrous_tissue']:+.2f} / {r['hu_shift']['blood_iodine']:+.2f} HU",
            f"{r['dqe_without']:.3f} → {r['dqe']:.3f}",
            f"{100 * ((r['dqe_without'] / r['dqe']) ** 0.5 - 1):+.1f} %",
        ]
        for r in rows
    ]
    head = ["charge sharing", "counts", "mean bin energy", "fibrous tissue / blood", "DQE", "noise"]
    return (
        "## Charge sharing\n\nOff by default (`SiliconDetector(charge_sharing=…)`); the shares are assumed. Behind "
        "24 cm of fat, counting mode with its water correction; the shifts are those of CT numbers.\n\n"
        f"{markdown_table(head, table)}"
    )


def pile_up(dead_ns: float) -> dict[str, Any]:
    """Losses, spectra and CT numbers with a dead time, in air and behind the body."""
    result: dict[str, Any] = {"dead_time_ns": dead_ns, "merge_ns": dead_ns / 2}
    spectral = SiliconDetector("spectral", dead_time_ns=dead_ns, merge_ns=dead_ns / 2)
    free, scanner = presets.pcct(), presets.pcct(detector=SiliconDetector(dead_time_ns=dead_ns, merge_ns=dead_ns / 2))
    current = scanner.source.current_ma
    for key, path in (("air", 0.0), ("body", FAT_MM)):
        energies, beam = beam_behind(scanner, path_mm=path)
        true, recorded = (
            spectral.response(energies) @ beam * current,
            recorded_rates(spectral, energies, beam * current),
        )
        thresholds = spectral.thresholds_kev
        result[key] = {
            "true_mcps": float(true.sum()) / 1e6,
            "lost_percent": 100 * float(1 - recorded.sum() / true.sum()),
            "energy_shift_kev": _mean_energy(thresholds, recorded) - _mean_energy(thresholds, true),
            "top_bin_percent": [100 * float(v[-1] / v.sum()) for v in (true, recorded)],
        }
    # Line integrals of the central ray: air and body as recorded, with the correction of the ideal detector and with
    # one that was calibrated in water with pile-up on.
    body, inset = _lines(free, free), {}
    for name, corrected in (("uncorrected", free), ("calibrated", scanner)):
        lines = _lines(scanner, corrected)
        mu, reference = corrected.water_linearisation().mu_ref, free.water_linearisation().mu_ref
        result[f"{name}_body_hu"] = 1000 * float(lines[0] / mu - body[0] / reference) / FAT_MM
        inset[name] = 1000 * float((lines[1] - lines[0]) / mu - (body[1] - body[0]) / reference) / INSET_MM
    result["uncorrected_contrast_hu"], result["calibrated_contrast_hu"] = inset["uncorrected"], inset["calibrated"]
    result["true_contrast_hu"] = 1000 * float(body[1] - body[0]) / free.water_linearisation().mu_ref / INSET_MM
    return result


def _lines(scanner: Scanner, corrected: Scanner) -> Floats:
    """Corrected line integrals of the central ray: 24 cm of fat, and with 3.36 mm of it replaced by blood."""
    import torch

    energies, air = beam_behind(scanner, path_mm=0.0)
    fat, blood = (material(n).attenuation(energies) for n in ("pericoronary_fat", "blood_iodine"))
    depths = np.array([0 * fat, fat * FAT_MM, fat * (FAT_MM - INSET_MM) + blood * INSET_MM])
    detector: Any = scanner.detector
    rates = recorded_rates(detector, energies, air * scanner.source.current_ma * np.exp(-depths))[0]
    p = np.log(rates[0] / rates[1:])
    linearisation = corrected.water_linearisation()
    columns = linearisation.scale.size
    spread = torch.from_numpy(np.repeat(p[:, None], columns, axis=1))
    return linearisation.apply(spread).numpy()[:, columns // 2]


def pile_up_section(rows: list[dict[str, Any]]) -> str:
    table = [
        [
            f"{r['dead_time_ns']:.0f} ns",
            f"{r['air']['lost_percent']:.1f} %",
            f"{r['body']['lost_percent']:.2f} %",
            f"{r['air']['energy_shift_kev']:+.1f} / {r['body']['energy_shift_kev']:+.2f} keV",
            f"{r['uncorrected_body_hu']:+.0f} HU",
            f"{r['calibrated_body_hu']:+.2f} HU",
            f"{r['calibrated_contrast_hu']:+.2f} of {r['true_contrast_hu']:.0f} HU",
        ]
        for r in rows
    ]
    head = [
        "dead time", "lost in air", "lost behind 24 cm fat", "mean bin energy, air / body", "body, uncorrected",
        "body, calibrated", "blood contrast, calibrated",
    ]  # fmt: skip
    return (
        "## Pile-up\n\nOff by default (`SiliconDetector(dead_time_ns=…, merge_ns=…)`); dead times are assumed, pulses "
        "merge within half of it. Central ray at 1000 mA (the rate does not depend on the exposure time). "
        "“uncorrected”: the air reading loses most, so that the body reads too low. “calibrated”: the water correction "
        "is calibrated on what the detector records, as a scanner does.\n\n"
        f"{markdown_table(head, table)}"
    )
