"""An off-centre inset of the deep-silicon scanner as an operator with weights, its dense matrix,
and a tissue in it."""

import math

import numpy as np
import torch

from recon.data_term import Quadratic
from torchpcct import ConeBeam, Projector, VolumeGrid
from torchpcct.detector_window import footprint
from torchpcct.geometry import full_turn

HU = 2e-5
CENTER = (0.0, -30.38, -29.63)


def problem(views=240, shape=(8, 13, 13), voxel=0.4, rows=10, dtype=torch.float32, window=True):
    """An off-centre inset of the deep-silicon scanner, with weights that change smoothly over
    views and columns."""
    geometry = ConeBeam(full_turn(views), 626.0, 1098.0, 1500, rows, (0.5, 0.35), detector="curved")
    grid = VolumeGrid(shape, voxel, CENTER)
    part = footprint(geometry, grid, margin=1)
    A = Projector(geometry, grid, part if window else None)
    gamma = (
        geometry.fan_angles[part.column_indices]
        if window
        else geometry.fan_angles[None].repeat(views, 0)
    )
    path = 2 * np.sqrt(120.0**2 - (626.0 * np.sin(np.clip(gamma, -0.17, 0.17))) ** 2)
    w = torch.from_numpy(115 * np.exp(0.0185 * (240 - path)))[:, None]
    return A, w.expand(A.range_shape).to(dtype).contiguous()


def term_of(inset, b, exposure_s=1.0):
    """The data term of b ``(batch, z, y, x)`` of an inset that is given by its attributes."""
    scale = torch.full((len(b),), exposure_s, dtype=torch.float64)
    return Quadratic(inset.gram, b, scale, inset.grid.spacing, inset.mu_ref, inset.level)


def matrix(operator, shape, dtype=torch.float64):
    n = math.prod(shape)
    return operator(torch.eye(n, dtype=dtype).reshape(n, *shape)).reshape(n, n)


def dense(A):
    """A as a float64 matrix, ``(readings, voxels)``."""
    n = math.prod(A.domain_shape)
    return A(torch.eye(n, dtype=torch.float64).reshape(n, *A.domain_shape)).reshape(n, -1).T


def minimum(H, b, bound, shape, step, start=None):
    """Of ½ xᵀHx − bᵀx and a prior, by float64 matrices: majorise and minimise until the steps are
    below ``step``.

    The energy is convex: a start near the end only saves time.
    """
    x = torch.zeros_like(b) if start is None else start.double().flatten()
    for _ in range(2000):
        at = x.reshape(1, *shape)
        R = matrix(lambda v, at=at: bound.majorizer(at.expand(len(v), *at.shape[1:]), v), shape)
        new = torch.linalg.solve(H + R, b)
        done = float((new - x).abs().max()) < step
        x = new
        if done:
            return x.reshape(shape)
    raise AssertionError("the reference did not converge")


def tissue(grid):
    _, y, x = np.meshgrid(
        *(a - c for a, c in zip(grid.axes, grid.center, strict=True)), indexing="ij"
    )
    tube = 160.0 * (np.hypot(y, x - 0.3) < 1.7) + 400.0 * (np.hypot(y, x + 0.4) < 1.0)
    return torch.from_numpy(tube * HU).float()
