"""
Evaluate my denoiser
====================
How much dose does *your* denoiser really save? (Here it is a Gaussian filter: quiet images, little
dose saved.)
"""

import matplotlib.pyplot as plt
import torch

from recon.evaluate import Task, denoiser, evaluate
from torchpcct import VolumeGrid
from torchpcct.scanner import presets
from torchpcct.scene import Body, Ellipsoid, EllipticCylinder, Scene


def mine(volume):
    """HU (z, y, x) in, the same shape out: put your network here."""
    k = torch.exp(-(torch.arange(-4, 5) ** 2) / (2 * 1.2**2))
    for size in ((9, 1, 1), (1, 9, 1), (1, 1, 9)):
        volume = torch.nn.functional.conv3d(
            volume[None], (k / k.sum()).reshape(1, 1, *size), padding="same"
        )[0]
    return volume


patient = Body("patient", EllipticCylinder(100.0), "water")
sphere = Body(
    "sphere", Ellipsoid((1.5, 1.5, 1.5), position=(30.0, 0.0, 0.0)), "necrotic_core", "patient"
)
inset = VolumeGrid((41, 45, 45), 0.2, (0.0, 0.0, 30.0))
task = Task("sphere_in_water", Scene([patient, sphere]), "sphere", presets.pcct(views=123), inset)
found = evaluate(task, [denoiser(mine, "fbp:standard", "mine")], exposures_s=[1.0], n=8)
rows = [r for r in found.records if r["method"] == "mine" and r["figure"].startswith("dose factor")]
rows = [r for r in rows if r["where"] in ("patient", "lesion")]
plt.figure(figsize=(7, 2.6), layout="constrained")
# 95 %; the limit is exact
spread = [[abs(r["value"] - r[end]) for r in rows] for end in ("low", "high")]
plt.barh(
    [r["figure"].removeprefix("dose factor: ") for r in rows],
    [r["value"] for r in rows],
    xerr=spread,
)
plt.gca().set(xlabel="dose factor: how many times the dose soft FBP needs for the same figure")
print({r["figure"]: (round(r["value"], 1), round(r["low"], 1), round(r["high"], 1)) for r in rows})
