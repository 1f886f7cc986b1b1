"""Model-based reconstruction of a small inset: crop to its shadow, take the background off, solve PWLS, give HU."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.fbp.inset import require_inside, static_fbp
from recon.gram.gram import Gram
from recon.pwls.pwls import pwls
from recon.pwls.qggmrf import QGGMRF
from torchpcct.detector_window import DetectorWindow, shadow
from torchpcct.geometry import VolumeGrid
from torchpcct.projector import Projector
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.volume import Volume, to_hu

__all__ = ["DEFAULT_PRIOR", "InsetProblem", "Statistic", "reconstruct_pwls"]

DEFAULT_PRIOR = QGGMRF(strength=0.3, threshold=300.0)
"""Noise-normalised q-GGMRF, chosen for about the resolution of FBP's soft kernel: the curvatures of data and prior
are equal at 0.75 line pairs per mm, edges steeper than 300 HU/mm (lumen, fat) pass. A stronger prior lowers the noise
of ROI means further, but shrinks the contrast of a millimetre-sized core: look at means and slope, not at CNR alone."""


@dataclass(frozen=True)
class Statistic:
    """All that a scan says about an inset, given the weights W.

    Args:
        b: AᵀW y, ``grid.shape``, y with the background taken off.
        energy: yᵀW y.
        readings: number of readings in the inset's shadow.
    """

    b: Tensor
    energy: float
    readings: int


class InsetProblem:
    """What all realisations of one scan on one grid share: projector, weights, Gram, background.

    Args:
        scan: a counting-mode scan of the family; its noise does not matter.
        grid: ``(z, y, x)`` grid that holds everything the background does not.
        nodes: of the Gram operator. Linear in position (5) is enough for solvers: what the model lacks, the exact
            pairs repair, and each step costs half of that with 9.
        motion: displacement of the inset in every view, ``(views, 3)`` z, y, x mm
            (:func:`recon.fbp.inset.view_motion`); None: at rest. The background stands still; it is taken off before,
            so that only what moves is projected. The Gram is that of a grid at rest with the weights that the moving
            one meets; exact pairs use the moving projector.

    The weights are the inverse variances of the line integrals expected from the BACKGROUND: weights from the noisy
    readings themselves would bias the result, and a small inset changes the counts behind it by a few per cent only.

    Attributes:
        weights: on ``window``, at 1 s, of line integrals in mm⁻¹ · mm.

    Raises:
        ValueError: a grid outside the field of view or the scan's region; a spectral or energy-integrating scan.
    """

    def __init__(self, scan: Scan, grid: VolumeGrid, nodes: int = 5, *, motion: Any = None) -> None:
        if scan.counts.ndim != 3:
            raise ValueError("PWLS in HU needs a counting-mode scan; decompose or sum the energy bins before")
        if not scan.counting:
            raise ValueError("PWLS and MBIR weigh readings as photon counts; use fbp for an energy-integrating scan")
        if scan.surround is None or scan.window is None:
            raise ValueError("PWLS of an inset needs a scan with a known surround: acquire it with region=")
        self.grid, self.geometry, self.outer = grid, scan.geometry, scan.window
        require_inside(shadow(scan.geometry, grid, margin=1), scan.window)
        self.mu_ref = scan.linearisation.mu_ref
        self.background = scan.surround_line_integrals()
        # The background's own value inside the inset, from the same data by FBP.
        self.level = float(static_fbp(self.background, scan.geometry, grid).mean())
        polychromatic = scan.air.log() - scan.surround.log()
        slope = scan.linearisation.slope(polychromatic)
        exposure = scan.exposure_s or NOISE_FREE_EXPOSURE_S
        # Per second of exposure: the Gram of one exposure serves all by a factor.
        self._cell_weights = scan.surround / slope.square() / exposure
        self._nodes = nodes
        self._place(motion)

    def _place(self, motion: Any) -> None:
        geometry, grid = self.geometry, self.grid
        self.window = shadow(geometry, grid, margin=1, motion=motion)
        self.weights = self.window.take(self._cell_weights).contiguous()
        self.projector = Projector(geometry, grid, self.window, motion)
        if motion is None:
            self.gram = Gram(self.projector, self.weights, nodes=self._nodes)
            return
        # A displaced grid sees its voxels as the grid at rest does, a magnification of 0.3 % apart, but through the
        # weights of where it is.
        still = shadow(geometry, grid, margin=1)
        first = np.clip(self.window.first_column, 0, geometry.columns - still.columns)
        along = DetectorWindow(first, still.columns, still.first_row, still.rows)
        weights = along.take(self._cell_weights).contiguous()
        self.gram = Gram(Projector(geometry, grid, still), weights, nodes=self._nodes)

    def with_motion(self, motion: Any) -> InsetProblem:
        """The same problem for another displacement of the inset (None: at rest); the background is kept.

        Args:
            motion: as for :class:`InsetProblem`.
        """
        other = copy.copy(self)
        other._place(motion)
        return other

    def data(self, scan: Scan) -> Tensor:
        """Line integrals of a scan on the grid's shadow, background taken off, ``(views, rows, columns)``."""
        if scan.window != self.outer or scan.geometry != self.geometry:
            raise ValueError("this scan has another geometry or window than the one the problem was made for")
        return self.outer.crop(scan.line_integrals(), self.window) - self.window.take(self.background)

    def statistic(self, scan: Scan) -> Statistic:
        """What the solvers need of a scan, with the weights of its exposure (noise free: of 1 s)."""
        y = self.data(scan)
        weighted = self.weights * (scan.exposure_s or NOISE_FREE_EXPOSURE_S) * y
        energy = float((weighted * y).sum((-1, -2), dtype=torch.float64).sum())
        return Statistic(self.projector.T(weighted), energy, y.numel())

    @staticmethod
    def exposure(scans: Sequence[Scan]) -> float:
        """The one exposure of several scans, in s; 1 for noise-free ones.

        Raises:
            ValueError: they have several.
        """
        exposures = {s.exposure_s or NOISE_FREE_EXPOSURE_S for s in scans}
        if len(exposures) != 1:
            raise ValueError(f"the scans of one batch must have one exposure, got {sorted(exposures)} s")
        return float(exposures.pop())

    def solve(self, scans: Sequence[Scan], prior: QGGMRF, **options: Any) -> tuple[Tensor, dict[str, Any]]:
        """PWLS of several realisations of one exposure: ``(scans, z, y, x)`` HU, and the solver's report."""
        exposure = self.exposure(scans)
        result = pwls(
            self.projector, torch.stack([self.data(s) for s in scans]), self.weights * exposure, prior,
            hu=self.mu_ref / 1000.0, gram=self.gram.scaled(exposure), **options,
        )  # fmt: skip
        return to_hu(result.x + self.level, self.mu_ref), dict(result.report)


def reconstruct_pwls(
    scans: Sequence[Scan],
    grid: VolumeGrid,
    *,
    progress: Callable[[float], None] | None = None,
    prior: QGGMRF | None = None,
    problem: InsetProblem | None = None,
    batch: int = 1,
    tolerance: float = 1.0,
    **options: Any,
) -> list[Volume]:
    """PWLS with a q-GGMRF prior, to convergence.

    Args:
        scans: realisations of one windowed scan at one exposure.
        grid: the inset.
        progress: called with the finished fraction.
        prior: None: :data:`DEFAULT_PRIOR`.
        problem: kept from an earlier call with the same scan and grid; None: made here.
        batch: volumes solved at a time; they iterate until the slowest has converged.
        tolerance: stop within so many HU (root mean square) of the exact minimum.
        options: ``max_exact``, ``callback`` of :func:`recon.pwls.pwls.pwls`.

    Returns:
        Volumes in HU with the solver's report.

    Raises:
        ValueError, TypeError: see :class:`InsetProblem` and :func:`recon.pwls.pwls.pwls`.
    """
    start = time.perf_counter()
    problem = problem or InsetProblem(scans[0], grid)
    volumes: list[Volume] = []
    for i in range(0, len(scans), batch):
        data, report = problem.solve(scans[i : i + batch], prior or DEFAULT_PRIOR, tolerance=tolerance, **options)
        report["seconds"] = round((time.perf_counter() - start) / len(data), 3)
        volumes += [Volume(v.to(torch.float32), grid, report) for v in data]
        start = time.perf_counter()
        if progress is not None:
            progress(min(i + batch, len(scans)) / len(scans))
    return volumes
