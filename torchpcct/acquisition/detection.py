"""What the detector makes of expected readings: dead time, and the noise model of an energy-integrating one."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpcct.detector_window import DetectorWindow
from torchpcct.scan import NOISE_FREE_EXPOSURE_S
from torchpcct.scanner.pileup import PileUpMap
from torchpcct.scanner.scanner import Scanner

__all__ = ["quanta", "recorded", "signal_spectra"]


def signal_spectra(scanner: Scanner) -> tuple[Any, Any, Any]:
    """Energies, ``(bins, columns, energies)`` signal per energy in air, and the air readings ``(bins, rows, columns)``.

    Of an energy-integrating detector the variance follows as one more "bin": the same transmission, weighted by the
    squared signal.
    """
    energies, spectra = scanner.weights()
    if scanner.detector.energy_integrating:
        spectra = np.concatenate([spectra, scanner.noise_weights()[1]])
    spectra = spectra * scanner.mas_per_view(NOISE_FREE_EXPOSURE_S)
    return energies, spectra, np.einsum("bce,r->brc", spectra, scanner.row_factor)


def quanta(scanner: Scanner, counts: Tensor, energies: Any) -> Tensor | None:
    """Variance over expectation of an energy-integrating detector's readings; None of a counting one.

    In place: the readings of a whole detector are large. Behind a perfect absorber any energy will do.
    """
    if not scanner.detector.energy_integrating:
        return None
    bins = scanner.detector.bins
    dark = counts[:bins] <= 0
    return counts[bins:].div_(counts[:bins]).masked_fill_(dark, float(energies[-1]))


def recorded(
    pile_up: PileUpMap, counts: Tensor, air: Any, surround: Any, kept: DetectorWindow
) -> tuple[Tensor, Any, Any]:
    """What a detector with dead time records of the expected counts: readings, air, surround."""
    cells = torch.from_numpy(np.array(air))
    part = cells[:, kept.first_row : kept.first_row + kept.rows]
    for v, seen in enumerate(kept.column_indices):
        counts[:, v] = pile_up.apply(counts[:, v], part[..., torch.from_numpy(seen)], seen)
    columns = np.arange(air.shape[-1])
    behind = pile_up.apply(cells, cells, columns).numpy()
    return counts, behind, pile_up.apply(torch.from_numpy(np.array(surround)), cells, columns).numpy()
