"""FBP of several channels of line integrals (basis materials, energy bins) on a window, with a static surround.

As :class:`recon.fbp.inset.InsetFbp` does for counting-mode scans: the surround, the same in every view and noise free,
is filtered once; what differs from it inside the window is filtered from the window alone. The sum equals the FBP of
the whole rows.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.fbp.angular_weights import angular_weights
from recon.fbp.backproject import BackprojectionPlan
from recon.fbp.fbp import backproject, filter_sinogram, filter_windowed
from recon.fbp.filter_plan import FilterPlan
from torchpcct.detector_window import DetectorWindow, shadow
from torchpcct.geometry import ConeBeam, VolumeGrid

__all__ = ["ChannelFbp", "static_fbp"]


def static_fbp(lines: Tensor, geometry: ConeBeam, grid: VolumeGrid, kernel: str = "standard") -> Tensor:
    """FBP of readings that are the same in every view (rotationally symmetric objects).

    Args:
        lines: ``(..., rows, columns)`` line integrals of one view.
        geometry: of the whole scan.
        grid: ``(z, y, x)`` grid in the field of view.
        kernel: reconstruction kernel.

    Returns:
        ``(..., *grid.shape)``, unit of ``lines`` per mm.

    Raises:
        ValueError: a wrong shape, a grid outside the field of view.
    """
    part = shadow(geometry, grid, margin=1)
    return backproject(_static(lines, geometry, kernel, part), geometry, grid, part)


def _static(lines: Tensor, geometry: ConeBeam, kernel: str, part: DetectorWindow) -> Tensor:
    """Filtered readings ``(..., views, rows, columns)`` on ``part`` of lines that are the same in every view."""
    weights = angular_weights(geometry)
    if not np.allclose(weights, weights[0, 0], rtol=1e-6, atol=0):
        whole = lines.unsqueeze(-3).expand(*lines.shape[:-2], *geometry.shape)
        return filter_sinogram(whole, geometry, kernel, part)
    one = geometry.select([0])
    return part.take(filter_sinogram(lines.unsqueeze(-3), one, kernel, weights=weights[:1, :1]).squeeze(-3))


class ChannelFbp:
    """FBP of one grid from channels of line integrals that share geometry, window and surround.

    Args:
        geometry: of the whole scan.
        window: where the line integrals are given.
        surround: ``(channels, rows, columns)`` line integrals of every cell outside the window, the same in all views.
        grid: ``(z, y, x)`` grid inside the window's shadow.
        kernel: reconstruction kernel.

    Raises:
        ValueError: shapes that do not fit, a grid outside the field of view or the window, an unknown kernel.
    """

    def __init__(
        self, geometry: ConeBeam, window: DetectorWindow, surround: Tensor, grid: VolumeGrid, kernel: str = "standard"
    ) -> None:
        if surround.ndim < 2 or tuple(surround.shape[-2:]) != (geometry.rows, geometry.columns):
            raise ValueError(
                f"surround must have the shape (channels, {geometry.rows}, {geometry.columns}), got "
                f"{tuple(surround.shape)}"
            )
        self.geometry, self.window, self.grid, self.kernel = geometry, window, grid, kernel
        self.shadow = shadow(geometry, grid, margin=1)
        inside = (self.shadow.first_column >= window.first_column) & (
            self.shadow.first_column + self.shadow.columns <= window.first_column + window.columns
        )
        if not inside.all():
            raise ValueError("the grid reaches beyond the window of the data: acquire a larger region")
        self.surround = surround
        self._filtered = _static(surround, geometry, kernel, self.shadow)

    @property
    def background(self) -> Tensor:
        """FBP of the surround itself on the grid, ``(channels, *grid.shape)``."""
        return backproject(self._filtered, self.geometry, self.grid, self.shadow)

    def __call__(self, lines: Tensor) -> Tensor:
        """Images of the channels.

        Args:
            lines: ``(..., channels, views, rows, columns)`` on the window, e.g.
                :attr:`torchpcct.spectral.Decomposition.line_integrals` in mm.

        Returns:
            ``(..., channels, *grid.shape)``: unit of ``lines`` per mm (basis coefficients: dimensionless).

        Raises:
            ValueError, TypeError: a wrong shape or dtype.
        """
        channels = tuple(self.surround.shape[:-2])
        if lines.ndim < 3 or tuple(lines.shape[lines.ndim - 3 - len(channels) : -3]) != channels:
            raise ValueError(f"lines must have the channels {channels} before the views, got {tuple(lines.shape)}")
        difference = lines - self.window.take(self.surround.to(lines.dtype))
        filtered = filter_windowed(difference, self.geometry, self.window, self.kernel, self.shadow)
        return backproject(filtered + self._filtered.to(lines.dtype), self.geometry, self.grid, self.shadow)

    def covariance(self, functionals: Tensor, ray_covariance: Tensor) -> NDArray[np.float64]:
        """Exact covariance of linear functionals of two channels: one adjoint pass per functional, no Monte Carlo.

        FBP is linear and rays are independent, so with h the adjoint of a functional's weights the covariance between
        channel c of functional i and channel d of functional j is Σ_rays h_i h_j C_cd.

        Args:
            functionals: ``(functionals, *grid.shape)`` weights on the volume: one voxel, an ROI mean.
            ray_covariance: ``(3, views, rows, columns)`` C₁₁, C₁₂, C₂₂ on the window, as :func:`cramer_rao` gives it.

        Returns:
            ``(functionals, functionals, 3)`` float64.

        Raises:
            ValueError: wrong shapes.
        """
        w = self.window
        if tuple(ray_covariance.shape) != (3, w.views, w.rows, w.columns):
            raise ValueError(
                f"ray_covariance must have the shape {(3, w.views, w.rows, w.columns)}, got "
                f"{tuple(ray_covariance.shape)}"
            )
        if tuple(functionals.shape[1:]) != self.grid.shape:
            raise ValueError(f"functionals must have the shape (n, *{self.grid.shape}), got {tuple(functionals.shape)}")
        spread = BackprojectionPlan(self.geometry, self.grid, self.shadow).transpose
        plan = FilterPlan(self.geometry, (self.kernel,), angular_weights(self.geometry), w, self.shadow)
        h = [plan.transpose(t[None]) for t in spread(functionals.to(ray_covariance.dtype))]
        out = np.empty((len(h), len(h), 3))
        for i, a in enumerate(h):
            for j, b in enumerate(h[: i + 1]):
                # Summed row by row in float64: millions of terms of one sign would lose digits in float32.
                terms = (a * b * ray_covariance).sum(-1, dtype=torch.float64).sum((-1, -2))
                out[i, j] = out[j, i] = terms.numpy()
        return out
