"""Training data without a projector in the loop: random scenes, and the right-hand side AᵀW y drawn
through Gram operators.

For a scene x and an exposure, β = H x + noise of covariance H is distributed as AᵀW y of a scan (up
to the model error of the Gram operator, see :mod:`recon.gram.gram`), so thousands of scans a minute
cost a few FFTs. The Gram operators are those of real scanners: several inset positions, patient
sizes and pitches, each made when it is first asked for.

What the network sees of a scan, its *views*, does not depend on any weight. It is computed when a
scene is first used, kept in a file (:class:`Views`) in half precision, and read from there in every
later epoch, mirrored and turned at random. A scene has one exposure, two independent noise draws
and one volume without noise.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.format import open_memmap
from numpy.typing import NDArray
from torch import Tensor

from recon.data_term import Quadratic
from recon.least_squares.inset_problem import InsetProblem
from recon.mbir.network import extremes_nearby, largest_nearby
from recon.mbir.unrolled import Views as NetworkViews
from recon.mbir.unrolled import first_views
from torchpcct.acquisition.acquire import acquire
from torchpcct.files import atomic_write
from torchpcct.geometry import VolumeGrid
from torchpcct.scanner import presets
from torchpcct.scene import Body, EllipticCylinder, Scene
from train.config import OF_ROIS, DataConfig, Situation
from train.scenes.drawing import draw_scene
from train.scenes.rasterise import rasterise
from train.scenes.scene import SceneConfig

__all__ = ["Data"]


def seed_of(*key: int | str) -> int:
    """A seed below 2⁶³ that depends on every part of the key and on their order."""
    text = ",".join(str(part) for part in key)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little") >> 1


ROIS = 3
"""Contrasts of each scene: two of small ROIs, one of a whole core."""
VOLUMES = 3
"""Of each scene: two noise draws and one volume without noise."""
BODY_HU = 15.0
"""What differs by more from the background is a body; where values differ by more there is an
edge."""
FORMAT = "torchpcct training views 2"
"""What kept views say of themselves."""
_REACH = 2
"""Voxels about one in which the truth is constant, or an edge."""
_LEAST_VOXELS = 8
"""Of a whole core, for its contrast."""
_DRAWS_OF_ROI = 6
"""Random numbers that a small ROI takes."""
_SIGNAL = 1
"""Bit of a scene's labels: wholly in the signal."""
_AROUND = 2
"""Bit of a scene's labels: wholly in the tissue around it."""
_EDGE = 4
"""Bit of a scene's labels: near an edge."""
_BODY = 8
"""Bit of a scene's labels: in or near a body."""
_LESION = 16
"""Bit of a scene's labels: what is no vessel, tissue or stent shows there."""
_LESION_HU = 5.0
"""By how much it differs there from the scene without."""
_PIECE = 64
"""Scenes that a process paints before it gives them back."""
_LEFT_FREE = 0.4
"""Of a GPU's memory: where less is free, no more scenes are held there."""
_TURNS = 16
"""Mirror images along three axes, with y and x exchanged or not."""


@dataclass(frozen=True)
class Sample:
    """One scene as it is kept.

    Args:
        views: ``(3, 4, z, y, x)`` float16: of every volume start, step towards the data, its
            filtered view, and β, all in noise units.
        truth: ``(z, y, x)`` float16, HU above the background.
        labels: ``(z, y, x)`` uint8.
        exposure: s.
    """

    views: Tensor
    truth: Tensor
    labels: Tensor
    exposure: float

    def to(self, device: torch.device | str) -> Sample:
        """The same on a device."""
        return Sample(
            self.views.to(device), self.truth.to(device), self.labels.to(device), self.exposure
        )


@dataclass(frozen=True)
class Batch:
    """Scenes with two independent noise draws each.

    Args:
        problem: of ``3 · size`` volumes: the first draws of all scenes, the second ones, no noise.
        views: of the problem, :func:`recon.mbir.unrolled.first_views`.
        truth: ``(size, z, y, x)`` HU above the background.
        edges, bodies, lesions: ``(size, z, y, x)``, 1 near edges of the truth, in bodies and one
            voxel about them, and where a lesion is seen, else 0.
        contrast: ``(size, rois, z, y, x)`` weights of ROI contrasts: mean over a core (or of plain
            tissue) less mean over the tissue around it, random small parts of both, last all of
            both; 0 where the scene offers none.
        voxels: ``(size, rois)`` voxels of the smaller ROI, 0 if none.
        lots: ``(size, 2)`` random numbers in 0 … 1 of each scene, for its fidelity and whether it
            is also seen without noise.
        turned: a volume as the network shall see it, mirrored; unturned: the inverse.
    """

    problem: Quadratic
    views: NetworkViews
    truth: Tensor
    edges: Tensor
    bodies: Tensor
    lesions: Tensor
    contrast: Tensor
    voxels: Tensor
    lots: Tensor
    turned: Callable[[Tensor], Tensor]
    unturned: Callable[[Tensor], Tensor]

    @property
    def size(self) -> int:
        """Number of scenes."""
        return self.truth.shape[0]

    def volumes(self, rows: Tensor) -> tuple[Quadratic, NetworkViews]:
        """Problem and views of some of the ``3 · size`` volumes."""
        first, towards, smoothed = (None if v is None else v[rows] for v in self.views)
        assert first is not None
        assert towards is not None
        return self.problem.part(rows), (first, towards, smoothed)


class Views:
    """A file of samples: each is written when it has been computed, and says so.

    Several processes may use one folder. Files are made at their full length, so that a disk that
    is too small is noticed at the start. They are found by a digest of all that the samples depend
    on.

    Args:
        folder: of the files, made if missing.
        config: of the samples; seed: of the run.

    Raises:
        OSError: the folder cannot be written, or the disk has no room; the message says how much is
            needed.
    """

    def __init__(self, folder: Path, config: DataConfig, seed: int) -> None:
        data = {k: v for k, v in asdict(config).items() if k not in OF_ROIS}
        key = json.dumps({"format": FORMAT, "seed": seed, "data": data}, sort_keys=True)
        digest = hashlib.sha256(key.encode()).hexdigest()[:16]
        self.folder = folder / digest
        self.folder.mkdir(parents=True, exist_ok=True)
        shape = tuple(config.shape)
        n = config.scenes_kept
        kinds = {
            "views": ((n, VOLUMES, 4, *shape), np.float16),
            "truth": ((n, *shape), np.float16),
            "labels": ((n, *shape), np.uint8),
            "exposure": ((n,), np.float32),
            "done": ((n,), np.uint8),
        }
        self._arrays = {name: self._open(name, *kind) for name, kind in kinds.items()}
        if not (self.folder / "config.json").exists():
            with atomic_write(self.folder / "config.json") as part:
                part.write_text(key, encoding="utf-8")

    def _open(self, name: str, shape: tuple[int, ...], kind: type) -> np.memmap:
        path = self.folder / f"{name}.npy"
        if not path.exists():
            size = math.prod(shape) * np.dtype(kind).itemsize
            part = path.with_name(f"{name}.{os.getpid()}.part")
            try:
                open_memmap(part, mode="w+", dtype=kind, shape=shape).flush()
                with part.open("r+b") as file:
                    os.posix_fallocate(file.fileno(), 0, part.stat().st_size)
                # Another process may have been faster: its file is the one that counts.
                os.link(part, path)
            except FileExistsError:
                pass
            except OSError as error:
                if error.errno != errno.ENOSPC:
                    raise
                text = (
                    f"no room for {size / 1e9:.1f} GB of views in {self.folder}: name another "
                    "folder with --views"
                )
                raise OSError(errno.ENOSPC, text + ", or a smaller data.scenes_kept") from error
            finally:
                part.unlink(missing_ok=True)
        found = np.load(path, mmap_mode="r+", allow_pickle=False)
        if found.shape != shape or found.dtype != kind:
            raise ValueError(
                f"{path} is damaged: it holds {found.dtype} of shape {found.shape}; remove the "
                "folder"
            )
        return found

    def __len__(self) -> int:
        return len(self._arrays["done"])

    def __contains__(self, number: int) -> bool:
        return bool(self._arrays["done"][number])

    def __getitem__(self, number: int) -> Sample:
        views, truth, labels = (
            torch.from_numpy(self._arrays[k][number]) for k in ("views", "truth", "labels")
        )
        return Sample(views, truth, labels, float(self._arrays["exposure"][number]))

    def __setitem__(self, number: int, sample: Sample) -> None:
        arrays = self._arrays
        arrays["views"][number] = sample.views.numpy()
        arrays["truth"][number] = sample.truth.numpy()
        arrays["labels"][number] = sample.labels.numpy()
        arrays["exposure"][number] = sample.exposure
        arrays["done"][number] = 1


class Data:
    """Batches of scenes; a pure function of seed, step and scene index.

    Args:
        config: what is drawn.
        seed: of the run.
        device: of the batches.
        folder: of the views.
    """

    def __init__(
        self, config: DataConfig, seed: int, folder: Path, device: torch.device | str = "cpu"
    ) -> None:
        self.config = config
        self.seed = seed
        self.device = torch.device(device)
        self._accelerated = self.device.type != "cpu"
        self.views = Views(folder, config, seed)
        self._epoch: tuple[tuple[int, int], list[list[int]]] = (-1, 0), []
        self._terms: dict[int, Quadratic] = {}
        self._on_device: dict[int, Sample] = {}

    def term(self, situation: int) -> Quadratic:
        """The data term of a situation, empty, of a scan of 1 s; its operator is a Gram."""
        if situation not in self._terms:
            term = situation_term(self.config.situations[situation], self.config)
            gram: Any = term.operator
            self._terms[situation] = replace(term, operator=gram.to(self.device))
        return self._terms[situation]

    def prepare(self, processes: int) -> None:
        """Compute all views beforehand; else they are computed when a scene is first used.

        Args:
            processes: that paint the scenes. Without a GPU they compute the views, too; a GPU does
                that by itself.
        """
        numbers = [n for n in range(len(self.views)) if n not in self.views]
        # All scenes of a situation in one process: each makes its Gram operator once.
        numbers.sort(key=self._situation)
        pieces = [numbers[k : k + _PIECE] for k in range(0, len(numbers), _PIECE)]
        with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as workers:
            if not self._accelerated:
                make = partial(_compute_views, self.config, self.seed, self.views.folder.parent)
                for _ in workers.map(make, pieces):
                    pass
                return
            paintings = workers.map(partial(_paint, self.config, self.seed), pieces)
            for piece, painting in zip(pieces, paintings, strict=True):
                for number, scene in zip(piece, painting, strict=True):
                    self._keep(number, self._seen(number, *(torch.from_numpy(v) for v in scene)))

    def _situation(self, number: int) -> int:
        return number % len(self.config.situations)

    def sample(self, number: int) -> Sample:
        """A scene of the pool, from the file or computed and kept there; on a GPU it stays while
        there is room."""
        if number in self._on_device:
            return self._on_device[number]
        if number not in self.views:
            return self._keep(
                number,
                self._seen(number, *painted(self.config, seed_of("scene", self.seed, number))),
            )
        sample = self.views[number]
        return sample if not self._accelerated else self._hold(number, sample.to(self.device))

    def _keep(self, number: int, sample: Sample) -> Sample:
        self.views[number] = sample.to("cpu")
        # What comes out of the file is what every later epoch sees.
        return self.views[number] if not self._accelerated else self._hold(number, sample)

    def _hold(self, number: int, sample: Sample) -> Sample:
        free, total = torch.cuda.mem_get_info(self.device)
        if free > _LEFT_FREE * total:
            self._on_device[number] = sample
        return sample

    @torch.no_grad()
    def _seen(self, number: int, data: Tensor, truth: Tensor, labels: Tensor) -> Sample:
        """The views of a scene as :func:`painted` gives it."""
        c = self.config
        empty = self.term(self._situation(number))
        gram: Any = empty.operator
        generator = torch.Generator().manual_seed(seed_of("sample", self.seed, number))
        low, high = (math.log(v) for v in c.exposure_s)
        exposure = math.exp(low + (high - low) * float(torch.rand((), generator=generator)))
        noise = gram.noise((2,), generator=generator) * math.sqrt(exposure)
        signal = gram.apply(data.to(self.device))[None] * (empty.mu_per_hu * exposure)
        b = torch.cat([signal + noise, signal])
        exposures = torch.full((VOLUMES,), exposure, device=self.device)
        problem = replace(empty, b=b, scale=exposures).in_noise_units()
        found = first_views(problem, bilateral=True)
        views = torch.stack([*(v for v in found if v is not None), problem.b], 1)
        return Sample(views.to(torch.float16), truth.to(torch.float16), labels, exposure).to(
            self.device
        )

    def batches_in_epoch(self, batch: int) -> int:
        """Batches of an epoch; scenes that fill none are left out of it."""
        kinds = len(self.config.situations)
        return sum(len(range(k, len(self.views), kinds)) // batch for k in range(kinds))

    def numbers(self, step: int, batch: int) -> list[int]:
        """The scenes of a step, all of one situation; an epoch takes every scene once, in an
        order of its own."""
        epoch, index = divmod(step, self.batches_in_epoch(batch))
        if self._epoch[0] != (epoch, batch):
            rng = np.random.default_rng(seed_of("epoch", self.seed, epoch))
            kinds = len(self.config.situations)
            found = []
            for kind in range(kinds):
                order = rng.permutation(np.arange(kind, len(self.views), kinds)).tolist()
                found += [order[k : k + batch] for k in range(0, len(order) - batch + 1, batch)]
            self._epoch = (epoch, batch), [found[k] for k in rng.permutation(len(found))]
        return self._epoch[1][index]

    def batch(self, step: int, batch: int, indices: Sequence[int]) -> Batch:
        """Scenes ``indices`` of a step.

        Args:
            step: all scenes of a step share one Gram operator, and one orientation.
            batch: scenes of the whole step.
            indices: of it, any subset in any order.
        """
        c = self.config
        numbers = self.numbers(step, batch)
        empty = self.term(self._situation(numbers[0]))
        samples = [self.sample(numbers[i]) for i in indices]
        generators = [
            torch.Generator().manual_seed(seed_of("step", self.seed, step, i)) for i in indices
        ]
        random = torch.stack(
            [torch.rand(2 + (ROIS - 1) * _DRAWS_OF_ROI, generator=g) for g in generators]
        )
        random = random.to(self.device)
        # ``(volume, scene)`` is the order of a batch: the first draws of all scenes, the second
        # ones, no noise.
        views = torch.stack([s.views for s in samples], 1).float().flatten(0, 1)
        truth = torch.stack([s.truth for s in samples]).float()
        labels = torch.stack([s.labels for s in samples])
        exposure = torch.tensor([s.exposure for s in samples], device=self.device).repeat(VOLUMES)
        # b was kept in noise units.
        problem = replace(empty, b=views[:, 3], scale=exposure).in_noise_units()
        problem = replace(problem, b=views[:, 3])
        signal, around = labels & _SIGNAL > 0, labels & _AROUND > 0
        signal = _inner(signal, c.roi_margin)
        found = [
            _random_contrasts(signal, around, c, part)
            for part in random[:, 2:].split(_DRAWS_OF_ROI, 1)
        ]
        found.append(_whole_contrasts(signal, around))
        contrast, voxels = (torch.stack(v, 1) for v in zip(*found, strict=True))
        return Batch(
            problem,
            (views[:, 0], views[:, 1], views[:, 2]),
            truth,
            (labels & _EDGE > 0).float(),
            (labels & _BODY > 0).float(),
            (labels & _LESION > 0).float(),
            contrast,
            voxels,
            random[:, :2],
            *turn(seed_of("turn", self.seed, step) % _TURNS, truth.shape[-1] == truth.shape[-2]),
        )


class InTurn:
    """Two sources of scenes, one after the other.

    Args:
        first: until the step ``begins``.
        late: from then on.
        begins: that step.
    """

    def __init__(self, first: Data, late: Data, begins: int) -> None:
        self.first, self.late, self.begins = first, late, begins

    def prepare(self, processes: int) -> None:
        """Compute all views of both beforehand (:meth:`Data.prepare`)."""
        self.first.prepare(processes)
        self.late.prepare(processes)

    def batch(self, step: int, batch: int, indices: Sequence[int]) -> Batch:
        """Scenes of a step of the whole training (:meth:`Data.batch`)."""
        if step < self.begins:
            return self.first.batch(step, batch, indices)
        return self.late.batch(step - self.begins, batch, indices)


def _compute_views(config: DataConfig, seed: int, folder: Path, numbers: Sequence[int]) -> None:
    """Paint scenes and keep their views, in a process of its own."""
    data = Data(config, seed, folder)
    for number in numbers:
        data.sample(number)


def _paint(
    config: DataConfig, seed: int, numbers: Sequence[int]
) -> list[list[NDArray[np.generic]]]:
    """Scenes for another process, which computes their views."""
    return [
        [v.numpy() for v in painted(config, seed_of("scene", seed, number))] for number in numbers
    ]


def turn(
    number: int, square: bool
) -> tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]]:
    """One of the mirror images along three axes, y and x exchanged or not (``square``), and its
    inverse."""
    axes = [axis for k, axis in enumerate((-3, -2, -1)) if number >> k & 1]
    exchanged = square and bool(number >> 3)

    def there(v: Tensor) -> Tensor:
        v = v.flip(axes)
        return v.transpose(-1, -2) if exchanged else v

    def back(v: Tensor) -> Tensor:
        return (v.transpose(-1, -2) if exchanged else v).flip(axes)

    return there, back


def painted(config: DataConfig, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """A random scene, ``(z, y, x)`` each: what a scan holds of it and the truth, HU above the
    background; labels."""
    nz, ny, nx = config.shape
    z, y, x = (round(n * config.voxel_mm, 6) for n in (nz, ny, nx))
    scene = draw_scene(seed, (z, y, x), SceneConfig(**config.scenes))
    found = rasterise(scene, (nz, ny, nx), config.voxel_mm)
    truth = torch.from_numpy(found.image) - scene.background
    signal, around = torch.from_numpy(found.signal) > 0.97, torch.from_numpy(found.around) > 0.97
    healthy = rasterise(scene.without_lesions(), (nz, ny, nx), config.voxel_mm)
    lesions = torch.from_numpy(np.abs(found.image - healthy.image)) > _LESION_HU
    labels = _SIGNAL * signal + _AROUND * around + _LESION * lesions
    labels = labels + _EDGE * _edges(truth) + _BODY * _bodies(truth)
    return torch.from_numpy(found.data) - scene.background, truth, labels.to(torch.uint8)


def _bodies(truth: Tensor) -> Tensor:
    """Bodies and one voxel about them, of ``(z, y, x)``."""
    return largest_nearby(truth.abs(), 1) > BODY_HU


def _edges(truth: Tensor) -> Tensor:
    """Where values about a voxel differ by more than that of a body, of ``(z, y, x)``."""
    return spread(truth) > BODY_HU


def spread(truth: Tensor) -> Tensor:
    """Highest less lowest value in the cube of five voxels about each, of ``(..., z, y, x)``."""
    highest, lowest = extremes_nearby(truth, _REACH)
    return highest - lowest


def situation_term(situation: Situation, config: DataConfig) -> Quadratic:
    """The data term of the training inset in one situation, empty, of a scan of 1 s."""
    scanner = presets.pcct(views=config.views)
    g = scanner.geometry
    scanner = replace(
        scanner, geometry=replace(g, pitch=tuple(p * situation.pitch_scale for p in g.pitch))
    )
    patient = Scene(
        (Body("patient", EllipticCylinder(situation.patient_mm / 2), "pericoronary_fat"),)
    )
    grid = VolumeGrid(config.shape, config.voxel_mm, (0.0, situation.y, situation.x))
    clean = acquire(patient, scanner, region=grid)
    problem = InsetProblem(clean, grid, nodes=1)
    b = torch.zeros(1, *config.shape)
    return Quadratic(problem.gram, b, torch.ones(1), (config.voxel_mm,) * 3, problem.mu_ref)


# -- of a whole batch: masks ``(n, z, y, x)``, random numbers in 0 … 1 ``(n, k)`` ------------------


def _chosen(which: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    """``yes`` of the scenes ``(n,)`` that ``which`` names, ``no`` of the others."""
    return torch.where(which.reshape(-1, *[1] * (yes.dim() - 1)), yes, no)


def _size(mask: Tensor) -> Tensor:
    return mask.flatten(1).sum(1)


def _inner(mask: Tensor, margin: int) -> Tensor:
    """As much of the mask as lies ``margin`` voxels within it, or as deep as leaves enough."""
    for _ in range(margin):
        within = largest_nearby((~mask).float(), 1) == 0.0
        mask = _chosen(_size(within) >= _LEAST_VOXELS, within, mask)
    return mask


def _contrasts(first: Tensor, second: Tensor, least: int) -> tuple[Tensor, Tensor]:
    """Mean over one mask less mean over the other, and the voxels of the smaller; 0 where one
    has too few."""
    n, m = _size(first), _size(second)
    enough = (n >= least) & (m >= least)
    one, other = (
        mask / size.clamp_min(1).reshape(-1, 1, 1, 1) for mask, size in ((first, n), (second, m))
    )
    return _chosen(enough, one - other, torch.zeros_like(one)), torch.minimum(n, m) * enough.float()


def _whole_contrasts(core: Tensor, tissue: Tensor) -> tuple[Tensor, Tensor]:
    """All of the core against all tissue in its slices."""
    return _contrasts(core, tissue & core.any(3).any(2)[:, :, None, None], _LEAST_VOXELS)


def _random_contrasts(
    inside: Tensor, around: Tensor, config: DataConfig, random: Tensor
) -> tuple[Tensor, Tensor]:
    """A random part of ``inside`` against one of ``around``."""
    flat, size, place, margin, other_size, other_place = random.unbind(1)
    inside = _chosen(inside.flatten(1).any(1), inside, around)
    first = _ball(inside, config.core_roi, config.voxel_mm, size, place) & inside
    # Where there is no core, both lie in the same tissue: voxels of both would cancel.
    around = around & ~first
    # The tissue next to the core is what the study's background ROI lies in, and hardest: half of
    # all draws.
    near = around & _within(first, 0.7 + 0.5 * margin, config.voxel_mm)
    near = _chosen(near.flatten(1).any(1), near, around)
    second = _ball(near, config.tissue_roi, config.voxel_mm, other_size, other_place) & around
    flat = flat < config.flat_roi
    first, second = (_chosen(flat, _fullest_slice(m), m) for m in (first, second))
    return _contrasts(first, second, 4)


def _ball(
    mask: Tensor, radius_mm: tuple[float, float], voxel_mm: float, size: Tensor, place: Tensor
) -> Tensor:
    """The voxels in a ball about a random voxel of ``mask``."""
    low, high = radius_mm
    reach = (low + (high - low) * size) / voxel_mm
    counted = mask.flatten(1).int().cumsum(1)
    wanted = (place * counted[:, -1]).int().clamp_max(counted[:, -1] - 1) + 1
    at = torch.searchsorted(counted, wanted[:, None].clamp_min(1))[:, 0].clamp_max(
        counted.shape[1] - 1
    )
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
