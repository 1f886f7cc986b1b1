"""
Tissues instead of voxels
=========================
What is known of a vessel if its tissues, and not voxels, are the unknowns?
"""

import matplotlib.pyplot as plt

from recon.least_squares.inset_problem import InsetProblem
from recon.vessel import read_plaque
from torchpcct import VolumeGrid, acquire
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

scene, plaque = plaque_scene(vessel_length=6.0)
inset = VolumeGrid((37, 45, 45), 0.2, plaque.position[::-1])
scan = acquire(
    scene, presets.pcct(views=492, rows=32), exposure_s=2.0, seed=0, region=inset, duty=1 / 4
)
# blind; or a point that a reader gives
reading = read_plaque(InsetProblem(scan, inset).term(scan))
fig, axes = plt.subplots(1, 2, figsize=(7.5, 3.4), layout="constrained")
shown = axes[0].imshow(
    reading.image[18], cmap="gray", vmin=-150, vmax=450, extent=(-4.5, 4.5) * 2, origin="lower"
)
fig.colorbar(shown, ax=axes[0], label="HU, fitted tissues", shrink=0.8)
core = reading.regions["core"][18]
shown = axes[1].imshow(core, cmap="viridis", vmin=0, vmax=1, extent=(-4.5, 4.5) * 2, origin="lower")
fig.colorbar(shown, ax=axes[1], label="share of the voxel that is core", shrink=0.8)
for ax in axes:
    ax.set(xlabel="x, mm", ylabel="y, mm")
print(f"probability of a core: {reading.presence:.3f}")
for name, figure in reading.figures.items():
    print(f"{name}: {figure.value:.4g} [{figure.low:.4g}, {figure.high:.4g}] {figure.unit}")
