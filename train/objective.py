"""What the training minimises, and how checkpoints are chosen.

A plain squared error teaches a network to shrink what it is unsure of: the error falls, the
contrast with it. So there are several terms, all from two independent noise draws of each scene
with errors e₁, e₂ in noise units:

* ``image``: ‖e‖² over that of the filtered view of the same data, so that scenes count alike: their
  squared errors differ by far more than one power of ten, and the largest would decide a step
  (``train/experiments.md``); more on both sides of edges, where blur and undershoot are, and in
  bodies, which are small beside what surrounds them; more again where tissue is constant, deep in
  wide bodies and outside of them: no contrast can be lost there, and noise that is shown is false;
* ``lesion_bias``: e₁ᵀe₂ per voxel where the scene holds a lesion, over the same. As the draws are
  independent, its mean is the squared bias, so κ trades variance against bias there: small and
  faint bodies, which are nothing beside the error of edges, are shown instead of smoothed away. In
  every voxel it would be the bias of strong edges that decides;
* ``noise_free``: ``image`` of the same scene without noise, where all that is left is blur and
  overshoot beside edges;
* ``contrast``: the errors d of ROI contrasts, small ones and that of a whole core, (d₁² + d₂²) / 2
  + κ d₁ d₂. The product of two draws is an unbiased estimate of the squared bias, so κ trades
  variance against bias.

Every scene has a random fidelity, so that one network serves all of them: from the least error,
which shrinks what it is unsure of, at fidelity 0, to the least bias at fidelity 1. The contrast's
weight and κ grow with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from recon.data_term import Quadratic
from recon.mbir.network import bilateral_prior
from recon.mbir.priors import Prior
from recon.mbir.unrolled import DEFAULT_FIDELITY, Views
from train.config import VALIDATED_AT_ONCE, ObjectiveConfig
from train.data import Batch, Data, spread

_LEAST_ERROR = 1e-4
"""Mean squared error of a filtered view, in noise units, that counts at least: of what is nearly
empty and without noise nothing is to be learned."""
_TAME_CONTRAST = 2.0
"""Squared errors of contrast beyond count less than their size."""
_NOISE_FREE_SHARE = 0.5
"""Share of the scenes that are seen without noise too; there that counts so many times more."""
_LEAST_CONTRAST_HU = 10.0
"""Contrasts below are none: what is read there is invented."""
_FAINT_HU = 150.0
"""Contrasts below are faint, of the validation."""
_FLAT_HU = 10.0
"""Spread of the truth about a voxel, in HU, that is called constant."""


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
    """Figures of a checkpoint on held-out scenes.

    Args:
        score: higher is better; selects the checkpoint.
        figures: at low and at high exposures, ``error`` (root mean square in bodies over that of
            the bilateral filter in the network's place), ``all`` (the same over whole volumes),
            ``slope`` of the cores' contrasts against the true ones, ``faint`` of all ROI contrasts
            below 150 HU, which large ones would hide, ``false_hu``, the mean size of contrasts
            where there is none.
        pictures: axial images in HU above the background, truth, volume and filter side by side.
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
        self._filtered: dict[int, Tensor] = {}

    def __call__(self, model: nn.Module, batch: Batch, progress: float = 0.0) -> Loss:
        """Loss of a batch; ``progress`` is the finished share of the training.

        Both draws of a scene have the same fidelity.
        """
        c, n = self.config, batch.size
        free = torch.nonzero((batch.lots[:, 1] < _NOISE_FREE_SHARE) & bool(c.noise_free))[:, 0]
        rows = torch.cat([torch.arange(2 * n, device=free.device), 2 * n + free])
        scene = rows % n
        fidelity = _between(c.fidelities, batch.lots[:, 0])

        def network(
            estimate: Tensor, towards: Tensor, condition: Tensor, smoothed: Tensor | None
        ) -> Tensor:
            seen = [None if v is None else batch.turned(v) for v in (estimate, towards, smoothed)]
            prior: Any = model.network
            made: Tensor = prior(seen[0], seen[1], condition, seen[2])
            return batch.unturned(made)

        problem, views = batch.volumes(rows)
        made: Tensor = model(
            problem,
            fidelity[scene],
            steps=1 if progress < self.single else None,
            views=views,
            prior=network,
        )
        truth = batch.truth[scene] / problem.unit_hu.reshape(-1, 1, 1, 1)
        error = made - truth
        places = c.edge * batch.edges + c.body * batch.bodies
        end = progress >= c.end_from
        if (c.flat or c.empty) and end:
            constant = spread(batch.truth) < _FLAT_HU
            places = places + constant * (c.flat * batch.bodies + c.empty * (1.0 - batch.bodies))
        counts = 1.0 + places[scene]
        _, towards, smoothed = views
        of_view = ((towards if smoothed is None else smoothed) - truth).square()
        measure = (of_view * counts).mean(dim=(1, 2, 3)).clamp_min(_LEAST_ERROR)
        image = c.image * (error.square() * counts).mean(dim=(1, 2, 3)) / measure
        total = 0.5 * image[: 2 * n].sum()
        parts = {"image": total / c.image}
        if c.lesion_bias != (0.0, 0.0) and end:
            there = counts[:n] * batch.lesions
            both = (error[:n] * error[n : 2 * n] * there).mean(dim=(1, 2, 3))
            bias = both / (measure[:n] * measure[n : 2 * n]).sqrt()
            total = total + c.image * (_between(c.lesion_bias, fidelity) * bias).sum()
            parts["lesion_bias"] = bias.sum()
        error = error[: 2 * n]
        # The noise of an ROI mean falls with its size, but less than as 1/√voxels: neighbours are
        # correlated.
        size = (20.0 / batch.voxels.clamp_min(4.0)).pow(0.25) * c.contrast_sd
        d = torch.einsum("dnzyx,nrzyx->dnr", error.unflatten(0, (2, n)), batch.contrast) / size
        variance, product = d.square().mean(0), d[0] * d[1]
        tame = 1.0 / (1.0 + variance.detach() / _TAME_CONTRAST)
        kappa = _between(c.contrast_bias, fidelity)[:, None]
        of_contrast = c.contrast_end if end and c.contrast_end is not None else c.contrast
        weight = of_contrast * (c.viewing + (1.0 - c.viewing) * fidelity)[:, None]
        total = total + (weight * tame * (variance + kappa * product)).sum()
        parts |= {"contrast": variance.sum(), "contrast_bias": product.sum()}
        if c.noise_free:
            of_free = image[2 * n :].sum()
            total = total + c.noise_free / _NOISE_FREE_SHARE * of_free
            parts["noise_free"] = of_free / c.image
        # All at once: on a GPU each number that is asked for waits for all that was asked before.
        values = torch.stack([v.detach() for v in parts.values()]).tolist()
        return Loss(total, dict(zip(parts, values, strict=True)))

    @torch.no_grad()
    def validate(self, model: nn.Module, held_out: Data) -> Validation:
        """Figures of the whole method at the usual fidelity on scenes that no training draws, one
        noise draw of each.

        Args:
            model: in evaluation mode.
            held_out: whose scenes are used, all of them.
        """
        rows: list[dict[str, float]] = []
        contrasts: list[list[tuple[float, float]]] = []
        pictures: dict[str, NDArray[np.float32]] = {}
        for step in range(held_out.batches_in_epoch(VALIDATED_AT_ONCE)):
            batch = held_out.batch(step, VALIDATED_AT_ONCE, range(VALIDATED_AT_ONCE))
            problem, views = batch.volumes(torch.arange(batch.size))
            scale = problem.unit_hu.reshape(-1, 1, 1, 1)

            def volume(
                prior: Prior | None, problem: Quadratic = problem, views: Views = views
            ) -> Tensor:
                # The filter has the views that are kept: those of one step.
                made: Tensor = model(
                    problem,
                    DEFAULT_FIDELITY,
                    steps=None if prior is None else 1,
                    views=views,
                    prior=prior,
                )
                return made

            if step not in self._filtered:
                self._filtered[step] = volume(bilateral_prior) * scale
            made, simple = volume(None) * scale, self._filtered[step]
            bodies = batch.bodies
            for i in range(batch.size):
                inside = bodies[i] > 0
                contrasts.append(
                    [
                        (float((batch.truth[i] * roi).sum()), float((made[i] * roi).sum()))
                        for roi in batch.contrast[i]
                    ]
                )
                errors = [(v[i] - batch.truth[i]).square() for v in (made, simple)]
                row = {"scale": float(problem.unit_hu[i])}
                for name, error in zip(("made", "simple"), errors, strict=True):
                    row[f"{name}_inside"] = (
                        float(error[inside].mean()) if inside.any() else math.nan
                    )
                    row[f"{name}_all"] = float(error.mean())
                row["true"], row["read"] = contrasts[-1][-1]
                row["has"] = float(batch.contrast[i, -1].any())
                rows.append(row)
            if step < 4:
                middle = made.shape[1] // 2
                pictures[f"held_out_{step}"] = (
                    torch.cat([v[0, middle] for v in (batch.truth, made, simple)], 1).cpu().numpy()
                )
        figures: dict[str, float] = {}
        scales = np.array([r["scale"] for r in rows])
        middle_scale = float(np.median(scales))
        score = 0.0
        for name, chosen in (("low", scales >= middle_scale), ("high", scales < middle_scale)):
            of = {k: np.array([r[k] for r in rows])[chosen] for k in rows[0]}
            for key, label, counts in (("inside", "error", 1.0), ("all", "all", 0.5)):
                ratio = np.log(of[f"made_{key}"] / of[f"simple_{key}"])
                ratio = ratio[np.isfinite(of[f"simple_{key}"])]  # of scenes that hold a body
                figures[f"{label}_{name}"] = (
                    float(np.exp(0.5 * ratio.mean())) if ratio.size else math.nan
                )
                if ratio.size:
                    score -= counts * math.log(figures[f"{label}_{name}"])
            has, real = of["has"] > 0, np.abs(of["true"]) > _LEAST_CONTRAST_HU
            both = has & real
            figures[f"slope_{name}"] = _slope(of["true"][both], of["read"][both])
            true, read = np.array(contrasts)[chosen].reshape(-1, 2).T
            faint = (np.abs(true) > _LEAST_CONTRAST_HU) & (np.abs(true) < _FAINT_HU)
            figures[f"faint_{name}"] = _slope(true[faint], read[faint])
            figures[f"false_hu_{name}"] = (
                float(np.abs(of["read"])[has & ~real].mean()) if (has & ~real).any() else 0.0
            )
        return Validation(score, figures, pictures)


def _between(ends: tuple[float, float], share: Tensor) -> Tensor:
    """From the first to the last, linear in the share."""
    first, last = ends
    return first + (last - first) * share


def _slope(true: NDArray[np.float64], read: NDArray[np.float64]) -> float:
    """Of what is read against what is true, through the origin; NaN of nothing."""
    return float((true * read).sum() / np.square(true).sum()) if true.size else math.nan
