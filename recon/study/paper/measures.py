"""What the studies of resolution and motion read off the protocol's axial image: lumen, cap and core."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.plaque_measures import PlaqueSegmentation, basin_depth, cap_on_line, dice, segment_plaque
from torchpcct.metrics.roi import axial_grid
from torchpcct.scene import Scene
from torchpcct.scene.plaque import Plaque

__all__ = ["PlaqueImage", "Truth", "measure_plaque"]


@dataclass(frozen=True, eq=False)
class Truth:
    """The plaque as it is, on the protocol's axial image through its middle.

    Attributes:
        image: the axial image, ``(1, y, x)``.
        masks: ``"lumen"`` and ``"core"`` → ``(y, x)`` bool, where they are.
        line: ``(y, x)`` mm of the lumen's and of the core's centre: the line on which the cap is measured.
    """

    image: VolumeGrid
    masks: dict[str, NDArray[np.bool_]]
    line: tuple[tuple[float, float], tuple[float, float]]

    @classmethod
    def of(cls, scene: Scene, plaque: Plaque) -> Truth:
        """Of a scene at rest and its plaque."""
        image = axial_grid(plaque.position[::-1])
        labels = scene.labels(image)[0]
        x, y, _, _ = (float(v) for v in plaque.section("lumen", 0.0))
        lumen, core = plaque.to_scanner((x, y, 0.0)), plaque.to_scanner(plaque.core_center)
        return cls(
            image,
            {name: labels == scene.index(name) for name in ("lumen", "core")},
            ((float(lumen[1]), float(lumen[0])), (float(core[1]), float(core[0]))),
        )


@dataclass(frozen=True, eq=False)
class PlaqueImage:
    """Measures of one axial image.

    Attributes:
        image: ``(y, x)`` HU.
        segmentation: of it.
        cap_line: cap thickness in mm on the line from the lumen's to the core's centre; NaN where there is no lumen.
        depth: of the core's basin, HU (:func:`torchpcct.metrics.plaque_measures.basin_depth`).
        lumen_dice, core_dice: overlap of the segmented regions with the true ones.
    """

    image: Tensor
    segmentation: PlaqueSegmentation
    cap_line: float
    depth: float
    lumen_dice: float
    core_dice: float

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        s = self.segmentation
        return {
            "lumen_mm2": s.lumen_area,
            "core_found": s.core_found,
            "core_mm2": s.core_area,
            "cap_line_mm": self.cap_line,
            "lumen_dice": self.lumen_dice,
            "core_dice": self.core_dice,
            "basin_depth_hu": self.depth,
        }


def measure_plaque(image: Tensor, truth: Truth) -> PlaqueImage:
    """Segment and measure an axial image ``(y, x)`` HU on ``truth.image``."""
    found = segment_plaque(image, truth.image)
    return PlaqueImage(
        image,
        found,
        cap_on_line(image, truth.image, *truth.line),
        basin_depth(image, truth.image, truth.masks["core"]),
        dice(found.lumen, truth.masks["lumen"]),
        dice(found.core, truth.masks["core"]),
    )
