"""Test objects of CT quality assurance as scenes: water cylinder, CTDI phantom."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from torchpcct.scene.bodies import EllipticCylinder
from torchpcct.scene.scene import Body, Scene
from torchpcct.validate import checked, number

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torchpcct.scene.materials import Material


__all__ = ["ctdi", "water_cylinder"]

CTDI_HOLES = ("centre", "peripheral_0", "peripheral_90", "peripheral_180", "peripheral_270")
"""Names of the CTDI phantom's inserts, the centre first, then counter-clockwise from +x."""


@checked
def water_cylinder(
    diameter: float = 200.0,
    length: float = math.inf,
    material: Material | str = "water",
    position: Sequence[float] = (0.0, 0.0, 0.0),
) -> Scene:
    """One upright cylinder, of water by default; body ``"cylinder"``.

    Args:
        diameter, length: in mm; an endless cylinder by default.
        material: a material or its name.
        position: ``(x, y, z)`` of its centre in mm.
    """
    radius = number("diameter", diameter, positive=True) / 2.0
    half = number("length", length, positive=True, finite=False) / 2.0
    return Scene([Body("cylinder", EllipticCylinder(radius, half, position=position), material)])


@checked
def ctdi() -> Scene:
    """The CTDI body phantom (IEC 60601-2-44): an acrylic cylinder of 320 mm and five bores, filled
    with water as the paper's, one in the middle and four at the border.

    Returns:
        a scene of the body ``"phantom"`` and, inside it, the bodies named in ``CTDI_HOLES``.
    """
    half, radius, hole, ring = 75.0, 160.0, 6.5, 150.0
    bodies = [Body("phantom", EllipticCylinder(radius, half), "pmma")]
    places = [(0.0, 0.0)] + [
        (ring * math.cos(k * math.pi / 2), ring * math.sin(k * math.pi / 2)) for k in range(4)
    ]
    for name, (x, y) in zip(CTDI_HOLES, places, strict=True):
        bodies.append(
            Body(name, EllipticCylinder(hole, half, position=(x, y, 0.0)), "water", "phantom")
        )
    return Scene(bodies)
