"""What the training minimises, and how checkpoints are chosen.

A plain squared error teaches a network to shrink what it is unsure of: the error falls, the contrast with it. Three
terms, all from two independent noise draws of each scene with errors e₁, e₂ in noise units:

* ``data``: eᵀH e per voxel, the error as the scanner would see it, which is the noise-whitened squared error;
* ``white``: ‖e‖² per voxel, for the frequencies that the scanner does not see; more on both sides of edges, where blur
  and undershoot are, and in bodies, which are small beside what surrounds them;
* ``noise_free``: both of the same scene without noise, where all that is left is blur and overshoot beside edges;
* ``contrast``: the errors d of ROI contrasts, small ones and that of a whole core, (d₁² + d₂²) / 2 + κ d₁ d₂. The
  product of two draws is an unbiased estimate of the squared bias, so κ trades variance against bias.

Every scene has a random fidelity, so that one network serves all of them: from the least error, which shrinks what it
is unsure of, at fidelity 0, to the least bias at fidelity 1. The contrast's weight and κ grow with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from recon.mbir.problem import NormalisedProblem
from recon.mbir.unrolled import DEFAULT_FIDELITY, Unrolled, start
from train.config import ObjectiveConfig
from train.data import Batch, Data, seed_of
from train.scenes.held_out import ValidationScenes, validation_scenes

__all__ = ["Loss", "Objective", "Validation"]

_BODY_HU = 15.0
"""What differs by more from the background is a body; where values differ by more there is an edge."""
_TAME_ERROR, _TAME_CONTRAST = 0.02, 2.0
"""A few scenes (calcifications at high dose) would drown all others: losses beyond count less than their size."""
_NOISE_FREE_SHARE = 0.5
"""Share of the scenes that are seen without noise too; there that counts so many times more."""
_SMALL_VOXELS = 6
"""Of the small ROIs of the validation: a quarter of a square millimetre, as the paper's."""
_FALSE_HU = {0.35: 6.0, 2.0: 3.0}
"""Contrast where there is no core that a checkpoint may have without being marked down, at the exposures in s."""


@dataclass(frozen=True)
class Loss:
    """Sum over the scenes of a batch.

    Args:
        total: scalar, differentiable.
        parts: the terms before weighting.
    """

    total: Tensor
    parts: dict[str, float]


@dataclass(frozen=True)
class Validation:
    """Figures of a checkpoint on held-out plaques.

    Args:
        score: higher is better; selects the checkpoint.
        figures: per exposure: ``slope`` and ``sd_hu`` (slope-corrected) of the contrast of small ROIs, ``lesion_slope``
            and ``lesion`` (slope-corrected variance of the whole core's contrast, that of the linear start over the
            network's), ``false_hu`` (mean contrast of small ROIs, and of the whole core, where there is no core),
            ``rmse_hu`` inside bodies and ``fat_hu``, the SD of the background.
        pictures: axial images in HU above the background.
    """

    score: float
    figures: dict[str, float]
    pictures: dict[str, NDArray[np.float32]] = field(default_factory=dict)


class Objective:
    """The loss of a batch and the validation of a model.

    Args:
        config: weights and sizes.
        single: share of the training with one step instead of all.
    """

    def __init__(self, config: ObjectiveConfig | None = None, single: float = 0.0) -> None:
        self.config = config or ObjectiveConfig()
        self.single = single

    def __call__(self, model: nn.Module, batch: Batch, progress: float = 0.0) -> Loss:
        """Loss of a batch; ``progress`` is the finished share of the training.

        Both draws of a scene have the same fidelity.
        """
        c = self.config
        key = f"{c.fidelities} {c.noise_free > 0} {getattr(model, 'bilateral', None)}"
        if key not in batch.kept:
            batch.kept[key] = self._seen(model, batch)
        seen: _Seen = batch.kept[key]
        n, free = batch.size, len(seen.scene) - 2 * batch.size
        problem, scene = seen.problem, seen.scene
        known = {} if seen.views is None else {"views": seen.views}
        made: Tensor = model(problem, seen.fidelity, steps=1 if progress < self.single else None, **known)
        error = made - batch.truth[scene] / problem.scale_hu.reshape(-1, 1, 1, 1)
        data = (error * problem.apply(error)).mean(dim=(1, 2, 3))
        places = c.edge * _edges(batch.truth) + c.body * _bodies(batch.truth)
        white = (error.square() * (1.0 + places[scene])).mean(dim=(1, 2, 3))
        image = c.data * (data + c.white * white) / (1.0 + data.detach() / _TAME_ERROR)
        noisy, error = image[: 2 * n], error[: 2 * n]
        # The noise of an ROI mean falls with its size, but less than as 1/√voxels: neighbours are correlated.
        size = (20.0 / batch.voxels.clamp_min(4.0)).pow(0.25) * c.contrast_sd
        d = torch.einsum("dnzyx,nrzyx->dnr", error.unflatten(0, (2, n)), batch.contrast) / size
        variance, product = d.square().mean(0), d[0] * d[1]
        total = 0.5 * noisy.sum()
        tame = 1.0 / (1.0 + variance.detach() / _TAME_CONTRAST)
        fidelity = seen.fidelity[:n]
        kappa = (c.bias[0] + (c.bias[1] - c.bias[0]) * fidelity)[:, None]
        weight = c.contrast * (c.viewing + (1.0 - c.viewing) * fidelity)[:, None]
        total = total + (weight * tame * (variance + kappa * product)).sum()
        parts = {
            "data": data[: 2 * n].sum() / 2, "white": white[: 2 * n].sum() / 2,
            "contrast": variance.sum(), "bias": product.sum(),
        }  # fmt: skip
        if free:
            total = total + c.noise_free / _NOISE_FREE_SHARE * image[2 * n :].sum()
        if c.noise_free:
            parts["noise_free"] = image[2 * n :].sum() / c.data
        return Loss(total, {k: float(v.detach()) for k, v in parts.items()})

    @torch.no_grad()
    def _seen(self, model: nn.Module, batch: Batch) -> _Seen:
        c, n, whole = self.config, batch.size, batch.with_noise_free
        low, high = c.fidelities
        free = torch.nonzero((batch.lots[:, 1] < _NOISE_FREE_SHARE) & bool(c.noise_free))[:, 0]
        rows = torch.cat([torch.arange(2 * n, device=free.device), 2 * n + free])
        problem, scene = whole.part(rows), rows % n
        fidelity = (low + (high - low) * batch.lots[:, 0])[scene]
        return _Seen(problem, scene, fidelity, model.first_views(problem) if isinstance(model, Unrolled) else None)

    @torch.no_grad()
    def validate(self, model: nn.Module, data: Data, seed: int) -> Validation:
        """Figures on held-out plaques at the usual fidelity; what counts are small contrasts and lesions, and that none
        is invented.

        Args:
            model: in evaluation mode.
            data: whose first situation is used.
            seed: of the scenes and their noise.
        """
        c, d = self.config, data.config
        held = validation_scenes(d.shape, (d.voxel_mm,) * 3, seed=seed, contrasts=(-60.0, 0.0))
        figures: dict[str, float] = {}
        pictures: dict[str, NDArray[np.float32]] = {}
        scores = []
        for exposure in c.validation_exposures_s:
            rows = []
            for i in range(held.image.shape[0]):
                row, picture = self._of_scene(model, data, held, i, exposure, seed)
                rows.append(row)
                if i < 2:
                    pictures[f"{exposure:g}s_{i}"] = picture
            of = {k: np.array([r[k] for r in rows]) for k in rows[0]}
            slope, lesion_slope = of["slope"].mean(), of["lesion_slope"].mean()
            found = {
                "slope": slope,
                "slope_spread": of["slope"].std(),
                "sd_hu": math.sqrt(of["variance"].mean()) / slope,
                "lesion_slope": lesion_slope,
                "lesion": lesion_slope**2 * np.exp(np.log(of["lesion_linear"] / of["lesion_variance"]).mean()),
                "false_hu": np.abs(of["false"]).mean(),
                "false_lesion_hu": np.abs(of["false_lesion"]).mean(),
                "rmse_hu": math.sqrt(of["square"].mean()),
                "fat_hu": math.sqrt(of["fat"].mean()),
            }
            figures |= {f"{k}_{exposure:g}s": float(v) for k, v in found.items()}
            most = min(_FALSE_HU.items(), key=lambda item: abs(math.log(item[0] / exposure)))[1]
            excess = max(found["false_lesion_hu"] / most - 1.0, 0.0)
            scores.append(
                0.5 * math.log(found["lesion"]) - math.log(found["sd_hu"] * math.sqrt(found["rmse_hu"])) - 0.1 * excess
            )
        return Validation(float(np.mean(scores)), figures, pictures)

    def _of_scene(
        self, model: nn.Module, data: Data, held: ValidationScenes, i: int, exposure: float, seed: int
    ) -> tuple[dict[str, float], NDArray[np.float32]]:
        """Figures of one held-out plaque, and a picture: truth beside the first volume."""
        c, d = self.config, data.config
        gram, hu = data.gram(0)
        truth = (held.image[i] - held.scenes[i].background).to(data.device)
        rois = torch.stack([_small(held, i), _mean(held.core_roi[i]) - _mean(held.fibrous_roi[i])]).to(data.device)
        generator = torch.Generator(data.device).manual_seed(seed_of(seed, i))
        noise = gram.noise((c.validation_draws,), generator=generator) * math.sqrt(exposure)
        exposures = torch.full((c.validation_draws,), exposure, device=data.device)
        volumes, linear = [], []
        for signal in gram.apply(truth) * (hu * exposure):  # the same noise for all contrasts
            problem = NormalisedProblem.from_statistic(gram, signal + noise, exposures, hu, d.voxel_mm)
            scale = problem.scale_hu.reshape(-1, 1, 1, 1)
            volumes.append(model(problem, DEFAULT_FIDELITY) * scale)
            linear.append(start(problem, problem.spectrum()) * scale)
        found, plain = (torch.einsum("cnzyx,rzyx->rcn", torch.stack(v), rois).double() for v in (volumes, linear))
        true = torch.einsum("czyx,rzyx->rc", truth, rois).double()
        slope, plain_slope = ((v[:, 0].mean(1) - v[:, 1].mean(1)) / (true[:, 0] - true[:, 1]) for v in (found, plain))
        false = found[:, 1].mean(1) - true[:, 1]
        variance, plain_variance = (v.var(2).mean(1) for v in (found, plain))
        error = torch.cat([v - t for v, t in zip(volumes, truth, strict=True)])
        bodies = _bodies(truth[:1])[0] > 0
        middle = d.shape[0] // 2
        row = {
            "slope": slope[0], "lesion_slope": slope[1], "false": false[0], "false_lesion": false[1],
            "variance": variance[0], "lesion_variance": variance[1],
            "lesion_linear": plain_variance[1] / plain_slope[1] ** 2,
            "square": error[:, bodies].square().mean(), "fat": error[:, ~bodies].var(0).mean(),
        }  # fmt: skip
        picture = torch.cat([truth[0, middle], volumes[0][0, middle]], dim=1).cpu().numpy()
        return {k: float(v) for k, v in row.items()}, picture


@dataclass(frozen=True)
class _Seen:
    """What the network sees of a batch, and no weight changes.

    Args:
        problem: of all volumes.
        scene: ``(m,)`` of each volume: the first draws, the second draws, and what is seen without noise.
        fidelity: ``(m,)``.
        views: :meth:`recon.mbir.unrolled.Unrolled.first_views`.
    """

    problem: NormalisedProblem
    scene: Tensor
    fidelity: Tensor
    views: Any


def _bodies(truth: Tensor) -> Tensor:
    """1 in bodies and one voxel about them, else 0; ``(n, z, y, x)``."""
    return F.max_pool3d((truth.abs() > _BODY_HU).float()[:, None], 3, 1, 1)[:, 0]


def _edges(truth: Tensor) -> Tensor:
    """1 where values of the cube of five voxels about a voxel differ by more than that of a body, else 0."""
    both = torch.stack([truth, -truth], 1)
    for size in ((1, 1, 5), (1, 5, 1), (5, 1, 1)):
        both = F.max_pool3d(both, size, 1, [n // 2 for n in size])
    return (both.sum(1) > _BODY_HU).float()


def _mean(mask: Tensor) -> Tensor:
    return mask / mask.sum()


def _small(held: ValidationScenes, i: int) -> Tensor:
    """Weights of the contrast between the voxels in the middle of the core's fullest slice and the nearest tissue."""
    core, tissue = held.core_roi[i].clone(), held.fibrous_roi[i]
    z = int(core.sum(dim=(1, 2)).argmax())
    core[:z], core[z + 1 :] = 0.0, 0.0
    middle = torch.nonzero(core).float().mean(0)
    out = torch.zeros_like(core)
    for sign, mask in ((1.0, core), (-1.0, tissue)):
        found = torch.nonzero(mask)
        near = found[(found.float() - middle).square().sum(1).argsort()[:_SMALL_VOXELS]]
        out[tuple(near.T)] += sign / len(near)
    return out
