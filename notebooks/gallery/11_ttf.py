"""
Resolution of an edge
=====================
Which details survive? The task transfer function (TTF) of the edge of a rod, for two kernels.
"""

import matplotlib.pyplot as plt
import numpy as np

import recon
from torchpcct import VolumeGrid, acquire
from torchpcct.metrics import task_transfer
from torchpcct.scanner import presets
from torchpcct.scene import Body, EllipticCylinder, Scene

water = Body("water", EllipticCylinder(100.0), "water")
rod = Body("rod", EllipticCylinder(4.0, position=(0.0, 40.0, 0.0)), "fibrous_tissue", "water")
grid = VolumeGrid((1, 80, 80), 0.15, (0.0, 40.0, 0.0))
# without noise
scan = acquire(Scene([water, rod]), presets.pcct(views=492, rows=1), region=grid, duty=1 / 4)
y, x = np.meshgrid(*grid.axes[1:], indexing="ij")
distance = np.hypot(y - 40.0, x) - 4.0  # of every voxel from the rod's edge, mm
fig, axes = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")
for kernel in ("soft", "bone"):
    image = recon.reconstruct(scan, grid, "fbp", kernel=kernel).data[0]
    ttf = task_transfer(image, distance, (1.8, 1.8), 0.05)
    axes[0].plot(ttf.positions, ttf.profile, label=kernel)
    axes[1].plot(ttf.frequencies, ttf.values, label=f"{kernel}: half at {ttf.f50:.2f} lp/mm")
    print(f"{kernel}: TTF falls to a half at {ttf.f50:.2f} line pairs per mm")
axes[0].set(xlabel="distance from the edge, mm", ylabel="HU")
axes[1].set(xlabel="line pairs per mm", ylabel="TTF", xlim=(0, 2), ylim=(0, 1.2))
axes[1].legend()
