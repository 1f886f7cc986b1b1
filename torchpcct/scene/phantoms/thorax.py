"""An adult thorax at the height of the heart, from analytic bodies: what dose and noise studies of
the chest need.

An average adult man: body section 340 × 236 mm, skin 2 mm, subcutaneous fat 12 to 13 mm, chest wall
of muscle with cut ribs (cortical shell, spongiosa), sternum, vertebra with arch and canal, both
lungs around a mediastinum that holds heart, descending aorta and oesophagus. Tissues: ICRU Report
44; heart and spongiosa Woodard and White 1986. Dimensions are typical ones of axial CT images,
chosen by us; no atlas was copied. All bodies are elliptic cylinders along z, so every slice is the
same; ribs do not slope.

The lungs are what a wide ellipse (the rib cage's inside) holds beside its children: so they follow
the mediastinum.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from torchpcct.scene.bodies import EllipticCylinder
from torchpcct.scene.scene import Body, Scene
from torchpcct.validate import checked, numbers

if TYPE_CHECKING:
    from torchpcct.scene.materials import Material


__all__ = ["thorax"]

HEART_CENTER_MM = (14.0, 34.0)
"""Centre of the heart relative to the middle of the body's section, x to the patient's left, y
to the front."""

RIB_ANGLES_DEG = (-58.0, -31.0, -2.0, 27.0, 54.0)
"""Where the ribs of the left side cross the slice: polar angle on the chest wall's ellipse, 0 to
the side."""

_HEART_TILT = math.radians(-22.0)
"""Turn of the heart about z, rad."""
_WALL = (145.0, 93.5, 2.0)
"""Ellipse on which the ribs lie: semi-axes and y of its centre, mm."""

_ELLIPSES: tuple[
    tuple[str, tuple[float, float], tuple[float, float], float, str, str | None], ...
] = (
    ("skin", (170.0, 118.0), (0.0, 0.0), 0.0, "skin", None),
    ("fat", (168.0, 116.0), (0.0, 0.0), 0.0, "adipose", "skin"),
    ("muscle", (156.0, 103.0), (0.0, 0.0), 0.0, "skeletal_muscle", "fat"),
    ("lungs", (134.0, 82.0), (0.0, 6.0), 0.0, "lung", "muscle"),
    ("pericardium", (60.0, 43.0), HEART_CENTER_MM, -22.0, "adipose", "lungs"),
    ("mediastinum", (38.0, 27.0), (3.0, -46.0), 0.0, "adipose", "lungs"),
    ("aorta", (11.5, 11.5), (25.0, -39.0), 0.0, "blood", "mediastinum"),
    ("oesophagus", (7.0, 4.5), (6.0, -28.0), 0.0, "soft_tissue", "mediastinum"),
    ("vertebra", (18.0, 14.5), (0.0, -54.0), 0.0, "cortical_bone", "mediastinum"),
    ("vertebra_marrow", (16.8, 13.3), (0.0, -54.0), 0.0, "spongiosa", "vertebra"),
    ("arch", (17.0, 11.5), (0.0, -89.0), 0.0, "cortical_bone", "muscle"),
    ("canal", (8.5, 7.0), (0.0, -86.5), 0.0, "soft_tissue", "arch"),
    ("sternum", (19.0, 4.8), (0.0, 95.2), 0.0, "cortical_bone", "muscle"),
    ("sternum_marrow", (18.0, 3.8), (0.0, 95.2), 0.0, "spongiosa", "sternum"),
)
"""Name, semi-axes, centre (body frame), turn in degrees, material, parent."""

_CHAMBERS = (
    ("left_ventricle", (17.0, 10.5), (23.0, -12.0)),
    ("right_ventricle", (18.0, 8.0), (15.0, 21.0)),
    ("left_atrium", (16.0, 10.0), (-22.0, -18.0)),
    ("right_atrium", (12.0, 13.0), (-33.0, 10.0)),
)
"""Cavities of the heart in its own frame (x along its long axis, towards the apex at the patient's
left and front)."""


def _cylinder(
    axes: tuple[float, float], center: tuple[float, float], turn: float
) -> EllipticCylinder:
    return EllipticCylinder(axes, position=(*center, 0.0), rotation=turn)


@checked
def thorax(
    center: object = (-HEART_CENTER_MM[0], -HEART_CENTER_MM[1]),
    *,
    blood: Material | str = "blood",
    myocardium: Material | str = "heart",
) -> Scene:
    """The thorax, by default with the heart at the isocentre.

    Args:
        center: ``(x, y)`` in mm of the body section's middle. +x is the patient's left, +y the
            front.
        blood: in the chambers and the aorta; ``"blood_iodine"`` for contrast medium.
        myocardium: of the heart's walls.

    Returns:
        A scene of endless cylinders: ``"skin"``, ``"fat"``, ``"muscle"``, ``"lungs"``, ``"heart"``
        and its chambers, ``"rib_left_0"``… with ``"…_marrow"``, ``"vertebra"``, ``"sternum"`` and
        others.

    Raises:
        ValueError: unknown materials.
    """
    x0, y0 = numbers("center", center, 2)
    bodies = []
    for name, axes, (x, y), turn, material, parent in _ELLIPSES:
        tissue = blood if name == "aorta" else material
        bodies.append(
            Body(name, _cylinder(axes, (x0 + x, y0 + y), math.radians(turn)), tissue, parent)
        )
    cos, sin = math.cos(_HEART_TILT), math.sin(_HEART_TILT)
    hx, hy = x0 + HEART_CENTER_MM[0], y0 + HEART_CENTER_MM[1]
    bodies.append(
        Body("heart", _cylinder((56.0, 39.0), (hx, hy), _HEART_TILT), myocardium, "pericardium")
    )
    for name, axes, (along, across) in _CHAMBERS:
        place = (hx + along * cos - across * sin, hy + along * sin + across * cos)
        bodies.append(Body(name, _cylinder(axes, place, _HEART_TILT), blood, "heart"))
    bodies += _ribs(x0, y0)
    return Scene(bodies)


def _ribs(x0: float, y0: float) -> list[Body]:
    a, b, lift = _WALL
    ribs = []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for k, angle in enumerate(RIB_ANGLES_DEG):
            t = math.radians(angle)
            turn = math.atan2(b * math.cos(t), -a * math.sin(t) * sign)
            place = (x0 + sign * a * math.cos(t), y0 + lift + b * math.sin(t))
            name = f"rib_{side}_{k}"
            ribs.append(Body(name, _cylinder((13.0, 4.2), place, turn), "cortical_bone", "muscle"))
            ribs.append(
                Body(f"{name}_marrow", _cylinder((12.0, 3.2), place, turn), "spongiosa", name)
            )
    return ribs
