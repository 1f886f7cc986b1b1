"""Where the two ROIs of the paper's CNR go: by tissue and distance, so that they follow any variant
of the plaque.

The paper shows its ROIs only in a figure: the foreground lies inside the necrotic core, the
background in the fibrous tissue next to the core, both fully inside their tissue on the noise-free
0.1 mm image (means 40.1 and 91.8 HU). The distances below are our choice; they are printed with
every CNR because the number hinges on them. The background is ONE connected region: in the paper's
table its SD is 1.7 to 2.3 times that of the core, so it must be the smaller one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.roi import RoiMean
from torchpcct.scene import Scene
from torchpcct.validate import checked

if TYPE_CHECKING:
    from torchpcct.typing import Bools, Floats


__all__ = ["RoiPair", "RoiRule", "place_rois"]


@dataclass(frozen=True)
class RoiRule:
    """Distances in mm that place the ROIs in the axial image.

    Args:
        core_margin: the foreground keeps this far from the core's edge.
        background_margin: the background keeps this far from every edge of the fibrous tissue.
        background_reach: the background ends this far from the core.
        lumen_margin: the background keeps this far from the lumen, whose blood (500 HU) would spill
            into it.
    """

    core_margin: float = 0.20
    background_margin: float = 0.10
    background_reach: float = 0.50
    lumen_margin: float = 0.40


@dataclass(frozen=True)
class RoiPair:
    """Boolean masks of the axial image, ``(1, y, x)``, and their grid."""

    foreground: Bools
    background: Bools
    image: VolumeGrid
    rule: RoiRule

    def on(self, grid: VolumeGrid) -> tuple[RoiMean, RoiMean]:
        """The two ROI means as functionals of volumes on ``grid``."""
        return RoiMean(grid, self.image, self.foreground), RoiMean(
            grid, self.image, self.background
        )

    def as_dict(self) -> dict[str, object]:
        """Sizes of the ROIs for the report."""
        pixel = self.image.spacing[1] * self.image.spacing[2]
        return {
            "rule_mm": vars(self.rule),
            "pixel_mm": self.image.spacing[1],
            "foreground_pixels": int(self.foreground.sum()),
            "foreground_mm2": round(float(self.foreground.sum() * pixel), 4),
            "background_pixels": int(self.background.sum()),
            "background_mm2": round(float(self.background.sum() * pixel), 4),
        }


@checked
def place_rois(scene: Scene, image: VolumeGrid, rule: RoiRule | None = None) -> RoiPair:
    """Place the paper's ROIs on an axial image of a scene.

    Args:
        scene: its bodies ``"core"``, ``"fibrous"`` and ``"lumen"`` mark where the ROIs go, whatever
            fills them.
        image: axial image grid, e.g. :func:`torchpcct.metrics.roi.axial_grid`.
        rule: distances; None: the defaults.

    Raises:
        ValueError: an unknown body, or a ROI that comes out empty.
    """
    found = _placed(scene, image, rule or RoiRule())
    regions, count = ndimage.label(found.background[0])
    sizes = ndimage.sum_labels(found.background[0], regions, np.arange(1, count + 1))
    return replace(found, background=(regions == 1 + int(np.argmax(sizes)))[None])


@checked
def whole_rois(scene: Scene, image: VolumeGrid) -> RoiPair:
    """All of the core and all of the tissue in an image of one or more slices, but for a margin at
    their edges.

    The paper's two ROIs ask for a contrast in one small place; these ask how different the two
    tissues are.

    Args:
        scene: as for :func:`place_rois`.
        image: ``(z, y, x)`` grid; with one slice distances are taken in the slice, else in space.

    Raises:
        ValueError: an unknown body, or a ROI that comes out empty.
    """
    return _placed(scene, image, RoiRule(0.10, 0.10, float("inf"), 0.30))


def _placed(scene: Scene, image: VolumeGrid, rule: RoiRule) -> RoiPair:
    labels = scene.labels(image)
    core, tissue, lumen = (labels == scene.index(name) for name in ("core", "fibrous", "lumen"))
    if not core.any():
        raise ValueError("the body 'core' does not cross the image: move the image")
    foreground = _depth(core, image) > rule.core_margin
    background = (
        (_depth(tissue, image) > rule.background_margin)
        & (_depth(~core, image) < rule.background_reach)
        & (_depth(~lumen, image) > rule.lumen_margin)
    )
    for name, mask, margin in (
        ("foreground", foreground, rule.core_margin),
        ("background", background, rule.background_margin),
    ):
        if not mask.any():
            raise ValueError(
                f"the {name} ROI is empty: its margin of {margin} mm is wider than the tissue; "
                "reduce it"
            )
    return RoiPair(foreground, background, image, rule)


def _depth(mask: Bools, image: VolumeGrid) -> Floats:
    """Distance in mm to the mask's edge; in the plane where the image has one slice."""
    if image.shape[0] == 1:
        return ndimage.distance_transform_edt(mask[0], sampling=image.spacing[1:])[None]
    return ndimage.distance_transform_edt(mask, sampling=image.spacing)
