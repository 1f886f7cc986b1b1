"""The silicon detector: counts, efficiency beside the published one, pile-up and charge sharing.

Efficiency is found by following photons through silicon and foils: repeated counts, against
threshold and energy. What pile-up and charge sharing cost is computed at the detector's rates in
counts, energies, CT numbers and noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from recon.jobs.store import Step, StudyCache
from recon.study.report import Check
from recon.study.study import Measured, Progress, StudySettings, silent
from torchpcct.scanner import Scanner, SiliconDetector, presets
from torchpcct.scanner.pileup import recorded_rates
from torchpcct.scanner.silicon_transport import Stack, efficiency, follow
from torchpcct.scene.materials import PLAQUE_MATERIALS, material
from torchpcct.validate import numbers

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from torchpcct.typing import JsonObject


Floats = NDArray[np.float64]

PUBLISHED_DQE = 0.68
"""Density-imaging performance at a lowest threshold of 0 keV relative to an ideal detector, of an
edge-on silicon detector: Grönberg, Yin, Maltz, Pelc and Persson, "The effects of intra-detector
Compton scatter on zero-frequency DQE for photon-counting CT using edge-on-irradiated silicon
detectors", arXiv 2206.04164 (2022)."""
PUBLISHED_SLOPE = 0.017
"""Its fall per keV of the threshold, from the same paper."""

THRESHOLDS_KEV = (0.0, 2.5, 5.0, 7.5, 10.0, 15.0)
"""Lowest thresholds that are compared, keV."""
ENERGIES_KEV = (20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 100.0, 120.0)
"""Energies of the photons that are followed, keV."""

EXPOSURE_S = 0.35
"""One rotation, s."""
FAT_MM = 240.0
"""Fat of the patient, mm."""
INSET_MM = 3.36
"""Vessel diameter: the path of the contrast that pile-up and charge sharing may change."""


@dataclass(frozen=True)
class DetectorSettings(StudySettings):
    """Settings of the detector study; the quick ones follow a fifth of the photons.

    Args:
        photons: photons followed through the detector per case, at least 1000.
        seed: of their random numbers.
        dead_times_ns: dead times looked at, ns (assumed; the merging time is half of each).
        charge_sharing: shares of split pulses looked at (assumed), in (0, 1].
    """

    photons: int = 200_000
    seed: int = 0
    dead_times_ns: tuple[float, ...] = (20.0, 50.0, 100.0)
    charge_sharing: tuple[float, ...] = (0.1, 0.2)

    QUICK: ClassVar = {"photons": 40_000}

    def __post_init__(self) -> None:
        self.check_whole(photons=1000, seed=0)
        numbers("dead_times_ns", self.dead_times_ns, positive=True, unit="ns")
        numbers("charge_sharing", self.charge_sharing, positive=True, high=1.0)


T = TypeVar("T")


def measure(
    settings: DetectorSettings, progress: Progress = silent, folder: str | Path | None = None
) -> Measured:
    """Follow photons and compute rates; finished parts are cached."""
    s, rng = settings, np.random.default_rng(settings.seed)
    cache = StudyCache(folder, settings)

    def followed(name: str, compute: Callable[[], T]) -> T:
        """What ``compute`` gives, cached; the next one draws photons where this one ended."""
        found, after = cache(name, lambda: (compute(), rng.bit_generator.state))
        rng.bit_generator.state = after
        return found

    efficiency, spectrum, looked_at = [], [], cases()
    for i, case in enumerate(looked_at):
        efficiency.append(followed(f"case_{i}", partial(efficiencies, case, s.photons, rng)))
        progress("photons followed, thresholds", (i + 1) / len(looked_at))
    for i, energy in enumerate(ENERGIES_KEV):
        spectrum.append(
            followed(f"energy_{i}", partial(at_energy, energy, max(1000, s.photons // 4), rng))
        )
        progress("photons followed, energies", (i + 1) / len(ENERGIES_KEV))
    cache.ahead(*_pile_ups(s))
    data = {
        "counts": counts(),
        "efficiency": efficiency,
        "efficiency_by_energy": spectrum,
        "repeated_counts_hu": repeated_counts_hu(spectrum),
        "charge_sharing": [
            followed(f"sharing_{c:g}", partial(charge_sharing, c, s.photons, rng))
            for c in s.charge_sharing
        ],
        "pile_up": [_pile_up(s, cache, t) for t in s.dead_times_ns],
    }
    progress("rates", 1.0)
    return Measured(s, data)


def plan(settings: DetectorSettings, folder: str | Path | None) -> None:
    """List the jobs that are left; see :mod:`recon.study.study`."""
    StudyCache(folder, settings).plan(_pile_ups(settings))


def _pile_ups(s: DetectorSettings) -> Step:
    return _pile_up, [(t,) for t in s.dead_times_ns]


def _pile_up(
    settings: DetectorSettings, cache: StudyCache, dead_time_ns: float
) -> dict[str, object]:
    return cache(f"pile_up_{dead_time_ns:g}", partial(pile_up, dead_time_ns))


# --- efficiency -----------------------------------------------------------------------------------


class DetectorInBeam(NamedTuple):
    """A detector in a beam: photons per energy in keV."""

    name: str
    detector: SiliconDetector
    stack: Stack
    energies: NDArray[np.float64]
    photons: NDArray[np.float64]


def cases() -> list[DetectorInBeam]:
    """The detectors and beams that are compared, from this package's defaults to the published
    figure's."""
    standard, hard = (
        beam_behind(presets.pcct()),
        beam_behind(presets.pcct(kvp=120.0), "water", 300.0),
    )
    deep, short = SiliconDetector(), SiliconDetector(length_mm=30.0)
    return [
        DetectorInBeam("60 mm, 100 kVp, 24 cm fat", deep, Stack(), *standard),
        DetectorInBeam("60 mm, foils of 10 µm", deep, Stack(foil_mm=0.01), *standard),
        DetectorInBeam("60 mm, no foils", deep, Stack(foil_mm=0.0), *standard),
        DetectorInBeam("30 mm, 100 kVp, 24 cm fat", short, Stack(), *standard),
        DetectorInBeam("60 mm, 120 kVp, 30 cm water", deep, Stack(), *hard),
        DetectorInBeam("30 mm, 120 kVp, 30 cm water", short, Stack(), *hard),
    ]


def efficiencies(case: DetectorInBeam, photons: int, rng: np.random.Generator) -> dict[str, object]:
    """One-interaction share, and DQE of counts by following photons, against the lowest
    threshold."""
    d = replace(case.detector, fill_factor=1.0 - case.stack.foil_mm / case.stack.sheet_pitch_mm)
    single = d.above(case.energies, THRESHOLDS_KEV) @ case.photons / case.photons.sum()
    deposits = follow(d, case.energies, case.photons, photons, rng, case.stack)
    task = material("water").attenuation(deposits.incident_kev)
    rows = []
    for threshold, share in zip(THRESHOLDS_KEV, single, strict=True):
        k = deposits.counts(threshold, d.sigma_kev, rng)
        dqe, error = efficiency(k)
        density, density_error = efficiency(k, task)
        rows.append(
            {
                "threshold_kev": threshold,
                "one_interaction": float(share),
                "counts_per_photon": float(k.mean()),
                "dqe": dqe,
                "dqe_error": error,
                "density": density,
                "density_error": density_error,
                "published": PUBLISHED_DQE - PUBLISHED_SLOPE * threshold,
            }
        )
    return {"case": case.name, "rows": rows}


def at_energy(energy: float, photons: int, rng: np.random.Generator) -> dict[str, float]:
    """The same of photons of one energy in keV, at the detector's own threshold."""
    d = SiliconDetector()
    k = follow(d, [energy], [1.0], photons, rng).counts(d.thresholds_kev[0], d.sigma_kev, rng)
    dqe, error = efficiency(k)
    photo, compton = d.interaction([energy])
    return {
        "energy_kev": energy,
        "photoelectric": float(photo[0]),
        "compton": float(compton[0]),
        "one_interaction": float(d.response([energy])[0, 0]),
        "counts_per_photon": float(k.mean()),
        "dqe": dqe,
        "dqe_error": error,
    }


def repeated_counts_hu(rows: list[dict[str, float]]) -> dict[str, float]:
    """Shifts of the plaque's CT numbers by the weight that repeated counts, see
    :func:`at_energy`, give to energies."""
    energies, beam = beam_behind(presets.pcct())
    weight = SiliconDetector().response(energies)[0] * beam
    ratio = [r["counts_per_photon"] / r["one_interaction"] for r in rows]
    return hu_shift(
        energies, weight, weight * np.interp(energies, [r["energy_kev"] for r in rows], ratio)
    )


# --- rates ----------------------------------------------------------------------------------------


def beam_behind(
    scanner: Scanner, name: str = "pericoronary_fat", path_mm: float = FAT_MM
) -> tuple[Floats, Floats]:
    """Energies and photons per mAs that reach the central cell behind a slab."""
    energies, quanta = scanner.quanta()
    centre = scanner.geometry.columns // 2
    return energies, np.asarray(
        quanta[centre] * np.exp(-material(name).attenuation(energies) * path_mm)
    )


def hu_shift(energies: Floats, before: Floats, after: Floats) -> dict[str, float]:
    """How far the CT numbers of the plaque's materials move between two weightings of the
    energies."""
    return {
        n: material(n).hu(energies, after) - material(n).hu(energies, before)
        for n in PLAQUE_MATERIALS
    }


def counts() -> list[dict[str, object]]:
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


def _mean_energy(thresholds: Sequence[float], binned: Floats) -> float:
    """Mean energy of the bins (their middle; the open one by the width of its neighbour),
    weighted by counts."""
    edges = np.append(thresholds, 2 * thresholds[-1] - thresholds[-2])
    return float((edges[:-1] + edges[1:]) @ binned / 2 / binned.sum())


def charge_sharing(share: float, photons: int, rng: np.random.Generator) -> dict[str, object]:
    """Counts (both parts may count), photons (or none), energies, CT numbers and efficiency if
    pulses split between two strips."""
    energies, beam = beam_behind(presets.pcct())
    pure, split = SiliconDetector("spectral"), SiliconDetector("spectral", charge_sharing=share)
    before, after = pure.response(energies) @ beam, split.response(energies) @ beam
    lowest = pure.thresholds_kev[:1]
    seen = [float(d.photons_above(energies, lowest)[0] @ beam) for d in (pure, split)]
    deposits = follow(SiliconDetector(), energies, beam, photons, rng)
    thresholds, sigma = pure.thresholds_kev, pure.sigma_kev
    dqe = [
        efficiency(deposits.counts(thresholds[0], sigma, rng, charge_sharing=c))[0]
        for c in (0.0, share)
    ]
    return {
        "share": share,
        "counts_percent": 100 * float(after.sum() / before.sum() - 1),
        "photons_percent": 100 * (seen[1] / seen[0] - 1),
        "bins": (after / after.sum()).tolist(),
        "bins_without": (before / before.sum()).tolist(),
        "energy_shift_kev": _mean_energy(thresholds, after) - _mean_energy(thresholds, before),
        "hu_shift": hu_shift(
            energies, pure.response(energies).sum(0) * beam, split.response(energies).sum(0) * beam
        ),
        "dqe_without": dqe[0],
        "dqe": dqe[1],
        "dqe_percent": 100 * float(dqe[1] / dqe[0] - 1),
    }


def pile_up(dead_ns: float) -> dict[str, object]:
    """Losses, spectra and CT numbers with a dead time, in air and behind the body."""
    result: dict[str, object] = {"dead_time_ns": dead_ns, "merge_ns": dead_ns / 2}
    spectral = SiliconDetector("spectral", dead_time_ns=dead_ns, merge_ns=dead_ns / 2)
    free, scanner = (
        presets.pcct(),
        presets.pcct(detector=SiliconDetector(dead_time_ns=dead_ns, merge_ns=dead_ns / 2)),
    )
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
    # Line integrals of the central ray: air and body as recorded, with the correction of the ideal
    # detector and with one that was calibrated in water with pile-up on.
    body, reference = _lines(free, free), free.water_linearisation().mu_ref
    for name, corrected in (("uncorrected", free), ("calibrated", scanner)):
        lines, mu = _lines(scanner, corrected), corrected.water_linearisation().mu_ref
        result[f"{name}_body_hu"] = 1000 * float(lines[0] / mu - body[0] / reference) / FAT_MM
        contrast = (lines[1] - lines[0]) / mu - (body[1] - body[0]) / reference
        result[f"{name}_contrast_hu"] = 1000 * float(contrast) / INSET_MM
    result["true_contrast_hu"] = 1000 * float(body[1] - body[0]) / reference / INSET_MM
    return result


def _lines(scanner: Scanner, corrected: Scanner) -> Floats:
    """Corrected line integrals of the central ray: 24 cm of fat, and with 3.36 mm of it replaced
    by blood."""
    energies, air = beam_behind(scanner, path_mm=0.0)
    fat, blood = (material(n).attenuation(energies) for n in ("pericoronary_fat", "blood_iodine"))
    depths = np.array([0 * fat, fat * FAT_MM, fat * (FAT_MM - INSET_MM) + blood * INSET_MM])
    detector: Any = scanner.detector
    rates = recorded_rates(detector, energies, air * scanner.source.current_ma * np.exp(-depths))[0]
    linearisation = corrected.water_linearisation()
    columns = linearisation.scale.size
    spread = torch.from_numpy(np.repeat(np.log(rates[0] / rates[1:])[:, None], columns, axis=1))
    return linearisation.apply(spread).numpy()[:, columns // 2]


# --- the report -----------------------------------------------------------------------------------


def checks(data: JsonObject) -> list[Check]:
    """Counts beside CatSim's beam, efficiency beside the published one, and that pile-up behind
    the body is small."""
    air, body = data["counts"]
    first, last = (
        {r["threshold_kev"]: r["density"] for r in data["efficiency"][k]["rows"]} for k in (0, -1)
    )
    middle = next(r for r in data["pile_up"] if r["dead_time_ns"] >= 50 or r is data["pile_up"][-1])
    note = "60 mm; 30 mm, 120 kVp: next row. Repeated counts, length and beam, see the table"
    incident = "incident photons per cell and view"
    return [
        Check(
            f"{incident}, air", air["incident_per_view"], "16070 (CatSim beam)", 15749.0, 16391.0
        ),
        Check(
            f"{incident}, 24 cm fat", body["incident_per_view"], "161 (CatSim beam)", 157.8, 164.2
        ),
        Check(
            "counted / incident behind 24 cm fat", body["share"], "0.71 (CatSim beam)", 0.70, 0.72
        ),
        Check("density DQE at 0 keV, 60 mm, 100 kVp", first[0.0], PUBLISHED_DQE, 0.58, 0.78, note),
        Check("density DQE at 0 keV, 30 mm, 120 kVp", last[0.0], PUBLISHED_DQE, 0.63, 0.73),
        Check("its fall per keV up to 10 keV", (last[0.0] - last[10.0]) / 10, 0.017, 0.012, 0.022),
        Check(
            "pile-up behind the body, calibrated, HU",
            middle["calibrated_body_hu"],
            "negligible",
            -1.0,
            1.0,
        ),
    ]


def figures(measured: Measured) -> dict[str, Figure]:
    """Efficiency against threshold and energy, and recorded over true counts against the
    thickness of fat."""
    from matplotlib.figure import Figure

    parts = measured.data
    figure = Figure(figsize=(11.5, 3.8), dpi=150, layout="constrained")
    threshold, energy, loss = figure.subplots(1, 3)
    shown = {
        0: ("black", "60 mm, 100 kVp"),
        3: ("tab:blue", "30 mm, 100 kVp"),
        5: ("tab:green", "30 mm, 120 kVp"),
    }
    for index, (colour, label) in shown.items():
        rows = parts["efficiency"][index]["rows"]
        x = [r["threshold_kev"] for r in rows]
        threshold.plot(
            x,
            [r["density"] for r in rows],
            "o-",
            color=colour,
            markersize=3,
            label=f"{label}, followed",
        )
        if index == 0:
            threshold.plot(
                x,
                [r["one_interaction"] for r in rows],
                ":",
                color=colour,
                label=f"{label}, counted once",
            )
    published = [r["published"] for r in rows if r["threshold_kev"] <= 10]
    threshold.plot(x[: len(published)], published, "--", color="tab:red", label="published")
    threshold.set(
        xlabel="lowest threshold, keV", ylabel="DQE(0)", ylim=(0, 1), title="against the threshold"
    )
    rows = parts["efficiency_by_energy"]
    x, dqe, error = ([r[k] for r in rows] for k in ("energy_kev", "dqe", "dqe_error"))
    energy.plot(x, [r["one_interaction"] for r in rows], ":", color="black", label="counted once")
    energy.errorbar(x, dqe, error, fmt="o-", color="tab:blue", markersize=3, label="DQE, followed")
    energy.plot(x, [r["photoelectric"] for r in rows], color="0.6", label="photoelectric")
    energy.plot(x, [r["compton"] for r in rows], "--", color="0.6", label="Compton")
    energy.set(xlabel="photon energy, keV", ylim=(0, 1), title="against energy (5 keV, 60 mm)")
    scanner, path = presets.pcct(), np.linspace(0.0, 240.0, 49)
    energies = scanner.quanta()[0]
    arriving = scanner.source.current_ma * np.stack(
        [beam_behind(scanner, path_mm=t)[1] for t in path]
    )
    for entry in parts["pile_up"]:
        detector = SiliconDetector(dead_time_ns=entry["dead_time_ns"])
        ratio = recorded_rates(detector, energies, arriving)[0] / (
            arriving @ detector.response(energies)[0]
        )
        loss.plot(path, ratio, label=f"{entry['dead_time_ns']:.0f} ns")
    loss.set(
        xlabel="fat, mm",
        ylabel="recorded / true counts",
        ylim=(0, 1.02),
        title="pile-up, central ray, 1000 mA",
    )
    for ax in (threshold, energy, loss):
        ax.legend(fontsize=7)
        ax.title.set_fontsize(10)
    return {"detector.png": figure}
