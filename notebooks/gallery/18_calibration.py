"""
Geometry from the object itself
===============================
How far is the detector displaced and rolled, and what does the volume look like before and after?
"""

import matplotlib.pyplot as plt
import numpy as np
import torch

import recon
from torchpcct import ConeBeam, Projector, Scan, VectorGeometry, VolumeGrid, full_turn

# what the scanner's file says, and how the detector really stands
given = ConeBeam(full_turn(60), sod=40.0, sdd=80.0, columns=48, rows=32, pitch=0.6)
true = VectorGeometry.of(given.with_column_offset(0.5)).turned(roll=np.deg2rad(1.5))

# a tooth: dentine, pulp, enamel and two fillings, on voxels finer than those of the volume
fine = VolumeGrid((44, 52, 52), 0.18)
z, y, x = np.meshgrid(*fine.axes, indexing="ij")
tooth = np.where((x / 3.9) ** 2 + (y / 3.4) ** 2 + (z / 3.2) ** 2 < 1, 0.05, 0.0)
tooth[((x - 0.4) / 1.1) ** 2 + (y / 0.8) ** 2 + (z / 2.2) ** 2 < 1] = 0.02
for cx, cy, cz in ((-1.9, 1.2, 1.4), (1.7, -1.6, -1.0)):
    tooth[(x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2 < 0.6**2] = 0.12
lines = Projector(true, fine)(torch.from_numpy(tooth).float())
photons = 2e4
counts = torch.poisson(photons * torch.exp(-lines), generator=torch.Generator().manual_seed(0))
measured = -torch.log(counts.clamp_min(1.0) / photons)
scan = Scan.from_line_integrals(measured, given, photons=photons, mu_water=0.02)

grid = VolumeGrid((24, 30, 30), 0.32)
found = recon.calibrate(scan, grid, ["offset", "roll"])
print(found)

mended = Scan.from_line_integrals(measured, found.geometry, photons=photons, mu_water=0.02)
fig, axes = plt.subplots(1, 3, figsize=(10, 3.4), layout="constrained")
shown = VolumeGrid((1, 52, 52), 0.18, (1.4, 0.0, 0.0))
both = {"as the file says": scan, "calibrated": mended}
for ax, (name, s) in zip(axes, both.items(), strict=False):
    hu = recon.reconstruct(s, shown, "fbp").data[0]
    ax.imshow(hu, cmap="gray", vmin=-1000, vmax=4000, origin="lower", extent=(-4.7, 4.7) * 2)
    ax.set(title=name, xlabel="x, mm", ylabel="y, mm")
names = list(found.values)
axes[2].errorbar(
    names, list(found.values.values()), [2 * e for e in found.errors.values()], fmt="o", capsize=4
)
axes[2].plot(names, [0.5, 1.5], "x", ms=9, label="put in")
axes[2].set(title="found, ± 2 standard errors", ylabel="mm, °", ylim=(0, 2), xlim=(-0.5, 1.5))
axes[2].legend()
