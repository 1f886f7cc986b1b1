"""Figures of the dose-factor study: dose factors of every method by every figure, and pictures."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from recon.study.dose_factor.measure import Measured
from recon.study.dose_factor.merit import FACTOR_NAMES
from recon.study.dose_factor.settings import FBP_BASE, METHOD_NAMES, fbp_label
from recon.study.dose_factor.variant import Variant
from recon.study.figures import extent, roi_outlines
from recon.study.paper.facts import ASSUMED_FACTOR
from torchpcct.metrics.roi import sample_axial
from torchpcct.viz import Panel, panels

__all__ = ["factors_figure", "images_figure"]

_COLORS = {
    "linear": "tab:brown", "linear_z": "tab:cyan", "linear_z_added": "tab:blue", "quadratic": "tab:olive",
    "qggmrf": "tab:green", "tv": "tab:purple", "fbp_cnn": "tab:pink", "mbir_viewing": "gold", "mbir": "tab:red",
    "mbir_measuring": "tab:orange", "mbir_no_cnn": "black", "mbir_one_step": "tab:gray",
    "mbir_free": "silver", "mbir_tissues": "magenta",
}  # fmt: skip
"""What is drawn; methods that are told a wrong noise are not."""


def factors_figure(data: dict[str, Any]) -> Any:
    """Dose factors of every method by every figure, one panel per exposure, with the limit."""
    from matplotlib.figure import Figure

    doses, names = data["settings"]["doses"], list(FACTOR_NAMES)
    figure = Figure(figsize=(4.6 * len(doses) + 1.6, 5.0), dpi=150, layout="constrained")
    axes = figure.subplots(1, len(doses), squeeze=False, sharey=True)[0]
    for ax, dose in zip(axes, doses, strict=True):
        entries = [e for e in data["methods"] if e["exposure_s"] == dose and e["method"] in _COLORS]
        for k, e in enumerate(entries):
            at = np.arange(len(names)) + 0.7 * ((k + 0.5) / len(entries) - 0.5)
            found = [e["factors"][name].get("value") for name in names]
            values = [math.nan if v is None or v <= 0 else v for v in found]
            label = METHOD_NAMES[e["method"]]
            ax.plot(at, values, "o", color=_COLORS[e["method"]], markersize=4, label=label)
        limit = next(c for c in data["limits"] if c["exposure_s"] == dose)["factors"]
        known = [k for k, name in enumerate(names) if name in limit]
        levels = [limit[names[k]] for k in known]
        ax.hlines(levels, [k - 0.4 for k in known], [k + 0.4 for k in known], color="black", label="limit of the data")
        ax.axhline(ASSUMED_FACTOR, color="tab:blue", linewidth=0.8, linestyle=":", label=f"assumed, {ASSUMED_FACTOR}×")
        ax.axhline(1.0, color="0.5", linewidth=0.8)
        ax.set_yscale("log", base=2)
        ax.set_xticks(range(len(names)), FACTOR_NAMES.values(), fontsize=7, rotation=40, ha="right")
        ax.set_title(f"{dose:g} s", fontsize=10)
        ax.grid(True, axis="y", linewidth=0.3, alpha=0.6)
    axes[0].set_ylabel(f"dose factor against FBP {fbp_label(*FBP_BASE)}")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=7)
    return figure


def images_figure(measured: Measured, data: dict[str, Any]) -> Any:
    """One realisation with and without the core: FBP, the methods, the truth. C150 / W600."""
    s = measured.settings
    dose = s.doses[-1]
    variant = Variant("paper", s)
    image = variant.rois.image
    columns: list[tuple[str, Any]] = [("fbp", f"FBP {fbp_label(*FBP_BASE)}")]
    columns += [(m, METHOD_NAMES[m]) for m in measured.methods if (m, "paper", dose) in measured.volumes]
    rows: list[list[Panel]] = []
    for name in ("paper", "absent_core"):
        row = []
        for method, title in columns:
            volume = measured.volumes.get((method, name, dose))
            if volume is None:
                continue
            grid = variant.grid_of(FBP_BASE[1] if method == "fbp" else s.voxel_mm)
            section = sample_axial(torch.from_numpy(volume.astype(np.float32)), grid, image)[0]
            row.append(Panel(section, extent(image), title if not rows else ""))
        title = "truth" if not rows else ""
        row.append(Panel(_true_image(measured, name, image), extent(image), title, roi_outlines(variant.rois)))
        rows.append(row)
    footer = "C150 / W600 HU. ROI outlines: necrotic core (blue), fibrous tissue (red)."
    return panels(rows, ("core", "no core"), f"First realisation at {dose:g} s, axial", footer)


def _true_image(measured: Measured, name: str, image: Any) -> Any:
    values_hu = {**measured.facts["paper"].tissue_hu, **measured.facts[name].tissue_hu}
    scene = Variant(name, measured.settings).scene
    values = np.full(len(scene) + 1, -1000.0)
    for k, body in enumerate(scene.bodies):
        values[k] = values_hu[body.name]
    labels = np.asarray(scene.labels(image))[0]
    return np.where(labels < 0, -1000.0, values[labels])
