"""
Penalised weighted least squares
================================
How much smoothing should the prior of PWLS (which weighs each reading by its photons) do?
"""

import matplotlib.pyplot as plt

import recon
from recon.least_squares.qggmrf import QGGMRF
from torchpcct import VolumeGrid, acquire
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

scene, plaque = plaque_scene(vessel_length=6.0)
inset = VolumeGrid((33, 39, 39), 0.2, plaque.position[::-1])
scan = acquire(
    scene, presets.pcct(views=492, rows=28), exposure_s=2.0, seed=0, region=inset, duty=1 / 4
)
volumes = {"FBP, soft": recon.reconstruct(scan, inset, "fbp", kernel="soft")}
for strength in (0.5, 2.0):
    # HU/mm: steeper slopes count as edges and are smoothed less
    prior = QGGMRF(strength=strength, threshold=300.0)
    volumes[f"strength {strength:g}"] = recon.reconstruct(scan, inset, "pwls", prior=prior)
fig, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
for ax, (name, volume) in zip(axes, volumes.items(), strict=True):
    noise, core = float(volume.data[:, :8].std()), float(volume.data[16, 18:21, 26:28].mean())
    shown = ax.imshow(
        volume.data[16], cmap="gray", vmin=-150, vmax=450, extent=(-3.9, 3.9) * 2, origin="lower"
    )
    ax.set(title=f"{name}: {noise:.0f} HU in fat", xlabel="x, mm", ylabel="y, mm")
    print(f"{name}: noise in fat {noise:.0f} HU, core {core:.0f} HU (truth about 41)")
fig.colorbar(shown, ax=axes, label="HU")
