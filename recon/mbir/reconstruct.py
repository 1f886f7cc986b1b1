"""MBIR of a scan: of an inset here, of a whole field in :mod:`recon.mbir.field`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch

from recon.least_squares.field_problem import is_whole_field
from recon.least_squares.inset_problem import InsetProblem
from recon.least_squares.surround import CELL_MM, length_unit
from recon.mbir.field import field_solutions
from recon.mbir.known import Known
from recon.mbir.mbir import Mbir, average_onto, working_grid
from recon.mbir.unrolled import low_residual
from recon.solution import RESIDUAL_TEST, Solution, tested
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan

__all__ = ["reconstruct_mbir"]


FARTHEST_CELL = 4.0
"""Detector cells at the axis may be so many times as large, or as small, as the network's
voxels: clinical scanners."""


def reconstruct_mbir(
    scans: Sequence[Scan],
    grid: VolumeGrid,
    progress: Callable[[float], None],
    *,
    network: Mbir | None = None,
    prior: Any = None,
    problem: InsetProblem | None = None,
    batch: int = 4,
    fidelity: float | None = None,
    noise_map: bool = False,
    known: Known | None = None,
) -> Iterator[list[Solution]]:
    """Unrolled MBIR with the learned prior, of an inset or of a whole field
    (:mod:`recon.mbir.field`).

    Args:
        scans: realisations of one scan.
        grid: the inset, or the field.
        progress: called with the finished fraction.
        network: with its weights; None: those of the package.
        prior: in the place of the network, which keeps the data steps: a prior, a denoiser of HU,
            or a name such as ``perona-malik`` or ``package.module:function``
            (:func:`recon.mbir.priors.prior_of`).
        problem: kept from an earlier call with the same scan and (working) grid; None: made here.
        batch: volumes at a time.
        fidelity: from 0 (quiet images for viewing) to 1 (for measuring: more of the contrast and
            more noise), see :mod:`recon.mbir.unrolled`; None: that of ``network``, which is 0.5
            unless it was loaded with another.
        noise_map: add an estimate of each voxel's standard deviation, ``report["noise_sd_hu"]``.
        known: what is known of the object and drawn before, such as a vessel
            (:mod:`recon.mbir.known`), of small insets; None: nothing, or what ``network`` knows.

    Yields:
        Volumes in HU, batch by batch. Report: ``iterations``, ``fidelity``, ``residual`` (what is
            left of the data at
        the low frequencies that are the data's own, over what there was,
        :func:`recon.mbir.unrolled.low_residual`), ``chi2`` (weighted squared residual per reading),
        ``weights_sha256`` or the name of the ``prior``, of noisy scans ``residual_p``
        (:mod:`torchpcct.metrics.residual_test`: does the volume explain its data?), ``warnings``;
        with something ``known``, under its name, whether it was drawn (``drawn``) or ``why`` not,
        and where it was, ``drawn_minus_plain_hu``, the difference from the volume without drawing,
        like the volume in HU.

    Raises:
        ValueError, TypeError: see :class:`recon.least_squares.inset_problem.InsetProblem`; an inset
            of a scanner whose cells have another size than the network's voxels by far; a problem
            that was made for another grid; a fidelity outside of 0 … 1; what is no prior, or
            returns NaN or another kind of volume; for a whole field see
            :func:`recon.mbir.field.field_solutions`.
        FileNotFoundError: the package has no weights.
    """
    if prior is not None:
        network = network.with_prior(prior) if network is not None else Mbir(prior=prior)
    network = network or Mbir.load()
    if fidelity is not None:
        network = network.with_fidelity(fidelity)
    if known is not None:
        network = network.with_known(known)
    if problem is None and is_whole_field(scans[0], grid):
        asked = ["noise_map"] * noise_map
        asked += [f"a drawn {network.known.name}"] if network.known is not None else []
        if asked:
            raise ValueError(
                f"{asked[0]} needs the FFT model of a small inset: ask for a smaller grid"
            )
        yield from field_solutions(scans, grid, network, progress)
        return
    _check_cells(scans[0], network.voxel_mm)
    work = working_grid(grid, network.voxel_mm)
    problem = problem or InsetProblem(scans[0], work)
    if problem.grid != work:
        raise ValueError(
            f"the problem was made for another grid: make it on {work} (recon.mbir.working_grid)"
        )
    for i in range(0, len(scans), batch):
        part = scans[i : i + batch]
        exposure = problem.exposure(part)
        data = [problem.data(s) for s in part]
        statistics = [problem.statistic(s, y) for s, y in zip(part, data, strict=True)]
        b = torch.stack([s.b for s in statistics])
        with torch.no_grad():
            solution = network.solved(problem, b, exposure)
            normal, u = solution.normal, solution.u
            left = normal.beta - normal.apply(u)
            residuals = low_residual(normal, left, network.fidelity).tolist()
            # ‖y − A u‖²_W less ‖y‖²_W = uᵀ H u − 2 βᵀ u
            misfit = -(u * (left + normal.beta)).sum(dim=(1, 2, 3), dtype=torch.float64)
            hu = network.in_hu(problem, u, normal)
        found = []
        for k, (scan, volume, statistic) in enumerate(zip(part, hu, statistics, strict=True)):
            report: dict[str, Any] = {
                "method": "mbir",
                "iterations": network.model.steps,
                "fidelity": network.fidelity,
                "residual": residuals[k],
                "chi2": (statistic.energy + float(misfit[k])) / statistic.readings,
                **network.made_with,
                **solution.notes[k],
            }
            seen = network.check(
                [float(normal.scale_hu[k])], float(volume.max()), scan.unit, problem.mu_ref
            )
            warnings = [*report.pop("warnings", []), *seen]
            tests = []
            if not scan.noise_free:
                tests = tested(
                    RESIDUAL_TEST, warnings, problem.residual_test, scan, volume, data[k]
                )
            if solution.drawn[k]:
                with torch.no_grad():
                    plain = network.with_known(None)
                    changed = volume - plain(problem, statistic.b[None], exposure)[0]
                report["drawn_minus_plain_hu"] = (
                    changed if work is grid else average_onto(changed, work, grid)
                )
            if noise_map:
                sd = network.noise_map(problem, statistic.b, exposure)
                report["noise_sd_hu"] = sd if work is grid else average_onto(sd, work, grid)
            found.append(
                Solution(
                    volume if work is grid else average_onto(volume, work, grid),
                    report,
                    warnings,
                    tests,
                )
            )
        yield found
        progress(min(i + batch, len(scans)) / len(scans))


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
