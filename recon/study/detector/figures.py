"""Figure of the detector study."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.study.detector.rate import beam_behind
from torchpcct.scanner import SiliconDetector, presets
from torchpcct.scanner.pileup import recorded_rates

__all__ = ["draw"]


def draw(parts: dict[str, Any]) -> Any:
    """Efficiency against threshold and energy, and recorded over true counts against the thickness of fat."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.5, 3.8), dpi=150, layout="constrained")
    threshold, energy, loss = figure.subplots(1, 3)
    shown = {0: ("black", "60 mm, 100 kVp"), 3: ("tab:blue", "30 mm, 100 kVp"), 5: ("tab:green", "30 mm, 120 kVp")}
    for index, (colour, label) in shown.items():
        rows = parts["efficiency"][index]["rows"]
        x = [r["threshold_kev"] for r in rows]
        threshold.plot(x, [r["density"] for r in rows], "o-", color=colour, markersize=3, label=f"{label}, followed")
        if index == 0:
            threshold.plot(x, [r["one_interaction"] for r in rows], ":", color=colour, label=f"{label}, counted once")
    published = [r["published"] for r in rows if r["threshold_kev"] <= 10]
    threshold.plot(x[: len(published)], published, "--", color="tab:red", label="published")
    threshold.set(xlabel="lowest threshold, keV", ylabel="DQE(0)", ylim=(0, 1), title="against the threshold")
    rows = parts["efficiency_by_energy"]
    x, dqe, error = ([r[k] for r in rows] for k in ("energy_kev", "dqe", "dqe_error"))
    energy.plot(x, [r["one_interaction"] for r in rows], ":", color="black", label="counted once")
    energy.errorbar(x, dqe, error, fmt="o-", color="tab:blue", markersize=3, label="DQE, followed")
    energy.plot(x, [r["photoelectric"] for r in rows], color="0.6", label="photoelectric")
    energy.plot(x, [r["compton"] for r in rows], "--", color="0.6", label="Compton")
    energy.set(xlabel="photon energy, keV", ylim=(0, 1), title="against energy (5 keV, 60 mm)")
    scanner, path = presets.pcct(), np.linspace(0.0, 240.0, 49)
    energies = scanner.quanta()[0]
    arriving = scanner.source.current_ma * np.stack([beam_behind(scanner, path_mm=t)[1] for t in path])
    for entry in parts["pile_up"]:
        detector = SiliconDetector(dead_time_ns=entry["dead_time_ns"])
        ratio = recorded_rates(detector, energies, arriving)[0] / (arriving @ detector.response(energies)[0])
        loss.plot(path, ratio, label=f"{entry['dead_time_ns']:.0f} ns")
    loss.set(xlabel="fat, mm", ylabel="recorded / true counts", ylim=(0, 1.02), title="pile-up, central ray, 1000 mA")
    for ax in (threshold, energy, loss):
        ax.legend(fontsize=7)
        ax.title.set_fontsize(10)
    return figure
