"""CT numbers of 4 mm rods of each tissue at the plaque's place (:mod:`recon.study.paper.plaque_scan`)."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpcct.geometry import VolumeGrid
from torchpcct.scene import Scene

__all__ = ["ROD_HU", "true_volume"]

ROD_HU = {"fat": -92.65, "wall": 63.53, "fibrous": 103.22, "lumen": 479.97, "core": 41.07}


def true_volume(scene: Scene, grid: VolumeGrid) -> tuple[Tensor, Tensor]:
    """Of a plaque in its patient of fat: volume-weighted CT numbers ``grid.shape``, and the voxels of the vessel."""
    values = {**ROD_HU, "patient": ROD_HU["fat"]}
    true = torch.from_numpy(scene.render(grid, {name: values[name] for name in scene.names})).float()
    return true, true > ROD_HU["fat"] + 10.0
