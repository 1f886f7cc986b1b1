"""Figures of the dose-factor study: FBP's exact dose curves with every method's reading, and pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from recon.study.dose_factor.measure import Measured
from recon.study.dose_factor.settings import FBP_BASE, METHOD_NAMES, fbp_label
from recon.study.dose_factor.variant import Variant
from recon.study.figures import extent, roi_outlines
from recon.study.paper.facts import ASSUMED_FACTOR
from torchpcct.metrics.dose_curve import DOSES
from torchpcct.metrics.roi import sample_axial
from torchpcct.viz import Panel, panels

__all__ = ["curves_figure", "images_figure"]

_COLORS = {
    "linear": "tab:brown", "linear_z": "tab:cyan", "quadratic": "tab:olive", "qggmrf": "tab:green", "tv": "tab:purple",
    "fbp_cnn": "tab:pink", "mbir_one_pass": "tab:orange", "mbir": "tab:red",
}  # fmt: skip
"""What is drawn; methods that are told a wrong noise are not."""


def curves_figure(data: dict[str, Any]) -> Any:
    """Top: the paper's CNR against dose; bottom: slope-corrected SD of the contrast. One column per exposure."""
    from matplotlib.figure import Figure

    doses = data["settings"]["doses"]
    figure = Figure(figsize=(3.9 * len(doses) + 1.6, 7.0), dpi=150, layout="constrained")
    axes = figure.subplots(2, len(doses), squeeze=False, sharex=True, sharey="row")
    shown: list[list[float]] = [[], []]
    for column, limit in enumerate(data["ceiling"]):
        for row, (figure_key, value) in enumerate((("paper_cnr", "paper_cnr"), ("contrast_sd_hu", "contrast_sd_hu"))):
            shown[row] += _draw(axes[row, column], data, limit, figure_key, value)
        axes[0, column].set_title(f"1× = {limit['exposure_s']:g} s", fontsize=10)
        axes[1, column].set_xlabel("dose relative to the method's")
    for row, values in enumerate(shown):
        axes[row, 0].set_ylim(0.8 * min(values), 1.25 * max(values))
    axes[0, 0].set_ylabel("paper's CNR")
    axes[1, 0].set_ylabel("contrast SD at slope 1, HU")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=7)
    title = "FBP's exact dose curves; a method's reading at 1×\nmeets them at its dose factor"
    figure.suptitle(title, fontsize=9)
    return figure


def _draw(ax: Any, data: dict[str, Any], limit: dict[str, Any], key: str, value: str) -> list[float]:
    """One panel; the lowest and highest values that must be visible."""
    from matplotlib.ticker import FuncFormatter

    rising = key == "paper_cnr"
    relative = np.array(DOSES)
    exposure = limit["exposure_s"]
    styles = ("-", "--", "-.", ":")
    shown = [f for f in data["fbp"] if not f["blur_mm"] and f["voxel_mm"] == FBP_BASE[1]]
    for fbp, style in zip(shown, styles, strict=False):
        exact = next(d for d in fbp["doses"] if d["exposure_s"] == exposure)[key]
        ax.plot(
            relative, exact * relative ** (0.5 if rising else -0.5), style, color="0.35", linewidth=1.2,
            label=f"FBP {fbp['label']}",
        )  # fmt: skip
    base = next(f for f in shown if f["label"] == fbp_label(*FBP_BASE))
    at_one = next(d for d in base["doses"] if d["exposure_s"] == exposure)[key]

    def met(level: float) -> float:
        return (level / at_one) ** (2.0 if rising else -2.0)

    readings = [
        e
        for e in data["methods"]
        if e["method"] in _COLORS and e["exposure_s"] == exposure and e[value].get("value") is not None
    ]
    for k, e in enumerate(readings):
        # Beside each other, so that no interval hides another.
        at = 2.0 ** (0.22 * (k - (len(readings) - 1) / 2))
        v, low, high = (e[value][n] for n in ("value", "low", "high"))
        end = float(np.clip(met(v), relative[0], relative[-1]))
        color = _COLORS[e["method"]]
        ax.plot([at, end], [v, v], color=color, linewidth=1.0)
        ax.plot([end], [v], "|", color=color, markersize=9)
        spread = [[v - low], [high - v]] if low is not None and high is not None else None
        ax.errorbar(
            [at], [v], yerr=spread, fmt="o", color=color, markersize=4, capsize=2, label=METHOD_NAMES[e["method"]]
        )
    top = limit[key]
    reach = float(np.clip(met(top), relative[0], relative[-1]))
    ax.plot([1.0, reach], [top, top], color="black", linewidth=1.6, label="limit of the data")
    ax.plot([1.0], [top], "k*", markersize=8)
    ax.axhspan(top, 10.0 * top if rising else 0.1 * top, color="black", alpha=0.06)
    ax.axvline(ASSUMED_FACTOR, color="tab:blue", linewidth=0.8, linestyle=":", label=f"assumed, {ASSUMED_FACTOR}×")
    ax.set_xscale("log", base=2)
    ax.set_yscale("log")
    ax.set_xticks(relative, [f"{d:g}" for d in relative], fontsize=7)
    ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    ax.yaxis.set_minor_formatter(FuncFormatter(lambda v, _: f"{v:g}" if f"{v:.0e}"[0] in "235" else ""))
    ax.tick_params(labelsize=7, which="both")
    ax.grid(True, which="both", linewidth=0.3, alpha=0.6)
    # The thinnest dose makes the worst FBP.
    return [top, at_one * relative[0] ** (0.5 if rising else -0.5)]


def images_figure(measured: Measured, data: dict[str, Any]) -> Any:
    """One realisation with and without the core: FBP, the methods, the truth. C150 / W600."""
    s = measured.settings
    dose = s.doses[-1]
    variant = Variant("paper", s)
    image = variant.rois.image
    columns: list[tuple[str, Any]] = [("fbp", f"FBP {fbp_label(*FBP_BASE)}")]
    columns += [(m, METHOD_NAMES[m]) for m in measured.methods if m in _COLORS]
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
    facts = measured.facts[name]
    scene = Variant(name, measured.settings).scene
    values = np.full(len(scene) + 1, -1000.0)
    for k, body in enumerate(scene.bodies):
        values[k] = facts.amplitudes_hu[facts.tissue(body.name)]
    labels = np.asarray(scene.labels(image))[0]
    return np.where(labels < 0, -1000.0, values[labels])
