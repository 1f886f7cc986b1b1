"""What the training minimises, and how checkpoints are chosen.

A plain squared error teaches a network to shrink what it is unsure of: the error falls, the contrast with it. Three
terms, all from two independent noise draws of each scene with errors e₁, e₂ in noise units:

* ``data``: eᵀH e per voxel, the error as the scanner would see it, which is the noise-whitened squared error;
* ``white``: ‖e‖² per voxel, small, for the frequencies that the scanner does not see;
* ``contrast``: the error d of a random ROI contrast, (d₁² + d₂²) / 2 + κ d₁ d₂. The product of two draws is an unbiased
  estimate of the squared bias, so κ trades variance against bias: the slope of the contrast stays near 1.

κ grows during the training. With a large one from the start the network never dares to smooth: what is noisy is at
least not biased. First it learns which noise can go, then to give back the contrast that went with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from recon.mbir.unrolled import NormalisedProblem
from train.config import ObjectiveConfig
from train.data import Batch, Data, seed_of
from train.scenes.held_out import validation_scenes

__all__ = ["Loss", "Objective", "Validation"]


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
        figures: per exposure ``slope``, ``sd_hu``, ``efficiency`` (variance with everything but the core's amplitude
            known, over the slope-corrected variance) and ``false_hu`` (mean contrast of an absent core).
        pictures: axial images in HU above the background.
    """

    score: float
    figures: dict[str, float]
    pictures: dict[str, NDArray[np.float32]] = field(default_factory=dict)


class Objective:
    """The loss of a batch and the validation of a model."""

    def __init__(self, config: ObjectiveConfig | None = None) -> None:
        self.config = config or ObjectiveConfig()

    def __call__(self, model: nn.Module, batch: Batch, progress: float = 0.0) -> Loss:
        """Loss of a batch; ``progress`` is the finished share of the training."""
        c = self.config
        scale = batch.problem.scale_hu.reshape(-1, 1, 1, 1)
        error = model(batch.problem) - torch.cat([batch.truth, batch.truth]) / scale
        voxels = error[0].numel()
        data = (error * batch.problem.apply(error)).sum(dim=(1, 2, 3)) / voxels
        white = error.square().sum(dim=(1, 2, 3)) / voxels
        n = batch.size
        # The noise of an ROI mean falls with its size, but less than as 1/√voxels: neighbours are correlated.
        size = (20.0 / batch.voxels.clamp_min(4.0)).pow(0.25)
        d = (error * torch.cat([batch.contrast, batch.contrast])).sum(dim=(1, 2, 3)) / c.contrast_sd
        d = d / torch.cat([size, size])
        d1, d2 = d[:n], d[n:]
        variance, product = 0.5 * (d1 * d1 + d2 * d2), d1 * d2
        # A few scenes (calcifications at high dose) would drown all others: large losses count less than their size.
        tame = 1.0 / (1.0 + data.detach() / 0.2)
        total = 0.5 * c.data * (tame * (data + c.white * white)).sum()
        tame = 1.0 / (1.0 + variance.detach() / 20.0)
        total = total + c.contrast * (tame * (variance + self.kappa(progress) * product)).sum()
        parts = {"data": data.sum() / 2, "white": white.sum() / 2, "contrast": variance.sum(), "bias": product.sum()}
        return Loss(total, {k: float(v.detach()) for k, v in parts.items()})

    def kappa(self, progress: float) -> float:
        """κ at the finished share of the training."""
        c = self.config
        if c.bias == 0:
            return 0.0
        return c.bias_start * (c.bias / c.bias_start) ** min(1.0, progress / c.bias_ramp)

    @torch.no_grad()
    def validate(self, model: nn.Module, data: Data, seed: int = 0) -> Validation:
        """Contrast slope, noise and efficiency on held-out plaques.

        Args:
            model: in evaluation mode.
            data: whose first situation is used.
            seed: of the scenes and their noise.
        """
        c, d = self.config, data.config
        held = validation_scenes(d.shape, (d.voxel_mm,) * 3, seed=seed, contrasts=(-60.0, 0.0))
        gram, hu = data.gram(0)
        figures: dict[str, float] = {}
        pictures: dict[str, Any] = {}
        scores = []
        for exposure in c.validation_exposures_s:
            slopes, false, variances, ideal = [], [], [], []
            for i in range(held.image.shape[0]):
                truth = held.image[i] - held.scenes[i].background
                roi = held.core_roi[i] / held.core_roi[i].sum() - held.fibrous_roi[i] / held.fibrous_roi[i].sum()
                generator = torch.Generator().manual_seed(seed_of(seed, i))
                noise = gram.noise((c.validation_draws,), generator=generator) * math.sqrt(exposure)
                exposures = torch.full((c.validation_draws,), exposure)
                volumes = []
                for signal in gram.apply(truth) * (hu * exposure):  # the same noise for all contrasts
                    problem = NormalisedProblem.from_statistic(gram, signal + noise, exposures, hu, d.voxel_mm)
                    volumes.append(model(problem) * problem.scale_hu.reshape(-1, 1, 1, 1))
                found = torch.stack([(v * roi).sum(dim=(1, 2, 3)) for v in volumes]).double()
                if i < 2:
                    middle = d.shape[0] // 2
                    pictures[f"{exposure:g}s_{i}"] = torch.cat([truth[0, middle], volumes[0][0, middle]], dim=1).numpy()
                true = (truth * roi).sum(dim=(1, 2, 3))
                mean = found.mean(1)
                slopes.append(float((mean[0] - mean[1]) / (true[0] - true[1])))
                false.append(float(mean[1] - true[1]))
                variances.append(float(found.var(1).mean()))
                core = held.core[i] * hu
                ideal.append(1.0 / float((core * gram.apply(core)).sum() * exposure))
            slope = float(np.mean(slopes))
            ratio = np.array(ideal) * np.array(slope**2) / np.array(variances)
            efficiency = float(np.exp(np.mean(np.log(ratio))))
            tag = f"{exposure:g}s"
            figures[f"slope_{tag}"] = slope
            figures[f"slope_spread_{tag}"] = float(np.std(slopes))
            figures[f"false_hu_{tag}"] = float(np.mean(np.abs(false)))
            figures[f"sd_hu_{tag}"] = float(np.sqrt(np.mean(variances)))
            figures[f"efficiency_{tag}"] = efficiency
            # Beyond 0.95…1.05 a slope costs more than it can gain in variance.
            excess = max(abs(slope - 1.0) - 0.05, 0.0)
            scores.append(math.log(efficiency) - (excess / 0.05) ** 2 * 0.1)
        return Validation(float(np.mean(scores)), figures, pictures)
