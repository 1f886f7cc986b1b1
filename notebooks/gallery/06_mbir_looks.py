"""
MBIR for looking and for measuring
==================================
What does the option ``fidelity`` of the learned reconstruction trade?
"""

import matplotlib.pyplot as plt

import recon
from recon.least_squares.inset_problem import InsetProblem
from torchpcct import VolumeGrid, acquire
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

scene, plaque = plaque_scene(vessel_length=6.0)
inset = VolumeGrid((33, 39, 39), 0.2, plaque.position[::-1])
scan = acquire(
    scene, presets.pcct(views=492, rows=28), exposure_s=0.7, seed=1, region=inset, duty=1 / 4
)
problem = InsetProblem(scan, inset)  # what both need of the data, computed once
volumes = {
    f: recon.reconstruct(scan, inset, "mbir", problem=problem, fidelity=f) for f in (0.0, 1.0)
}
fig, axes = plt.subplots(1, 2, figsize=(7.5, 3.4), layout="constrained")
for ax, (fidelity, volume) in zip(axes, volumes.items(), strict=True):
    noise = float(volume.data[:, :8].std())  # rows of plain fat
    shown = ax.imshow(
        volume.data[16], cmap="gray", vmin=-150, vmax=450, extent=(-3.9, 3.9) * 2, origin="lower"
    )
    ax.set(title=f"fidelity = {fidelity:g}: {noise:.0f} HU in fat", xlabel="x, mm", ylabel="y, mm")
    print(f"fidelity {fidelity:g}: noise in fat {noise:.1f} HU")
fig.colorbar(shown, ax=axes, label="HU")
print("what the training did not see:", volumes[0.0].report["warnings"] or "nothing")
