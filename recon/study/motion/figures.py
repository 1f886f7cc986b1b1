"""Figures of the motion study: images with error maps, and measures against the motion."""

from __future__ import annotations

from typing import Any

from recon.study.figures import curve_axes, middle_panel, plaque_panel
from recon.study.motion.compensation import estimate_name
from recon.study.motion.measure import Measured
from recon.study.motion.observed import Observed
from recon.study.motion.settings import METHODS
from torchpcct.viz import WINDOW_HU, Panel, panels

__all__ = ["curves_figure", "images_figure"]

_ERROR_WIDTH_HU = 200.0
"""Width of the window of the error maps, about 0 HU, as in the paper."""


def _error_map(found: Observed, rest: Observed) -> Panel:
    # The one grey scale of the figure is that of images: stretch the error to its window.
    center, width = WINDOW_HU
    return middle_panel((found.image - rest.image) * (width / _ERROR_WIDTH_HU) + center)


def images_figure(m: Measured) -> Any:
    """PCCT and EID-CT with residual motion and their error maps; then the compensated images."""
    rows: list[list[Panel]] = []
    labels = []
    for name, rest in m.at_rest.items():
        found = {"at rest": rest, **{f"{100 * f:.0f} %": here for f, (here, _) in m.residuals(name).items()}}
        rows += [[plaque_panel(o, title) for title, o in found.items()], [_error_map(o, rest) for o in found.values()]]
        labels += [name, "error"]
    for noisy in (False, True):
        for method, title in METHODS.items():
            row = [
                plaque_panel(found[0], estimate_name(error))
                for (name, error, with_noise), found in m.compensated.items()
                if name == method and with_noise == noisy
            ]
            if row:
                rows.append(row)
                labels.append(f"{title.split(' (')[0]}{', noise' if noisy else ''}")
    figure = panels(
        rows, labels, "Residual motion, and compensation of the largest",
        f"C150 / W600 HU; error maps C0 / W{_ERROR_WIDTH_HU:g} HU. Outlines: lumen (red), core where segmented "
        "(yellow).",
    )  # fmt: skip
    figure.set_size_inches(0.6 * figure.get_size_inches())  # ten rows of small images
    return figure


def curves_figure(m: Measured) -> Any:
    """NRMSE, lumen area and depth of the core's basin against residual motion, uncompensated and compensated."""
    figure, axes = curve_axes("residual motion, mm", ["NRMSE, %", "lumen area, of that at rest", "core's basin, HU"])

    def draw(x: list[float], found: list[Observed], rest: Observed, marker: str, color: str, label: str) -> None:
        area = rest.segmentation.lumen_area
        curves = (
            [100 * o.nrmse for o in found],
            [o.segmentation.lumen_area / area for o in found],
            [o.depth for o in found],
        )
        for ax, values in zip(axes, curves, strict=True):
            # Moving the image back does not change an area.
            if marker != "x--" or ax is not axes[1]:
                ax.plot(x, values, marker, color=color, label=label)

    amplitude = m.settings.amplitude_mm
    for name, color in (("PCCT", "black"), ("EID-CT", "tab:blue")):
        rest, pairs = m.at_rest[name], m.residuals(name)
        if pairs:
            x = [amplitude * f for f in (0.0, *pairs)]
            in_place, back = ([rest, *(pair[k] for pair in pairs.values())] for k in (0, 1))
            draw(x, in_place, rest, "o-", color, f"{name}, in place")
            draw(x, back, rest, "x--", color, f"{name}, moved back")
    known = [0.0, *m.settings.errors]
    for method, color in (("fbp", "tab:orange"), ("mbir", "tab:red")):
        if method in m.settings.methods:
            rest = m.compensated[method, None, False][0]
            found = [m.compensated[method, e, False][0] for e in known]
            x = [e * amplitude * m.settings.worst for e in known]
            draw(x, found, rest, "s-", color, f"compensated {METHODS[method].split(' (')[0]}")
    for ax in axes:
        ax.legend(fontsize=6.5)
    return figure
