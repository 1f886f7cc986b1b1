"""Model-based reconstruction of a small inset: crop to its shadow, take the background off, solve PWLS, give HU."""

from __future__ import annotations

import copy
import logging
import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from recon.fbp.coverage import check_rows
from recon.fbp.inset import require_inside, require_same_surround, static_fbp
from recon.gram.gram import Gram
from recon.pwls.field_model import FieldModel
from recon.pwls.pwls import data_model, pwls
from recon.pwls.qggmrf import QGGMRF
from recon.pwls.surround import UnknownSurround, expected_counts
from torchpcct.detector_window import DetectorWindow, shadow
from torchpcct.geometry import VolumeGrid
from torchpcct.projector import Projector
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.volume import Volume, to_hu

__all__ = ["DEFAULT_PRIOR", "InsetProblem", "Statistic", "reconstruct_pwls"]

if TYPE_CHECKING:
    from torchpcct.metrics.residual_test import ResidualTest

_LOG = logging.getLogger(__name__)

DEFAULT_PRIOR = QGGMRF(strength=0.3, threshold=300.0)
"""Noise-normalised q-GGMRF, chosen for about the resolution of FBP's soft kernel: the curvatures of data and prior
are equal at 0.75 line pairs per mm, edges steeper than 300 HU/mm (lumen, fat) pass. A stronger prior lowers the noise
of ROI means further, but shrinks the contrast of a millimetre-sized core: look at means and slope, not at CNR alone."""

NOISE_GRADIENT = 1.65
"""Least threshold of the default prior in units of ``(λ mm³)^(−1/2)``, the gradient scale of the noise. 300 HU/mm is so
much for the paper's scan at 0.35 s; at a hundredth of the dose it let single voxels of noise pass as edges, and the
noise of the image grew twice as fast as that of the data."""


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
        scan: a counting-mode scan of the family; its noise does not matter. A scan of the whole detector without a
            known surround serves too: what lies around the grid is then found from its own readings, scan by scan
            (:mod:`recon.pwls.surround`), unless the grid holds the whole field of view.
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
        model: of AᵀWA at 1 s, :func:`recon.pwls.pwls.data_model`.

    Raises:
        ValueError: a grid outside the field of view or the scan's region; a spectral or energy-integrating scan.
    """

    def __init__(self, scan: Scan, grid: VolumeGrid, nodes: int = 5, *, motion: Any = None) -> None:
        if scan.counts.ndim != 3:
            raise ValueError("PWLS in HU needs a counting-mode scan; decompose or sum the energy bins before")
        if not scan.counting:
            raise ValueError("PWLS and MBIR weigh readings as photon counts; use fbp for an energy-integrating scan")
        self.grid, self.geometry = grid, scan.geometry
        self.outer = scan.window or DetectorWindow.full(scan.geometry)
        check_rows(scan.geometry, grid, motion)
        self.mu_ref = scan.linearisation.mu_ref
        self._nodes = nodes
        self._around: UnknownSurround | None = None
        self._background: Tensor | None = None
        self.model: Gram | FieldModel
        exposure = scan.exposure_s or NOISE_FREE_EXPOSURE_S
        if scan.surround is None:
            self._start_unknown(scan, exposure, motion)
            return
        require_inside(shadow(scan.geometry, grid, margin=1), self.outer)
        self._background = scan.surround_line_integrals()
        # The background's own value inside the inset, from the same data by FBP.
        self.level = float(static_fbp(self._background, scan.geometry, grid).mean())
        polychromatic = scan.air.log() - scan.surround.log()
        slope = scan.linearisation.slope(polychromatic)
        # Per second of exposure: the Gram of one exposure serves all by a factor.
        self._cell_weights = scan.surround / slope.square() / exposure
        self._place(motion)

    def _start_unknown(self, scan: Scan, exposure: float, motion: Any) -> None:
        """Weights from the smoothed readings themselves; what surrounds the inset is found scan by scan."""
        if motion is not None:
            raise ValueError("motion compensation needs the surround at rest: acquire the scan with region=")
        geometry, grid = self.geometry, self.grid
        radius = geometry.fov_radius
        edges = zip(grid.extent[1:], grid.center[1:], strict=True)
        whole = all(extent / 2 - abs(center) >= radius / math.sqrt(2) for extent, center in edges)
        self.window = self.outer if whole else shadow(geometry, grid, margin=1)
        counts = expected_counts(scan.counts).clamp_min(torch.finfo(scan.counts.dtype).tiny)
        counts = self.outer.crop(counts, self.window)
        polychromatic = self.window.take(scan.air.log()) - counts.clamp_min(0.5).log()
        slope = scan.linearisation.slope(polychromatic, self.window)
        self.weights = (counts / slope.square() / exposure).contiguous()
        self.projector = Projector(geometry, grid, None if whole else self.window)
        self.model = data_model(self.projector, self.weights, nodes=self._nodes)
        self.level = 0.0
        if not whole:
            self._around = UnknownSurround(geometry, grid, self.window, self.projector)
            self.level = self._around.level(scan.line_integrals())

    def _place(self, motion: Any) -> None:
        geometry, grid = self.geometry, self.grid
        self.window = shadow(geometry, grid, margin=1, motion=motion)
        self.weights = self.window.take(self._cell_weights).contiguous()
        self.projector = Projector(geometry, grid, self.window, motion)
        if motion is None:
            self.model = Gram(self.projector, self.weights, nodes=self._nodes)
            return
        # A displaced grid sees its voxels as the grid at rest does, a magnification of 0.3 % apart, but through the
        # weights of where it is.
        still = shadow(geometry, grid, margin=1)
        first = np.clip(self.window.first_column, 0, geometry.columns - still.columns)
        along = DetectorWindow(first, still.columns, still.first_row, still.rows)
        weights = along.take(self._cell_weights).contiguous()
        self.model = Gram(Projector(geometry, grid, still), weights, nodes=self._nodes)

    @property
    def background(self) -> Tensor:
        """Line integrals of the known surround, ``(rows, columns)``.

        Raises:
            ValueError: nobody knows it.
        """
        if self._background is None:
            raise ValueError("the surround of this scan is not known: acquire it with region=")
        return self._background

    @property
    def gram(self) -> Gram:
        """The FFT model of AᵀWA at 1 s.

        Raises:
            ValueError: the grid is no inset, so there is none: PWLS alone can do without.
        """
        if not isinstance(self.model, Gram):
            raise ValueError(
                "the grid takes more than half of the detector's columns, too much for the FFT model of a small inset: "
                'use method="pwls", or a smaller grid'
            )
        return self.model

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
        if (scan.window or DetectorWindow.full(scan.geometry)) != self.outer or scan.geometry != self.geometry:
            raise ValueError("this scan has another geometry or window than the one the problem was made for")
        lines = scan.line_integrals()
        if self._around is not None:
            return self._around.take_off(lines, self.level)
        kept = self.outer.crop(lines, self.window)
        if self._background is None:
            return kept
        require_same_surround(scan, self._background)
        return kept - self.window.take(self._background)

    def statistic(self, scan: Scan) -> Statistic:
        """What the solvers need of a scan, with the weights of its exposure (noise free: of 1 s)."""
        y = self.data(scan)
        weighted = self.weights * (scan.exposure_s or NOISE_FREE_EXPOSURE_S) * y
        energy = float((weighted * y).sum((-1, -2), dtype=torch.float64).sum())
        return Statistic(self.projector.T(weighted), energy, y.numel())

    def residual_test(self, scan: Scan, volume: Tensor) -> ResidualTest:
        """Whether a volume ``(z, y, x)`` in HU explains a noisy scan, by one projection of it.

        The variances are those of the counts that the volume itself predicts. Raises ``ValueError`` for a noise-free
        scan, which no statistic describes.
        """
        from torchpcct.metrics.residual_test import residual_test  # loads scipy.stats

        if scan.noise_free:
            raise ValueError("the residual of a noise-free scan is not noise: test a noisy one")
        x = (volume / 1000.0 + 1.0) * self.mu_ref - self.level
        fitted = self.projector(x.to(torch.float32))
        weights = self.weights * self.exposure([scan]) * torch.exp(-fitted)
        return residual_test(self.data(scan) - fitted, weights, fitted, unknowns=self.grid.voxels)

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
            hu=self.mu_ref / 1000.0, gram=self.model.scaled(exposure), **options,
        )  # fmt: skip
        return to_hu(result.x + self.level, self.mu_ref), dict(result.report)


def _tested(problem: InsetProblem, scan: Scan, volume: Volume) -> Volume:
    """The volume with what its residual says; findings are logged as warnings, too."""
    found = problem.residual_test(scan, volume.data)
    for text in found.findings:
        _LOG.warning("%s", text)
    tested = {
        "chi2": found.chi2,
        "residual_p": dict(found.p_values),
        "warnings": [*volume.report["warnings"], *found.findings],
    }
    return replace(volume, report={**volume.report, **tested})


def _default_prior(problem: InsetProblem, exposure: float) -> tuple[QGGMRF, list[str]]:
    """:data:`DEFAULT_PRIOR`, its threshold raised where the noise is larger, and what is to be said of that."""
    unit = DEFAULT_PRIOR.bind(
        problem.model.information(problem.mu_ref / 1000.0) * exposure, problem.grid.spacing, problem.mu_ref / 1000.0
    )
    least = NOISE_GRADIENT / math.sqrt(unit.lam)
    if least <= DEFAULT_PRIOR.threshold:
        return DEFAULT_PRIOR, []
    return replace(DEFAULT_PRIOR, threshold=least), [
        f"the noise is so high that edges below {least:.0f} HU/mm are smoothed as noise (usually "
        f"{DEFAULT_PRIOR.threshold:.0f} HU/mm): raise the exposure, or pass prior= to choose"
    ]


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
        prior: None: :data:`DEFAULT_PRIOR`, whose threshold is raised for scans of few photons, with a warning.
        problem: kept from an earlier call with the same scan and grid; None: made here.
        batch: volumes solved at a time; they iterate until the slowest has converged.
        tolerance: stop within so many HU (root mean square) of the exact minimum.
        options: ``max_exact``, ``callback`` of :func:`recon.pwls.pwls.pwls`.

    Returns:
        Volumes in HU with the solver's report; of noisy scans also ``chi2`` (weighted squared residual per reading),
        ``residual_p`` and ``warnings`` of :func:`torchpcct.metrics.residual_test.residual_test`: a volume that does not
        explain its data (wrong centre, drifting gain, metal or a body beyond the grid) is not given out without a word.
        A volume whose iteration did not reach ``tolerance`` says so in ``warnings``, too, and a :class:`RuntimeWarning`
        is given.

    Raises:
        ValueError, TypeError: see :class:`InsetProblem` and :func:`recon.pwls.pwls.pwls`.
    """
    start = time.perf_counter()
    problem = problem or InsetProblem(scans[0], grid)
    noisy: list[str] = []
    if prior is None:
        prior, noisy = _default_prior(problem, problem.exposure(scans))
    for text in noisy:
        _LOG.warning("%s", text)
    volumes: list[Volume] = []
    for i in range(0, len(scans), batch):
        data, report = problem.solve(scans[i : i + batch], prior, tolerance=tolerance, **options)
        unfinished = [] if report["converged"] else [_unfinished(report)]
        for text in unfinished:
            warnings.warn(text, RuntimeWarning, stacklevel=2)
        report["seconds"] = round((time.perf_counter() - start) / len(data), 3)
        for scan, values in zip(scans[i : i + batch], data, strict=True):
            volume = Volume(values.to(torch.float32), grid, {**report, "warnings": [*noisy, *unfinished]})
            volumes.append(volume if scan.noise_free else _tested(problem, scan, volume))
        start = time.perf_counter()
        if progress is not None:
            progress(min(i + batch, len(scans)) / len(scans))
    return volumes


def _unfinished(report: Mapping[str, Any]) -> str:
    return (
        f"PWLS stopped {report['rmsd_hu'][-1]:.3g} HU from the minimum after {report['exact_pairs']} projection pairs "
        f"(tolerance {report['tolerance_hu']:g} HU): raise max_exact, or strengthen the prior"
    )
