"""The picture of the plaque."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.study.phantom.measure import Measured
from torchpcct.viz import Panel, panels

__all__ = ["SHOWN_KEV", "draw"]

SHOWN_KEV = 64.0
"""Energy of the picture's CT numbers, at which the soft tissues have the paper's."""

_PIXEL_MM = 0.02
_HALF_MM = 2.75


def draw(measured: Measured) -> Any:
    """Axial section through the plaque's middle, and the section along the vessel through wall, core and lumen."""
    scene, plaque = measured.scene, measured.plaque
    values = np.array([m.hu(SHOWN_KEV) for m in scene.materials])
    across = np.arange(-_HALF_MM, _HALF_MM, _PIXEL_MM) + 0.5 * _PIXEL_MM
    half = plaque.vessel_length / 2.0
    along = np.arange(-half, half, _PIXEL_MM) + 0.5 * _PIXEL_MM

    def section(x: Any, y: Any, z: Any) -> Any:
        points = np.stack(np.broadcast_arrays(x, y, z), -1)
        return values[scene.labels(plaque.to_scanner(points))]

    def panel(image: Any, vertical: float, title: str) -> Panel:
        return Panel(image, (-_HALF_MM, _HALF_MM, -vertical, vertical), title)

    axial = section(across[None, :], across[:, None], np.zeros(1))
    sagittal = section(across[None, :], np.zeros(1), along[:, None])
    side = section(np.full(1, plaque.core_center[0]), across[None, :], along[:, None])
    row = [
        panel(axial, _HALF_MM, "axial"),
        panel(sagittal, half, "sagittal, towards the plaque"),
        panel(side, half, "sagittal, through the core"),
    ]
    figure = panels([row], (), "The plaque", f"HU at {SHOWN_KEV:g} keV, C150 / W600")
    figure.set_size_inches(8.0, 5.2)
    return figure
