"""
Noise power spectrum
====================
How coarse is the noise? The noise power spectrum (NPS) says at which spatial frequencies it lies.
"""

import matplotlib.pyplot as plt
import torch

import recon
from torchpcct import VolumeGrid, acquire
from torchpcct.metrics import noise_power_spectrum
from torchpcct.scanner import presets
from torchpcct.scene.phantoms import water_cylinder

grid = VolumeGrid((1, 48, 48), 0.25, (0.0, 40.0, 0.0))
clean = acquire(water_cylinder(200.0), presets.pcct(views=246, rows=1), region=grid, duty=1 / 8)
# the same scan with other photons
scans = [clean.with_noise(exposure_s=2.0, seed=k) for k in range(16)]
fig, axes = plt.subplots(1, 3, figsize=(10, 3.1), layout="constrained")
for ax, kernel in zip(axes[1:], ("soft", "bone"), strict=True):
    slices = torch.stack([v.data[0] for v in recon.reconstruct(scans, grid, "fbp", kernel=kernel)])
    nps = noise_power_spectrum(slices, 0.25)
    f, power = nps.radial()
    axes[0].plot(f, power, label=f"{kernel}: {nps.variance**0.5:.0f} HU")
    noise = slices[0] - slices.mean(0)
    shown = ax.imshow(
        noise, cmap="gray", vmin=-200, vmax=200, extent=(-6, 6, 34, 46), origin="lower"
    )
    ax.set(title=f"noise, {kernel}", xlabel="x, mm", ylabel="y, mm")
    print(
        f"{kernel}: noise {nps.variance**0.5:.0f} HU, most of it near {f[power.argmax()]:.2f} "
        "line pairs per mm"
    )
axes[0].set(xlabel="line pairs per mm", ylabel="NPS, HU² mm²")
axes[0].legend()
fig.colorbar(shown, ax=axes[1:], label="HU", shrink=0.8)
