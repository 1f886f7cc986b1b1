"""
Detectability
=============
Is a faint sphere seen? The observer's d′ (difference of its scores with and without sphere, in
units of their noise).
"""

import matplotlib.pyplot as plt
import torch

import recon
from torchpcct import VolumeGrid, acquire
from torchpcct.metrics import dog_channels, observe
from torchpcct.scanner import presets
from torchpcct.scene import Body, Ellipsoid, EllipticCylinder, Scene

water = Body("water", EllipticCylinder(100.0), "water")
sphere = Body(
    "sphere", Ellipsoid((1.5, 1.5, 1.5), position=(0.0, 40.0, 0.0)), "necrotic_core", "water"
)
grid = VolumeGrid((1, 40, 40), 0.25, (0.0, 40.0, 0.0))
clean = [
    acquire(Scene(b), presets.pcct(123, rows=1), region=grid, duty=1 / 16)
    for b in ([water, sphere], [water])
]
signal = [recon.reconstruct(c, grid, "fbp").data[0] for c in clean]
# FBP is linear: a faint sphere adds this to every image, and nothing to the noise
signal = signal[0] - signal[1]
exposures, found, images = (0.1, 0.3, 1.0), [], {}
for s in exposures:
    scans = [clean[1].with_noise(s, seed=k) for k in range(16)]
    absent = torch.stack([v.data[0] for v in recon.reconstruct(scans, grid, "fbp")])
    found.append(
        observe(absent + signal, absent, dog_channels(grid.slice, (40.0, 0.0), count=4)).estimate()
    )
    images[s] = absent[0] + signal
fig, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
for ax, s in zip(axes, (0.1, 1.0), strict=False):
    shown = ax.imshow(
        images[s], cmap="gray", vmin=-200, vmax=280, extent=(-5, 5, 35, 45), origin="lower"
    )
    ax.set(title=f"{s:g} s", xlabel="x, mm", ylabel="y, mm")
fig.colorbar(shown, ax=axes[:2], label="HU", shrink=0.8)
low, high = ([abs(e.value - end(e)) for e in found] for end in (lambda e: e.low, lambda e: e.high))
axes[2].errorbar(exposures, [e.value for e in found], (low, high), fmt="o-")
axes[2].set(xscale="log", xlabel="exposure, s", ylabel="d′ (bars: 95 %)")
print(
    "d′ at each exposure in s:",
    {s: round(e.value, 1) for s, e in zip(exposures, found, strict=True)},
)
