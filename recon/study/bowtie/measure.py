"""Everything that the bowtie study computes, part by part."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon.evaluate.store import Pieces
from recon.study.bowtie.combined import combine
from recon.study.bowtie.dose_maps import (
    DoseMaps,
    ctdi_figures,
    dose_maps,
    patient_ratio,
    ramp_figures,
    ratios,
    thorax_ratios,
    transmission,
)
from recon.study.bowtie.settings import Settings
from recon.study.bowtie.slices import Images, cupping, noise, phantom_grid, phantoms, wide_scanners
from recon.study.study import Clock, Progress, silent
from torchpcct.dose import CtdiDose

__all__ = ["Measured", "measure"]


@dataclass(frozen=True)
class Measured:
    """What the report needs.

    Attributes:
        settings: of the study.
        parts: JSON values by part.
        ctdi: reading of "dose" → bowtie → doses in the CTDI phantom.
        maps, images: of the CTDI phantom and the thorax.
        seconds: step → seconds.
    """

    settings: Settings
    parts: dict[str, Any]
    ctdi: dict[str, dict[str, CtdiDose]]
    maps: dict[str, DoseMaps]
    images: dict[str, Images]
    seconds: dict[str, float]


def measure(settings: Settings, progress: Progress = silent, folder: str | Path | None = None) -> Measured:
    """Dose, noise, beam hardening, and the plaque by FBP and MBIR, in resumable pieces."""
    s, clock, pieces = settings, Clock(), Pieces(folder, settings)
    parts: dict[str, Any] = {}
    scenes = phantoms()

    scanners = wide_scanners(8)
    parts["transmission"] = transmission(scanners)
    parts["ramps"] = ramp_figures(scanners, s.exposure_s)
    pieces.ahead(
        _kept, *((name,) for name in ("ctdi", "patient", *(f"{k}_{n}" for k in ("noise", "map") for n in scenes)))
    )
    ctdi = _kept(s, pieces, "ctdi")
    progress("dose", 0.3)
    parts["ctdi_ratios"] = {k: ratios(v) for k, v in ctdi.items()}
    maps = {}
    for k, name in enumerate(("ctdi", "thorax")):
        maps[name] = _kept(s, pieces, f"map_{name}")
        progress("dose", 0.3 + 0.3 * (k + 1))
    parts["thorax_dose_ratio"] = thorax_ratios(maps["thorax"], scenes["thorax"])
    parts["patient_dose_ratio"] = _kept(s, pieces, "patient")
    progress("dose", 1.0)
    clock.lap("dose")

    found = {}
    for k, name in enumerate(scenes):
        found[name] = _kept(s, pieces, f"noise_{name}")
        progress("noise", (k + 1) / len(scenes))
    parts["noise"] = {name: values for name, (values, _) in found.items()}
    clock.lap("noise")

    # Round about the axis: every view is the same, a few are enough.
    parts["cupping_hu"] = cupping(wide_scanners(min(s.views, 492), s.detector), s.kernel)
    progress("beam hardening", 1.0)
    clock.lap("beam hardening")

    step = "plaque: MBIR and ROI bowtie"
    saved: dict[str, float] = {k: 1.0 / parts["ctdi_ratios"][k]["weighted"] for k in ("plane", "total") if k in ctdi}
    parts["combined"] = combine(
        s.plaque_doses, s.plaque_realizations, s.plaque_views, s.seed, saved, pieces.folder("evaluate"), progress
    )
    clock.lap(step)
    images = {name: image for name, (_, image) in found.items()}
    return Measured(s, parts, ctdi, maps, images, clock.seconds)


def _kept(settings: Settings, pieces: Pieces, name: str) -> Any:
    """A piece of the study by its name."""
    s, (kind, _, scene) = settings, name.partition("_")

    def compute() -> Any:
        if kind == "noise":
            scanners, seeds = wide_scanners(s.views, s.detector), range(s.seed, s.seed + s.realizations)
            return noise(scene, phantoms()[scene], scanners, s.exposure_s, s.kernel, seeds)
        scanners = wide_scanners(8)
        if kind == "ctdi":
            return ctdi_figures(scanners, s.exposure_s, s.histories, s.seed)
        if kind == "patient":
            return patient_ratio(scanners, s.exposure_s, s.histories // 2, s.seed)
        # The CTDI phantom's map is drawn only, its doses are those in the bores: no scatter.
        spacing, histories = (max(s.map_mm / 2, 1.0), 0) if scene == "ctdi" else (s.map_mm, s.histories)
        grid = phantom_grid(scene, spacing)
        return dose_maps(phantoms()[scene], scanners, grid, s.exposure_s, histories, s.seed)

    return pieces(name, compute)
