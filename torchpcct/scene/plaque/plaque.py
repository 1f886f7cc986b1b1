"""The coronary plaque of Li et al., *Coronary Atherosclerotic Plaque Characterization with
Photon-counting CT*.

The paper gives the vessel's diameter 3.36 mm, wall 0.19 mm, fibrous cap 0.17 mm and a flat
ellipsoidal necrotic core of 1.97 mm (major) by 1.2 mm (minor axis), 42.4 mm off the isocentre in a
24 cm adipose cylinder. It leaves open the core's third axis, how far the lumen narrows, how long
the bulge is and where the core lies. The construction here meets every number given; what it adds
are parameters of :class:`Plaque`.

In the plaque's own frame z runs along the vessel and x from the vessel's axis towards the plaque.
With ``d(z) = bulge · cos²(π z / bulge_length)`` the outer surface is the ellipse about ``(d, 0)``
with semi-axes ``(R + d, R)``, the inner wall the same with ``R`` less the wall, the lumen the
largest circle that touches the inner wall opposite the plaque from inside; between inner wall and
lumen lies fibrous tissue, and in it the core.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from torchpcct.scene.bodies import Ellipsoid, EllipticCylinder, Floats
from torchpcct.scene.materials import Material, material
from torchpcct.scene.motion import SinusoidalMotion
from torchpcct.scene.scene import Body, Scene
from torchpcct.scene.tubes import BulgedTube, NarrowedTube
from torchpcct.validate import checked, number, numbers

__all__ = ["PAPER_POSITION", "PATIENT_DIAMETER", "Plaque", "interpolate_material", "plaque_scene"]

PAPER_POSITION = (-29.63, -30.38, 0.0)
"""Default of ``Plaque.position``, x, y, z in mm: the centre in the authors' published phantom
description, 42.44 mm off the isocentre."""
PATIENT_DIAMETER = 240.0
"""Diameter of the paper's patient, mm."""


@dataclass(frozen=True)
class Plaque:
    """Geometry of a vessel segment with an eccentric plaque; all lengths in mm.

    Args:
        position: ``(x, y, z)`` of the undisturbed vessel's axis at the middle of the plaque, in the
            scanner's frame.
        orientation: angle in rad, counter-clockwise from the scanner's +x, of the direction from
            the vessel's axis to the plaque (the paper does not give it; 0 by default; π mirrors the
            plaque).
        vessel_diameter: outer diameter of the undisturbed vessel [paper].
        wall_thickness: [paper].
        cap_thickness: smallest distance between core and lumen [paper]; it places the core.
        core_semi_axes: across the vessel towards the lumen (half of the paper's minor axis 1.2),
            across, and along the vessel (half of the paper's major axis 1.97, rounded as published;
            the third axis is assumed equal to it).
        bulge: largest ``d``, by which the vessel's centre moves and its half-width grows [assumed].
        bulge_length: length of the deformed segment [assumed].
        vessel_length: length of the vessel, cut flat at both ends; ``inf`` for an endless one. The
            default is the authors' 230 voxels of 0.042 mm.
        lumen_narrowing: ``d`` of the lumen over ``d`` of the wall, at least 1 [assumed 1].
        core_shift: displacement of the core in the plaque's frame from where ``cap_thickness`` puts
            it.
        core_scale: factor on the core's semi-axes, about its centre.

    Raises:
        ValueError, TypeError: a value out of range or of the wrong kind; the message names it.
    """

    position: tuple[float, float, float] = PAPER_POSITION
    orientation: float = 0.0
    vessel_diameter: float = 3.36
    wall_thickness: float = 0.19
    cap_thickness: float = 0.17
    core_semi_axes: tuple[float, float, float] = (0.6, 0.985, 0.985)
    bulge: float = 0.45
    bulge_length: float = 6.0
    vessel_length: float = 230 * 0.042
    lumen_narrowing: float = 1.0
    core_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    core_scale: float = 1.0

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "position", numbers("position", self.position, 3))
        set_(
            self, "core_semi_axes", numbers("core_semi_axes", self.core_semi_axes, 3, positive=True)
        )
        set_(self, "core_shift", numbers("core_shift", self.core_shift, 3))
        set_(self, "orientation", number("orientation", self.orientation))
        for name in (
            "vessel_diameter",
            "wall_thickness",
            "cap_thickness",
            "bulge_length",
            "core_scale",
        ):
            set_(self, name, number(name, getattr(self, name), positive=True))
        set_(
            self,
            "vessel_length",
            number("vessel_length", self.vessel_length, positive=True, finite=False),
        )
        set_(self, "bulge", number("bulge", self.bulge, low=0.0, unit="mm"))
        set_(self, "lumen_narrowing", number("lumen_narrowing", self.lumen_narrowing))
        if self.lumen_narrowing < 1:
            raise ValueError(
                f"lumen_narrowing must be at least 1, got {self.lumen_narrowing:g}: a wider lumen "
                "would cross the wall"
            )
        if 2 * self.wall_thickness >= self.vessel_diameter:
            raise ValueError(
                f"wall_thickness ({self.wall_thickness:g} mm) must be less than half of "
                f"vessel_diameter ({self.vessel_diameter:g} mm)"
            )

    @property
    def inner_radius(self) -> float:
        """Radius in mm of the undisturbed inner wall."""
        return self.vessel_diameter / 2.0 - self.wall_thickness

    @property
    def _frame(self) -> dict[str, Any]:
        return {"position": self.position, "rotation": self.orientation}

    @cached_property
    def outer(self) -> BulgedTube:
        """The vessel's outer surface."""
        return BulgedTube(
            self.vessel_diameter / 2.0,
            self.bulge,
            self.bulge_length,
            self.vessel_length / 2.0,
            **self._frame,
        )

    @cached_property
    def inner(self) -> BulgedTube:
        """The wall's inner surface, outside of the fibrous tissue."""
        return BulgedTube(
            self.inner_radius,
            self.bulge,
            self.bulge_length,
            self.vessel_length / 2.0,
            **self._frame,
        )

    @cached_property
    def lumen(self) -> NarrowedTube:
        """The lumen's surface."""
        narrowing = self.bulge * self.lumen_narrowing
        return NarrowedTube(
            self.inner_radius, narrowing, self.bulge_length, self.vessel_length / 2.0, **self._frame
        )

    @cached_property
    def core_center(self) -> tuple[float, float, float]:
        """Centre of the core in the plaque's frame, mm: where the cap is as thick as asked, plus
        the shift."""
        a, b, c = self.core_semi_axes
        lumen_edge = 2.0 * float(self.lumen.section(0.0)[1]) - self.inner_radius
        x = lumen_edge + self.cap_thickness + a
        for _ in range(50):  # the gap grows one to one with x, or almost
            error = _gap(self.lumen, (x, 0.0, 0.0), (a, b, c)) - self.cap_thickness
            x -= error
            if abs(error) < 1e-9:
                break
        sx, sy, sz = self.core_shift
        return x + sx, sy, sz

    @cached_property
    def core(self) -> Ellipsoid:
        """The necrotic core."""
        axes = tuple(self.core_scale * v for v in self.core_semi_axes)
        return Ellipsoid(
            axes, position=tuple(self.to_scanner(self.core_center)), rotation=self.orientation
        )

    @cached_property
    def minimum_cap(self) -> float:
        """Smallest distance in mm between core and lumen: ``cap_thickness`` unless the core is
        moved or scaled."""
        return _gap(self.lumen, self.core_center, self.core.semi_axes)

    def to_scanner(self, points: ArrayLike) -> Floats:
        """Points ``(..., 3)`` of the plaque's frame in the scanner's frame, mm."""
        return self.outer.to_scanner(points)

    def section(self, name: str, z: ArrayLike = 0.0) -> tuple[Floats, Floats, Floats, Floats]:
        """The axial section of a surface: an ellipse with axes along the plaque's x and y.

        Args:
            name: ``"outer"``, ``"inner"``, ``"lumen"`` or ``"core"``.
            z: heights in the plaque's frame, mm, any shape.

        Returns:
            centre x, centre y, semi-axis along x, semi-axis along y, each of the shape of ``z``, mm
            in the plaque's frame. Semi-axes are 0 where the core has no section.
        """
        height = np.asarray(z, dtype=np.float64)
        if name == "core":
            a, b, c = self.core.semi_axes
            x, y, z0 = self.core_center
            scale = np.sqrt(np.clip(1.0 - ((height - z0) / c) ** 2, 0.0, None))
            return np.full_like(height, x), np.full_like(height, y), a * scale, b * scale
        tubes: dict[str, BulgedTube | NarrowedTube] = {
            "outer": self.outer,
            "inner": self.inner,
            "lumen": self.lumen,
        }
        if name not in tubes:
            raise ValueError(f"name must be one of outer, inner, lumen, core, got {name!r}")
        centre, ax, ay = tubes[name].section(height)
        return centre, np.zeros_like(height), ax, ay

    def area(self, name: str, z: ArrayLike = 0.0) -> Floats:
        """Area in mm² of the axial section of a surface (names of :meth:`section`), of the shape
        of ``z``."""
        _, _, ax, ay = self.section(name, z)
        return math.pi * ax * ay


def _gap(lumen: NarrowedTube, center: tuple[float, ...], axes: tuple[float, ...]) -> float:
    """Smallest distance between the ellipsoid and the lumen in the lumen's frame; 0 where they
    touch or overlap."""
    from scipy.optimize import minimize

    c, s = np.array(center), np.array(axes)

    def gap(v: Floats) -> Floats:
        theta, phi = v[:2]
        x, y, z = (
            c[0] - s[0] * np.cos(theta) * np.cos(phi),
            c[1] + s[1] * np.cos(theta) * np.sin(phi),
            c[2] + s[2] * np.sin(theta),
        )
        middle, radius, _ = lumen.section(v[2])
        return np.hypot(np.maximum(np.hypot(x - middle, y) - radius, 0.0), z - v[2])

    angles = np.linspace(-1.4, 1.4, 15)
    heights = c[2] + s[2] * np.linspace(-1.5, 1.5, 31)
    grid = np.stack(np.meshgrid(angles, angles, heights, indexing="ij")).reshape(3, -1)
    start = grid[:, int(gap(grid).argmin())]
    options = {"xatol": 1e-9, "fatol": 1e-13, "maxiter": 4000}
    return float(minimize(gap, start, method="Nelder-Mead", options=options).fun)


@checked
def interpolate_material(
    name: str, start: Material | str, end: Material | str, weight: float
) -> Material:
    """A material whose attenuation lies at ``weight`` of the way between two others, at every
    energy.

    Its partial densities (mass of each element per volume) are those of ``start`` plus ``weight``
    times the difference, so that attenuation, a sum over partial densities, is exactly linear in
    ``weight``. Weights outside 0…1 extrapolate: −1 turns the contrast's sign.

    Args:
        name: of the new material.
        start, end: materials or their names.
        weight: 0 gives ``start``, 1 gives ``end``.

    Raises:
        ValueError: an element's partial density would be negative.
    """
    a, b, w = material(start), material(end), number("weight", weight)
    partial: dict[str, float] = {}
    for element in sorted({*a.mass_fractions, *b.mass_fractions}):
        first = a.density_g_cm3 * a.mass_fractions.get(element, 0.0)
        last = b.density_g_cm3 * b.mass_fractions.get(element, 0.0)
        value = first + w * (last - first)
        if value < -1e-12:
            raise ValueError(
                f"weight {w:g} between {a.name!r} and {b.name!r} needs a negative amount of "
                f"{element}: choose one closer to 0…1"
            )
        if value > 0:
            partial[element] = value
    density = math.fsum(partial.values())
    return Material(name, density, {element: value / density for element, value in partial.items()})


@checked
def plaque_scene(
    plaque: Plaque | None = None,
    *,
    patient_diameter: float = PATIENT_DIAMETER,
    fat: Material | str = "pericoronary_fat",
    wall: Material | str = "vessel_wall",
    fibrous: Material | str = "fibrous_tissue",
    core: Material | str = "necrotic_core",
    blood: Material | str = "blood_iodine",
    core_contrast: float = 1.0,
    motion_amplitude: float = 0.0,
    motion: SinusoidalMotion | None = None,
    extra: tuple[Body, ...] = (),
    **geometry: Any,
) -> tuple[Scene, Plaque]:
    """The paper's scene: the plaque in an endless adipose cylinder about the scanner's axis.

    Bodies, from outside to inside: ``"patient"`` (fat), ``"wall"``, ``"fibrous"``, then ``"lumen"``
    and ``"core"``.

    Args:
        plaque: the plaque's geometry; default: the paper's.
        patient_diameter: of the adipose cylinder, mm [paper: 240].
        fat, wall, fibrous, core, blood: materials or their names.
        core_contrast: contrast of the core against the fibrous tissue in units of the true one: 0.5
            halves it, 0 takes the core away (fibrous tissue instead), −1 turns its sign. Exact at
            every energy.
        motion_amplitude: amplitude in mm of the paper's motion of the vessel (along x, 60 bpm), 0
            for none.
        motion: another motion, of any body, instead.
        extra: further bodies inside the present ones (calcification, stent, texture).
        **geometry: parameters of :class:`Plaque` that replace those of ``plaque``.

    Returns:
        the scene, and the plaque's geometry to place ROIs with.

    Raises:
        ValueError: bodies overlap (a core too large for its wall, …), an unknown material, a value
            out of range.
        TypeError: a value of the wrong kind, an unknown parameter.
    """
    shape = replace(plaque if plaque is not None else Plaque(), **geometry)
    diameter = number("patient_diameter", patient_diameter, positive=True)
    contrast = number("core_contrast", core_contrast)
    if contrast == 0.0:
        core = fibrous
    elif contrast != 1.0:
        core = interpolate_material(
            f"core at {contrast:g} of its contrast", fibrous, core, contrast
        )
    if motion is None and motion_amplitude != 0.0:
        motion = SinusoidalMotion("wall", motion_amplitude)
    bodies = (
        Body("patient", EllipticCylinder(diameter / 2.0), fat),
        Body("wall", shape.outer, wall, "patient"),
        Body("fibrous", shape.inner, fibrous, "wall"),
        Body("lumen", shape.lumen, blood, "fibrous"),
        Body("core", shape.core, core, "fibrous"),
        *extra,
    )
    return Scene(bodies, motion), shape
