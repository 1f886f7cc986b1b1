"""Scans of an inset, for MBIR: the FFT model of their data term, on the voxels that the network
knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from torch import Tensor

from recon.data_term import Quadratic
from recon.least_squares.inset_problem import InsetProblem
from recon.least_squares.surround import CELL_MM, length_unit
from recon.mbir.mbir import Mbir, Reconstructed, average_onto, working_grid
from recon.result import RESIDUAL_TEST, tested
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan

if TYPE_CHECKING:
    from torchpcct.metrics.residual_test import ResidualTest  # loads scipy.stats

__all__ = ["Inset", "InsetScans"]

FARTHEST_CELL = 4.0
"""Detector cells at the axis may be so many times as large, or as small, as the network's
voxels: clinical scanners."""


class Inset:
    """Scans of one geometry on one grid of an inset.

    Args:
        scan: of the family.
        grid: of the inset.
        network: with its weights.
        problem: of the scan on :func:`recon.mbir.mbir.working_grid`; None: made here.

    Raises:
        ValueError: see :class:`recon.least_squares.inset_problem.InsetProblem`; a scanner whose
            cells have another size than the network's voxels by far; a problem that was made for
            another grid.
    """

    def __init__(
        self, scan: Scan, grid: VolumeGrid, network: Mbir, problem: InsetProblem | None = None
    ) -> None:
        _check_cells(scan, network.voxel_mm)
        self._asked, self._work = grid, working_grid(grid, network.voxel_mm)
        self.cell_mm = self._work.spacing[-1]
        self.problem = problem or InsetProblem(scan, self._work)
        if self.problem.grid != self._work:
            raise ValueError(
                f"the problem was made for another grid: make it on {self._work} "
                "(recon.mbir.working_grid)"
            )
        self.warnings: list[str] = []

    def scans(self, scans: Sequence[Scan]) -> InsetScans:
        """What is asked of some scans."""
        return InsetScans(self.problem, scans)

    def onto_grid(self, hu: Tensor) -> Tensor:
        """A volume of the grid that is worked on, on the one that was asked for."""
        return hu if self._work is self._asked else average_onto(hu, self._work, self._asked)


class InsetScans:
    """What :func:`recon.mbir.reconstruct.reconstruct_mbir` asks of scans of an inset.

    Args:
        problem: of the scans.
        scans: any of them.

    Attributes:
        term: of all of them, in mm⁻¹.

    Raises:
        ValueError: the grid is no inset: PWLS alone can do without its FFT model.
    """

    def __init__(self, problem: InsetProblem, scans: Sequence[Scan]) -> None:
        self._problem, self._scans = problem, list(scans)
        self._data = [problem.data(s) for s in scans]
        terms = [problem.term(s, y) for s, y in zip(scans, self._data, strict=True)]
        self.term = replace(Quadratic.joined(terms), operator=problem.gram)

    def solved(self, network: Mbir) -> Reconstructed:
        """Volumes in noise units."""
        return network.solved(self.term)

    def whole(self, normal: Quadratic) -> Quadratic:
        """The data term before anything was taken off that the volume shows: itself."""
        return normal

    def volumes(self, solved: Reconstructed) -> Tensor:
        """HU ``(batch, z, y, x)`` on the grid that is worked on."""
        return solved.normal.hu(solved.u)

    def noise_scale_hu(self, k: int, normal: Quadratic) -> tuple[float, float]:
        """The least and the largest of the grid: one."""
        scale = float(normal.unit_hu[k])
        return scale, scale

    def peak_hu(self, k: int, solved: Reconstructed) -> float:
        """The largest value."""
        return float(self.volumes(solved)[k].max())

    def doubts(self, network: Mbir, scales: tuple[float, float]) -> list[str]:
        """What the network was not trained for, beside :meth:`recon.mbir.mbir.Mbir.check`: insets
        it was."""
        return []

    def tests(self, k: int, solved: Reconstructed, failed: list[str]) -> list[ResidualTest]:
        """Of what is left of a scan's data."""
        volume = self.volumes(solved)[k]
        return tested(
            RESIDUAL_TEST,
            failed,
            self._problem.residual_test,
            self._scans[k],
            volume,
            self._data[k],
        )


def _check_cells(scan: Scan, voxel_mm: float) -> None:
    """Refuse a scanner, or a unit of length, on which the network's voxels mean nothing
    (ValueError)."""
    cell = length_unit(scan.geometry) * CELL_MM
    if not 1.0 / FARTHEST_CELL <= cell / voxel_mm <= FARTHEST_CELL:
        raise ValueError(
            f"MBIR of an inset works on voxels of {voxel_mm:g} mm, what its network was trained "
            "for, and the detector "
            f'cells of this scan have {cell:.3g} mm at the axis: use method="pwls", or check that '
            "lengths are in mm"
        )
