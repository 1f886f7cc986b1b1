"""What one image of the motion study yields, measured where the vessel is at rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from recon.study.resolution.blur import centers, truth
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.placement import RoiPair, place_rois
from torchpcct.metrics.plaque_measures import PlaqueSegmentation, basin_depth, cap_on_line, dice, segment_plaque
from torchpcct.metrics.roi import axial_grid, sample_axial

if TYPE_CHECKING:
    from torchpcct.scene import Scene
    from torchpcct.scene.plaque import Plaque

__all__ = ["Observed", "Reference", "observe"]


@dataclass(frozen=True, eq=False)
class Reference:
    """Where things are at rest: the protocol's axial image, the true masks on it, the line of the cap, the ROIs."""

    image: VolumeGrid
    masks: dict[str, NDArray[np.bool_]]
    line: tuple[tuple[float, float], tuple[float, float]]
    rois: RoiPair

    @classmethod
    def of(cls, scene: Scene, plaque: Plaque) -> Reference:
        """Of a scene at rest."""
        x, y, z = plaque.position
        image = axial_grid((z, y, x))
        return cls(image, truth(scene, image), centers(plaque), place_rois(scene, image))


@dataclass(frozen=True, eq=False)
class Observed:
    """Measures of one volume.

    Attributes:
        image: ``(y, x)`` HU, the protocol's axial image, float32.
        segmentation: of it.
        nrmse: rms difference to the reference volume over the rms of the reference's deviation from fat.
        roi_hu: means of the core's and the fibrous ROI.
        cap_line: cap thickness in mm on the line from the lumen's to the core's centre; NaN where motion has taken the
            lumen off its place.
        depth: of the core's basin, HU.
        lumen_dice, core_dice: overlap of the segmented regions with the true ones.
    """

    image: Tensor
    segmentation: PlaqueSegmentation
    nrmse: float
    roi_hu: tuple[float, float]
    cap_line: float
    depth: float
    lumen_dice: float
    core_dice: float

    @property
    def contrast_hu(self) -> float:
        """Fibrous ROI minus core ROI."""
        return self.roi_hu[1] - self.roi_hu[0]

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        s = self.segmentation
        return {
            "nrmse": self.nrmse,
            "lumen_mm2": s.lumen_area,
            "core_mm2": s.core_area,
            "core_found": s.core_found,
            "cap_line_mm": self.cap_line,
            "basin_depth_hu": self.depth,
            "roi_hu": self.roi_hu,
            "contrast_hu": self.contrast_hu,
            "lumen_dice": self.lumen_dice,
            "core_dice": self.core_dice,
        }


def observe(volume: Tensor, grid: VolumeGrid, reference: Reference, rest: Tensor) -> Observed:
    """Measure a volume.

    Args:
        volume: ``(z, y, x)`` HU.
        grid: of it.
        reference: where things are at rest.
        rest: ``(z, y, x)`` HU, the same without motion.
    """
    image = sample_axial(volume.double(), grid, reference.image)[0]
    found = segment_plaque(image, reference.image)
    core, fibrous = (float(r(volume)) for r in reference.rois.on(grid))
    # Fat fills most of the inset.
    fat = float(rest.median())
    error = (volume.double() - rest.double()).square().mean().sqrt()
    return Observed(
        image.float(),
        found,
        float(error / (rest.double() - fat).square().mean().sqrt()),
        (core, fibrous),
        cap_on_line(image, reference.image, *reference.line),
        basin_depth(image, reference.image, reference.masks["core"]),
        dice(found.lumen, reference.masks["lumen"]),
        dice(found.core, reference.masks["core"]),
    )
