"""Figures of the resolution study: the images under blur, and what blur does to lumen, cap and core."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from torch import Tensor

from recon.study.figures import curve_axes, middle_panel, plaque_panel
from recon.study.paper import facts as paper
from recon.study.resolution.blur import blur
from recon.study.resolution.measure import Imaged, Measured
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.roi import PROTOCOL_PIXEL_MM, sample_axial
from torchpcct.viz import panels

__all__ = ["curves_figure", "images_figure"]


def _sagittal(s: Imaged) -> Tensor:
    """``(z, x)`` HU through core and lumen, in the protocol's pixels."""
    image, high = s.scanned.rois.image, math.floor(s.scanned.fine.extent[0] / PROTOCOL_PIXEL_MM)
    cut = VolumeGrid((high, 1, image.shape[2]), PROTOCOL_PIXEL_MM, image.center)
    return sample_axial(s.volume.double(), s.scanned.fine, cut)[:, 0]


def images_figure(m: Measured) -> Any:
    """First row: both scanners; second: PCCT under blur with its segmentation; third: the same, along the vessel."""
    series = m.scanners["PCCT"].blurred
    top = []
    for name, s in m.scanners.items():
        top += [middle_panel(s.blurred[0].image, f"{name}, axial"), middle_panel(_sagittal(s), "along the vessel")]
    middle = [plaque_panel(b, f"σ = {b.sigma_px:g}", f"{b.fwhm_mm:.2f} mm") for b in series]
    bottom = [middle_panel(blur(_sagittal(m.scanners["PCCT"]), b.sigma_px)) for b in series]
    return panels(
        [top, middle, bottom], ("no blur", "PCCT axial", "PCCT along"),
        "Noise-free plaque in different resolutions",
        "C150 / W600 HU. Outlines: lumen (red), core where segmented (yellow). Below: FWHM of the blur.",
    )  # fmt: skip


def curves_figure(m: Measured) -> Any:
    """Lumen area, cap thickness and depth of the core's basin against the blur."""
    figure, (lumen, cap, basin) = curve_axes(
        "σ of the blur, 0.035 mm pixels",
        ["lumen area, of the sharp image's", "cap thickness, mm", "depth of the core's basin, HU"],
    )
    series = m.scanners["PCCT"].blurred
    x = [b.sigma_px for b in series]
    areas = np.array([b.segmentation.lumen_area for b in series])
    lumen.plot(x, areas / areas[0], "o-", color="black")
    lumen.axhspan(1 - m.settings.tolerance, 1, color="0.92", label="within tolerance")
    lumen.set_ylim(0.75, 1.02)
    values = np.array([b.cap_line for b in series])
    cap.plot(x, values, "o-", color="black", label="on the line")
    closest = np.array([b.segmentation.cap_thickness for b in series])
    cap.plot(x, closest, "x", color="tab:blue", label="smallest distance")
    low, high = values[0] * (1 - m.settings.tolerance), values[0] * (1 + m.settings.tolerance)
    cap.axhspan(low, high, color="0.92", label="within tolerance")
    cap.axhline(m.plaque.cap_thickness, color="0.5", linestyle=":", label="true")
    cap.axvline(float(paper.RESOLUTION["cap_limit_px"]), color="tab:red", linestyle="--", label="paper's limit")
    cap.legend(fontsize=7)
    for bulge, (shell, variant) in m.variants.items():
        depth = [b.depth for b in variant]
        own = bulge == m.plaque.bulge
        line = basin.plot(x, depth, "o-" if own else "-", label=f"{shell:.2f} mm{' (default)' if own else ''}")[0]
        kept = [(b.sigma_px, b.depth) for b in variant if b.segmentation.core_found]
        if kept:
            basin.plot(*zip(*kept, strict=True), "s", color=line.get_color(), markersize=7)
    basin.legend(fontsize=7, title="tissue on the fat side;\nsquares: segmented", title_fontsize=7)
    return figure
