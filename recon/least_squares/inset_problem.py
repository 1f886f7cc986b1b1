"""Model-based reconstruction of a small inset: crop to its footprint, take the background off,
solve PWLS, give HU."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Unpack

import numpy as np
import torch
from torch import Tensor

from recon.analytic.coverage import check_rows
from recon.analytic.inset import require_inside, require_same_exterior, static_fbp
from recon.data_term import Projected, Quadratic
from recon.gram.gram import Gram
from recon.least_squares.beyond_grid import beyond_grid
from recon.least_squares.exterior import UnknownExterior, length_unit
from recon.least_squares.field_model import FieldModel
from recon.least_squares.memory import require_memory
from recon.least_squares.pwls import MinimiseOptions, PwlsOptions, data_model, minimise
from recon.least_squares.qggmrf import DEFAULT_PRIOR, QGGMRF
from recon.result import BEYOND_TEST, RESIDUAL_TEST, Result, tested
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.devices import require_device
from torchpcct.geometry import ConeBeam, VolumeGrid
from torchpcct.projector import Projector
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.scan_memory import once
from torchpcct.switches import undisturbed
from torchpcct.vector_geometry import check_motion

__all__ = ["InsetProblem"]

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from torchpcct.metrics.residual_test import ResidualTest
    from torchpcct.typing import JsonObject


def is_whole_field(scan: Scan, grid: VolumeGrid) -> bool:
    """Whether PWLS and MBIR treat the grid as the whole field: always but for an inset of a cone
    beam."""
    geometry = scan.geometry
    if scan.exterior is not None:
        return False
    if not isinstance(geometry, ConeBeam):
        return True  # an inset of a scan given view by view is solved on all that its rays cross
    edges = zip(grid.extent[1:], grid.center[1:], strict=True)
    return all(
        extent / 2 - abs(center) >= geometry.fov_radius / math.sqrt(2) for extent, center in edges
    )


class InsetProblem:
    """What all realisations of one scan on one grid share: projector, weights, Gram, background.

    Args:
        scan: a scan of the family of one channel, counts or weighted bins; its noise does not
            matter. A scan of the whole
            detector without a known exterior serves too: what lies around the grid is then found
            from its own readings, scan by scan (:mod:`recon.least_squares.exterior`). Of a grid
            that holds the whole field of view see
            :class:`recon.least_squares.field_problem.FieldProblem`.
        grid: ``(z, y, x)`` grid that holds everything the background does not.
        nodes: of the Gram operator. Linear in position (5) is enough for solvers: what the model
            lacks, the exact pairs repair, and each step costs half of that with 9.

    The weights are the inverse variances of the line integrals expected from the BACKGROUND:
    weights from the noisy readings themselves would bias the result, and a small inset changes the
    counts behind it by a few per cent only.

    Attributes:
        motion: displacement of the inset in every view (:meth:`with_motion`), or None.
        weights: on ``window``, at 1 s, of line integrals in mm⁻¹ · mm.
        model: of AᵀWA at 1 s, :func:`recon.least_squares.pwls.data_model`.

    Raises:
        ValueError: a grid outside the field of view or the scan's region; a spectral scan, or one
            with electronic noise.
    """

    @undisturbed
    def __init__(self, scan: Scan, grid: VolumeGrid, nodes: int = 5) -> None:
        if scan.counts.ndim != 3:
            raise ValueError(
                "PWLS in HU needs a counting-mode scan; decompose the energy bins, or sum them "
                "with weights, before: scan.weighted(bin_weights(scanner, …))"
            )
        if scan.electronic_noise:
            raise ValueError(
                "PWLS and MBIR of an inset weigh readings by their quantum noise; use fbp for an "
                "energy-integrating scan with electronic noise"
            )
        self.grid, self.geometry = grid, scan.geometry
        self.outer = scan.window or DetectorWindow.full(scan.geometry)
        check_rows(scan.geometry, grid)
        self.mu_ref, self.unit = scan.linearisation.mu_ref, scan.unit
        self.device = scan.device
        self.warnings: list[str] = []
        self._nodes = nodes
        self._exterior: UnknownExterior | None = None
        self._background: Tensor | None = None
        self.model: Gram | FieldModel
        exposure = scan.exposure_s or NOISE_FREE_EXPOSURE_S
        if scan.exterior is None:
            self._start_unknown(scan, exposure)
            return
        require_inside(footprint(scan.geometry, grid, margin=1), self.outer)
        self._background = scan.exterior_line_integrals()
        # The background's own value inside the inset, from the same data by FBP.
        self.level = float(static_fbp(self._background, scan.geometry, grid).mean())
        # Per second of exposure: the Gram of one exposure serves all by a factor.
        self._cell_weights = scan.exterior_weights() / exposure
        self._place(None)

    def _start_unknown(self, scan: Scan, exposure: float) -> None:
        """Weights from the smoothed readings themselves; what surrounds the inset is found scan
        by scan."""
        if is_whole_field(scan, self.grid):
            raise ValueError(
                "the grid holds the whole field of view: use "
                "recon.least_squares.field_problem.FieldProblem"
            )
        geometry, grid = self.geometry, self.grid
        self.window = footprint(geometry, grid, margin=1)
        self.weights = self.outer.crop(scan.weights(), self.window) / exposure
        self.projector = Projector(geometry, grid, self.window)
        self.model = data_model(self.projector, self.weights, nodes=self._nodes)
        self._exterior = UnknownExterior(geometry, grid, self.window, self.projector)
        try:
            self.level = self._exterior.level(scan.line_integrals())
        except ValueError as error:
            raise ValueError(
                "the exterior of this inset is unknown and is estimated by FBP of the whole field: "
                f"{error}; or take a grid that holds the whole field of view"
            ) from error

    def _place(self, motion: ArrayLike | None) -> None:
        geometry, grid = self.geometry, self.grid
        self.motion = motion
        self.window = footprint(geometry, grid, margin=1, motion=motion)
        self.weights = self.window.take(self._cell_weights).contiguous()
        self.projector = Projector(geometry, grid, self.window, motion)
        if motion is None:
            self.model = Gram(self.projector, self.weights, nodes=self._nodes)
            return
        # A displaced grid sees its voxels as the grid at rest does, a magnification of 0.3 % apart,
        # but through the weights of where it is.
        still = footprint(geometry, grid, margin=1)
        first = np.clip(self.window.first_column, 0, geometry.columns - still.columns)
        along = DetectorWindow(first, still.columns, still.first_row, still.rows)
        weights = along.take(self._cell_weights).contiguous()
        self.model = Gram(Projector(geometry, grid, still), weights, nodes=self._nodes)

    @property
    def prior(self) -> QGGMRF:
        """The default one, :data:`recon.least_squares.qggmrf.DEFAULT_PRIOR` in the length unit of
        the scan (:func:`recon.least_squares.exterior.length_unit`): on the paper's scanner 0.75
        line pairs per mm."""
        return DEFAULT_PRIOR.stretched(length_unit(self.geometry), self.grid.ndim)

    @property
    def gram(self) -> Gram:
        """The FFT model of AᵀWA at 1 s.

        Raises:
            ValueError: the grid is no inset, so there is none: PWLS alone can do without.
        """
        if not isinstance(self.model, Gram):
            raise ValueError(
                "the grid takes more than half of the detector's columns, too much for the FFT "
                "model of a small inset: "
                'use method="pwls", or a smaller grid'
            )
        return self.model

    @undisturbed
    def with_motion(self, motion: ArrayLike | None) -> InsetProblem:
        """The same problem for an inset that moves.

        The background stands still; it is taken off before, so that only what moves is projected.
        The Gram is that of a grid at rest with the weights that the moving one meets; exact pairs
        use the moving projector.

        Args:
            motion: displacement of the inset in every view, ``(views, 3)`` z, y, x mm
                (:func:`recon.analytic.inset.view_motion`); None: at rest.

        Raises:
            ValueError: the exterior is not known.
        """
        if self._background is None:
            raise ValueError(
                "motion compensation needs the exterior at rest: acquire the scan with region="
            )
        check_rows(self.geometry, self.grid, motion)
        other = copy.copy(self)
        other._place(motion)
        return other

    @undisturbed
    def data(self, scan: Scan) -> Tensor:
        """Line integrals of a scan on the grid's footprint, background taken off, ``(views,
        rows, columns)``."""
        if (
            scan.window or DetectorWindow.full(scan.geometry)
        ) != self.outer or scan.geometry != self.geometry:
            raise ValueError(
                "this scan has another geometry or window than the one the problem was made for"
            )
        require_device(scan.device, self.device)
        if self._exterior is not None:
            return self._exterior.take_off(scan.line_integrals(), self.level)
        if self._background is None:
            return self.outer.crop(scan.line_integrals(), self.window)
        require_same_exterior(scan, self._background)
        # The logarithm is taken of the footprint alone; the interpolation of dead readings needs
        # their neighbours.
        near = scan if scan.dead is not None or scan.window is None else scan.crop(self.window)
        lines = near.line_integrals()
        if near is scan:
            lines = self.outer.crop(lines, self.window)
        return self.window.less(lines, self._background)

    def beyond(self, scan: Scan) -> list[str]:
        """Warnings of what lies beyond the grid of a scan with a known exterior
        (:mod:`recon.least_squares.beyond_grid`); of others none, since it belongs to the exterior
        that is found."""
        if self._background is None:
            return []
        background = self._background
        path = None if self.motion is None else check_motion(self.motion, scan.geometry.views, 3)
        return once(
            scan,
            "beyond",
            lambda: beyond_grid(scan, self.grid, self.window, background, path),
            self.grid,
            self.window,
        )

    @undisturbed
    def term(self, scan: Scan, data: Tensor | None = None) -> Quadratic:
        """What solvers need of a scan, with the weights of its exposure (noise free: of 1 s): a
        batch of one volume, the FFT model its operator; :meth:`exact` puts projections there.

        Args:
            scan: of the family.
            data: its :meth:`data`, where it is at hand already.
        """
        y = self.data(scan) if data is None else data
        exposure = float(scan.exposure_s or NOISE_FREE_EXPOSURE_S)
        weighted = self.weights * exposure * y
        energy = (weighted * y).sum((-1, -2), dtype=torch.float64).sum()
        found = self.term_of(self.projector.T(weighted)[None], exposure)
        return replace(found, energy=energy[None], readings=self.readings)

    @undisturbed
    def given(self, scan: Scan) -> tuple[Tensor, Quadratic]:
        """:meth:`data` and :meth:`term` of a scan, kept with it: a second method on the same
        problem needs the same. Neither may be changed."""

        def compute() -> tuple[Tensor, Quadratic]:
            data = self.data(scan)
            return data, self.term(scan, data)

        return once(scan, "term", compute, self)

    def term_of(self, b: Tensor, exposure_s: float) -> Quadratic:
        """The data term of b = AᵀW y ``(batch, z, y, x)`` that is known already, W that of the
        exposure."""
        return Quadratic(
            self.model if isinstance(self.model, Gram) else self._projected(1.0),
            b,
            b.new_full((len(b),), float(exposure_s), dtype=torch.float64),
            self.grid.spacing,
            self.mu_ref,
            self.level,
        )

    @property
    def readings(self) -> int:
        """Readings of positive weight in the inset's footprint."""
        return int((self.weights > 0).sum())

    def _projected(self, exposure_s: float) -> Projected:
        weights = self.weights * exposure_s
        return Projected(self.projector, lambda y: weights * y, self.model.scaled(exposure_s))

    def exact(self, term: Quadratic) -> Quadratic:
        """The data term with projections for its operator, for scans of one exposure.

        Raises:
            ValueError: they have several.
        """
        exposures = set(term.scale.tolist())
        if len(exposures) != 1:
            raise ValueError(
                f"the scans of one batch must have one exposure, got {sorted(exposures)} s"
            )
        (exposure,) = exposures
        scale = torch.ones(len(term.b), device=term.b.device)
        return replace(term, operator=self._projected(exposure), scale=scale)

    @undisturbed
    def residual_test(self, scan: Scan, volume: Tensor, data: Tensor | None = None) -> ResidualTest:
        """Whether a volume ``(z, y, x)`` in HU explains a noisy scan, by one projection of it.

        The variances are those of the counts that the volume itself predicts. ``data`` is
        :meth:`data` of the scan, where it is at hand already. Raises ``ValueError`` for a
        noise-free scan, which no right-hand side describes.
        """
        from torchpcct.metrics.residual_test import residual_test  # loads scipy.stats

        if scan.noise_free:
            raise ValueError("the residual of a noise-free scan is not noise: test a noisy one")
        x = (volume / 1000.0 + 1.0) * self.mu_ref - self.level
        fitted = self.projector(x.to(torch.float32))
        weights = (
            self.weights * float(scan.exposure_s or NOISE_FREE_EXPOSURE_S) * torch.exp(-fitted)
        )
        y = self.data(scan) if data is None else data
        tested = [v.cpu() for v in (y - fitted, weights, fitted)]  # its statistics are SciPy's
        return residual_test(*tested, unknowns=self.grid.voxels)

    @undisturbed
    def solve(
        self,
        term: Quadratic,
        prior: QGGMRF,
        memory: int | None = None,
        **options: Unpack[MinimiseOptions],
    ) -> tuple[Tensor, JsonObject]:
        """PWLS of data terms of one exposure: ``(batch, z, y, x)`` HU, and the solver's report.

        Args:
            term: of :meth:`term`, of one scan or several joined.
            prior, memory, options: as of :func:`recon.least_squares.pwls.pwls`.
        """
        require_memory(self.projector, len(term.b), term.b, memory)
        found = minimise(self.exact(term), prior, **options)
        return term.hu(found.volume), dict(found.report)

    def solutions(
        self,
        scans: Sequence[Scan],
        prior: QGGMRF,
        options: PwlsOptions,
        advance: Callable[[float], None],
    ) -> Iterator[Result]:
        """PWLS of all scans together; ``advance`` gets the finished share of them."""
        given = [self.given(s) for s in scans]
        term = Quadratic.joined([term for _, term in given])
        found, report = self.solve(term, prior, **options)
        for scan, (lines, _), values in zip(scans, given, found.to(torch.float32), strict=True):
            warnings: list[str] = []
            for texts in tested(BEYOND_TEST, warnings, self.beyond, scan):
                warnings += texts
            tests = (
                []
                if scan.noise_free
                else tested(RESIDUAL_TEST, warnings, self.residual_test, scan, values, lines)
            )
            yield Result(values, report, warnings, tests)
        advance(1.0)
