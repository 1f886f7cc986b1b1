"""Variants that show whether a prior invents structures: no core, moved, mirrored, calcified,
stented, textured.

A reconstruction with a learned prior may draw what it expects. Each variant here differs from the
paper's scene in one respect that such a prior does not know; run it through the same scan and look
for a core that is not there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from torchpcct.scene.bodies import Ellipsoid, EllipticCylinder
from torchpcct.scene.materials import calcification
from torchpcct.scene.plaque.plaque import PAPER_POSITION, Plaque, interpolate_material, plaque_scene
from torchpcct.scene.scene import Body, Scene
from torchpcct.validate import checked, choice, whole

if TYPE_CHECKING:
    from torchpcct.scene.materials import Material


__all__ = ["VARIANTS", "plaque_variant"]

_STRUT_MM = 0.08
"""Radial thickness and height of a stent's ring, mm, common for cobalt chromium."""
_RINGS_APART_MM = 1.5
"""From one ring to the next along the vessel, mm."""
_CLEARANCE_MM = 0.01
"""Between ring and lumen wall, mm."""


@checked
def calcification_bodies(plaque: Plaque) -> tuple[Body, ...]:
    """A calcified ellipsoid of 1500 HU at the plaque's shoulder, beside the core: body
    ``"calcification"``."""
    place = tuple(plaque.to_scanner((0.75, 1.1, 0.0)))
    shape = Ellipsoid((0.25, 0.2, 0.6), position=place, rotation=plaque.orientation)
    return (Body("calcification", shape, calcification(1500.0), "fibrous"),)


@checked
def stent_bodies(
    plaque: Plaque, *, rings: int = 5, blood: Material | str = "blood_iodine"
) -> tuple[Body, ...]:
    """A stent-like row of rings of cobalt chromium along the lumen's wall, with blood inside each
    ring.

    A ring is a flat metal disc ``"stent_k"`` that fills the lumen, with a disc of blood
    ``"stent_k_blood"`` in it.

    Args:
        plaque: geometry whose lumen holds the rings.
        rings: how many, centred at the middle of the plaque.
        blood: material or its name.

    Raises:
        ValueError: rings that are thicker than the lumen, or leave the vessel.
    """
    rings, height = whole("rings", rings), _STRUT_MM / 2.0
    bodies: list[Body] = []
    for k in range(rings):
        z = (k - (rings - 1) / 2.0) * _RINGS_APART_MM
        if abs(z) + height > plaque.vessel_length / 2.0:
            raise ValueError(f"ring {k} at z = {z:g} mm leaves the vessel: fewer rings")
        # The ring must fit the lumen over its whole height: all lumen circles touch x = -R, so the
        # smallest decides.
        radii = plaque.section("lumen", np.linspace(z - height, z + height, 9))[2]
        radius = float(radii.min()) - _CLEARANCE_MM
        centre = float(radii.min()) - plaque.inner_radius
        if radius <= _STRUT_MM:
            raise ValueError(
                f"ring {k}: strut {_STRUT_MM:g} mm does not fit the lumen's radius of {radius:g} mm"
            )
        place: dict[str, Any] = {
            "position": tuple(plaque.to_scanner((centre, 0.0, z))),
            "rotation": plaque.orientation,
        }
        bodies.append(
            Body(
                f"stent_{k}", EllipticCylinder(radius, height, **place), "cobalt_chromium", "lumen"
            )
        )
        inner = EllipticCylinder(radius - _STRUT_MM, height, **place)
        bodies.append(Body(f"stent_{k}_blood", inner, blood, f"stent_{k}"))
    return tuple(bodies)


@checked
def textured(
    scene: Scene,
    body: str,
    rng: np.random.Generator,
    *,
    count: int = 60,
    radius: tuple[float, float] = (0.06, 0.18),
    towards: Material | str = "water",
    strength: float = 0.5,
    around: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None,
) -> Scene:
    """The scene with one body's tissue broken up into small spheres of slightly different
    attenuation.

    Spheres ``"BODY_texture_k"`` lie apart from each other and from the body's other children. Each
    has a contrast drawn uniformly from ``[-strength, strength]`` times the difference between
    ``towards`` and the body's own material, so that the mean attenuation stays, on average, what it
    was.

    Args:
        scene, body: which body of which scene.
        rng: source of all randomness.
        count: how many spheres; fewer if no more fit.
        radius: smallest and largest radius in mm.
        towards: material or its name that gives the direction of the contrast.
        strength: largest contrast as a share of that direction's.
        around: lowest and highest corner ``(x, y, z)`` in mm of the box to fill; default: the
            body's own box.

    Raises:
        ValueError: an infinite body without ``around``, a material with a negative share of an
            element.
    """
    host = scene[body].shape
    box = host.bounding_box if around is None else np.array(around, dtype=np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all():
        raise ValueError(
            f"give around=(lowest corner, highest corner) in mm to fill {body!r}, which is endless"
        )
    siblings = [b.shape for b in scene.bodies if b.parent == body]
    # A shell a little larger than the sphere: the margin covers the gaps between its points.
    shell = 1.05 * Ellipsoid(1.0).surface_points(120)
    own = scene.materials[scene.index(body)]
    centres, radii = np.empty((0, 3)), np.empty(0)
    added: list[Body] = []
    for _ in range(200 * count):
        if len(added) == count:
            break
        centre, r = rng.uniform(box[0], box[1]), float(rng.uniform(*radius))
        points = centre + r * shell
        if not host.contains(points).all() or any(s.contains(points).any() for s in siblings):
            continue
        if len(radii) and bool((np.linalg.norm(centres - centre, axis=1) < radii + r).any()):
            continue
        name = f"{body}_texture_{len(added)}"
        material = interpolate_material(name, own, towards, float(rng.uniform(-strength, strength)))
        added.append(Body(name, Ellipsoid(r, position=tuple(centre)), material, body))
        centres, radii = np.vstack([centres, centre]), np.append(radii, r)
    return scene.add(*added)


def _with(**options: Any) -> Callable[..., tuple[Scene, Plaque]]:
    return lambda **more: plaque_scene(**{**options, **more})


def _mirrored(**more: Any) -> tuple[Scene, Plaque]:
    return plaque_scene(**{**more, "orientation": more.get("orientation", 0.0) + math.pi})


def _turned(**more: Any) -> tuple[Scene, Plaque]:
    x, y, z = more.get("position", PAPER_POSITION)
    turned = more.get("orientation", 0.0) + math.pi / 2.0
    return plaque_scene(**{**more, "orientation": turned, "position": (x, y, z + 1.0)})


def _calcified(**more: Any) -> tuple[Scene, Plaque]:
    _, plaque = plaque_scene(**more)
    return plaque_scene(
        **{**more, "extra": (*more.get("extra", ()), *calcification_bodies(plaque))}
    )


def _stented(**more: Any) -> tuple[Scene, Plaque]:
    _, plaque = plaque_scene(**more)
    bodies = stent_bodies(plaque, blood=more.get("blood", "blood_iodine"))
    return plaque_scene(**{**more, "extra": (*more.get("extra", ()), *bodies)})


def _textured(*, seed: int = 0, **more: Any) -> tuple[Scene, Plaque]:
    scene, plaque = plaque_scene(**more)
    rng = np.random.default_rng(seed)
    scene = textured(scene, "fibrous", rng, towards=more.get("core", "necrotic_core"))
    low, high = scene.bounding_box("wall")
    scene = textured(
        scene,
        "patient",
        rng,
        count=60,
        radius=(0.2, 0.6),
        strength=0.3,
        around=(tuple(low - 1.5), tuple(high + 1.5)),
    )
    return scene, plaque


VARIANTS: dict[str, Callable[..., tuple[Scene, Plaque]]] = {
    "paper": _with(),
    "absent_core": _with(core_contrast=0.0),
    "core_for_fibrous": _with(fibrous="necrotic_core"),
    "moved_core": _with(core_shift=(0.0, 0.1, 0.3)),
    "turned": _turned,
    "mirrored": _mirrored,
    "half_size_core": _with(core_scale=0.5),
    "half_contrast": _with(core_contrast=0.5),
    "flipped_contrast": _with(core_contrast=-1.0),
    "calcification": _calcified,
    "stent": _stented,
    "textured": _textured,
    "small_patient": _with(patient_diameter=180.0),
    "large_patient": _with(patient_diameter=290.0),
}
"""Each variant's name and the function that builds it; see :func:`plaque_variant`."""


@checked
def plaque_variant(name: str, **options: Any) -> tuple[Scene, Plaque]:
    """One of the variants of the paper's scene.

    * ``paper``: as published; ``absent_core``: fibrous tissue instead of the core;
      ``core_for_fibrous``: all fibrous tissue replaced by necrotic core;
    * ``moved_core``: core displaced by (0, 0.1, 0.3) mm in the plaque's frame, as far as the wall
      allows; ``turned``: the plaque turned by 90° about the vessel and moved 1 mm along it;
      ``mirrored``: on the vessel's other side;
    * ``half_size_core``; ``half_contrast`` and ``flipped_contrast`` of the core;
    * ``calcification``: 1500 HU at the plaque's shoulder; ``stent``: metal rings in the lumen;
      ``textured``: fibrous tissue and fat of varying attenuation (option ``seed``);
    * ``small_patient``, ``large_patient``: an adipose cylinder of 180 or 290 mm.

    Args:
        name: of the variant, a key of :data:`VARIANTS`.
        **options: of :func:`~torchpcct.scene.plaque.plaque.plaque_scene`, on top of the variant's
            own.

    Raises:
        ValueError: an unknown name, options that make bodies overlap.
    """
    return VARIANTS[choice("variant", name, VARIANTS)](**options)
