"""The scene: a tree of nested analytic bodies, each filled with one material.

Bodies NEST and siblings do not overlap, so a line integral is a plain sum: every body adds its
whole chord, children included, times the difference between its own attenuation and its parent's,

    ∫ μ dl = Σ_b chord_b · (μ(material_b) − μ(material_parent(b))),

with 0 for the surroundings of a body without a parent (readings are relative to a scan of air).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchpcct.geometry import VolumeGrid
from torchpcct.scene.bodies import Shape
from torchpcct.scene.materials import Material
from torchpcct.scene.materials import material as material_of
from torchpcct.scene.motion import SinusoidalMotion
from torchpcct.validate import checked

__all__ = ["Body", "Scene"]

Floats = NDArray[np.float64]

_TOUCH = 1e-7
"""Bodies may touch: relative overlap of two surfaces that still counts as touching."""


@dataclass(frozen=True)
class Body:
    """One body of a scene.

    Args:
        name: its name, unique in the scene.
        shape: an analytic shape in the scanner's frame.
        material: a :class:`~torchpcct.scene.materials.Material` or its name in ``MATERIALS``.
        parent: name of the smallest body that contains it, or ``None`` if only air surrounds it.
    """

    name: str
    shape: Shape
    material: Material | str
    parent: str | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise TypeError(f"name must be a non-empty text, got {self.name!r}")
        if not isinstance(self.shape, Shape):
            raise TypeError(
                f"body {self.name!r}: shape must be a Shape, got {type(self.shape).__name__}"
            )
        # an unknown one is refused here, not in the middle of a simulation
        material_of(self.material)


class Scene:
    """Nested bodies and their motion. Immutable: methods that change something return a new scene.

    Args:
        bodies: ``B`` bodies, parents before their children, names unique.
        motion: one :class:`SinusoidalMotion` or several; each moves a body with everything inside
            it, and a body inside two moving ones is displaced by the sum.
        validate: check on construction that bodies lie inside their parents and that bodies of
            one parent do not overlap
            (:meth:`validate`).

    Raises:
        ValueError: an empty scene, a name twice, a parent that is unknown or listed later, a moving
            body that does not exist, bodies that overlap.
        TypeError: an element that is not a :class:`Body` or a motion.
    """

    @checked
    def __init__(
        self,
        bodies: Sequence[Body],
        motion: SinusoidalMotion | Sequence[SinusoidalMotion] | None = None,
        *,
        validate: bool = True,
    ) -> None:
        self.bodies: tuple[Body, ...] = tuple(bodies)
        if not self.bodies:
            raise ValueError("a scene needs at least one body")
        index: dict[str, int] = {}
        for k, body in enumerate(self.bodies):
            if not isinstance(body, Body):
                raise TypeError(f"bodies[{k}] must be a Body, got {type(body).__name__}")
            if body.name in index:
                raise ValueError(
                    f"the name {body.name!r} is used twice: names of bodies must be unique"
                )
            if body.parent is not None and body.parent not in index:
                raise ValueError(
                    f"body {body.name!r}: its parent {body.parent!r} is not among the bodies "
                    f"before it ({', '.join(index) or 'none'}): list parents before their children"
                )
            index[body.name] = k
        self._index = index
        if motion is None:
            motions: tuple[SinusoidalMotion, ...] = ()
        else:
            motions = (motion,) if isinstance(motion, SinusoidalMotion) else tuple(motion)
        for move in motions:
            if not isinstance(move, SinusoidalMotion):
                raise TypeError(
                    f"motion must be a SinusoidalMotion or several, got {type(move).__name__}"
                )
            self.index(move.body)
        self.motion = motions
        if validate:
            self.validate()

    def __repr__(self) -> str:
        return (
            f"Scene({len(self.bodies)} bodies: "
            f"{', '.join(self.names)}{'' if self.is_static else '; moving'})"
        )

    def __len__(self) -> int:
        return len(self.bodies)

    def __getitem__(self, name: str) -> Body:
        return self.bodies[self.index(name)]

    def index(self, name: str) -> int:
        """Position of the body ``name`` in :attr:`bodies`; ``ValueError`` if there is none."""
        if name not in self._index:
            raise ValueError(f"no body {name!r} in the scene: it has {', '.join(self.names)}")
        return self._index[name]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the bodies, in order."""
        return tuple(b.name for b in self.bodies)

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """Shapes of the bodies, in order (at rest)."""
        return tuple(b.shape for b in self.bodies)

    @property
    def parents(self) -> NDArray[np.int64]:
        """Index of each body's parent, −1 for none, ``(B,)``."""
        return np.array(
            [-1 if b.parent is None else self._index[b.parent] for b in self.bodies], dtype=np.int64
        )

    @property
    def materials(self) -> tuple[Material, ...]:
        """Material of each body, names looked up in the registry."""
        return tuple(material_of(b.material) for b in self.bodies)

    def inside(self, name: str) -> tuple[str, ...]:
        """The body ``name`` and all bodies inside it, at any depth."""
        members = {name: None} if name in self._index else {}
        self.index(name)
        for body in self.bodies:
            if body.parent in members:
                members[body.name] = None
        return tuple(members)

    def contrast(self, energies: ArrayLike) -> Floats:
        """What a chord of each body adds to a line integral: ``μ(material) − μ(parent's
        material)``.

        Args:
            energies: photon energies ``(E,)`` in keV.

        Returns:
            ``(B, E)`` float64 in mm⁻¹.
        """
        mu = np.stack(
            [np.asarray(m.attenuation(energies), dtype=np.float64) for m in self.materials]
        )
        return mu - np.stack([mu[p] if p >= 0 else np.zeros_like(mu[0]) for p in self.parents])

    @property
    def moving(self) -> NDArray[np.bool_]:
        """Whether each body moves, ``(B,)``."""
        members = {name for m in self.motion if m.amplitude > 0 for name in self.inside(m.body)}
        return np.array([name in members for name in self.names])

    @property
    def is_static(self) -> bool:
        """Whether no body moves."""
        return not self.moving.any()

    def offsets(self, times: ArrayLike) -> Floats:
        """Displacement of each body from its place at rest.

        Args:
            times: ``(N,)`` in s.

        Returns:
            ``(B, N, 3)`` float64, x, y, z in mm.
        """
        t = np.asarray(times, dtype=np.float64)
        if t.ndim != 1 or not np.isfinite(t).all():
            raise ValueError(f"times must be a 1-D array of finite times in s, got shape {t.shape}")
        offsets = np.zeros((len(self.bodies), t.size, 3))
        for move in self.motion:
            for name in self.inside(move.body):
                offsets[self._index[name]] += move.displacement(t)
        return offsets

    def bounding_box(self, names: str | Sequence[str] | None = None) -> Floats:
        """The smallest box that contains bodies at all times of their motion.

        Args:
            names: of the bodies; None: all.

        Returns:
            Lowest and highest corner, ``(2, 3)``: x, y, z in mm.

        Raises:
            ValueError: a name that no body has.
        """
        wanted = (
            self.names if names is None else ((names,) if isinstance(names, str) else tuple(names))
        )
        low, high = np.full(3, math.inf), np.full(3, -math.inf)
        for name in wanted:
            box = self[name].shape.bounding_box
            for shift in self._extremes(name):
                low, high = np.minimum(low, box[0] + shift), np.maximum(high, box[1] + shift)
        return np.stack([low, high])

    def _extremes(self, name: str, seen_from: str | None = None) -> Floats:
        """All combinations of the extreme displacements of a body, ``(N, 3)``, one row of zeros if
        it stands still.

        ``seen_from``: another body, which may move with it; None: the scanner.
        """
        shifts = np.zeros((1, 3))
        for move in self.motion:
            members = self.inside(move.body)
            if move.amplitude > 0 and (name in members) != (seen_from in members):
                shifts = (
                    shifts[:, None] + np.concatenate([move.extremes(), np.zeros((1, 3))])
                ).reshape(-1, 3)
        return shifts

    def validate(self, samples: int = 2000) -> None:
        """Check by about ``samples`` surface points a body that each body lies inside its
        parent, and that bodies of one parent do not overlap.

        Touching is allowed (to 1e-7 of a body's size); a moving body is checked at rest and at both
        ends of its way. A body too small to be hit by its sibling's samples is found by its own.

        Raises:
            ValueError: names the two bodies and a point of the overlap.
        """
        surfaces = [shape.surface_points(samples) for shape in self.shapes]
        parents = self.parents
        for k in range(len(self.bodies)):
            if parents[k] >= 0:
                self._require_inside(k, int(parents[k]), surfaces[k])
            for j in range(k):
                if parents[j] == parents[k]:
                    self._require_apart(k, j, surfaces)

    def _require_inside(self, k: int, p: int, surface: Floats) -> None:
        parent = self.bodies[p]
        for shift in self._extremes(self.bodies[k].name, parent.name):
            level = parent.shape.level(surface + shift)
            worst = int(level.argmax())
            if level[worst] > 1.0 + _TOUCH:
                raise ValueError(
                    f"body {self.bodies[k].name!r} leaves its parent {parent.name!r}, for instance "
                    f"at (x, y, z) = {_format(surface[worst] + shift)} mm: move it, shrink it or "
                    "name another parent"
                )

    def _require_apart(self, k: int, j: int, surfaces: Sequence[Floats]) -> None:
        a, b = self.bodies[k], self.bodies[j]
        for shift in self._extremes(a.name, b.name):
            box_a, box_b = a.shape.bounding_box + shift, b.shape.bounding_box
            if (box_a[0] > box_b[1]).any() or (box_b[0] > box_a[1]).any():
                continue
            for points, shape in ((surfaces[k] + shift, b.shape), (surfaces[j] - shift, a.shape)):
                level = shape.level(points)
                deepest = int(level.argmin())
                # Equal bodies have all samples exactly on each other's surface: a point inside
                # tells them apart.
                if level[deepest] < 1.0 - _TOUCH or bool((level <= 1.0 + _TOUCH).all()):
                    raise ValueError(
                        f"bodies {a.name!r} and {b.name!r} overlap, for instance at (x, y, z) = "
                        f"{_format(points[deepest])} mm: move one, or make it the other's child"
                    )

    def replace_material(self, name: str, material: Material | str) -> Scene:
        """The same scene with another material in the body ``name``."""
        k = self.index(name)
        bodies = (
            *self.bodies[:k],
            replace(self.bodies[k], material=material),
            *self.bodies[k + 1 :],
        )
        return Scene(bodies, self.motion, validate=False)

    def with_motion(self, motion: SinusoidalMotion | Sequence[SinusoidalMotion] | None) -> Scene:
        """The same bodies with another motion (``None``: at rest); checked for overlap like a
        new scene."""
        return Scene(self.bodies, motion)

    def add(self, *bodies: Body) -> Scene:
        """The scene with further bodies behind the present ones; checked for overlap like a new
        scene."""
        return Scene((*self.bodies, *bodies), self.motion)

    def labels(self, where: VolumeGrid | ArrayLike) -> NDArray[np.int64]:
        """Index of the innermost body at points or voxel centres, −1 in the surroundings; at rest.

        Args:
            where: points ``(..., 3)`` of x, y, z in mm, or a
                :class:`~torchpcct.geometry.VolumeGrid`.

        Returns:
            ``(...)`` or ``grid.shape``, int64.
        """
        points = (
            voxel_centres(where)
            if isinstance(where, VolumeGrid)
            else np.asarray(where, dtype=np.float64)
        )
        labels = np.full(points.shape[:-1], -1, dtype=np.int64)
        for k, (body, parent) in enumerate(zip(self.bodies, self.parents, strict=True)):
            labels[(labels == parent) & body.shape.contains(points)] = k
        return labels

    def volume_fractions(self, grid: VolumeGrid, oversample: int = 16) -> Floats:
        """Share of each voxel that each body fills itself, without the bodies inside it; at rest.

        See :func:`torchpcct.scene.raster.volume_fractions`; ``(B, *grid.shape)`` float64.
        """
        from torchpcct.scene.raster import volume_fractions  # its kernels need numba, a slow import

        return volume_fractions(self.shapes, self.parents.tolist(), grid, oversample)

    def render(
        self,
        grid: VolumeGrid,
        values: Mapping[str, float],
        outside: float = 0.0,
        oversample: int = 16,
    ) -> Floats:
        """Reference image: volume-weighted mean of one value per body (HU, mm⁻¹, …) in each voxel,
        at rest.

        Args:
            grid: 2-D (the plane z = 0) or 3-D.
            values: one number for every body, by name.
            outside: value of the surroundings.
            oversample: see :func:`torchpcct.scene.raster.volume_fractions`.

        Returns:
            ``grid.shape`` float64.
        """
        missing = [name for name in self.names if name not in values]
        if missing or len(values) != len(self.bodies):
            raise ValueError(
                f"values must name every body once ({', '.join(self.names)}), got "
                f"{', '.join(values)}"
            )
        fractions = self.volume_fractions(grid, oversample)
        levels = np.array([values[name] - outside for name in self.names], dtype=np.float64)
        return np.tensordot(levels, fractions, axes=1) + outside

    def material_map(self, grid: VolumeGrid, energy_kev: float, oversample: int = 16) -> Floats:
        """Linear attenuation coefficient of each voxel at one photon energy, at rest.

        Args:
            grid: of the voxels.
            energy_kev: photon energy, a number.
            oversample: sub-voxels along each axis where a body's surface crosses a voxel.

        Returns:
            mm⁻¹, the mean over each voxel, ``grid.shape`` float64.

        Raises:
            ValueError: several energies, or one that is not positive or outside the cross-section
                table.
        """
        energy = np.atleast_1d(np.asarray(energy_kev, dtype=np.float64))
        if energy.size != 1 or not energy[0] > 0:
            raise ValueError(
                f"energy_kev must be one energy greater than 0 keV, got {energy_kev!r}"
            )
        mu = [float(np.ravel(m.attenuation(energy))[0]) for m in self.materials]
        return self.render(grid, dict(zip(self.names, mu, strict=True)), oversample=oversample)


@checked
def voxel_centres(grid: VolumeGrid) -> Floats:
    """``(*grid.shape, 3)`` as x, y, z in mm; a 2-D grid lies in the plane z = 0."""
    axes = grid.axes if grid.ndim == 3 else (np.zeros(1), *grid.axes)
    z, y, x = np.meshgrid(*axes, indexing="ij")
    return np.stack([x, y, z], axis=-1).reshape(*grid.shape, 3)


def _format(point: Floats) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in point) + ")"
