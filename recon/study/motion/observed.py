"""What one image of the motion study yields, measured where the vessel is at rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from recon.study.paper.measures import PlaqueImage, Truth, measure_plaque
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.placement import place_rois
from torchpcct.metrics.roi import RoiMean, sample_axial
from torchpcct.scene import Scene
from torchpcct.scene.plaque import Plaque

__all__ = ["Observed", "Reference", "observe"]


@dataclass(frozen=True, eq=False)
class Reference:
    """Where things are at rest: the plaque on the protocol's axial image, and its ROIs on the grid of all volumes."""

    grid: VolumeGrid
    truth: Truth
    rois: tuple[RoiMean, RoiMean]

    @classmethod
    def of(cls, scene: Scene, plaque: Plaque, grid: VolumeGrid) -> Reference:
        """Of a scene at rest, for volumes on ``grid``."""
        truth = Truth.of(scene, plaque)
        return cls(grid, truth, place_rois(scene, truth.image).on(grid))


@dataclass(frozen=True, eq=False)
class Observed(PlaqueImage):
    """Measures of one volume, and of its axial image.

    Attributes:
        nrmse: rms difference to the reference volume over the rms of the reference's deviation from fat.
        roi_hu: means of the core's and the fibrous ROI.
    """

    nrmse: float
    roi_hu: tuple[float, float]

    @property
    def contrast_hu(self) -> float:
        """Fibrous ROI minus core ROI."""
        return self.roi_hu[1] - self.roi_hu[0]

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {"nrmse": self.nrmse, **super().as_dict(), "roi_hu": self.roi_hu, "contrast_hu": self.contrast_hu}


def observe(volume: Tensor, reference: Reference, rest: Tensor) -> Observed:
    """Measure a volume.

    Args:
        volume: ``(z, y, x)`` HU.
        reference: where things are at rest.
        rest: ``(z, y, x)`` HU, the same without motion.
    """
    image = sample_axial(volume.double(), reference.grid, reference.truth.image)[0]
    core, fibrous = (float(r(volume)) for r in reference.rois)
    # Fat fills most of the inset.
    fat = float(rest.median())
    error = (volume.double() - rest.double()).square().mean().sqrt()
    return Observed(
        **vars(measure_plaque(image, reference.truth)),
        nrmse=float(error / (rest.double() - fat).square().mean().sqrt()),
        roi_hu=(core, fibrous),
    )
