"""FBP of a small inset from a scan: filter once, backproject onto any number of grids."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.fbp.angular_weights import angular_weights
from recon.fbp.fbp import backproject, fbp, filter_sinogram, filter_windowed
from torchpcct.detector_window import DetectorWindow, shadow
from torchpcct.geometry import Geometry, VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scene.motion import SinusoidalMotion

__all__ = ["InsetFbp", "to_hu", "view_motion"]


def to_hu(attenuation: Tensor, mu_water: float) -> Tensor:
    """CT numbers from attenuation in mm⁻¹: 1000 (μ / μ_water − 1), so that water reads 0 and air −1000."""
    return 1000.0 * (attenuation / mu_water - 1.0)


def view_motion(motion: SinusoidalMotion, geometry: Geometry, rotation_s: float) -> NDArray[np.float64]:
    """Displacement of a moving body in every view, as projectors and backprojectors take it.

    Args:
        motion: of the body.
        geometry: of the scan; its first view is read at t = 0, as :func:`torchpcct.acquire` does.
        rotation_s: time of one turn in s.

    Returns:
        ``(views, 3)`` z, y, x in mm, at the middle of each view.

    Raises:
        ValueError: ``rotation_s`` ≤ 0.
    """
    if not rotation_s > 0:
        raise ValueError(f"rotation_s must be greater than 0 s, got {rotation_s}")
    times = (geometry.angles - geometry.angles[0]) / (2.0 * math.pi) * rotation_s
    return np.ascontiguousarray(motion.displacement(times)[:, ::-1])


class InsetFbp:
    """FBP in HU of one or several grids from scans that share geometry, window and surround.

    A windowed scan is split by linearity: its surround, the same in every view and noise free, is filtered once; the
    difference of each realisation to the surround is zero outside the window and is filtered from the window alone.
    The sum equals the FBP of the whole rows.

    The same split compensates motion: the surround stands still while the inset moves, so the surround is
    backprojected at rest, the difference with the grid displaced in every view, and the sum shows the inset at rest.
    Backprojecting whole readings with the displacement would move the patient's body with the vessel. The difference
    of the logarithms is linear in the inset up to beam hardening (the inset is seen through the same fat everywhere)
    and in the surround up to the fat that the inset displaces, which moves with it as part of the difference.

    Args:
        scan: any scan of the family; its noise does not matter.
        grids: ``(z, y, x)`` grids inside the field of view.
        kernels: reconstruction kernels.
        motion: displacement of the inset in every view, ``(views, 3)`` z, y, x mm (:func:`view_motion`); None: at
            rest.

    Raises:
        ValueError: a grid outside the field of view or the scan's window; an unknown kernel; motion in a scan that was
            acquired without ``region`` (its surround is not known).
    """

    def __init__(self, scan: Scan, grids: Sequence[VolumeGrid], kernels: Sequence[str], *, motion: Any = None) -> None:
        if scan.counts.ndim != 3:
            raise ValueError("FBP in HU needs a counting-mode scan; decompose or sum the energy bins before")
        self.geometry, self.window, self.linearisation = scan.geometry, scan.window, scan.linearisation
        self.grids, self.kernels = tuple(grids), tuple(kernels)
        if motion is not None and scan.window is None:
            raise ValueError("motion compensation needs the surround at rest: acquire the scan with region=")
        self.motion = motion
        paths = (None,) if motion is None else (None, motion)
        windows = [shadow(self.geometry, grid, margin=1, motion=path) for grid in self.grids for path in paths]
        self.shadow = DetectorWindow.union(windows, self.geometry.columns)
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
        assert self.surround is not None
        return self._difference(scan) + self.surround

    def _difference(self, scan: Scan) -> Tensor:
        """What the inset adds to the surround, filtered, on the grids' shadow."""
        if self.surround is None or scan.window != self.window or scan.window is None:
            raise ValueError("this scan has another window than the one that InsetFbp was made for")
        difference = scan.line_integrals() - scan._at_window(self._surround_lines)
        return filter_windowed(difference, self.geometry, scan.window, self.kernels, self.shadow)

    def __call__(self, scan: Scan) -> list[Tensor]:
        """Volumes in HU, one ``(kernels, *grid.shape)`` float32 tensor per grid."""
        if scan.geometry != self.geometry:
            raise ValueError("this scan has another geometry than the one that InsetFbp was made for")
        mu = self.linearisation.mu_ref
        if self.window is None:
            lines = scan.line_integrals()
            return [to_hu(fbp(lines, self.geometry, grid, self.kernels), mu) for grid in self.grids]
        if self.motion is None:
            data = self.filtered(scan)
            return [to_hu(backproject(data, self.geometry, grid, self.shadow), mu) for grid in self.grids]
        moving = self._difference(scan)
        return [
            to_hu(rest + backproject(moving, self.geometry, grid, self.shadow, motion=self.motion), mu)
            for rest, grid in zip(self._rest, self.grids, strict=True)
        ]

    @cached_property
    def _rest(self) -> list[Tensor]:
        """The surround on every grid, mm⁻¹."""
        assert self.surround is not None
        return [backproject(self.surround, self.geometry, grid, self.shadow) for grid in self.grids]


def _require_inside(inner: DetectorWindow, outer: DetectorWindow) -> None:
    columns = (inner.first_column >= outer.first_column) & (
        inner.first_column + inner.columns <= outer.first_column + outer.columns
    )
    if not columns.all() or inner.first_row < outer.first_row:
        raise ValueError(
            "the grid reaches beyond the region that this scan was acquired for: acquire it with a larger region"
        )
