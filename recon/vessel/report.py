"""What a reading says: a table beside other volumes over the same regions, files, a picture."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from recon.vessel.reading import CERTAIN, PlaqueReading
from torchpcct.files import write_together
from torchpcct.viz import Panel, panels
from torchpcct.volume import Volume

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike


_COLOURS = {
    "lumen": "tab:red",
    "fibrous": "tab:orange",
    "wall": "tab:blue",
    "core": "lime",
    "calcification": "white",
    "second core": "lime",
}
"""Of the outlines in the picture."""


Deviations = Mapping[str, Mapping[str, float]]
"""Volume → region → standard deviation of its mean, HU."""


def table(
    reading: PlaqueReading,
    others: Mapping[str, ArrayLike] | None = None,
    deviations: Deviations | None = None,
) -> str:
    """Markdown: every figure with its 95 % interval, and what other volumes read over the same
    regions.

    Args:
        reading: to tell.
        others: name → volume in HU on the reading's grid.
        deviations: of their means, where they are known
            (:func:`recon.vessel.fbp_noise.fbp_deviations`).
    """
    sd = deviations or {}
    read = {name: reading.read(volume) for name, volume in (others or {}).items()}
    lines = [
        f"Plaque body: P = {reading.presence:.3f}"
        + (f" (less than {CERTAIN}: its figures are refused)" if reading.presence < CERTAIN else "")
        + (f"; calcifications: {reading.calcifications}" if reading.calcifications else "")
        if reading.explained and not reading.taken_off_hu
        else "Plaque body: none can be identified: "
        + (
            f"beside the vessel, {reading.taken_off_hu:.0f} HU were taken off the data"
            if reading.explained
            else "the tissues do not explain the data, see the warning"
        ),
        "",
        " | ".join(
            ["| figure", "tissues as unknowns [95 %]", *(f"{name}, same regions" for name in read)]
        )
        + " |",
        "|---" * (2 + len(read)) + "|",
    ]
    for name, e in reading.figures.items():
        digits = 1 if e.unit == "HU" else 2
        cells = [f"{e.value:.{digits}f} [{e.low:.{digits}f}, {e.high:.{digits}f}] {e.unit}"]
        for other, r in read.items():
            error = sd.get(other, {}).get(name)
            cells.append(
                "–"
                if name not in r
                else f"{r[name]:.{digits}f}" + ("" if error is None else f" ± {error:.1f}")
            )
        lines.append(" | ".join([f"| {name}", *cells]) + " |")
    for name, why in reading.refused.items():
        lines.append(" | ".join([f"| {name}", f"refused: {why}", *("–" for _ in read)]) + " |")
    second = reading.info.get("second_core")
    if second and reading.explained and not reading.taken_off_hu:
        z, y, x = second["at_mm"]
        lines += [
            "",
            f"A second core is there with a probability of {second['probability']:.3f}, at "
            f"({z:.1f}, {y:.1f}, {x:.1f}) mm (z, y, x), of about {second['volume_mm3']:.1f} mm³. "
            "Both were read together; the figures are those of the first, but for the second "
            "contrast.",
        ]
    if reading.explained and not reading.taken_off_hu:
        lines += [
            "",
            f"Contrast over a core that is there and one that is not: {reading.mean_contrast:.0f} "
            "HU. A contrast is given where the data prove a core, so rather where noise has "
            "enlarged it: on average those given are too large.",
        ]
    lines += [
        "",
        f"Residual: {reading.chi2:.3f} ± {reading.chi2_sd:.3f} of what noise leaves. Texture of "
        f"0.3 mm: {reading.texture_hu:.0f} HU, at most {reading.texture_high_hu:.0f} HU (95 %). "
        "Believed before the data: "
        + ", ".join(
            "{} {:g} ± {:g} HU".format(n, *reading.info["vessel_prior"][n])
            for n in ("wall", "fibrous")
        )
        + ".",
        *(f"Warning: {text}." for text in reading.warnings),
    ]
    return "\n".join(lines) + "\n"


def _hidden(reading: PlaqueReading) -> set[str]:
    """Plaque bodies that a reading must not show: fibrous tissue in their place."""
    trusted = reading.explained and not reading.taken_off_hu
    return (set() if trusted else {"calcification"}) | (
        set() if reading.certain else {"core", "second core"}
    )


def picture(reading: PlaqueReading, others: Mapping[str, ArrayLike] | None = None) -> Figure:
    """Sections across and along z through the core's centre: other volumes with the outlines, and
    the fitted tissues.

    Returns:
        ``matplotlib.figure.Figure``.
    """
    grid = reading.grid
    centre = np.array(reading.info["core_center_mm"])
    index = [
        int(np.clip(round((c - a[0]) / s), 0, n - 1))
        for c, a, s, n in zip(centre, grid.axes, grid.spacing, grid.shape, strict=True)
    ]
    (z0, z1), (y0, y1), (x0, x1) = (
        (a[0] - s / 2, a[-1] + s / 2) for a, s in zip(grid.axes, grid.spacing, strict=True)
    )
    hidden = _hidden(reading)
    shown = {k: v for k, v in _COLOURS.items() if k in reading.regions and k not in hidden}
    rows = []
    for cut, extent in (
        ((index[0],), (x0, x1, y0, y1)),
        ((slice(None), index[1]), (x0, x1, z0, z1)),
    ):
        outlines = tuple((reading.regions[k][cut] > 0.5, colour) for k, colour in shown.items())
        images = {**(others or {}), "fitted tissues": reading.image}
        rows.append(
            [Panel(np.asarray(v)[cut], extent, name, outlines) for name, v in images.items()]
        )
    return panels(rows, ("axial", "coronal"), title=f"plaque body: P = {reading.presence:.2f}")


def save(
    reading: PlaqueReading,
    folder: Path,
    others: Mapping[str, ArrayLike] | None = None,
    deviations: Deviations | None = None,
) -> list[Path]:
    """Write ``report.md``, ``report.json``, ``tissues.nii.gz`` (labels), ``image.nii.gz`` and
    ``plaque.png``.

    Labels: 0 fat, 1 wall, 2 fibrous, 3 lumen, 4 core, 5 calcification, 6 second core; cores only
    where they are certain, and no plaque body where none can be identified.

    Args:
        reading: to write.
        folder: made if it does not exist.
        others, deviations: as for :func:`table`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = ["fat", "wall", "fibrous", "lumen", "core", "calcification", "second core"]
    shares = [reading.regions.get(n, np.zeros(reading.grid.shape, np.float32)) for n in names]
    for k in (names.index(name) for name in _hidden(reading)):
        shares[2], shares[k] = shares[2] + shares[k], 0 * shares[k]
    labels = np.argmax(np.stack(shares), 0).astype(np.float32)
    data = {
        "presence": reading.presence,
        "second_core": reading.second_core,
        "third_core": reading.third_core,
        "explained": reading.explained,
        "mean_contrast_hu": reading.mean_contrast,
        "calcifications": reading.calcifications,
        "figures": {n: asdict(e) for n, e in reading.figures.items()},
        "refused": dict(reading.refused),
        "same_regions": {name: reading.read(volume) for name, volume in (others or {}).items()},
        "same_regions_sd": {name: dict(v) for name, v in (deviations or {}).items()},
        "chi2": reading.chi2,
        "chi2_sd": reading.chi2_sd,
        "left": asdict(reading.left),
        "taken_off_hu": reading.taken_off_hu,
        "texture_hu": reading.texture_hu,
        "texture_high_hu": reading.texture_high_hu,
        "warnings": reading.warnings,
        "labels": {n: k for k, n in enumerate(names)},
        "info": dict(reading.info),
    }
    Volume(torch.from_numpy(labels), reading.grid).save(folder / "tissues.nii.gz")
    Volume(torch.from_numpy(reading.image), reading.grid).save(folder / "image.nii.gz")
    drawn = io.BytesIO()
    picture(reading, others).savefig(drawn, format="png")
    text = json.dumps(data, indent=1) + "\n"
    contents = {
        "report.md": table(reading, others, deviations).encode(),
        "report.json": text.encode(),
        "plaque.png": drawn.getvalue(),
    }
    write_together(folder, contents)
    return [
        folder / n
        for n in ("report.md", "report.json", "tissues.nii.gz", "image.nii.gz", "plaque.png")
    ]
