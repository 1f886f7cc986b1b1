"""Reconstruction of the moving plaque with its motion known, exactly or not."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from torch import Tensor

from recon.analytic.inset import InsetFbp, view_motion
from recon.evaluate.store import Pieces
from recon.least_squares.inset_problem import InsetProblem
from recon.least_squares.reconstruct import reconstruct_pwls
from recon.mbir.mbir import Mbir
from recon.study.motion.observed import Observed, Reference, observe
from recon.study.motion.settings import Settings
from recon.study.paper.plaque_scan import REFERENCE_KERNEL
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan

__all__ = ["Key", "compensate", "estimate_name", "reconstruct_fbp"]

Key = tuple[str, float | None, bool]
"""Method, error of the estimated motion (0: the true one; None: the still vessel), whether there is noise."""

_PWLS_TOLERANCE_HU = 2.0


def estimate_name(error: float | None) -> str:
    """What a report calls an estimate of the motion; see :data:`Key`."""
    return "at rest" if error is None else f"wrong by {100 * error:.0f} %" if error else "true motion"


def reconstruct_fbp(scan: Scan, grid: VolumeGrid, motion: Any = None) -> Tensor:
    """FBP with the study's kernel, ``(z, y, x)`` HU; ``motion``: of :class:`recon.analytic.inset.InsetFbp`."""
    return InsetFbp(scan, [grid], [REFERENCE_KERNEL], motion=motion)(scan)[0][0]


def compensate(
    s: Settings, still: Scan, moving: Scan, reference: Reference, pieces: Pieces, progress: Callable[[float], None]
) -> dict[Key, list[Observed]]:
    """Reconstruct the noise-free scans of the still and of the moving vessel and their noisy realisations.

    PWLS, whose solution is to be certified by exact projections, is run without noise and for the first noise
    realisation, at rest and with the true motion; FBP and MBIR with every estimate of the motion. Every volume is kept
    in ``pieces``.

    Returns:
        One entry per realisation.
    """
    grid = reference.grid
    path = view_motion(s.motion.scaled(s.worst), moving.geometry, s.rotation_s)
    estimates: dict[float | None, Any] = {None: None}
    estimates |= {e: (1.0 - e) * path for e in (0.0, *s.errors)}
    problems: dict[float | None, InsetProblem] = {}
    if set(s.methods) - {"fbp"}:
        problem = InsetProblem(still, grid)
        problems = {e: problem if motion is None else problem.with_motion(motion) for e, motion in estimates.items()}
    network = Mbir.load() if "mbir" in s.methods else None

    def reconstruct(method: str, scan: Scan, error: float | None) -> Tensor:
        if method == "fbp":
            return reconstruct_fbp(scan, grid, estimates[error])
        if network is None or method == "pwls":
            return reconstruct_pwls([scan], grid, problem=problems[error], tolerance=_PWLS_TOLERANCE_HU)[0].data
        # Noise free: as a scan of the study's exposure whose readings happen to be their expectations.
        b = problems[error].statistic(scan).b * (s.exposure_s / NOISE_FREE_EXPOSURE_S if scan.noise_free else 1.0)
        return network(problems[error], b[None], s.exposure_s)[0]

    noise: list[int | None] = [None, *range(s.seed, s.seed + s.realizations)]
    found: dict[Key, list[Observed]] = {}
    rest: dict[str, Tensor] = {}
    for k, seed in enumerate(noise):
        # The same draws at rest and in motion: noise belongs to the reading, not to what is seen.
        scans = [scan if seed is None else scan.with_noise(s.exposure_s, seed) for scan in (still, moving)]
        for method in s.methods:
            for error in estimates:
                if method == "pwls" and (k > 1 or error):
                    continue
                run = partial(reconstruct, method, scans[error is not None], error)
                volume = pieces(f"{method}_{error}_{seed}", run)
                if seed is None and error is None:
                    rest[method] = volume
                found.setdefault((method, error, seed is not None), []).append(observe(volume, reference, rest[method]))
        progress((k + 1) / len(noise))
    return found
