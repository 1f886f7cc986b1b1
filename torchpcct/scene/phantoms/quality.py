"""Test objects of CT quality assurance as scenes: water cylinder, CTDI phantom, ellipsoids."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from torchpcct.scene.bodies import Ellipsoid, EllipticCylinder, number, rotation_matrix
from torchpcct.scene.scene import Body, Scene

__all__ = ["CTDI_HOLES", "ctdi", "random_ellipsoids", "water_cylinder"]

# Names of the CTDI phantom's inserts, the centre first, then counter-clockwise from +x.
CTDI_HOLES = ("centre", "peripheral_0", "peripheral_90", "peripheral_180", "peripheral_270")


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


def random_ellipsoids(
    count: int,
    radius: float,
    half_height: float,
    rng: np.random.Generator,
    *,
    size: tuple[float, float] = (0.05, 0.3),
    materials: tuple[Any, ...] = ("water",),
    body: Any = "water",
) -> Scene:
    """Ellipsoids of random size and rotation, apart from each other, in an upright cylinder ``"body"``; for tests.

    Args:
        count: number of ellipsoids, named ``"ellipsoid_0"``…
        radius, half_height: of the cylinder that holds them, mm.
        rng: source of all randomness.
        size: range of the semi-axes in units of ``radius`` (and at most ``half_height``).
        materials: drawn from at random for the ellipsoids.
        body: material of the cylinder.

    Raises:
        ValueError: they do not fit: fewer, or smaller ones.
    """
    bodies = [Body("body", EllipticCylinder(radius, half_height), body)]
    balls: list[tuple[Any, float]] = []
    for _ in range(200 * count):
        if len(balls) == count:
            break
        axes = np.minimum(rng.uniform(size[0], size[1], 3) * radius, 0.95 * half_height)
        reach = float(axes.max())
        r, phi = (radius - reach) * math.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * math.pi)
        z = rng.uniform(-1.0, 1.0) * (half_height - reach)
        centre = np.array([r * math.cos(phi), r * math.sin(phi), z])
        if all(np.linalg.norm(centre - other) > reach + far for other, far in balls):
            turn = rotation_matrix(rng.normal(size=3), rng.uniform(0.0, math.pi))
            material = materials[int(rng.integers(len(materials)))]
            shape = Ellipsoid(tuple(axes), position=tuple(centre), rotation=turn)
            bodies.append(Body(f"ellipsoid_{len(balls)}", shape, material, "body"))
            balls.append((centre, reach))
    if len(balls) < count:
        raise ValueError(f"only {len(balls)} of {count} ellipsoids fit: ask for fewer or smaller ones (size={size})")
    return Scene(bodies)
