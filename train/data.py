"""Training data without a projector in the loop: random scenes, and the statistic AᵀW y drawn through Gram operators.

For a scene x and an exposure, β = H x + noise of covariance H is distributed as AᵀW y of a scan (up to the model error
of the Gram operator, see :mod:`recon.gram.gram`), so thousands of scans a minute cost a few FFTs. The Gram operators
are those of real scanners: several inset positions, patient sizes and pitches, each made when it is first asked for.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from recon.gram.gram import Gram
from recon.least_squares.inset_problem import InsetProblem
from recon.mbir.problem import NormalisedProblem
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.scanner import presets
from torchpcct.scene import Body, EllipticCylinder, Scene
from train.config import DataConfig, Situation
from train.scenes.rasterise import random_scene
from train.scenes.scene import SceneConfig

__all__ = ["Batch", "Data", "seed_of", "situation_gram"]


def seed_of(*key: int | str) -> int:
    """A seed below 2⁶³ that depends on every part of the key and on their order."""
    text = ",".join(str(part) for part in key)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little") >> 1


ROIS = 3
"""Contrasts of each scene: two of small ROIs, one of a whole core."""


@dataclass(frozen=True)
class Batch:
    """Scenes with two independent noise draws each.

    Args:
        problem: of ``2 · size`` volumes, the first draws of all scenes, then the second ones.
        with_noise_free: the same with ``size`` volumes without noise after them.
        truth: ``(size, z, y, x)`` HU above the background.
        contrast: ``(size, rois, z, y, x)`` weights of ROI contrasts: mean over a core (or of plain tissue) less mean
            over the tissue around it, random small parts of both, last all of both; 0 where the scene offers none.
        voxels: ``(size, rois)`` voxels of the smaller ROI, 0 if none.
    """

    problem: NormalisedProblem
    with_noise_free: NormalisedProblem
    truth: Tensor
    contrast: Tensor
    voxels: Tensor

    @property
    def size(self) -> int:
        """Number of scenes."""
        return self.truth.shape[0]


class Data:
    """Draws batches; a pure function of seed, step and scene index once the Gram operators are made.

    Scenes come from a pool and are kept once they are drawn.
    """

    def __init__(self, config: DataConfig | None = None) -> None:
        self.config = config or DataConfig()
        self.scenes = SceneConfig(**self.config.scenes)
        self._grams: dict[int, tuple[Gram, float]] = {}
        self._pool: dict[tuple[int, int], tuple[Tensor, Tensor, Tensor]] = {}

    def gram(self, situation: int) -> tuple[Gram, float]:
        """Gram operator per second of exposure, and 1 HU in mm⁻¹."""
        if situation not in self._grams:
            self._grams[situation] = situation_gram(self.config.situations[situation], self.config)
        return self._grams[situation]

    def batch(self, seed: int, step: int, indices: Sequence[int]) -> Batch:
        """Scenes ``indices`` of a step.

        Args:
            seed: of the run.
            step: all scenes of a step share one Gram operator.
            indices: scenes of the step, any subset in any order.
        """
        c = self.config
        gram, hu = self.gram(seed_of(seed, step) % len(c.situations))
        drawn = [self._drawn(seed, step, i, gram) for i in indices]
        truth, exposure, contrast, voxels, first, second = (torch.stack(list(v)) for v in zip(*drawn, strict=True))
        scaled = (hu * exposure).reshape(-1, 1, 1, 1)
        signal = gram.apply(truth) * scaled
        b = torch.cat([signal + first, signal + second, signal])
        noisy, all_three = (
            NormalisedProblem.from_statistic(gram, b[: k * len(signal)], exposure.repeat(k), hu, c.voxel_mm)
            for k in (2, 3)
        )
        return Batch(noisy, all_three, truth, contrast, voxels)

    def _drawn(self, seed: int, step: int, index: int, gram: Gram) -> tuple[Tensor, ...]:
        c = self.config
        own = seed_of(seed, step, index)
        generator = torch.Generator().manual_seed(own)
        maps = _mirrored(self._scene(seed, own % c.pool), generator)
        low, high = (math.log(v) for v in c.exposure_s)
        exposure = torch.exp(low + (high - low) * torch.rand((), generator=generator))
        noise = gram.noise((2,), generator=generator) * exposure.sqrt()
        core, tissue = maps[1] > 0, maps[2] > 0
        found = [_random_contrast(core, tissue, c, generator) for _ in range(ROIS - 1)]
        found.append(_whole_contrast(core, tissue))
        contrast, voxels = (torch.stack(v) for v in zip(*found, strict=True))
        return maps[0], exposure, contrast, voxels, noise[0], noise[1]

    def _scene(self, seed: int, number: int) -> tuple[Tensor, Tensor, Tensor]:
        """Image in HU above the background; voxels wholly in a core, and wholly in the tissue around."""
        if (seed, number) not in self._pool:
            c = self.config
            generator = torch.Generator().manual_seed(seed_of("scene", seed, number))
            draw = float(torch.rand((), generator=generator))
            axis = 0 if draw < c.along_z else 1 if draw < 0.5 * (1 + c.along_z) else 2
            across, along = c.shape[axis], c.shape[0]
            shape = (across, *(along if k == axis else n for k, n in enumerate(c.shape) if k))
            scene = random_scene(
                (shape[0], shape[1], shape[2]), (c.voxel_mm,) * 3, generator=generator, config=self.scenes
            )
            maps = (scene.image[0] - scene.scenes[0].background, scene.core[0] > 0.97, scene.surround[0] > 0.97)
            z, y, x = (m.transpose(0, axis).contiguous() for m in maps)
            self._pool[seed, number] = (z.to(torch.float16), y, x)
        return self._pool[seed, number]


def _mirrored(maps: tuple[Tensor, Tensor, Tensor], generator: torch.Generator) -> list[Tensor]:
    """The maps as float32, along every axis mirrored or not, with y and x exchanged or not."""
    flips = [axis for axis in range(3) if float(torch.rand((), generator=generator)) < 0.5]
    exchange = float(torch.rand((), generator=generator)) < 0.5 and maps[0].shape[1] == maps[0].shape[2]
    out = [m.float().flip(flips) for m in maps]
    return [m.transpose(1, 2).contiguous() for m in out] if exchange else out


def _whole_contrast(core: Tensor, tissue: Tensor) -> tuple[Tensor, Tensor]:
    """Mean over all of the core less mean over all tissue in its slices."""
    tissue = tissue & core.any(2).any(1)[:, None, None]
    n, m = int(core.sum()), int(tissue.sum())
    if n < 8 or m < 8:
        return torch.zeros(core.shape), torch.zeros(())
    return core.float() / n - tissue.float() / m, torch.tensor(float(min(n, m)))


def situation_gram(situation: Situation, config: DataConfig) -> tuple[Gram, float]:
    """The Gram operator of the training inset in one situation, per second of exposure, and 1 HU in mm⁻¹."""
    scanner = presets.pcct(views=config.views)
    g = scanner.geometry
    scanner = replace(scanner, geometry=replace(g, pitch=tuple(p * situation.pitch_scale for p in g.pitch)))
    patient = Scene((Body("patient", EllipticCylinder(situation.patient_mm / 2), "pericoronary_fat"),))
    grid = VolumeGrid(config.shape, config.voxel_mm, (0.0, situation.y, situation.x))
    clean = acquire(patient, scanner, region=grid)
    problem = InsetProblem(clean, grid, nodes=1)
    return problem.gram, problem.mu_ref / 1000.0


def _random_contrast(
    inside: Tensor, around: Tensor, config: DataConfig, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Weights of a random ROI contrast between two masks, and the voxels of its smaller ROI."""
    if not inside.any():
        inside = around
    flat = float(torch.rand((), generator=generator)) < config.flat_roi
    first = _ball(inside, config.core_roi, config.voxel_mm, generator, inside)
    # Where there is no core, both lie in the same tissue: voxels of both would cancel.
    around = around & ~first
    # The tissue next to the core is what the study's background ROI lies in, and hardest: half of all draws.
    margin = 0.7 + 0.5 * float(torch.rand((), generator=generator))
    near = around & _within(first, margin, config.voxel_mm)
    second = _ball(near if near.any() else around, config.tissue_roi, config.voxel_mm, generator, around)
    if flat:
        first, second = _fullest_slice(first), _fullest_slice(second)
    n, m = int(first.sum()), int(second.sum())
    if n < 4 or m < 4:
        return torch.zeros(inside.shape), torch.zeros(())
    return first.float() / n - second.float() / m, torch.tensor(float(min(n, m)))


def _ball(
    mask: Tensor, radius_mm: tuple[float, float], voxel_mm: float, generator: torch.Generator, within: Tensor
) -> Tensor:
    """The voxels of ``within`` in a ball about a random voxel of ``mask``."""
    places = torch.nonzero(mask)
    low, high = radius_mm
    radius = low + (high - low) * float(torch.rand((), generator=generator))
    draw = torch.rand((), generator=generator)
    if len(places) == 0:
        return torch.zeros_like(mask)
    centre = places[min(int(draw * len(places)), len(places) - 1)]
    z, y, x = (torch.arange(n) - int(c) for n, c in zip(mask.shape, centre, strict=True))
    near = z[:, None, None] ** 2 + y[:, None] ** 2 + x**2 <= (radius / voxel_mm) ** 2
    return near & within


def _fullest_slice(mask: Tensor) -> Tensor:
    """The mask in the slice that holds most of it, empty elsewhere."""
    out = torch.zeros_like(mask)
    z = int(mask.sum(dim=(1, 2)).argmax())
    out[z] = mask[z]
    return out


def _within(ball: Tensor, margin_mm: float, voxel_mm: float) -> Tensor:
    """Voxels within ``margin_mm`` of the box that holds ``ball``."""
    places = torch.nonzero(ball)
    if len(places) == 0:
        return torch.ones_like(ball)
    out = torch.zeros_like(ball)
    reach = round(margin_mm / voxel_mm)
    low, high = places.amin(0) - reach, places.amax(0) + reach + 1
    out[tuple(slice(max(int(a), 0), int(b)) for a, b in zip(low, high, strict=True))] = True
    return out
