"""
The kernels of FBP
==================
What does a sharper reconstruction kernel (the window on the ramp filter) cost in noise?
"""

import matplotlib.pyplot as plt
import numpy as np

import recon
from recon.analytic.ramp import apodization
from recon.names import KERNELS
from torchpcct import VolumeGrid, acquire
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

scene, plaque = plaque_scene()
inset = VolumeGrid((5, 45, 45), 0.2, plaque.position[::-1])
scan = acquire(
    scene, presets.pcct(views=492, rows=8), exposure_s=2.0, seed=0, region=inset, duty=1 / 4
)
volumes = {kernel: recon.reconstruct(scan, inset, "fbp", kernel=kernel) for kernel in KERNELS}
# rows of plain fat
noise = {kernel: float(volume.data[:, :10].std()) for kernel, volume in volumes.items()}
fig, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained", width_ratios=(1.3, 1, 1))
for kernel in KERNELS:
    f = np.linspace(0, 1, 101)
    axes[0].plot(f, f * apodization(kernel, f), label=f"{kernel}: {noise[kernel]:.0f} HU of noise")
axes[0].set(xlabel="frequency / Nyquist frequency", ylabel="ramp × window", ylim=(0, 1.8))
axes[0].legend(fontsize=8)
for ax, kernel in zip(axes[1:], ("soft", "bone"), strict=True):
    shown = ax.imshow(
        volumes[kernel].data[2],
        cmap="gray",
        vmin=-150,
        vmax=450,
        extent=(-4.5, 4.5) * 2,
        origin="lower",
    )
    ax.set(title=kernel, xlabel="x, mm", ylabel="y, mm")
fig.colorbar(shown, ax=axes[1:], label="HU", shrink=0.8)
print("noise in fat, HU:", {kernel: round(value) for kernel, value in noise.items()})
