"""Figure of the hard cases."""

from __future__ import annotations

from typing import Any

from recon.study.hardcases.measure import RIGHT_NOISES, Measured

__all__ = ["draw"]

_COLOURS = {"right": "tab:green", "warned": "tab:orange", "unseen": "tab:grey", "SILENT": "tab:red"}


def draw(measured: Measured) -> Any:
    """Error over noise of every case, a panel per method; refused cases have no bar."""
    from matplotlib.figure import Figure

    methods, cases = measured.settings.methods, measured.settings.cases
    figure = Figure(figsize=(4.2 * len(methods) + 2, 0.24 * len(cases) + 1.2), dpi=150, layout="constrained")
    panels = figure.subplots(1, len(methods), sharey=True, squeeze=False)[0]
    for panel, method in zip(panels, methods, strict=True):
        rows = [r for r in measured.rows if r["method"] == method]
        for k, r in enumerate(rows):
            if r["error_hu"] is None or not r["finite"]:
                panel.text(0.011, k, "refused" if r["refused"] else "not finite", va="center", fontsize=7)
            else:
                panel.barh(k, max(r["error_hu"] / r["noise_hu"], 0.0105), color=_COLOURS[r["verdict"]], height=0.7)
        panel.axvline(RIGHT_NOISES, color="black", linewidth=0.8, linestyle=":")
        panel.set(xscale="log", xlim=(0.01, None), xlabel="error / noise of the sound scan", title=method)
        panel.set_yticks(range(len(rows)), [r["title"] for r in rows], fontsize=7)
    panels[0].invert_yaxis()
    return figure
