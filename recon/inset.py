"""FBP of a small inset from a scan: filter once, backproject onto any number of grids."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from recon.angular_weights import angular_weights
from recon.fbp import backproject, fbp, filter_sinogram, filter_windowed
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.window import DetectorWindow, shadow

__all__ = ["InsetFbp", "to_hu"]


def to_hu(attenuation: Tensor, mu_water: float) -> Tensor:
    """CT numbers from attenuation in mm⁻¹: 1000 (μ / μ_water − 1), so that water reads 0 and air −1000."""
    return 1000.0 * (attenuation / mu_water - 1.0)


class InsetFbp:
    """FBP in HU of one or several grids from scans that share geometry, window and surround.

    A windowed scan is split by linearity: its surround, the same in every view and noise free, is filtered once; the
    difference of each realisation to the surround is zero outside the window and is filtered from the window alone.
    The sum equals the FBP of the whole rows.

    Args:
        scan: any scan of the family; its noise does not matter.
        grids: ``(z, y, x)`` grids inside the field of view.
        kernels: reconstruction kernels.

    Raises:
        ValueError: a grid outside the field of view or the scan's window; an unknown kernel.
    """

    def __init__(self, scan: Scan, grids: Sequence[VolumeGrid], kernels: Sequence[str]) -> None:
        if scan.counts.ndim != 3:
            raise ValueError("FBP in HU needs a counting-mode scan; decompose or sum the energy bins before")
        self.geometry, self.window, self.linearisation = scan.geometry, scan.window, scan.linearisation
        self.grids, self.kernels = tuple(grids), tuple(kernels)
        windows = [shadow(self.geometry, grid, margin=1) for grid in self.grids]
        self.shadow = _union(windows, self.geometry.columns)
        self.surround: Tensor | None = None
        if scan.window is not None:
            _require_inside(self.shadow, scan.window)
            self._surround_lines = scan.surround_line_integrals()
            self.surround = self._filter_surround()

    def _filter_surround(self) -> Tensor:
        """The surround, filtered, on the grids' shadow: ``(kernels, views, rows, columns)``."""
        g, s = self.geometry, self.shadow
        weights = angular_weights(g)
        if not np.allclose(weights, weights[0, 0], rtol=1e-6, atol=0):
            return filter_sinogram(self._surround_lines.expand(g.shape), g, self.kernels, s)
        one = g.select([0])
        filtered = filter_sinogram(self._surround_lines[None], one, self.kernels, weights=weights[:1, :1])[:, 0]
        rows = filtered[:, s.first_row : s.first_row + s.rows]
        return rows[..., torch.from_numpy(s.column_indices)].movedim(2, 1)

    def filtered(self, scan: Scan) -> Tensor:
        """Filtered readings of a windowed scan on the grids' shadow, ``(kernels, views, rows, columns)``."""
        if self.surround is None or scan.window != self.window or scan.window is None:
            raise ValueError("this scan has another window than the one that InsetFbp was made for")
        difference = scan.line_integrals() - scan._at_window(self._surround_lines)
        return filter_windowed(difference, self.geometry, scan.window, self.kernels, self.shadow) + self.surround

    def __call__(self, scan: Scan) -> list[Tensor]:
        """Volumes in HU, one ``(kernels, *grid.shape)`` float32 tensor per grid."""
        if scan.geometry != self.geometry:
            raise ValueError("this scan has another geometry than the one that InsetFbp was made for")
        mu = self.linearisation.mu_ref
        if self.window is None:
            lines = scan.line_integrals()
            return [to_hu(fbp(lines, self.geometry, grid, self.kernels), mu) for grid in self.grids]
        data = self.filtered(scan)
        return [to_hu(backproject(data, self.geometry, grid, self.shadow), mu) for grid in self.grids]


def _union(windows: Sequence[DetectorWindow], columns: int) -> DetectorWindow:
    """The smallest window that holds all ``windows``."""
    first = np.min([w.first_column for w in windows], axis=0)
    last = np.max([w.first_column + w.columns for w in windows], axis=0)
    width = int((last - first).max())
    first_row = min(w.first_row for w in windows)
    rows = max(w.first_row + w.rows for w in windows) - first_row
    return DetectorWindow(np.minimum(first, columns - width), width, first_row, rows)


def _require_inside(inner: DetectorWindow, outer: DetectorWindow) -> None:
    columns = (inner.first_column >= outer.first_column) & (
        inner.first_column + inner.columns <= outer.first_column + outer.columns
    )
    if not columns.all() or inner.first_row < outer.first_row:
        raise ValueError(
            "the grid reaches beyond the region that this scan was acquired for: acquire it with a larger region"
        )
