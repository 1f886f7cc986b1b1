"""
Your own stack of TIFF files
============================
How does a folder of TIFF projections become a DICOM series in HU?
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import tifffile

import recon
from torchpcct import VolumeGrid
from torchpcct.formats.scans import open_scan

work, rng, u = Path(tempfile.mkdtemp()), np.random.default_rng(0), np.arange(128) - 63.5
# a simulated camera: water with a pin
for k, angle in enumerate(np.linspace(0, np.pi, 180, endpoint=False)):
    lengths = [
        2 * np.sqrt(np.clip(r**2 - (u - at) ** 2, 0, None))
        for r, at in ((40, 0), (5, -20 * np.sin(angle)))
    ]
    tifffile.imwrite(
        work / f"p{k:04d}.tif",
        rng.poisson(20000 * np.exp(-0.02 * sum(lengths)), (4, 128)).astype("u2"),
    )
(
    work / "scan.yaml"
).write_text("""{readings: "p*.tif", kind: counts, air: 20000, mu_water: 0.02, geometry:
  {kind: parallel, angles_deg: {start: 0, step: 1, count: 180}, columns: 128, pitch: 1.0}}""")

volume = recon.reconstruct(open_scan(work / "scan.yaml"), VolumeGrid((4, 100, 100), 1.0), "fbp")
# no ending: a folder with a DICOM series; .nii.gz, .mha and .h5 are single files
volume.save(work / "dicom")
plt.figure(figsize=(4.6, 3.6), layout="constrained")
plt.imshow(
    volume.data[2], cmap="gray", vmin=-1000, vmax=1500, origin="lower", extent=(-50, 50, -50, 50)
)
plt.colorbar(label="HU")
plt.gca().set(xlabel="x, mm", ylabel="y, mm", title="water, and a pin of twice its attenuation")
water = float(volume.data[:, 60:70, 40:60].mean())
print(f"{len(list((work / 'dicom').iterdir()))} DICOM files; water reads {water:.1f} HU")
