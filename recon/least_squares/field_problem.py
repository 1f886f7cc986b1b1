"""A scan of any scanner and the whole field that its rays cross: data, weights, grid, PWLS.

Everything that the rays meet must lie in the grid. If readings that miss the grid see something,
the problem is solved on a larger one (``work``), and the part that was asked for is cut out.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from recon.analytic.coverage import check_rows
from recon.analytic.fbp import fbp
from recon.least_squares.pwls import PwlsOptions, pwls
from recon.least_squares.qggmrf import DEFAULT_PRIOR, QGGMRF
from recon.result import RESIDUAL_TEST, Result, tested
from torchpcct.devices import require_device
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid
from torchpcct.projector import Projector
from torchpcct.scan import Scan
from torchpcct.switches import undisturbed
from torchpcct.vector_geometry import VectorGeometry
from torchpcct.volume import in_words, to_hu

if TYPE_CHECKING:
    from torchpcct.geometry import Geometry
    from torchpcct.metrics.residual_test import ResidualTest
    from torchpcct.typing import JsonObject

__all__ = ["FieldProblem"]

REFERENCE_VOXEL_MM = 0.25
"""Voxel that the default prior was chosen on, mm."""
UNDETERMINED_HU = 10.0
"""Distance from the minimum, beyond the field of view, from which it is named."""
PATCH = 8
"""Cells each way of a patch of readings beside the grid, whose mean tells whether they see
something."""
SEES_SOMETHING = (0.01, 0.03)
"""A patch sees something above this line integral (half a millimetre of water) and this share of
the mean of the readings that meet the grid."""


def field_prior(voxel_mm: float, dimensions: int = 3) -> QGGMRF:
    """The default prior of a whole field: the curvatures of data and prior are equal at 0.19 line
    pairs per voxel.

    A picture of an object twice as large on voxels twice as large looks the same, from micro-CT to
    a clinical scanner. At 0.25 mm it is :data:`recon.least_squares.qggmrf.DEFAULT_PRIOR`, whose
    threshold follows the noise.

    Args:
        voxel_mm: in-plane voxel size.
        dimensions: of the volume.
    """
    return DEFAULT_PRIOR.stretched(voxel_mm / REFERENCE_VOXEL_MM, dimensions)


class FieldProblem:
    """What scans of one geometry share on one grid.

    Args:
        scan: without a known exterior; counting, or energy integrating with ``quantum``. Its own
            readings, smoothed, give the weights (:meth:`torchpcct.Scan.weights`): dead readings
            weigh nothing.
        grid: ``(z, y, x)``; of a parallel or fan beam ``(y, x)`` or ``(slices, y, x)``.

    Attributes:
        work: the grid that is solved for, 2-D for parallel and fan beams; it holds ``grid``.
        projector: of ``work``.

    Raises:
        ValueError: a spectral scan, a grid that does not fit the scan.
    """

    @undisturbed
    def __init__(self, scan: Scan, grid: VolumeGrid) -> None:
        geometry = scan.geometry
        self.plane = len(geometry.shape) == 2
        if not self.plane and scan.counts.ndim != 3:
            raise ValueError(
                "PWLS in HU needs a counting-mode scan; decompose the energy bins, or sum them "
                "with weights, before: scan.weighted(bin_weights(scanner, …))"
            )
        if self.plane and tuple(grid.shape[:-2]) != tuple(scan.counts.shape[:-2]):
            wanted = (*scan.counts.shape[:-2], "y", "x")
            raise ValueError(
                f"this scan needs a grid of the shape {wanted} (slices first), got {grid.shape}"
            )
        self.warnings = check_rows(geometry, grid)
        self.grid, self.geometry, self.mu_ref = grid, geometry, scan.linearisation.mu_ref
        self.unit, self.device = scan.unit, scan.device
        self._asked = grid.slice if self.plane else grid
        self.work = self._asked
        self.projector = Projector(geometry, self.work)
        lines = scan.line_integrals()
        if self._misses(lines, scan.dead):
            self.work = larger_grid(self._asked, geometry)
            self.projector = Projector(geometry, self.work)

    def _misses(self, lines: Tensor, dead: Tensor | None) -> bool:
        """Whether readings that do not meet the grid see something."""
        met = self.projector(lines.new_ones(self.projector.domain_shape)) > 0
        known = torch.ones_like(lines, dtype=torch.bool) if dead is None else ~dead
        if not bool((known & met).any()):
            return False
        level = max(SEES_SOMETHING[0], SEES_SOMETHING[1] * float(lines[known & met].mean()))
        outside = (known & ~met).to(lines)
        # Means over patches: one that lies beside the body is enough, noise is not.
        size = [min(PATCH, n) for n in lines.shape[-2:]]
        seen, count = (
            F.avg_pool2d(v.reshape(-1, 1, *lines.shape[-2:]), size, size)
            for v in (lines * outside, outside)
        )
        return bool((seen > level * count).logical_and_(count >= 0.25).any())

    def slices(self, scan: Scan) -> list[tuple[Tensor, Tensor]]:
        """Line integrals and weights, ``projector.range_shape``, of each slice; of a cone beam one.

        Raises:
            ValueError: a scan of another geometry.
        """
        if scan.geometry != self.geometry:
            raise ValueError("this scan has another geometry than the one the problem was made for")
        require_device(scan.device, self.device)
        y, w = scan.line_integrals(), scan.weights()
        n = len(self.geometry.shape)
        pairs = zip(y.reshape(-1, *y.shape[-n:]), w.reshape(-1, *w.shape[-n:]), strict=True)
        return [(a, b.contiguous()) for a, b in pairs]

    def start(self, lines: Tensor) -> Tensor | None:
        """FBP on ``work`` as the first volume: low frequencies are right, and PWLS needs half of
        the projections.

        None where FBP refuses the geometry (views that do not suffice).
        """
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                found = fbp(lines, self.geometry, self.work, "soft", outside=self.mu_ref)
        except ValueError:
            return None
        return torch.nan_to_num(found, nan=0.0, posinf=0.0, neginf=0.0).clamp_min(0.0)

    def cut(self, volume: Tensor) -> Tensor:
        """The part of ``(..., *work.shape)`` that was asked for."""
        for axis, (whole, part) in enumerate(zip(self.work.axes, self._asked.axes, strict=True)):
            first = round((part[0] - whole[0]) / self.work.spacing[axis])
            volume = volume.narrow(axis - self.work.ndim, first, len(part))
        return volume

    def hu(self, volumes: Sequence[Tensor]) -> Tensor:
        """HU on ``grid`` of the volumes in mm⁻¹ of all slices."""
        parts = torch.stack([self.cut(v) for v in volumes])
        return to_hu(parts.reshape(self.grid.shape), self.mu_ref)

    @property
    def prior(self) -> QGGMRF:
        """The one that suits the voxels, :func:`field_prior`."""
        return field_prior(self.grid.spacing[-1], self.work.ndim)

    def solutions(
        self,
        scans: Sequence[Scan],
        prior: QGGMRF,
        options: PwlsOptions,
        advance: Callable[[float], None],
    ) -> Iterator[Result]:
        """PWLS of every scan, slice by slice, from FBP as the first volume; ``advance`` gets
        the finished share."""
        hu = self.mu_ref / 1000.0
        for i, scan in enumerate(scans):
            slices = self.slices(scan)
            results: list[Result] = []
            tests: list[ResidualTest] = []
            found: list[str] = []
            for k, (y, w) in enumerate(slices):
                results.append(
                    pwls(self.projector, y, w, prior, mu_per_hu=hu, start=self.start(y), **options)
                )
                if not scan.noise_free:
                    tests += tested(
                        RESIDUAL_TEST, found, self.residual_test, y, w, results[-1].volume
                    )
                advance((i + (k + 1) / len(slices)) / len(scans))
            report = {**joined([dict(r.report) for r in results]), "work_grid": self.work.shape}
            if report["undetermined_rmsd_hu"] > UNDETERMINED_HU:
                found.append(
                    f"{100 * report['undetermined']:.0f} % of the voxels are missed by some views "
                    "(corners beyond the field of view, outer slices): there the volume is "
                    f"{in_words(report['undetermined_rmsd_hu'], self.unit, self.mu_ref)} from the "
                    "minimum"
                )
            yield Result(self.hu([r.volume for r in results]), report, found, tests)

    def residual_test(self, y: Tensor, w: Tensor, x: Tensor) -> ResidualTest:
        """Whether a volume ``work.shape`` in mm⁻¹ explains the readings of one slice; the tests
        themselves are computed on the CPU."""
        from torchpcct.metrics.residual_test import residual_test  # loads scipy.stats

        fitted = self.projector(x.to(y))
        rows = (lambda v: v.unsqueeze(-2)) if self.plane else (lambda v: v)
        tested = [rows(v).cpu() for v in (y - fitted, w, fitted)]
        return residual_test(*tested, unknowns=self.work.voxels)


def larger_grid(grid: VolumeGrid, geometry: Geometry) -> VolumeGrid:
    """The grid with as many voxels more on each side as it takes to hold all that the rays cross.

    Args:
        grid: ``(y, x)`` or ``(z, y, x)``.
        geometry: of the scan.

    Raises:
        TypeError: an unknown geometry.
    """
    bottom = top = 0.0
    if isinstance(geometry, ParallelBeam):
        edge = float(np.abs(geometry.column_positions).max()) + geometry.pitch / 2
    elif isinstance(geometry, (FanBeam, ConeBeam)):
        edge = geometry.sod * math.sin(min(float(np.abs(geometry.fan_angles).max()), math.pi / 2))
        if geometry.has_rows:
            rows = float(np.abs(geometry.row_positions).max()) + geometry.row_pitch / 2
            top = rows * (geometry.sod + edge) / geometry.sdd
            bottom = -top
    elif isinstance(geometry, VectorGeometry):
        distance, height, climb = geometry.border_rays()
        edge = float(distance.max())
        rise = np.abs(climb) * np.sqrt(edge**2 - distance**2)
        bottom, top = float((height - rise).min()), float((height + rise).max())
    else:
        raise TypeError(f"unknown geometry {type(geometry).__name__}")
    reach = [(bottom, top), (-edge, edge), (-edge, edge)][-grid.ndim :]
    shape, center = [], []
    for n, h, c, (first, last) in zip(grid.shape, grid.spacing, grid.center, reach, strict=True):
        low, high = (max(math.ceil(r / h - n / 2 - 1e-6), 0) for r in (c - first, last - c))
        shape.append(n + low + high)
        center.append(c + (high - low) * h / 2)
    return VolumeGrid(tuple(shape), grid.spacing, tuple(center))


def joined(reports: Sequence[JsonObject]) -> JsonObject:
    """One report of several slices: counts are added, the worst slice speaks for the rest."""
    worst = dict(
        max(reports, key=lambda r: (not r["converged"], r["rmsd_hu"][-1] if r["rmsd_hu"] else 0.0))
    )
    if len(reports) > 1:
        worst["exact_pairs"] = sum(r["exact_pairs"] for r in reports)
        worst["misfit"] = [m for r in reports for m in r["misfit"]]
        worst["slices"] = len(reports)
    return worst
