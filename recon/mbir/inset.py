"""Scans of an inset, for MBIR: the FFT model of their data term, on the voxels that the network
knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from recon.data_term import Quadratic
from recon.least_squares.inset_problem import InsetProblem
from recon.mbir.mbir import Mbir, average_onto, working_grid
from recon.result import BEYOND_TEST, RESIDUAL_TEST, Result, tested
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scan_memory import once
from torchpcct.typing import JsonObject

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
        noise_map: whether reports hold ``noise_sd_hu``.

    Raises:
        ValueError: see :class:`recon.least_squares.inset_problem.InsetProblem`; a grid that is no
            inset; a scanner whose cells have another size than the network's voxels by far; a
            problem that was made for another grid.
    """

    def __init__(
        self,
        scan: Scan,
        grid: VolumeGrid,
        network: Mbir,
        problem: InsetProblem | None = None,
        noise_map: bool = False,
    ) -> None:
        _check_cells(scan, network.voxel_mm)
        self.network, self.noise_map = network, noise_map
        self._asked, self._work = grid, working_grid(grid, network.voxel_mm)
        self.problem = problem or once(
            scan, "inset", lambda: InsetProblem(scan, self._work), self._work
        )
        if self.problem.grid != self._work:
            raise ValueError(
                f"the problem was made for another grid: make it on {self._work} "
                "(recon.mbir.working_grid)"
            )

    def solve(self, scans: Sequence[Scan]) -> list[Result]:
        """Volumes in HU on the grid that was asked for."""
        network, problem = self.network, self.problem
        given = [problem.given(s) for s in scans]
        joined = Quadratic.joined([term for _, term in given])
        term = replace(joined, operator=problem.gram)
        with torch.no_grad():
            solved = network.solve(term)
        found = []
        for k, (scan, (y, _), (volume, report, before, _)) in enumerate(
            zip(scans, given, solved, strict=True)
        ):
            report["voxel_mm"] = self._work.spacing[-1]
            peak = float(volume.max())
            warnings = [
                *before,
                *network.check(report["noise_scale_hu"], peak, scan.unit, problem.mu_ref),
                *self._missing(report["missing_body"]),
            ]
            for texts in tested(BEYOND_TEST, warnings, problem.beyond, scan):
                warnings += texts
            tests = []
            if not scan.noise_free:
                report["notes"] = network.notes(report["noise_scale_hu"][0])
                tests = tested(RESIDUAL_TEST, warnings, problem.residual_test, scan, volume, y)
            if network.known is not None and report[network.known.name]["used"]:
                with torch.no_grad():
                    plain = network.with_known(None)(term.part([k]))[0]
                report["vessel_difference_hu"] = self._onto_grid(volume - plain)
            if self.noise_map:
                report["noise_sd_hu"] = self._onto_grid(network.noise_map(term.part([k])))
            found.append(Result(self._onto_grid(volume), report, warnings, tests))
        return found

    def _missing(self, body: JsonObject | None) -> list[str]:
        """What the data hold and the volume does not, where that is no noise."""
        if body is None:
            return []
        z, y, x = (axis[at] for axis, at in zip(self._work.axes, body["voxel"], strict=True))
        return [
            f"the data hold more than the volume shows: at z, y, x = {z:.1f}, {y:.1f}, {x:.1f} mm "
            f"a body of about {body['diameter_mm']:.1f} mm should be "
            f"{'brighter' if body['contrast_hu'] > 0 else 'darker'} "
            f"({body['deviations']:.1f} standard deviations of noise); the prior has lost it, or "
            "part of it, or exaggerates what is "
            f"{'darker' if body['contrast_hu'] > 0 else 'brighter'} there: "
            'look there in "fbp" or "pwls"'
        ]

    def _onto_grid(self, hu: Tensor) -> Tensor:
        """A volume of the grid that is worked on, on the one that was asked for."""
        return hu if self._work is self._asked else average_onto(hu, self._work, self._asked)


def _check_cells(scan: Scan, voxel_mm: float) -> None:
    """Refuse a scanner, or a unit of length, on which the network's voxels mean nothing
    (ValueError)."""
    cell = scan.geometry.cell
    if not 1.0 / FARTHEST_CELL <= cell / voxel_mm <= FARTHEST_CELL:
        raise ValueError(
            f"MBIR of an inset works on voxels of {voxel_mm:g} mm, what its network was trained "
            "for, and the detector "
            f'cells of this scan have {cell:.3g} mm at the axis: use method="pwls", or check that '
            "lengths are in mm"
        )
