"""Everything that the detector study computes, part by part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from recon.evaluate.store import Pieces
from recon.study.detector.efficiency import ENERGIES_KEV, at_energy, cases, efficiencies, repeated_counts_hu
from recon.study.detector.rate import charge_sharing, counts, pile_up
from recon.study.detector.settings import Settings
from recon.study.study import Clock, Progress, silent

__all__ = ["Measured", "measure"]


@dataclass(frozen=True)
class Measured:
    """What the report needs.

    Attributes:
        settings: of the study.
        parts: JSON values: ``counts``, ``efficiency``, ``efficiency_by_energy``, ``repeated_counts_hu``,
            ``charge_sharing``, ``pile_up``.
        seconds: step → seconds.
    """

    settings: Settings
    parts: dict[str, Any]
    seconds: dict[str, float]


def measure(settings: Settings, progress: Progress = silent, folder: str | Path | None = None) -> Measured:
    """Follow photons and compute rates, in resumable pieces."""
    s, clock, rng = settings, Clock(), np.random.default_rng(settings.seed)
    pieces = Pieces(folder, settings)

    def followed(name: str, compute: Callable[[], Any]) -> Any:
        """A piece that draws photons; the next one draws on where it ended."""
        found, after = pieces(name, lambda: (compute(), rng.bit_generator.state))
        rng.bit_generator.state = after
        return found

    efficiency, spectrum, looked_at = [], [], cases()
    for i, case in enumerate(looked_at):
        efficiency.append(followed(f"case_{i}", partial(efficiencies, case, s.photons, rng)))
        progress("photons followed, thresholds", (i + 1) / len(looked_at))
    clock.lap("thresholds")
    for i, energy in enumerate(ENERGIES_KEV):
        spectrum.append(followed(f"energy_{i}", partial(at_energy, energy, max(1000, s.photons // 4), rng)))
        progress("photons followed, energies", (i + 1) / len(ENERGIES_KEV))
    clock.lap("energies")
    pieces.ahead(_pile_up, *((t,) for t in s.dead_times_ns))
    parts = {
        "counts": counts(),
        "efficiency": efficiency,
        "efficiency_by_energy": spectrum,
        "repeated_counts_hu": repeated_counts_hu(spectrum),
        "charge_sharing": [
            followed(f"sharing_{c:g}", partial(charge_sharing, c, s.photons, rng)) for c in s.charge_sharing
        ],
        "pile_up": [_pile_up(s, pieces, t) for t in s.dead_times_ns],
    }
    clock.lap("rates")
    return Measured(s, parts, clock.seconds)


def _pile_up(settings: Settings, pieces: Pieces, dead_time_ns: float) -> Any:
    return pieces(f"pile_up_{dead_time_ns:g}", partial(pile_up, dead_time_ns))
