"""Where things are in a scene of the study: bodies, scanner, grids and ROIs, before anything is simulated."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cached_property

from recon.study.dose_factor.settings import ROIS, Settings
from recon.study.paper.plaque_scan import inset_grid
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.placement import RoiPair, place_rois, whole_rois
from torchpcct.metrics.roi import axial_grid
from torchpcct.scanner import Scanner, presets
from torchpcct.scene import Scene
from torchpcct.scene.plaque import Plaque, plaque_scene, plaque_variant

__all__ = ["Variant"]

_PITCH = re.compile(r"pitch_(\d\.\d+)mm")
"""The paper's scene on a scanner of another column pitch."""


class Variant:
    """A scene by name: a variant of the plaque, or ``"variant:absent"``, the same without its core.

    Args:
        name: see above.
        settings: of the study.
    """

    def __init__(self, name: str, settings: Settings) -> None:
        self.name, self.settings = name, settings

    @cached_property
    def _pair(self) -> tuple[Scene, Plaque]:
        variant, _, absent = self.name.partition(":")
        if _PITCH.fullmatch(variant):
            variant = "paper"
        return plaque_variant(variant, core_contrast=0.0) if absent else plaque_variant(variant)

    @property
    def scene(self) -> Scene:
        """All bodies."""
        return self._pair[0]

    @property
    def plaque(self) -> Plaque:
        """The plaque's geometry."""
        return self._pair[1]

    @cached_property
    def scanner(self) -> Scanner:
        """The paper's, or one with the column pitch of the scene's name."""
        scanner = presets.pcct(views=self.settings.views)
        pitch = _PITCH.match(self.name)
        if pitch is None:
            return scanner
        geometry = scanner.geometry
        return replace(scanner, geometry=replace(geometry, pitch=(geometry.pitch[0], float(pitch[1]))))

    @cached_property
    def plain(self) -> Scene:
        """The plain plaque of the same geometry, without extra bodies: where tissues are, whatever fills them."""
        return plaque_scene(self.plaque)[0]

    @cached_property
    def core_center(self) -> tuple[float, float, float]:
        """(z, y, x) mm."""
        x, y, z = (float(v) for v in self.plaque.to_scanner(self.plaque.core_center))
        return z, y, x

    @cached_property
    def lumen_center(self) -> tuple[float, float, float]:
        """(z, y, x) mm, in the plaque's middle slice."""
        x, y, _, _ = (float(v) for v in self.plaque.section("lumen", 0.0))
        x, y, z = (float(v) for v in self.plaque.to_scanner((x, y, 0.0)))
        return z, y, x

    def grid_of(self, voxel_mm: float) -> VolumeGrid:
        """The inset's grid at a voxel size."""
        return inset_grid(self.plaque, voxel_mm)

    @cached_property
    def grid(self) -> VolumeGrid:
        """The methods' grid."""
        return self.grid_of(self.settings.voxel_mm)

    @cached_property
    def rois(self) -> RoiPair:
        """The paper's ROIs; a calcification is kept clear of, texture and stent are not (they have no bulk there)."""
        scene = self.scene if "calcification" in self.name else self.plain
        return place_rois(scene, axial_grid(self.grid.center))

    def pair_of(self, name: str) -> RoiPair:
        """The ROIs of a name."""
        return self.rois if name == "paper" else self.wide_rois(name)

    def wide_rois(self, name: str) -> RoiPair:
        """The ROIs of :data:`recon.study.dose_factor.settings.ROIS` beyond the paper's, inside of the crop."""
        z, y, x = self.core_center
        if name == "section":
            image = VolumeGrid((1, 80, 80), 0.04, (self.grid.center[0], y, x))
        elif name == "tissue":
            half = float(self.plaque.core.semi_axes[2])
            image = VolumeGrid((max(1, math.floor(2 * half / 0.05)), 64, 64), 0.05, (z, y, x))
        else:
            raise ValueError(f"rois must be of {', '.join(ROIS[1:])}, got {name!r}")
        return whole_rois(self.plain, image)
