"""FBP and linear methods without sampling error: readings of every main scene, their covariance, noise in fat.

Both give the same arrays, at one exposure:

* ``readings`` ``(scenes, rows)`` of noise-free scans, ``covariance`` ``(rows, rows)`` HU²: of
  :attr:`recon.study.dose_factor.readings.Readings.weights`;
* ``variance`` ``(3,)`` HU² of a voxel in fat, in the vessel and at the core's edge, each averaged over its slices;
  ``square`` ``(2,)`` mean squared error of the noise-free volume in vessel and fat;
* ``row`` ``(z, y, x)`` covariance in HU² of the middle voxel with those around it, scaled to the variance in fat
  (linear noise knows no tissue);
* ``plane`` and ``z``: edge profile of the core, present minus absent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.fbp.exact_noise import line_integral_variance, roi_adjoints, voxel_covariance
from recon.fbp.inset import InsetFbp
from recon.study.dose_factor.exact_linear import exact_linear, statistic_covariance
from recon.study.dose_factor.readings import Readings
from recon.study.dose_factor.scene import StudyScene
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan

__all__ = ["fbp_figures", "linear_figures"]

Floats = NDArray[np.float64]

_LAGS_MM = 4.2
"""Largest lag of ``row``."""


def _of_scenes(readings: Readings, volumes: Tensor) -> dict[str, Any]:
    """What noise-free volumes of the main scenes show."""
    profiles = readings.profiles(volumes[:2])
    return {
        "readings": readings.linear(volumes),
        "square": readings.squares(volumes[:1])[0],
        **{direction: p[0] - p[1] for direction, p in profiles.items()},
    }


def _noise(readings: Readings, covariance: Floats, spread: Tensor) -> dict[str, Any]:
    count, ends = len(readings.weights), np.cumsum([len(places) for places, _ in readings.samples])
    single = np.split(np.diag(covariance)[count:], ends)
    variances = [shares @ v for (_, shares), v in zip(readings.samples, single, strict=False)]
    level = float(variances[0])
    grid, middle = readings.grid, readings.middle
    reach = [min(round(_LAGS_MM / s), k, n - 1 - k) for s, k, n in zip(grid.spacing, middle, grid.shape, strict=True)]
    row = spread.double().numpy()[tuple(slice(k - r, k + r + 1) for k, r in zip(middle, reach, strict=True))]
    return {
        "covariance": covariance[:count, :count],
        "variance": np.array(variances),
        "row": row * (level / float(spread[middle])),
    }


def fbp_figures(scenes: Sequence[StudyScene], readings: Readings, kernel: str) -> dict[str, Any]:
    """Of FBP at 1 s; its covariances fall as the inverse of the exposure.

    Args:
        scenes: the main scenes, the paper's first.
        readings: on the grid of FBP.
        kernel: of FBP.
    """
    clean, grid = scenes[0].clean, readings.grid
    fbp = InsetFbp(clean, [grid], [kernel])
    volumes = torch.stack([fbp(scene.clean)[0][0] for scene in scenes])
    adjoints = roi_adjoints(clean, fbp, [readings.functionals()])  # type: ignore[list-item]
    covariance = adjoints.joint_covariance(clean, NOISE_FREE_EXPOSURE_S)
    del adjoints
    spread = voxel_covariance(clean, fbp, NOISE_FREE_EXPOSURE_S, readings.middle)
    return {**_of_scenes(readings, volumes), **_noise(readings, covariance, spread)}


def linear_figures(
    method: Callable[[Any, Tensor, float], Tensor],
    scenes: Sequence[StudyScene],
    readings: Readings,
    dose: float,
    drawn: bool,
) -> dict[str, Any]:
    """Of a linear method; ``adjoints`` ``(rows, z, y, x)`` and ``offset`` give its readings of any b.

    Args:
        method: of :mod:`recon.study.dose_factor.methods`.
        scenes: the main scenes, the paper's first.
        readings: on the methods' grid.
        dose: exposure in s.
        drawn: noise of readings; else of the Gram operator's covariance.
    """
    problem, count = scenes[0].problem, len(readings.weights)
    b = torch.stack([torch.from_numpy(scene.facts.statistic) * dose for scene in scenes])
    clean = scenes[0].clean if drawn else None
    exact = exact_linear(method, problem, readings.functionals(), b[0], dose)
    covariance = statistic_covariance(problem, exact.adjoints, dose, clean)
    with torch.no_grad():
        volumes = method(problem, b, dose)
        zero = method(problem, torch.zeros_like(b[:1]), dose)
        spread = _statistic_row(problem, exact.adjoints[-1], dose, clean).to(b)
        row = (method(problem, spread[None], dose) - zero)[0]
    return {
        **_of_scenes(readings, volumes), **_noise(readings, covariance, row),
        "adjoints": exact.adjoints[:count].to(torch.float32).numpy(), "offset": exact.offset_hu[:count],
    }  # fmt: skip


def _statistic_row(problem: Any, g: Tensor, dose: float, clean: Scan | None) -> Tensor:
    """Cov(b) g."""
    g = g.to(torch.float32)
    out: Tensor
    if clean is None:
        out = problem.gram.scaled(dose).apply(g)
        return out
    variance = line_integral_variance(clean.crop(problem.window), dose)
    weights = problem.weights * (dose / NOISE_FREE_EXPOSURE_S)
    out = problem.projector.T(problem.projector(g) * weights.square() * variance)
    return out
