"""Pictures of the comparison."""

from __future__ import annotations

from typing import Any

import torch

from recon.study.compare.measure import Measured
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
    reference = m.grids[REFERENCE_VOXEL_MM]
    columns = [(f"noise free\n{REFERENCE_KERNEL} {REFERENCE_VOXEL_MM:.2f} mm", m.noise_free_image, reference)]
    columns += [(f"FBP {k}\n{voxel:.2f} mm", m.images[k, voxel], m.grids[voxel]) for k in s.kernels]
    if m.evaluation is not None:
        seen, dose = m.evaluation.seen[0], paper.table_exposure(s.doses)
        grid = seen.task.grid
        shown = [name for name in s.methods if (name, dose) in seen.volumes]
        columns += [(f"{name.replace('@', chr(10))}\n{grid.spacing[0]:.2f} mm",
                     torch.from_numpy(seen.volumes[name, dose][0]).float(), grid) for name in shown]  # fmt: skip
    z, y, x = image.center
    pixel = image.spacing[1]
    section = VolumeGrid((int(8.75 / pixel), 1, image.shape[2]), pixel, (z, y, x))
    rows: list[list[Panel]] = [[], []]
    for title, volume, grid in columns:
        axial = sample_axial(volume, grid, image)[0]
        rows[0].append(Panel(axial, extent(image), title, () if rows[0] else roi_outlines(m.rois)))
        rows[1].append(Panel(sample_axial(volume, grid, section)[:, 0], extent(section, 0, 2)))
    return panels(
        rows,
        ("axial", "sagittal (x–z)"),
        f"Plaque, deep-silicon PCCT, {paper.table_exposure(s.doses):g} s, one realisation",
        "C150 / W600 HU. ROI outlines: necrotic core (blue), fibrous tissue (red).",
    )
