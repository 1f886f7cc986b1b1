"""The worst-case response of the study's methods to a perturbation of the data, beside that of FBP."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from recon.fbp.backproject import backproject
from recon.fbp.exact_noise import line_integral_variance
from recon.fbp.fbp import filter_windowed
from recon.fbp.inset import InsetFbp
from recon.mbir.mbir import Mbir
from recon.sensitivity import worst_case_gain
from recon.study.dose_factor.methods import Method, fingerprint
from recon.study.dose_factor.realisations import Realisations
from recon.study.dose_factor.settings import FBP_BASE, fbp_label

__all__ = ["FBP_KERNELS", "worst_case_gains"]

FBP_KERNELS = ("soft", "standard")
_ITERATIONS, _FBP_ITERATIONS = 12, 6
"""Power iterations; a linear method's gain needs fewer digits of its eigenvector."""


def worst_case_gains(noise: Realisations, methods: list[Method], dose: float) -> dict[str, float]:
    """Gain of MBIR as it ships at the first realisation of the paper's scene, and of FBP, HU mm^1.5.

    Args:
        noise: realisations of the study.
        methods: of the study; only MBIR itself counts, not its ablations: a gain costs as much as a hundred volumes.
        dose: exposure in s.
    """
    scene = noise.scene("paper")
    found: dict[str, float] = {}
    for kernel in FBP_KERNELS:
        label = fbp_label(kernel, FBP_BASE[1])

        def compute(kernel: str = kernel) -> dict[str, Any]:
            clean = scene.clean
            assert clean.window is not None
            window = clean.window
            grid = scene.grid_of(FBP_BASE[1])
            fbp = InsetFbp(clean, [grid], [kernel])
            variance = line_integral_variance(clean, dose).to(torch.float32)
            hu = 1000.0 / clean.linearisation.mu_ref

            def reconstruct(lines: Tensor) -> Tensor:
                rows = filter_windowed(lines, clean.geometry, window, [kernel], fbp.shadow)
                return backproject(rows, clean.geometry, grid, fbp.shadow)[0] * hu

            start = torch.zeros_like(variance)
            gain, _ = worst_case_gain(
                reconstruct, start, lambda v: v * variance, grid.spacing[0], iterations=_FBP_ITERATIONS
            )
            return {"gain": gain}

        piece = noise.store.piece(f"gains/fbp_{kernel}_{dose:g}s", f"{noise.key} {_FBP_ITERATIONS}", compute)
        found[f"FBP {label}"] = float(piece["gain"])
    for method in methods:
        if isinstance(method, Mbir) and method.name == Mbir.name:
            found[method.name] = _learned_gain(noise, method, dose)
    return found


def _learned_gain(noise: Realisations, method: Mbir, dose: float) -> float:
    scene = noise.scene("paper")

    def compute() -> dict[str, Any]:
        b = noise.statistic("paper", dose, range(noise.settings.block))[:1]
        problem = scene.problem
        gram = problem.gram.scaled(dose)

        def reconstruct(x: Tensor) -> Tensor:
            normal = method.problem(problem, x, dose)
            return method.model(normal, method.look, **method.parts) * normal.scale_hu.reshape(-1, 1, 1, 1)

        gain, _ = worst_case_gain(reconstruct, b, gram.apply, scene.grid.spacing[0], iterations=_ITERATIONS)
        return {"gain": gain}

    key = f"{noise.key} {fingerprint(method)} {_ITERATIONS}"
    return float(noise.store.piece(f"gains/{method.name}_{dose:g}s", key, compute)["gain"])
