"""
The same scan at a quarter of its dose
======================================
How does noise grow when photons are taken out of a scan that exists?
"""

import matplotlib.pyplot as plt

import recon
from torchpcct import VolumeGrid, acquire
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

scene, plaque = plaque_scene()
inset = VolumeGrid((5, 45, 45), 0.2, plaque.position[::-1])
scan = acquire(
    scene, presets.pcct(views=492, rows=8), exposure_s=2.0, seed=0, region=inset, duty=1 / 4
)
# any scan of counts, measured ones too
scans = {1.0: scan} | {f: scan.at_dose(f, seed=1) for f in (0.5, 0.25, 0.125)}
volumes = {f: recon.reconstruct(s, inset, "fbp", kernel="soft") for f, s in scans.items()}
noise = {f: float(v.data[:, :8].std()) for f, v in volumes.items()}  # rows of plain fat
fig, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
for ax, f in zip(axes, (1.0, 0.25), strict=False):
    shown = ax.imshow(
        volumes[f].data[2], cmap="gray", vmin=-150, vmax=450, extent=(-4.5, 4.5) * 2, origin="lower"
    )
    ax.set(title=f"{f:g} of the dose", xlabel="x, mm", ylabel="y, mm")
fig.colorbar(shown, ax=axes[:2], label="HU")
axes[2].plot(list(noise), list(noise.values()), "o", label="measured in fat")
axes[2].plot(list(noise), [noise[1.0] / f**0.5 for f in noise], "--", label="dose to the power −½")
axes[2].set(xlabel="share of the dose", ylabel="noise, HU", ylim=(0, None))
axes[2].legend()
print("noise, HU:", {f: round(value, 1) for f, value in noise.items()})
