"""Test objects of CT quality assurance as scenes: water cylinder, CTDI phantom."""

from __future__ import annotations

import math
from typing import Any

from torchpcct.scene.bodies import EllipticCylinder
from torchpcct.scene.scene import Body, Scene
from torchpcct.validate import checked, number

__all__ = ["CTDI_HOLES", "ctdi", "water_cylinder"]

# Names of the CTDI phantom's inserts, the centre first, then counter-clockwise from +x.
CTDI_HOLES = ("centre", "peripheral_0", "peripheral_90", "peripheral_180", "peripheral_270")


@checked
def water_cylinder(
    diameter: float = 200.0, length: float = math.inf, material: Any = "water", position: Any = (0.0, 0.0, 0.0)
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
def ctdi(
    diameter: float = 320.0,
    insert: Any = "water",
    *,
    body: Any = "pmma",
    hole_diameter: float = 13.0,
    hole_depth: float = 10.0,
    length: float = 150.0,
    rotation: float = 0.0,
) -> Scene:
    """The CTDI body phantom (IEC 60601-2-44): an acrylic cylinder with a central and four peripheral bores.

    Args:
        diameter: of the cylinder in mm: 320 (body) or 160 (head).
        insert: material of the bores; the paper fills them with water.
        body: material of the cylinder.
        hole_diameter: in mm.
        hole_depth: distance of a peripheral bore's centre from the cylinder's surface in mm.
        length: of cylinder and bores in mm.
        rotation: angle in rad by which the peripheral bores are turned counter-clockwise from +x.

    Returns:
        a scene of the body ``"phantom"`` and, inside it, the bodies named in ``CTDI_HOLES``.
    """
    half = number("length", length, positive=True, finite=False) / 2.0
    hole = number("hole_diameter", hole_diameter, positive=True) / 2.0
    radius = number("diameter", diameter, positive=True) / 2.0
    ring = radius - number("hole_depth", hole_depth, positive=True)
    bodies = [Body("phantom", EllipticCylinder(radius, half), body)]
    places = [(0.0, 0.0)] + [
        (ring * math.cos(rotation + k * math.pi / 2), ring * math.sin(rotation + k * math.pi / 2)) for k in range(4)
    ]
    for name, (x, y) in zip(CTDI_HOLES, places, strict=True):
        bodies.append(Body(name, EllipticCylinder(hole, half, position=(x, y, 0.0)), insert, "phantom"))
    return Scene(bodies)
