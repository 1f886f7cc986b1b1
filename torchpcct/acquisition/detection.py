"""From expected readings to a scan: the detector's dead time, and the noise model of an energy-integrating one."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpcct.detector_window import DetectorWindow
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.scanner.scanner import Scanner

__all__ = ["detected", "signal_spectra"]


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


def detected(
    scanner: Scanner,
    counts: Tensor,
    air: Any,
    energies: Any,
    info: dict[str, Any],
    surround: Any = None,
    window: DetectorWindow | None = None,
) -> Scan:
    """The noise-free scan of expected readings, with what the detector makes of them.

    Args:
        scanner: whose detector it is.
        counts: ``(bins, views, rows, columns)`` float32, the bins of :func:`signal_spectra`; overwritten, as the
            readings of a whole detector are large.
        air, surround: ``(bins, rows, columns)``; surround None: of a scan without window.
        energies: ``(E,)`` keV.
        info: of the scan.
        window: the part of the detector that ``counts`` hold; None: all of it.
    """
    g, detector, bins = scanner.geometry, scanner.detector, scanner.detector.bins
    bare = torch.from_numpy(np.array(air))
    behind = None if surround is None else torch.from_numpy(np.array(surround))
    pile_up = scanner.pile_up()
    if pile_up is not None:
        kept, cells, columns = window or DetectorWindow.full(g), bare, np.arange(g.columns)
        part = cells[:, kept.first_row : kept.first_row + kept.rows]
        for v, seen in enumerate(kept.column_indices):
            counts[:, v] = pile_up.apply(counts[:, v], part[..., torch.from_numpy(seen)], seen)
        bare = pile_up.apply(cells, cells, columns)
        behind = None if behind is None else pile_up.apply(behind, cells, columns)
    quantum = None
    if detector.energy_integrating:
        dark = counts[:bins] <= 0  # behind a perfect absorber any energy will do
        quantum = counts[bins:].div_(counts[:bins]).masked_fill_(dark, float(energies[-1]))

    def of_bins(values: Tensor) -> Tensor:
        return (values[0] if bins == 1 else values[:bins]).to(torch.float32)

    return Scan(
        counts=of_bins(counts),
        air=of_bins(bare),
        geometry=g,
        linearisation=scanner.water_linearisation(),
        window=window,
        surround=None if behind is None else of_bins(behind),
        counting=not detector.energy_integrating,
        info=info,
        quantum=None if quantum is None else of_bins(quantum),
        electronic_noise=detector.electronic_noise if detector.energy_integrating else 0.0,
    )
