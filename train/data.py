"""Training data without a projector in the loop: random scenes, and the statistic AᵀW y drawn through Gram operators.

For a scene x and an exposure, β = H x + noise of covariance H is distributed as AᵀW y of a scan (up to the model error
of the Gram operator, see :mod:`recon.gram.gram`), so thousands of scans a minute cost a few FFTs. The Gram operators
are those of real scanners: several inset positions, patient sizes and pitches, each made when it is first asked for.

Scenes are painted on the CPU. All that follows is done for a whole batch on the device of the training.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.gram.gram import Gram
from recon.least_squares.inset_problem import InsetProblem
from recon.mbir.problem import NormalisedProblem
from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import VolumeGrid
from torchpcct.scanner import presets
from torchpcct.scene import Body, EllipticCylinder, Scene
from train.config import DataConfig, Situation
from train.scenes.drawing import draw_scene
from train.scenes.rasterise import rasterise
from train.scenes.scene import SceneConfig

__all__ = ["Batch", "Data", "painted", "seed_of", "situation_gram"]


def seed_of(*key: int | str) -> int:
    """A seed below 2⁶³ that depends on every part of the key and on their order."""
    text = ",".join(str(part) for part in key)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little") >> 1


ROIS = 3
"""Contrasts of each scene: two of small ROIs, one of a whole core."""
_DRAWS_OF_ROI, _OWN_DRAWS = 6, 7
"""Random numbers that a small ROI takes; those of a scene: three mirrors, an exchange, the exposure, two lots."""
_CORE, _AROUND = 1, 2
_WINDOW = 64
"""Draws of each scene of a batch that are at hand where they are used several times."""


@dataclass(frozen=True)
class Batch:
    """Scenes with two independent noise draws each.

    Args:
        with_noise_free: problem of ``3 · size`` volumes: the first draws of all scenes, the second ones, no noise.
        truth: ``(size, z, y, x)`` HU above the background.
        contrast: ``(size, rois, z, y, x)`` weights of ROI contrasts: mean over a core (or of plain tissue) less mean
            over the tissue around it, random small parts of both, last all of both; 0 where the scene offers none.
        voxels: ``(size, rois)`` voxels of the smaller ROI, 0 if none.
        lots: ``(size, 2)`` random numbers in 0 … 1 of each scene, for its fidelity and whether it is also seen without
            noise.
        kept: what has been made of the batch and does not change, as long as it is used.
    """

    with_noise_free: NormalisedProblem
    truth: Tensor
    contrast: Tensor
    voxels: Tensor
    lots: Tensor
    kept: dict[str, Any] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Number of scenes."""
        return self.truth.shape[0]

    @property
    def problem(self) -> NormalisedProblem:
        """Of the noisy volumes alone."""
        return self.with_noise_free.part(torch.arange(2 * self.size))


class Data:
    """Draws batches; a pure function of seed, step and scene index once the Gram operators are made.

    Scenes come from a pool and are kept once they are painted.

    Args:
        config: what is drawn.
        device: of the batches.
    """

    def __init__(self, config: DataConfig | None = None, device: torch.device | str = "cpu") -> None:
        self.config = config or DataConfig()
        self.device = torch.device(device)
        self._grams: dict[int, tuple[Gram, float]] = {}
        self._pool: dict[tuple[int, int], Tensor] = {}
        self._kept: dict[tuple[int, int, int], Batch] = {}

    def gram(self, situation: int) -> tuple[Gram, float]:
        """Gram operator per second of exposure, and 1 HU in mm⁻¹."""
        if situation not in self._grams:
            gram, hu = situation_gram(self.config.situations[situation], self.config)
            self._grams[situation] = gram.to(self.device), hu
        return self._grams[situation]

    def paint(self, seed: int, processes: int) -> None:
        """Paint the whole pool beforehand, by so many processes; else scenes are painted when they are first used."""
        make = partial(_as_array, self.config, seed)
        numbers = range(self.config.pool)
        make(0)  # compiles the kernels for all
        with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as workers:
            for number, maps in zip(numbers, workers.map(make, numbers, chunksize=16), strict=True):
                self._pool[seed, number] = torch.from_numpy(maps).to(self.device)

    def batches(self, seed: int, step: int, indices: Sequence[int]) -> list[Batch]:
        """Scenes ``indices`` of a step, all at once; one by one where draws are used several times.

        Then a scene is drawn out of :data:`_WINDOW` that move on by one in ``reuse`` steps.
        """
        reuse = self.config.reuse
        if reuse == 1:
            return [self.batch(seed, step, indices)]
        first = step // reuse
        self._kept = {key: batch for key, batch in self._kept.items() if key[1] >= first}
        found = []
        for index in indices:
            number = first + seed_of("window", seed, step, index) % _WINDOW
            if (seed, number, index) not in self._kept:
                self._kept[seed, number, index] = self.batch(seed, number, [index])
            found.append(self._kept[seed, number, index])
        return found

    def batch(self, seed: int, step: int, indices: Sequence[int]) -> Batch:
        """Scenes ``indices`` of a step.

        Args:
            seed: of the run.
            step: all scenes of a step share one Gram operator.
            indices: scenes of the step, any subset in any order.
        """
        c = self.config
        gram, hu = self.gram(seed_of(seed, step) % len(c.situations))
        own = [seed_of(seed, step, i) for i in indices]
        numbers = [o % c.pool for o in own]
        generators = [torch.Generator().manual_seed(o) for o in own]
        count = _OWN_DRAWS + (ROIS - 1) * _DRAWS_OF_ROI
        random = torch.stack([torch.rand(count, generator=g) for g in generators]).to(self.device)
        if self.device.type != "cpu":
            generators = [torch.Generator(self.device).manual_seed(o) for o in own]
        noise = gram.coloured(torch.stack([gram.white((2,), generator=g) for g in generators]))
        maps = _mirrored(torch.stack([self._scene(seed, n) for n in numbers]).float(), random[:, :4])
        truth, core, tissue = maps[:, 0], maps[:, 1] == _CORE, maps[:, 1] == _AROUND
        low, high = (math.log(v) for v in c.exposure_s)
        exposure = torch.exp(low + (high - low) * random[:, 4])
        found = [_random_contrasts(core, tissue, c, part) for part in random[:, _OWN_DRAWS:].split(_DRAWS_OF_ROI, 1)]
        found.append(_whole_contrasts(core, tissue))
        contrast, voxels = (torch.stack(v, 1) for v in zip(*found, strict=True))
        noise = noise * exposure.sqrt().reshape(-1, 1, 1, 1, 1)
        signal = gram.apply(truth) * (hu * exposure).reshape(-1, 1, 1, 1)
        b = torch.cat([signal + noise[:, 0], signal + noise[:, 1], signal])
        problem = NormalisedProblem.from_statistic(gram, b, exposure.repeat(3), hu, c.voxel_mm)
        return Batch(problem, truth, contrast, voxels, random[:, 5:7])

    def _scene(self, seed: int, number: int) -> Tensor:
        if (seed, number) not in self._pool:
            self._pool[seed, number] = painted(self.config, seed, number).to(self.device)
        return self._pool[seed, number]


def painted(config: DataConfig, seed: int, number: int) -> Tensor:
    """A scene of the pool, ``(2, z, y, x)`` float16: image in HU above the background, and a label.

    The label is 1 in voxels wholly in a core, 2 in those wholly in the tissue around, else 0.
    """
    generator = torch.Generator().manual_seed(seed_of("scene", seed, number))
    draw = float(torch.rand((), generator=generator))
    axis = 0 if draw < config.along_z else 1 if draw < 0.5 * (1 + config.along_z) else 2
    across, along = config.shape[axis], config.shape[0]
    shape = (across, *(along if k == axis else n for k, n in enumerate(config.shape) if k))
    # The extents of equal insets differ by rounding; without this so would positions drawn in them, in the last digit.
    z, y, x = (round(n * config.voxel_mm, 6) for n in shape)
    drawn = int(torch.randint(2**62, (), generator=generator))
    scene = draw_scene(drawn, (z, y, x), SceneConfig(**config.scenes))
    found = rasterise(scene, (shape[0], shape[1], shape[2]), (config.voxel_mm,) * 3)
    image, core, around = torch.from_numpy(found)
    maps = (image - scene.background, _CORE * (core > 0.97) + _AROUND * (around > 0.97))
    return torch.stack([m.transpose(0, axis).to(torch.float16) for m in maps])


def _as_array(config: DataConfig, seed: int, number: int) -> NDArray[np.float16]:
    # Tensors sent from another process would each hold a file open.
    return np.asarray(painted(config, seed, number).numpy())


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


# -- of a whole batch: masks ``(n, z, y, x)``, random numbers in 0 … 1 ``(n, k)`` -------------------------------------


def _chosen(which: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    """``yes`` of the scenes ``(n,)`` that ``which`` names, ``no`` of the others."""
    return torch.where(which.reshape(-1, *[1] * (yes.dim() - 1)), yes, no)


def _mirrored(maps: Tensor, random: Tensor) -> Tensor:
    """Maps ``(n, k, z, y, x)`` along every axis mirrored or not, with y and x exchanged or not."""
    for k, axis in enumerate((-3, -2, -1)):
        maps = _chosen(random[:, k] < 0.5, maps.flip(axis), maps)
    if maps.shape[-1] == maps.shape[-2]:
        maps = _chosen(random[:, 3] < 0.5, maps.transpose(-1, -2), maps)
    return maps


def _size(mask: Tensor) -> Tensor:
    return mask.flatten(1).sum(1)


def _contrasts(first: Tensor, second: Tensor, least: int) -> tuple[Tensor, Tensor]:
    """Mean over one mask less mean over the other, and the voxels of the smaller; 0 where one has too few."""
    n, m = _size(first), _size(second)
    enough = (n >= least) & (m >= least)
    one, other = (mask / size.clamp_min(1).reshape(-1, 1, 1, 1) for mask, size in ((first, n), (second, m)))
    return _chosen(enough, one - other, torch.zeros_like(one)), torch.minimum(n, m) * enough.float()


def _whole_contrasts(core: Tensor, tissue: Tensor) -> tuple[Tensor, Tensor]:
    """All of the core against all tissue in its slices."""
    return _contrasts(core, tissue & core.any(3).any(2)[:, :, None, None], 8)


def _random_contrasts(inside: Tensor, around: Tensor, config: DataConfig, random: Tensor) -> tuple[Tensor, Tensor]:
    """A random part of ``inside`` against one of ``around``."""
    flat, size, place, margin, other_size, other_place = random.unbind(1)
    inside = _chosen(inside.flatten(1).any(1), inside, around)
    first = _ball(inside, config.core_roi, config.voxel_mm, size, place) & inside
    # Where there is no core, both lie in the same tissue: voxels of both would cancel.
    around = around & ~first
    # The tissue next to the core is what the study's background ROI lies in, and hardest: half of all draws.
    near = around & _within(first, 0.7 + 0.5 * margin, config.voxel_mm)
    near = _chosen(near.flatten(1).any(1), near, around)
    second = _ball(near, config.tissue_roi, config.voxel_mm, other_size, other_place) & around
    flat = flat < config.flat_roi
    first, second = (_chosen(flat, _fullest_slice(m), m) for m in (first, second))
    return _contrasts(first, second, 4)


def _ball(mask: Tensor, radius_mm: tuple[float, float], voxel_mm: float, size: Tensor, place: Tensor) -> Tensor:
    """The voxels in a ball about a random voxel of ``mask``."""
    low, high = radius_mm
    reach = (low + (high - low) * size) / voxel_mm
    counted = mask.flatten(1).int().cumsum(1)
    wanted = (place * counted[:, -1]).int().clamp_max(counted[:, -1] - 1) + 1
    at = torch.searchsorted(counted, wanted[:, None].clamp_min(1))[:, 0].clamp_max(counted.shape[1] - 1)
    nz, ny, nx = mask.shape[1:]
    z, y, x = (
        (torch.arange(n, device=mask.device) - c[:, None]).square()
        for n, c in ((nz, at // (ny * nx)), (ny, at // nx % ny), (nx, at % nx))
    )
    apart = z[:, :, None, None] + y[:, None, :, None] + x[:, None, None, :]
    return apart <= reach.square().reshape(-1, 1, 1, 1)


def _fullest_slice(mask: Tensor) -> Tensor:
    """The mask in the slice that holds most of it, empty elsewhere."""
    fullest = mask.sum((2, 3)).argmax(1)
    here = torch.arange(mask.shape[1], device=mask.device) == fullest[:, None]
    return mask & here[:, :, None, None]


def _within(mask: Tensor, margin_mm: Tensor, voxel_mm: float) -> Tensor:
    """Voxels within a margin ``(n,)`` of the box that holds ``mask``."""
    reach = (margin_mm / voxel_mm).round()[:, None]
    out = torch.ones_like(mask)
    for axis in (1, 2, 3):
        some = mask.any(tuple(a for a in (1, 2, 3) if a != axis))
        at = torch.arange(some.shape[1], device=mask.device, dtype=reach.dtype)
        first = torch.where(some, at, torch.inf).amin(1, keepdim=True) - reach
        last = torch.where(some, at, -torch.inf).amax(1, keepdim=True) + reach
        shape = [1] * 4
        shape[0], shape[axis] = len(mask), -1
        out &= ((at >= first) & (at <= last)).reshape(shape)
    return out
