"""
With deepinv
============
Do the solvers of deepinv (a library of learned inverse problems) take a scanner of this package?
"""

import importlib.util

import matplotlib.pyplot as plt
import torch

from torchpcct import FanBeam, Projector, VolumeGrid, full_turn

A = Projector(FanBeam(full_turn(60), 400.0, 800.0, 129, 2.0), VolumeGrid((64, 64), 2.0))
y, x = (torch.as_tensor(a, dtype=torch.float32) for a in A.grid.axes)
truth = 0.02 * (torch.hypot(x, y[:, None]) < 40) + 0.01 * (torch.hypot(x - 15, y[:, None]) < 10)
data = (A(truth) + 0.02 * torch.randn(A.range_shape))[None, None]
if importlib.util.find_spec("deepinv") is None:
    print('Skipped: deepinv is not installed; pip install "torchpcct[interop]" brings it.')
else:
    physics = A.as_deepinv()
    volume = physics.A_dagger(data, max_iter=15)[0, 0]  # deepinv's own least squares
    error = float((volume - truth).square().mean().sqrt()) / 0.02 * 1000
    plt.figure(figsize=(4.6, 3.6), layout="constrained")
    plt.imshow(
        volume * 50000 - 1000,
        cmap="gray",
        extent=(-64, 64) * 2,
        origin="lower",
        vmin=-1000,
        vmax=800,
    )
    plt.colorbar(label="HU")
    plt.gca().set(xlabel="x, mm", ylabel="y, mm", title="least squares by deepinv")
    print(f"deepinv's least squares, 60 views: error {error:.0f} HU (root mean square)")
