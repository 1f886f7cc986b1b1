"""
A vessel that moved during the turn
===================================
Where was the vessel in every view, how sure is that, and what does the volume look like once that
is known?
"""

import matplotlib.pyplot as plt
import numpy as np

import recon
from recon.analytic.inset import view_motion
from torchpcct import VolumeGrid, acquire
from torchpcct.scanner import presets
from torchpcct.scene import Body, Scene, SinusoidalMotion
from torchpcct.scene.bodies import Ellipsoid, EllipticCylinder

x, y, turn_s = -18.0, -12.0, 0.35
inset = VolumeGrid((9, 20, 20), 0.4, (0.0, y, x))
patient = Body("patient", EllipticCylinder(40.0), "pericoronary_fat")
vessel = Body("vessel", Ellipsoid((1.2,) * 3, position=(x, y, 0.0)), "blood_iodine", "patient")
beat = SinusoidalMotion("vessel", 1.2, rate_bpm=70.0, direction=0.4)
scanner = presets.pcct(views=60, rows=16, columns=500)
scene = Scene([patient, vessel], beat)
# 60 views as short as those of a scan of 2000
scan = acquire(scene, scanner, region=inset, rotation_s=turn_s, duty=0.03, sub_rays=16)
scan = scan.with_noise(30.0, 0)

blurred = recon.reconstruct(scan, inset, "fbp")
still = recon.reconstruct(scan, inset, "fbp", motion="estimate")
motion = still.report["motion"]
path, errors = np.array(motion["path_mm"]), np.array(motion["errors_mm"])
true = view_motion(beat, scan.geometry, turn_s)
true -= true.mean(0)
off = np.sqrt(((path - true) ** 2).sum(1).mean())
print(f"moved by {motion['rms_mm']:.2f} mm, root mean square; the path is wrong by {off:.3f} mm")

fig, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
for ax, (name, v) in zip(axes, {"as it is": blurred, "path found": still}.items(), strict=False):
    ax.imshow(v.data[4], cmap="gray", vmin=-200, vmax=500, origin="lower")
    ax.set(title=name, xticks=[], yticks=[])
for axis, name in ((2, "x"), (1, "y"), (0, "z")):
    axes[2].errorbar(range(60), path[:, axis], 2 * errors[:, axis], label=f"{name}, ± 2 errors")
axes[2].plot(true[:, 1:], "k--", lw=0.8)
axes[2].set(title="displacement (dashed: true)", xlabel="view", ylabel="mm")
axes[2].legend(fontsize=7)
