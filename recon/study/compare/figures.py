"""Pictures of the comparison."""

from __future__ import annotations

from typing import Any

from recon.study.compare.measure import MBIR, PWLS, PWLS_VOXEL_MM, Measured
from recon.study.figures import extent, roi_outlines
from recon.study.paper import facts as paper
from recon.study.paper.plaque_scan import REFERENCE_KERNEL, REFERENCE_VOXEL_MM
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.roi import sample_axial
from torchpcct.viz import Panel, panels

__all__ = ["sections_figure"]


def sections_figure(m: Measured) -> Any:
    """Axial and longitudinal sections of one realisation at the tables' dose, per kernel and method."""
    s, image = m.settings, m.rois.image
    voxel = 0.25 if 0.25 in s.voxels_mm else s.voxels_mm[0]
    columns = [("noise free\nstandard 0.10 mm", ("noise free", REFERENCE_KERNEL, REFERENCE_VOXEL_MM))]
    columns += [(f"FBP {kernel}\n{voxel:.2f} mm", ("fbp", kernel, voxel)) for kernel in s.kernels]
    columns.append((f"PWLS {PWLS[1]}\n{PWLS_VOXEL_MM:.2f} mm", (*PWLS, PWLS_VOXEL_MM)))
    for key in m.images:
        if key[0] == MBIR[0]:
            columns.append((f"MBIR\n{key[2]:.2f} mm", key))
        elif key[0] == "mbir absent":
            columns.append(("MBIR, no core,\nthe same noise", key))
    z, y, x = image.center
    pixel = image.spacing[1]
    section = VolumeGrid((int(8.75 / pixel), 1, image.shape[2]), pixel, (z, y, x))
    rows: list[list[Panel]] = [[], []]
    for title, key in columns:
        if key not in m.images:
            continue
        volume, grid = m.images[key], m.grids[key[2]]
        axial = sample_axial(volume, grid, image)[0]
        rows[0].append(Panel(axial, extent(image), title, () if rows[0] else roi_outlines(m.rois)))
        rows[1].append(Panel(sample_axial(volume, grid, section)[:, 0], extent(section, 0, 2)))
    return panels(
        rows,
        ("axial", "sagittal (x–z)"),
        f"Plaque, deep-silicon PCCT, {paper.table_exposure(s.doses):g} s, one realisation",
        "C150 / W600 HU. ROI outlines: necrotic core (blue), fibrous tissue (red).",
    )
