"""FBP of a small inset from a scan: filter once, backproject onto any number of grids.

A windowed scan is split by linearity: its exterior, the same in every view and noise free, is
filtered once; the difference of each realisation to the exterior is zero outside the window and is
filtered from the window alone. The sum equals the FBP of the whole rows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from recon.analytic.any_orbit import ideal_circle
from recon.analytic.coverage import check_rows
from recon.analytic.fbp import FbpPlan, fbp
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import ConeBeam, Geometry, VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scene.motion import SinusoidalMotion
from torchpcct.switches import undisturbed
from torchpcct.validate import checked, number
from torchpcct.volume import to_hu

__all__ = ["InsetFbp", "static_fbp", "view_motion"]


SAME_EXTERIOR = 1e-4
"""Difference of line integrals up to which two exteriors are one: rounding of float32 stays below
1e-5, and behind 24 cm of fat it is worth 0.02 HU."""


@checked
def view_motion(
    motion: SinusoidalMotion, geometry: Geometry, rotation_s: float
) -> NDArray[np.float64]:
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
    number("rotation_s", rotation_s, positive=True, unit="s")
    times = (geometry.angles - geometry.angles[0]) / (2.0 * math.pi) * rotation_s
    return np.ascontiguousarray(motion.displacement(times)[:, ::-1])


@checked
def static_fbp(lines: Tensor, geometry: ConeBeam, grid: VolumeGrid) -> Tensor:
    """FBP (standard kernel) of readings that are the same in every view (rotationally symmetric
    objects).

    Args:
        lines: ``(..., rows, columns)`` line integrals of one view.
        geometry: of the whole scan.
        grid: ``(z, y, x)`` grid in the field of view.

    Returns:
        ``(..., *grid.shape)``, unit of ``lines`` per mm.

    Raises:
        ValueError: a wrong shape, a grid outside the field of view.
    """
    plan = FbpPlan(geometry, [grid], window=footprint(geometry, grid, margin=1))
    return plan.backprojected(plan.filtered_static(lines))[0]


@checked
def require_inside(inner: DetectorWindow, window: DetectorWindow) -> None:
    """Refuse a grid whose footprint ``inner`` the scan's window does not hold (ValueError)."""
    if not window.holds(inner):
        raise ValueError(
            "the grid reaches beyond the region that this scan was acquired for: acquire it with "
            "a larger region"
        )


def require_same_exterior(scan: Scan, lines: Tensor) -> None:
    """Refuse a scan whose exterior is not that of ``lines``, its line integrals ``(rows,
    columns)`` (ValueError)."""
    own = scan.exterior_line_integrals()
    if own.shape != lines.shape or not float((own - lines.to(own)).abs().max()) <= SAME_EXTERIOR:
        raise ValueError(
            "this scan has another exterior (or water correction) than the scan that this was "
            "made for: reconstruct scans of different objects or scanners one by one"
        )


class InsetFbp:
    """FBP of one or several grids from scans that share geometry, window and exterior.

    A counting-mode scan is reconstructed in HU: call the object with it. A stack of parallel or
    fan-beam slices needs 3-D grids with as many voxels along z. Rows that end inside the object are
    continued by water (:func:`recon.analytic.coverage.consistency_warnings` says so). Channels of
    line integrals (energy bins, basis materials) on the scan's window go to :meth:`images`.

    The split of the readings also compensates motion: the exterior stands still while the inset
    moves, so the exterior is backprojected at rest, the difference with the grid displaced in every
    view, and the sum shows the inset at rest. Backprojecting whole readings with the displacement
    would move the patient's body with the vessel. The difference of the logarithms is linear in the
    inset up to beam hardening (the inset is seen through the same fat everywhere) and in the
    exterior up to the fat that the inset displaces, which moves with it as part of the difference.

    Attributes:
        circle: the geometry that is filtered: that of the scan, or the ideal circle next to one
            given view by view.
        plan, moving: of a windowed scan, the way of what stands still and of what moves.

    Args:
        scan: any scan of the family; its noise does not matter.
        grids: ``(z, y, x)`` grids inside the field of view.
        kernels: reconstruction kernels.
        exterior: line integrals of every cell outside the window, the same in all views:
            ``(channels, rows, columns)`` for channels; None: ``(rows, columns)`` of the
            counting-mode scan.
        motion: displacement of the inset in every view, ``(views, 3)`` z, y, x mm
            (:func:`view_motion`); None: at rest.

    Raises:
        ValueError: a spectral scan without ``exterior``; a grid outside the field of view or the
            scan's window; an unknown kernel; an exterior of a wrong shape, or motion, in a scan
            that was acquired without ``region`` (its exterior is not known).
    """

    @checked
    def __init__(
        self,
        scan: Scan,
        grids: Sequence[VolumeGrid],
        kernels: Sequence[str],
        *,
        exterior: Tensor | None = None,
        motion: object = None,
    ) -> None:
        if exterior is None and scan.counts.ndim != 3 and scan.geometry.has_rows:
            raise ValueError(
                "FBP in HU needs a counting-mode scan; decompose the energy bins, or sum them "
                "with weights, before: scan.weighted(bin_weights(scanner, …))"
            )
        self.geometry, self.window, self.linearisation = (
            scan.geometry,
            scan.window,
            scan.linearisation,
        )
        self.grids, self.kernels = tuple(grids), tuple(kernels)
        if scan.window is None and motion is not None:
            raise ValueError(
                "motion compensation needs the exterior at rest: acquire the scan with region="
            )
        if scan.window is None and exterior is not None:
            raise ValueError(
                "a scan of the whole detector has no exterior: acquire it with region="
            )
        self.motion = motion
        self.circle, path = self.geometry, motion
        if not self.geometry.on_circle:
            self.circle, path = ideal_circle(self.geometry)[:2]
        self.warnings = [
            text for grid in self.grids for text in check_rows(self.circle, grid, path)
        ]
        self._lines: Tensor | None = None
        if scan.window is None:
            self._require_slices(scan)
            self.footprint = DetectorWindow.full(self.geometry)
            return
        paths = (None,) if motion is None else (None, motion)
        windows = [
            footprint(self.geometry, grid, margin=1, motion=path)
            for grid in self.grids
            for path in paths
        ]
        self.footprint = DetectorWindow.union(windows, self.geometry.columns)
        require_inside(self.footprint, scan.window)
        self._lines = scan.exterior_line_integrals() if exterior is None else exterior
        self._of_scan = exterior is None
        cells = self.geometry.shape[1:]
        if tuple(self._lines.shape[-2:]) != cells:
            raise ValueError(
                f"exterior must have the shape (channels, {cells[0]}, {cells[1]}), got "
                f"{tuple(self._lines.shape)}"
            )
        self.plan = FbpPlan(self.geometry, self.grids, self.kernels, window=self.footprint)
        self.moving = (
            self.plan
            if motion is None
            else FbpPlan(
                self.geometry, self.grids, self.kernels, motion=motion, window=self.footprint
            )
        )
        # (kernels, [channels,] views, rows, columns) on the grids' footprint.
        self._exterior = self.plan.filtered_static(self._lines)

    def _require_slices(self, scan: Scan) -> None:
        if self.geometry.has_rows:
            return
        slices = tuple(scan.counts.shape[:-2])
        held = f"{slices[0]} slices" if slices else "one slice (a 2-D scan)"
        for grid in self.grids:
            if tuple(grid.shape[:-2]) != slices:
                raise ValueError(
                    f"this scan of {held} needs a grid of shape {(*slices, 'y', 'x')}, "
                    f"got {grid.shape}"
                )

    @cached_property
    def _rest(self) -> list[Tensor]:
        """The exterior on every grid, per mm."""
        return self.plan.backprojected(self._exterior)

    @undisturbed
    def images(self, lines: Tensor, outside: float | None = None) -> list[Tensor]:
        """Images of line integrals on the window.

        Args:
            lines: ``(..., [channels,] views, rows, columns)`` on the scan's window (whole detector:
                without one), e.g. :attr:`torchpcct.spectral.Decomposition.line_integrals` in mm.
            outside: of :func:`recon.analytic.fbp.fbp`, for scans without a window.

        Returns:
            ``(kernels, ..., [channels,] *grid.shape)`` for every grid: unit of ``lines`` per mm
            (basis coefficients: dimensionless).

        Raises:
            ValueError, TypeError: a wrong shape or dtype.
        """
        if self.window is None or self._lines is None:
            grids = self.grids if self.geometry.has_rows else [grid.slice for grid in self.grids]
            return [
                fbp(lines, self.geometry, grid, self.kernels, outside=outside) for grid in grids
            ]
        channels = tuple(self._lines.shape[:-2])
        if lines.ndim < 3 or tuple(lines.shape[lines.ndim - 3 - len(channels) : -3]) != channels:
            raise ValueError(
                f"lines must have the channels {channels} before the views, got "
                f"{tuple(lines.shape)}"
            )
        difference = self.window.less(lines, self._lines.to(lines.dtype))
        filtered = self.plan.filtered(difference, held=self.window)
        if self.moving is self.plan:
            filtered = filtered + self._over_batch(self._exterior.to(lines.dtype), filtered)
            return self.plan.backprojected(filtered)
        moving = self.moving.backprojected(filtered)
        return [self._over_batch(rest, m) + m for rest, m in zip(self._rest, moving, strict=True)]

    @staticmethod
    def _over_batch(exterior: Tensor, like: Tensor) -> Tensor:
        """``(kernels, *rest)`` with axes of length 1 where ``like`` has its batch, after the
        kernels."""
        return exterior.reshape(
            len(exterior), *[1] * (like.ndim - exterior.ndim), *exterior.shape[1:]
        )

    @undisturbed
    def __call__(self, scan: Scan) -> list[Tensor]:
        """Volumes in HU, one ``(kernels, *grid.shape)`` float32 tensor per grid."""
        if scan.geometry != self.geometry:
            raise ValueError(
                "this scan has another geometry than the one that InsetFbp was made for"
            )
        if scan.window != self.window:
            raise ValueError("this scan has another window than the one that InsetFbp was made for")
        if self._lines is not None and self._of_scan:
            require_same_exterior(scan, self._lines)
        water = self.linearisation.mu_ref
        return [to_hu(v, water) for v in self.images(scan.line_integrals(), water)]
