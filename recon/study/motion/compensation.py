"""Reconstruction of the moving plaque with its motion known, exactly or not."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from torch import Tensor

from recon.fbp.inset import InsetFbp, view_motion
from recon.pwls.inset_problem import InsetProblem, reconstruct_pwls
from recon.study.motion.measure import KERNEL, Measured
from recon.study.motion.observed import Observed, Reference, observe
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan

if TYPE_CHECKING:
    from recon.mbir.mbir import Mbir

__all__ = ["compensate"]

_PWLS_TOLERANCE_HU = 2.0


def compensate(m: Measured, still: Scan, moving: Scan, reference: Reference, progress: Callable[[float], None]) -> None:
    """Fill ``m.compensated`` from the noise-free scans of the still and of the moving vessel.

    PWLS, whose solution is to be certified by exact projections, is run without noise and for the first noise
    realisation, at rest and with the true motion; FBP and MBIR with every estimate of the motion.
    """
    s = m.settings
    path = view_motion(s.motion.scaled(max(s.fractions)), moving.geometry, s.rotation_s)
    estimates: list[float | None] = [None, 0.0, *s.errors]
    noise: list[int | None] = [None, *range(s.seed, s.seed + s.realizations)]
    makers = {"fbp": _fbp, "pwls": _pwls, "mbir": _mbir}
    problems: dict[float | None, InsetProblem] = {}
    if set(s.methods) - {"fbp"}:
        problem = InsetProblem(still, m.grid)
        problems = {e: problem if e is None else problem.with_motion((1.0 - e) * path) for e in estimates}
    rest: dict[str, Tensor] = {}
    for k, seed in enumerate(noise):
        # The same draws at rest and in motion: noise belongs to the reading, not to what is seen.
        scans = [scan if seed is None else scan.with_noise(s.exposure_s, seed) for scan in (still, moving)]
        for method in s.methods:
            if method == "pwls" and k > 1:
                continue
            for error in estimates:
                if method == "pwls" and error:
                    continue
                motion = None if error is None else (1.0 - error) * path
                volume = makers[method](scans[error is not None], m, motion, problems.get(error))
                if seed is None and error is None:
                    rest[method] = volume
                found: Observed = observe(volume, m.grid, reference, rest[method])
                m.compensated.setdefault((method, error, seed is not None), []).append(found)
        progress((k + 1) / len(noise))


def _fbp(scan: Scan, m: Measured, motion: Any, problem: InsetProblem | None) -> Tensor:
    return InsetFbp(scan, [m.grid], [KERNEL], motion=motion)(scan)[0][0]


def _pwls(scan: Scan, m: Measured, motion: Any, problem: InsetProblem | None) -> Tensor:
    return reconstruct_pwls([scan], m.grid, problem=problem, tolerance=_PWLS_TOLERANCE_HU)[0].data


@lru_cache(maxsize=1)
def _learned() -> Mbir:
    from recon.mbir.mbir import Mbir

    return Mbir.load()


def _mbir(scan: Scan, m: Measured, motion: Any, problem: InsetProblem | None) -> Tensor:
    """Noise free: as a scan of the study's exposure whose readings happen to be their expectations."""
    assert problem is not None
    b = problem.statistic(scan).b * (m.settings.exposure_s / NOISE_FREE_EXPOSURE_S if scan.noise_free else 1.0)
    return _learned()(problem, b[None], m.settings.exposure_s)[0]
