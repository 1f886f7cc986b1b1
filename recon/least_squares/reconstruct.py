"""PWLS from a scan to HU, of an inset or of a whole field."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Unpack

from recon.least_squares.field_problem import FieldProblem
from recon.least_squares.inset_problem import InsetProblem, is_whole_field
from recon.least_squares.pwls import PwlsOptions
from recon.least_squares.qggmrf import QGGMRF
from recon.result import Result
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scan_memory import once
from torchpcct.volume import in_words

__all__ = ["reconstruct_pwls"]

TOLERANCE_HU = 1.0
"""Root mean square distance to the minimum at which PWLS of a scan ends, unless another is asked
for."""


def reconstruct_pwls(
    scans: Sequence[Scan],
    grid: VolumeGrid,
    progress: Callable[[float], None],
    *,
    prior: QGGMRF | None = None,
    problem: InsetProblem | FieldProblem | None = None,
    batch: int = 1,
    **options: Unpack[PwlsOptions],
) -> Iterator[list[Result]]:
    """PWLS with a q-GGMRF prior, to convergence: of an inset, or of a whole field of view (every
    scan of a parallel or fan beam, slice by slice, from FBP as the first volume).

    Args:
        scans: realisations of one scan at one exposure; of a whole field scans of one geometry.
        grid: the inset, or the field.
        progress: called with the finished fraction.
        prior: None: :data:`recon.least_squares.qggmrf.DEFAULT_PRIOR` in the length unit of the scan
            (:func:`recon.least_squares.exterior.length_unit`); of a whole field
            :func:`recon.least_squares.field_problem.field_prior`. Neither depends on the unit of
            length.
        problem: kept from an earlier call with the same scan and grid; None: made here.
        batch: volumes of an inset solved at a time; they iterate until the slowest has converged.
        options: of :func:`recon.least_squares.pwls.pwls`; ``tolerance`` is :data:`TOLERANCE_HU`
            unless given.

    Yields:
        Volumes in HU, batch by batch, with the solver's report; of several slices with the sum of
        ``exact_pairs`` and the worst of the rest. Of noisy scans also ``chi2`` (weighted squared
        residual per reading), ``residual_p`` and ``warnings`` of
        :func:`torchpcct.metrics.residual_test.residual_test`: a volume that does not explain its
        data (wrong centre, drifting gain, metal or a body beyond the grid) carries a warning. A
        volume whose iteration did not reach ``tolerance`` says so in ``warnings``, too, and a
        :class:`RuntimeWarning` is given.

    Raises:
        ValueError, TypeError: see :class:`recon.least_squares.inset_problem.InsetProblem`,
            :class:`recon.least_squares.field_problem.FieldProblem` and
            :func:`recon.least_squares.pwls.pwls`.
    """
    wanted: PwlsOptions = {"tolerance": TOLERANCE_HU, **options}
    if problem is None:
        problem = (
            FieldProblem(scans[0], grid)
            if is_whole_field(scans[0], grid)
            else once(scans[0], "inset", lambda: InsetProblem(scans[0], grid), grid)
        )
    for i in range(0, len(scans), batch):
        part = scans[i : i + batch]

        def advance(share: float, done: int = i, count: int = len(part)) -> None:
            progress((done + share * count) / len(scans))

        found = []
        for solution in problem.solutions(part, prior or problem.prior, wanted, advance):
            messages, report = list(problem.warnings), solution.report
            if not report["converged"]:
                left, asked = (
                    in_words(v, problem.unit, problem.mu_ref)
                    for v in (report["rmsd_hu"][-1], report["tolerance_hu"])
                )
                messages.append(
                    f"PWLS stopped {left} from the minimum after {report['exact_pairs']} "
                    f"projection pairs (tolerance {asked}): raise max_exact, or strengthen the "
                    "prior"
                )
                warnings.warn(messages[-1], RuntimeWarning, stacklevel=2)
            found.append(solution._replace(warnings=[*messages, *solution.warnings]))
        yield found
