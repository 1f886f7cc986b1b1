"""
A first scan
============
What do filtered backprojection (FBP) and model-based reconstruction (MBIR) make of the same
photons?
"""

import matplotlib.pyplot as plt

import recon
from torchpcct import VolumeGrid, acquire
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

# a vessel with a plaque in 24 cm of fat, as analytic bodies
scene, plaque = plaque_scene(vessel_length=6.0)
inset = VolumeGrid((33, 39, 39), 0.2, plaque.position[::-1])  # (z, y, x) voxels, mm, centre in mm
scan = acquire(
    scene, presets.pcct(views=492, rows=28), exposure_s=2.0, seed=0, region=inset, duty=1 / 4
)
volumes = {"FBP, soft": recon.reconstruct(scan, inset, "fbp", kernel="soft")}
volumes["MBIR"] = recon.reconstruct(scan, inset, "mbir")
fig, axes = plt.subplots(1, 2, figsize=(7.5, 3.4), layout="constrained", sharey=True)
for ax, (name, volume) in zip(axes, volumes.items(), strict=True):
    shown = ax.imshow(
        volume.data[16], cmap="gray", vmin=-150, vmax=450, origin="lower", extent=(-3.9, 3.9) * 2
    )
    ax.set(title=name, xlabel="x from the vessel, mm")
axes[0].set_ylabel("y from the vessel, mm")
fig.colorbar(shown, ax=axes, label="HU")
noise = {name: float(v.data[:, :8, :8].std()) for name, v in volumes.items()}  # a corner: plain fat
print("noise in the fat, HU:", {name: round(value, 1) for name, value in noise.items()})
