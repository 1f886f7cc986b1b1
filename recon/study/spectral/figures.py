"""Figures of the spectral study: basis and monochromatic images with the CNR curve, and tissue maps."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.study.figures import extent
from recon.study.paper import facts as paper
from recon.study.spectral.measure import Measured
from torchpcct.spectral import MMD_TISSUES, vmi
from torchpcct.viz import WINDOW_HU

__all__ = ["curves_figure", "tissue_figure"]

# Colours of the paper's maps: blood green, core red, fibrous tissue blue, fat dark.
_COLOURS = ("#2ca02c", "#d62728", "#1f77b4", "#202020")
_SHOWN_KEV = (40.0, 52.0, 70.0)


def _show(ax: Any, image: Any, measured: Measured, title: str, **options: Any) -> Any:
    ax.set_xticks([])
    ax.set_yticks([])
    ax.set_title(title, fontsize=8)
    edges = extent(measured.scan.grid)
    return ax.imshow(np.asarray(image), origin="lower", extent=edges, interpolation="nearest", **options)


def curves_figure(measured: Measured) -> Any:
    """Basis images, monochromatic images (noise free above, standard noise below), and CNR against energy."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 7.2), dpi=130, layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.55, 1.0))
    top, bottom = parts
    axes = top.subplots(2, 5)
    scan, images = measured.scan, measured.images
    z = scan.grid.shape[0] // 2
    low, high = WINDOW_HU[0] - WINDOW_HU[1] / 2, WINDOW_HU[0] + WINDOW_HU[1] / 2
    for row, (name, volume) in enumerate((("noise free", images.clean), ("standard noise", images.noisy[0]))):
        middle = volume[:, z]
        for c, material in enumerate(("PE", "PVC")):
            clean = images.clean[c, z]
            reach = (float(clean.min()), float(clean.max()))
            if row:
                spread = 2 * float(middle[c].std())
                reach = (reach[0] - spread, reach[1] + spread)
            _show(axes[row, c], middle[c], measured, f"{material}, {name}", cmap="gray", vmin=reach[0], vmax=reach[1])
        for c, energy in enumerate(_SHOWN_KEV):
            hu = vmi(middle, scan.basis, [energy])[0]
            shown = _show(axes[row, 2 + c], hu, measured, f"{energy:g} keV, {name}", cmap="gray", vmin=low, vmax=high)
    top.colorbar(shown, ax=axes[:, -1], shrink=0.7, label="HU")
    left, right = bottom.subplots(1, 2)
    v = measured.data["vmi"]
    energies = v["energies_kev"]
    left.plot(energies, v["voxel"]["noise_hu"], color="tab:red", label="noise of a voxel")
    left.plot(energies, v["voxel"]["contrast_hu"], color="tab:blue", label="contrast fibrous − core")
    left.set_yscale("log")
    left.set_ylabel("HU")
    for key, style, label in (("voxel", "-", "voxel noise"), ("roi_means", "--", "ROI means (paper's protocol)")):
        cnr = np.array(v[key]["cnr"])
        best = v[key]["optimum_kev"]
        right.plot(energies, cnr / cnr.max(), style, color="black", label=f"{label}: best {best:.1f} keV")
        right.axvline(best, color="black", linestyle=style, linewidth=0.8)
    right.axvline(paper.SPECTRAL["optimum_kev"], color="tab:orange", linewidth=1.2, label="paper: 52 keV")
    right.set_ylabel("CNR / best CNR")
    for ax in (left, right):
        ax.set_xlabel("energy of the monochromatic image, keV")
        ax.legend(fontsize=8)
        ax.grid(alpha=0.3)
    return figure


def tissue_figure(measured: Measured) -> Any:
    """Tissue maps of the middle slice: truth, then one column per noise level; rows: FBP, joint MBIR."""
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    levels, dice = measured.settings.noise_levels, measured.data["dice"]
    tissues, images = measured.tissues, measured.images
    methods = [m for m in ("FBP", "joint MBIR") if m in dice]
    figure = Figure(figsize=(1.9 * (1 + len(levels)) + 0.4, 2.25 * len(methods) + 0.7), dpi=150, layout="constrained")
    axes = figure.subplots(len(methods), 1 + len(levels), squeeze=False)
    colours = ListedColormap(["white", *_COLOURS])
    k = tissues.middle
    for row, method in enumerate(methods):
        _show(axes[row, 0], tissues.truth[k] + 1, measured, "truth" if row == 0 else "", cmap=colours, vmin=0, vmax=4)
        axes[row, 0].set_ylabel(method, fontsize=9)
        for c, level in enumerate(levels):
            volume = images.fbp(level)[0] if images.mbir is None or method == "FBP" else images.mbir[c]
            labels = tissues.labels(volume)[k]
            ax = axes[row, 1 + c]
            _show(ax, labels + 1, measured, f"{100 * level:.0f} % noise", cmap=colours, vmin=0, vmax=4)
            score = dice[method][c]["necrotic_core"]["mean"]
            ax.set_xlabel(f"core's Dice {score:.2f}", fontsize=7)
    names = [t.replace("_", " ") for t in MMD_TISSUES]
    handles = [Patch(color=c, label=n) for c, n in zip(_COLOURS, names, strict=True)]
    handles.append(Patch(facecolor="white", edgecolor="black", label="vessel wall, mixed voxels (left out)"))
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=7)
    return figure
