"""Figures of the motion study: images with error maps, and measures against the motion."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.study.motion.measure import METHODS, Measured
from recon.study.motion.observed import Observed
from torchpcct.metrics.roi import PROTOCOL_PIXEL_MM
from torchpcct.viz import WINDOW_HU, Panel, panels

__all__ = ["curves_figure", "images_figure"]

_HALF_PX = 80
_ERROR_WIDTH_HU = 200.0
"""Width of the window of the error maps, about 0 HU, as in the paper."""


def _panel(found: Observed, title: str, rest: Observed | None = None) -> Panel:
    """The middle of the axial image with its segmentation; with ``rest`` the difference to that."""
    n = found.image.shape[-1] // 2
    part = (slice(n - _HALF_PX, n + _HALF_PX),) * 2
    half = _HALF_PX * PROTOCOL_PIXEL_MM
    extent = (-half, half, -half, half)
    if rest is not None:
        # The one grey scale of the figure is that of images: stretch the error to its window.
        center, width = WINDOW_HU
        error = (found.image - rest.image)[part] * (width / _ERROR_WIDTH_HU) + center
        return Panel(error.numpy(), extent, title)
    outlines = [(found.segmentation.lumen[part], "tomato")]
    if found.segmentation.core_found:
        outlines.append((found.segmentation.core[part], "gold"))
    return Panel(found.image[part].numpy(), extent, title, outlines)


def images_figure(m: Measured) -> Any:
    """PCCT and EID-CT with residual motion and their error maps; then the compensated images."""
    rows: list[list[Panel]] = []
    labels = []
    for name, rest in m.at_rest.items():
        found = {f: here for (scanner, f), (here, _) in m.residual.items() if scanner == name}
        rows.append([_panel(rest, "at rest"), *(_panel(o, f"{100 * f:.0f} %") for f, o in found.items())])
        rows.append([_panel(rest, "", rest), *(_panel(o, "", rest) for o in found.values())])
        labels += [name, "error"]
    for noisy in (False, True):
        for method, title in METHODS.items():
            row = [
                _panel(
                    found[0],
                    "at rest" if error is None else ("true motion" if error == 0 else f"wrong by {100 * error:.0f} %"),
                )
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
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 3.8), dpi=130, layout="constrained")
    nrmse, lumen, basin = figure.subplots(1, 3)
    amplitude = m.settings.amplitude_mm
    for name, color in (("PCCT", "black"), ("EID-CT", "tab:blue")):
        rest = m.at_rest[name]
        items = [(f, *pair) for (scanner, f), pair in m.residual.items() if scanner == name]
        if not items:
            continue
        x = np.array([0.0, *(f for f, _, _ in items)]) * amplitude
        nrmse.plot(x, [0.0, *(100 * h.nrmse for _, h, _ in items)], "o-", color=color, label=f"{name}, in place")
        nrmse.plot(x, [0.0, *(100 * b.nrmse for _, _, b in items)], "x--", color=color, label=f"{name}, moved back")
        area = rest.segmentation.lumen_area
        lumen.plot(x, [1.0, *(h.segmentation.lumen_area / area for _, h, _ in items)], "o-", color=color, label=name)
        basin.plot(x, [rest.depth, *(h.depth for _, h, _ in items)], "o-", color=color, label=f"{name}, in place")
        basin.plot(x, [rest.depth, *(b.depth for _, _, b in items)], "x--", color=color, label=f"{name}, moved back")
    worst = max(m.settings.fractions)
    known = [0.0, *m.settings.errors]
    for method, color in (("fbp", "tab:orange"), ("mbir", "tab:red")):
        if (method, None, False) not in m.compensated:
            continue
        rest = m.compensated[method, None, False][0]
        found = [m.compensated[method, e, False][0] for e in known]
        x = np.array(known) * amplitude * worst
        label = f"compensated {METHODS[method].split(' (')[0]}"
        nrmse.plot(x, [100 * o.nrmse for o in found], "s-", color=color, label=label)
        lumen.plot(
            x, [o.segmentation.lumen_area / rest.segmentation.lumen_area for o in found], "s-", color=color, label=label
        )
        basin.plot(x, [o.depth for o in found], "s-", color=color, label=label)
    for ax, text in ((nrmse, "NRMSE, %"), (lumen, "lumen area, of that at rest"), (basin, "core's basin, HU")):
        ax.set_xlabel("residual motion, mm")
        ax.set_ylabel(text)
        ax.grid(alpha=0.3)
        ax.legend(fontsize=6.5)
    return figure
