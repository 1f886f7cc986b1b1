"""
DICOM-CT-PD
===========
How are the projections of a clinical scanner read (the format of the public low-dose CT data)?
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from pydicom import Dataset, FileMetaDataset

import recon
from torchpcct import VolumeGrid
from torchpcct.formats.scans import open_scan

# fan angles of 256 columns of 2 mm
folder, gamma = Path(tempfile.mkdtemp()), (np.arange(256) - 127.5) * 2 / 1085.6
tags = {
    0x70291002: ("FL", 2.0),
    0x70291006: ("FL", 2.0),
    0x7029100B: ("CS", "CYLINDRICAL"),
    0x70291010: ("US", 4),
}
tags |= {
    0x70291011: ("US", 256),
    0x70311002: ("FL", 0.0),
    0x70311003: ("FL", 595.0),
    0x70311031: ("FL", 1085.6),
}
tags |= {
    0x70311033: ("FL", [128.5, 2.5]),
    0x7033100E: ("CS", "FFSNONE"),
    0x70411001: ("DS", "0.02"),
}
# a simulated scanner: 20 cm of water, a file a view
for k, phi in enumerate(2 * np.pi * np.arange(240) / 240):
    # of each ray, from the middle of the water at x = 30 mm
    across = 595 * np.sin(gamma) - 30 * np.cos(phi + gamma)
    path = 0.04 * np.sqrt(np.clip(100**2 - across**2, 0, None))
    d = Dataset()
    d.preamble = bytes(128)
    d.file_meta, d.InstanceNumber, d.Rows, d.Columns = FileMetaDataset(), k + 1, 256, 4
    d.file_meta.TransferSyntaxUID, d.RescaleSlope, d.RescaleIntercept = (
        "1.2.840.10008.1.2.1",
        "0.0001",
        "0",
    )
    d.SamplesPerPixel, d.PhotometricInterpretation, d.PixelRepresentation = 1, "MONOCHROME2", 0
    d.BitsAllocated, d.BitsStored, d.HighBit = 16, 16, 15
    for tag, (vr, value) in {**tags, 0x70311001: ("FL", phi)}.items():
        d.add_new(tag, vr, value)
    d.PixelData = np.repeat(path[:, None] / 0.0001, 4, 1).astype("<u2").tobytes()
    d.save_as(folder / f"{k:04d}.dcm", implicit_vr=False, little_endian=True)

volume = recon.reconstruct(open_scan(folder), VolumeGrid((2, 150, 150), 2.0), "fbp")
plt.figure(figsize=(4.6, 3.6), layout="constrained")
plt.imshow(volume.data[1], cmap="gray", vmin=-200, vmax=200, extent=(-150, 150) * 2, origin="lower")
plt.colorbar(label="HU")
plt.gca().set(xlabel="x, mm", ylabel="y, mm", title="20 cm of water, its middle at x = 30 mm")
print(f"water reads {float(volume.data[1, 60:90, 80:110].mean()):.1f} HU")
