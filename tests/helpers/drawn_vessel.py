"""A tilted vessel with a fibrous layer and a core, averaged over voxels by brute force, and its
noise-free data.

Data are projected from voxels of half the size: what is fitted must not share its painting."""

import functools
import math
from types import SimpleNamespace

import numpy as np
import torch
from inset_operators import HU, problem, term_of

from recon.data_term import Quadratic
from recon.gram.gram import Gram
from recon.mbir.mbir import Mbir
from recon.mbir.network import NetworkConfig
from recon.mbir.unrolled import Unrolled
from recon.vessel.data import in_hu
from torchpcct import Projector, VolumeGrid

VALUES = {"fat": -90.0, "wall": 50.0, "fibrous": 100.0, "lumen": 400.0}
TILT = 0.15
LUMEN_MM = 1.1
INNER_MM = 1.6
WALL_MM = 0.2
LUMEN_OFF = -0.3
CORE_OFF = 1.15
CORE_MM = (0.35, 0.8, 0.9)


HARD_AT = (0.75, 1.1)
HARD_MM = (0.25, 0.2, 0.6)


def labels(points, cores=(0.0,)):
    """0 fat, 1 wall, 2 fibrous, 3 lumen, 4 core, 5 calcification at points (z, y, x) about the
    inset's centre; the axis tilts in y, ``cores`` are positions along it in mm."""
    z, y, x = np.moveaxis(points, -1, 0)
    across, along = (y - TILT * z) / np.hypot(1, TILT), (z + TILT * y) / np.hypot(1, TILT)
    out = (np.hypot(across, x) < INNER_MM + WALL_MM).astype(int)
    out[np.hypot(across, x) < INNER_MM] = 2
    for middle in cores:
        core = (
            sum(
                (v / s) ** 2
                for v, s in zip((x - CORE_OFF, across, along - middle), CORE_MM, strict=True)
            )
            < 1
        )
        out[core & (out == 2)] = 4
    out[np.hypot(across, x - LUMEN_OFF) < LUMEN_MM] = 3
    off = (x - HARD_AT[0], across + HARD_AT[1], along - 1.0)
    hard = sum((v / s) ** 2 for v, s in zip(off, HARD_MM, strict=True)) < 1
    out[hard & (out == 2)] = 5
    return out


def image(grid, contrast, samples=5, hard=0.0, cores=(0.0,), **values):
    """``grid.shape`` HU; the core is ``contrast`` HU below the fibrous tissue, the calcification
    ``hard`` above it; ``values`` are of other tissues than :data:`VALUES`."""
    table = np.array(
        [*{**VALUES, **values}.values(), VALUES["fibrous"] - contrast, VALUES["fibrous"] + hard]
    )
    found = _shares(grid.shape, tuple(grid.spacing), samples, tuple(cores)) @ table
    return torch.from_numpy(found).float()


@functools.cache
def _shares(shape, spacing, samples, cores):
    """``(*shape, 6)`` of each of the :func:`labels` in a voxel, the grid's centre at 0.

    Kept: many tests look at the same vessel in other tissues.
    """
    axes = VolumeGrid(shape, spacing).axes
    sub = (np.arange(samples) + 0.5) / samples - 0.5
    out = np.zeros((math.prod(shape), 6))
    for dz in sub:
        for dy in sub:
            for dx in sub:
                shift = np.array([dz, dy, dx]) * spacing
                points = np.stack(
                    np.meshgrid(*(a + d for a, d in zip(axes, shift, strict=True)), indexing="ij"),
                    -1,
                )
                out[np.arange(len(out)), labels(points, cores).ravel()] += 1.0
    return out.reshape(*shape, 6) / samples**3


@functools.cache
def operator(shape=(26, 24, 24), voxel=0.3):
    """Gram operator of a scan in which a core stands out of the noise; its ``right_hand_side``
    takes ``finer`` voxels."""
    A, w = problem(views=120, shape=shape, voxel=voxel, rows=32)
    gram = Gram(A, w, 5).scaled(200.0)
    gram.finer = VolumeGrid(tuple(2 * n for n in shape), voxel / 2, A.grid.center)
    fine = Projector(A.geometry, gram.finer, A.window)
    gram.right_hand_side = lambda volume: A.T(200.0 * w * fine(volume))
    return gram


def data(gram, volume, seed=None):
    """The data term of a volume on ``gram.finer``, in HU; noise of the operator for a seed."""
    b = HU * gram.right_hand_side(volume)
    if seed is not None:
        b = b + gram.noise(generator=torch.Generator().manual_seed(seed))
    term = Quadratic(gram, b[None], torch.ones(1), gram.grid.spacing, 1000.0 * HU)
    return in_hu(term)


def inset():
    """What MBIR asks of an inset's problem."""
    gram = operator()
    return SimpleNamespace(gram=gram, grid=gram.grid, mu_ref=1000.0 * HU, level=910.0 * HU)


def right_hand_side(drawn, seen, seed, exposure_s=1.0):
    """The data term of HU on ``gram.finer`` in an :func:`inset`; noise of a seed, None: without
    noise."""
    noise = 0.0 if seed is None else drawn.gram.noise(generator=torch.Generator().manual_seed(seed))
    clean = drawn.gram.right_hand_side((seen / 1000.0 + 1.0) * drawn.mu_ref - drawn.level)
    b = (exposure_s * clean + exposure_s**0.5 * noise)[None]
    return term_of(drawn, b, exposure_s)


def untrained():
    """MBIR of an untrained network: the linear start, the data's low frequencies; nothing is put
    back."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = Unrolled(NetworkConfig((6, 8, 8), 0.3), 2)
    model.seen_scale_hu = torch.tensor([1.0, 5000.0])
    return Mbir(model, restore=False)
