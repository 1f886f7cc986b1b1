"""Why the noise of the slices is not the paper's in HU: what the paper leaves open, one thing at a time.

The paper states tube current, rotation time, views, voxels and that electronic noise is off. It names neither the
kernel, nor the cells of its energy-integrating detector, nor the flat filter, and its thorax is another one (XCIST's
adult man of the 50th percentile). Noise of the large bowtie alone is computed for each.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from recon.study.bowtie.slices import (
    PIXEL_MM,
    enlarged,
    noise_regions,
    phantom_grid,
    phantoms,
    polynomial_linearisation,
    slice_image,
    wide_scanners,
)
from recon.study.paper import facts as paper
from torchpcct.acquisition.acquire import acquire
from torchpcct.scanner import Scanner, Scintillator, presets
from torchpcct.scene import Scene
from torchpcct.scene.materials import MATERIALS

__all__ = ["REGIONS", "Change", "changes", "fits", "noise_causes", "thorax_scale"]

REGIONS = {"inside": "ctdi", "outside": "ctdi", "heart": "thorax"}
"""Region whose noise is compared → its phantom."""

FIT = 0.10
"""Largest relative difference of an SD that counts as reproduced."""

_WIDE_FAN_RAD = 0.38  # holds the largest thorax
_ELECTRONIC_NOISE_KEV = Scintillator().electronic_noise_kev


@dataclass(frozen=True)
class Change:
    """One change of what the paper leaves open.

    Args:
        name: in tables.
        kernel: None: the study's.
        load: factor on the tube load.
        electronic_noise_kev: of a reading.
        flat_mm: aluminium of the flat filter.
        pitch: (row, column) of the cells.
        pixel_mm: voxels.
        thorax: factor on the thorax's lengths.
    """

    name: str
    kernel: str | None = None
    load: float = 1.0
    electronic_noise_kev: float = 0.0
    flat_mm: float = presets.FLAT_FILTER_MM
    pitch: tuple[float, float] = presets.EID_PITCH_MM
    pixel_mm: float = PIXEL_MM
    thorax: float = 1.0

    def scanner(self, views: int) -> Scanner:
        """The scanner with the large bowtie."""
        plain = wide_scanners(views, half_fan_rad=_WIDE_FAN_RAD)["large"]
        columns = 2 * math.ceil(_WIDE_FAN_RAD * plain.geometry.sdd / self.pitch[1])
        return plain.replace(
            geometry=replace(plain.geometry, columns=columns, pitch=self.pitch),
            detector=Scintillator(electronic_noise_kev=self.electronic_noise_kev),
            filters=((MATERIALS["aluminium"], self.flat_mm),),
        )


def changes(kernel: str) -> list[Change]:
    """All changes, none first; ``kernel``: of the study."""
    rows, columns = presets.EID_PITCH_MM
    fine_rows, fine_columns = presets.PCCT_PITCH_MM
    return [
        Change("as in this study"),
        *(Change(f"kernel {k}", kernel=k) for k in paper.KERNELS if k != kernel),
        Change("half the tube load", load=0.5),
        Change("a quarter of the tube load", load=0.25),
        Change(f"electronic noise {_ELECTRONIC_NOISE_KEV:g} keV", electronic_noise_kev=_ELECTRONIC_NOISE_KEV),
        Change("no flat filter", flat_mm=0.0),
        Change("flat filter of 6 mm", flat_mm=6.0),
        Change(f"slice of the PCCT's rows, {fine_rows:g} mm", pitch=(fine_rows, columns)),
        Change(f"columns of the PCCT, {fine_columns:g} mm", pitch=(rows, fine_columns)),
        Change("cells of the PCCT", pitch=(fine_rows, fine_columns)),
        Change(f"voxels of {PIXEL_MM / 2:g} mm", pixel_mm=PIXEL_MM / 2),
        Change("thorax 5 % larger", thorax=1.05),
        Change("thorax 10 % larger", thorax=1.10),
        Change("thorax 15 % larger", thorax=1.15),
        Change(f"both: slice of {fine_rows:g} mm, thorax 10 % larger", pitch=(fine_rows, columns), thorax=1.10),
        Change("both: kernel detail, thorax 10 % larger", kernel="detail", thorax=1.10),
    ]


def noise_causes(views: int, exposure_s: float, kernel: str, seeds: range, progress: Callable[[float], None]) -> Any:
    """SDs of every change.

    Args:
        views: of the scans, which share the whole tube load.
        exposure_s: of the scans.
        kernel: of the study.
        seeds: of the noise.
        progress: called with the finished fraction.

    Returns:
        JSON values: ``rows``, each with ``sd_hu`` by region, ``over_paper`` (ours over the paper's) and ``fits``; the
        paper's ``needed`` factors on ours; ``thorax_scale``, see there.
    """
    scenes, asked = phantoms(), changes(kernel)
    rows: list[dict[str, Any]] = []
    for k, change in enumerate(asked):
        sd: dict[str, float] = {}
        for name, scene in scenes.items():
            if rows and _of_thorax(change, asked[0]) and name != "thorax":  # the other phantom does not change
                sd |= {r: v for r, v in rows[0]["sd_hu"].items() if REGIONS[r] == name}
            else:
                body = enlarged(scene, change.thorax) if name == "thorax" else scene
                sd |= _sds(name, body, change, views, exposure_s, kernel, seeds)
        over = {r: v / paper.BOWTIE[f"{r}_sd_hu"][0] for r, v in sd.items()}
        rows.append({"change": change.name, "sd_hu": sd, "over_paper": over, "fits": fits(over)})
        progress((k + 1) / len(asked))
    needed = {r: 1.0 / v for r, v in rows[0]["over_paper"].items()}
    sizes = {c.thorax: r["over_paper"] for c, r in zip(asked, rows, strict=True) if _of_thorax(c, asked[0])}
    return {"views": views, "rows": rows, "needed": needed, "thorax_scale": thorax_scale(sizes)}


def _of_thorax(change: Change, none: Change) -> bool:
    """Whether nothing but the thorax differs from no change."""
    return replace(change, name=none.name, thorax=none.thorax) == none


def fits(over_paper: dict[str, float]) -> bool:
    """Whether all SDs are the paper's within :data:`FIT`."""
    return all(abs(v - 1.0) <= FIT for v in over_paper.values())


def thorax_scale(sizes: dict[float, dict[str, float]]) -> float:
    """Factor on the thorax's lengths at which heart and CTDI phantom need the same factor on their noise; NaN: none.

    Args:
        sizes: factor → our SDs over the paper's by region. Between them the logarithm of the noise is taken as linear
            in the size, as attenuation is.
    """
    excess = {math.log(over["heart"] / over["inside"]): size for size, over in sizes.items()}
    if not min(excess) <= 0.0 <= max(excess):
        return math.nan
    order = sorted(excess)
    return float(np.interp(0.0, order, [excess[e] for e in order]))


def _sds(
    name: str, scene: Scene, change: Change, views: int, exposure_s: float, kernel: str, seeds: range
) -> dict[str, float]:
    scanner, grid = change.scanner(views), phantom_grid(name, change.pixel_mm)
    scan = replace(acquire(scene, scanner, sub_rays=1), linearisation=polynomial_linearisation(scanner))
    used = change.kernel or kernel
    clean = slice_image(scan, grid, used)
    regions = noise_regions(name, grid)
    squares = []
    for seed in seeds:
        error = slice_image(scan.with_noise(exposure_s * change.load, seed), grid, used) - clean
        squares.append([float(error[mask].var()) for mask in regions.values()])
    return dict(zip(regions, np.sqrt(np.mean(squares, axis=0)).tolist(), strict=True))
