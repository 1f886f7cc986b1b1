"""Picture of the comparison."""

from __future__ import annotations

from typing import Any

import torch

from recon.study.compare.measure import Measured
from recon.study.figures import extent
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.roi import axial_grid, sample_axial
from torchpcct.viz import Panel, panels

__all__ = ["sections_figure"]


def sections_figure(m: Measured) -> Any:
    """Axial and sagittal sections of one realisation at the largest exposure, the truth first, and without noise."""
    seen = m.evaluation.results[0]
    grid, dose = seen.task.grid, max(m.settings.exposures_s)
    image = axial_grid(grid.center)
    section = VolumeGrid((int(8.75 / image.spacing[1]), 1, image.shape[2]), image.spacing[1], image.center)
    columns: list[tuple[str, Any]] = [("truth", seen.truth)]
    for name in m.settings.methods:
        columns.append((name.replace("@", "\n@ "), seen.volumes[name, dose][0]))
    rows: list[list[Panel]] = [[], []]
    for title, volume in columns:
        hu = torch.as_tensor(volume).float()
        rows[0].append(Panel(sample_axial(hu, grid, image)[0], extent(image), title))
        rows[1].append(Panel(sample_axial(hu, grid, section)[:, 0], extent(section, 0, 2)))
    return panels(
        rows,
        ("axial", "sagittal (x–z)"),
        f"Plaque, deep-silicon PCCT, {dose:g} s, one realisation",
        f"C150 / W600 HU, voxels of {grid.spacing[0]:.2f} mm.",
    )
