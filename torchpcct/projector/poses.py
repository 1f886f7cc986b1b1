"""Geometries of which some numbers are tensors, so that readings have gradients by them.

Whatever a geometry's number is, it acts on a view through its pose: source, detector centre and the
steps u and v to the next column and row. :func:`with_parameters` makes a scan whose poses are
computed from tensors; :class:`~torchpcct.projector.Projector` has the readings' derivatives by the
poses.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from torch import Tensor

from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import Geometry, ParallelBeam
from torchpcct.validate import checked, choice
from torchpcct.vector_geometry import VectorGeometry

if TYPE_CHECKING:
    from torchpcct.typing import Floats


__all__ = ["PARAMETERS", "ParametricGeometry", "with_parameters"]

PARAMETERS: Mapping[str, str] = {
    "offset": "mm",
    "row_offset": "mm",
    "axis": "mm",
    "sod": "mm",
    "sdd": "mm",
    "angles": "rad",
    "roll": "rad",
    "tilt": "rad",
    "slant": "rad",
    "vectors": "mm",
}
"""What :func:`with_parameters` takes, and its unit."""
_TURNS = ("slant", "tilt", "roll")
"""Turns of the detector, in the order in which they are carried out."""


class ParametricGeometry:
    """A scan some of whose numbers are tensors; made by :func:`with_parameters`.

    Attributes:
        base: the scan that the numbers are put into.
        parameters: tensors by name.
    """

    def __init__(self, base: Geometry, parameters: Mapping[str, Tensor]) -> None:
        self.base, self.parameters = base, dict(parameters)

    def __repr__(self) -> str:
        return f"ParametricGeometry({self.base!r}, {', '.join(self.parameters)})"

    @property
    def bend(self) -> float:
        """Angle between neighbouring columns of a detector on an arc, rad; 0: flat."""
        g: Any = self.base
        curved = getattr(g, "detector", "flat") == "curved"
        return float(g.column_pitch / g.sdd) if curved else 0.0

    def poses(self) -> Tensor:
        """``(views, 4, 3)`` float64: source (of parallel rays: direction), detector centre, u, v,
        with gradients; of a curved detector centre and u are those of the arc's middle, and the
        centre stands in the plane of the source.

        Raises:
            ValueError: values that are not finite, or ``sdd`` not greater than ``sod``.
        """
        given = {name: value.to("cpu", torch.float64) for name, value in self.parameters.items()}
        for name, value in given.items():
            if not torch.isfinite(value).all():
                raise ValueError(f"{name} has values that are not finite")
        if isinstance(self.base, VectorGeometry):
            source, centre, u, v = _of_vectors(self.base, given)
        else:
            source, centre, u, v = _of_circle(self.base, given)
        for name in _TURNS:
            if name in given:
                about = {"slant": v, "tilt": u, "roll": torch.linalg.cross(u, v)}[name]
                angle = given[name].reshape(-1, 1)
                u, v = _rotated(u, about, angle), _rotated(v, about, angle)
        return torch.stack([source, centre, u, v], dim=1)

    def settled(self) -> Geometry:
        """The geometry as the tensors are now, without gradients; a circular scan where it is
        one.

        Raises:
            ValueError: a curved detector that was displaced as no circular scan is.
        """
        base: Any = self.base
        if self.bend:
            if set(self.parameters) - {"offset", "angles"}:
                raise ValueError(
                    "vectors describe flat detectors only, and this one is curved: only its offset "
                    "and angles can be applied"
                )
            angles = self.parameters.get("angles")
            made = base if angles is None else _with_angles(base, angles)
            offset = self.parameters.get("offset")
            return cast(
                Geometry, made if offset is None else made.with_column_offset(float(offset))
            )
        with torch.no_grad():
            poses = self.poses().numpy()
        rows = base.shape[1] if base.has_rows else None
        flat = poses.reshape(-1, 12) if rows is not None else poses[:, :3, :2].reshape(-1, 6)
        vectors = VectorGeometry(flat, base.columns, rows, base.parallel)
        circle = vectors.as_circular()
        return vectors if circle is None or circle[1] is not None else circle[0]


def _with_angles(base: Any, angles: Tensor) -> Any:
    from dataclasses import replace

    return replace(base, angles=angles.detach().cpu().double().numpy())


@checked
def with_parameters(geometry: Geometry, **parameters: Tensor | float) -> ParametricGeometry:
    """A scan some of whose numbers are tensors, for ``Projector(with_parameters(…), grid)``:
    readings then have gradients by them.

    All but ``angles`` and ``vectors`` are one number, or one per view, ``(views,)``.

    Args:
        geometry: parallel, fan or cone beam, or a :class:`~torchpcct.VectorGeometry`; what is not
            given stays as it is there.
        parameters: any of

            * ``offset``, ``row_offset``: of the detector's centre along columns and rows, mm, in
              the place of the geometry's own;
            * ``axis``: way of the rotation axis along growing columns, off the line from the source
              that meets the detector upright, mm: source and detector stand as much the other way;
            * ``sod``, ``sdd``: distances, mm, in the place of the geometry's own;
            * ``angles``: of the views ``(views,)``, rad, in the place of the geometry's own;
            * ``roll``, ``tilt``, ``slant``: of the detector about its own centre, rad, as
              :meth:`torchpcct.VectorGeometry.turned` has them;
            * ``vectors``: of a ``VectorGeometry``, as it has them, in the place of its own.

    Raises:
        TypeError: another geometry, a parameter that is no number or tensor of real numbers.
        ValueError: an unknown parameter, one that the geometry does not have, a wrong shape.

    Example:
        >>> import torch
        >>> from torchpcct import FanBeam, Projector, VolumeGrid, full_turn
        >>> from torchpcct.projector import with_parameters
        >>> offset = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
        >>> fan = with_parameters(FanBeam(full_turn(8), 60.0, 110.0, 21, 2.0), offset=offset)
        >>> A = Projector(fan, VolumeGrid((8, 8), 1.5))
        >>> A(torch.rand(8, 8).cumsum(1)).square().sum().backward()
        >>> offset.grad.shape
        torch.Size([])
    """
    if not isinstance(geometry, Geometry):
        raise TypeError(f"geometry must be a scan geometry, got {type(geometry).__name__}")
    given = {}
    for name, value in parameters.items():
        choice("parameter", name, tuple(PARAMETERS))
        given[name] = _tensor(name, value, geometry)
    _refuse(geometry, given)
    return ParametricGeometry(geometry, given)


def _tensor(name: str, value: object, geometry: Geometry) -> Tensor:
    try:
        tensor = value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{name} must be a tensor or number, got {type(value).__name__}") from None
    if not tensor.is_floating_point():
        raise TypeError(f"{name} must be a tensor of floating point, got {tensor.dtype}")
    views: tuple[int, ...] = (geometry.views,)
    if name == "vectors":
        if not isinstance(geometry, VectorGeometry):
            raise ValueError("vectors are those of a VectorGeometry: VectorGeometry.of(geometry)")
        shapes = [tuple(geometry.vectors.shape)]
    else:
        shapes = [views] if name == "angles" else [(), views]
    if tuple(tensor.shape) not in shapes:
        raise ValueError(
            f"{name} must have the shape {' or '.join(map(str, shapes))}, got {tuple(tensor.shape)}"
        )
    if not torch.isfinite(tensor.detach()).all():
        raise ValueError(f"{name} has values that are not finite")
    return tensor


def _refuse(geometry: Geometry, given: Mapping[str, Tensor]) -> None:
    """Parameters that the geometry does not have (ValueError)."""
    per_view = not geometry.on_circle
    missing = {
        "angles": "of a VectorGeometry are in its vectors" if per_view else "",
    }
    for name in ("sod", "sdd"):
        missing[name] = "of a VectorGeometry are in its vectors" if per_view else ""
        if geometry.parallel and not per_view:
            missing[name] = "does not exist of parallel rays"
    if not geometry.has_rows:
        for name in ("row_offset", "roll", "tilt"):
            missing[name] = "needs a detector with rows: without, it would leave the plane"
    if getattr(geometry, "detector", "flat") == "curved":
        for name in ("row_offset", "sdd", *_TURNS):
            missing[name] = missing.get(name) or (
                "of a curved detector has no gradient here: it is fixed; a flat one has"
            )
    for name in given:
        if missing.get(name):
            raise ValueError(f"{name} {missing[name]}")


def _of_circle(geometry: Any, given: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Source, centre, u and v ``(views, 3)`` of a circular scan."""

    def of(name: str, own: float | Floats) -> Tensor:
        value = given.get(name)
        return torch.tensor(own, dtype=torch.float64) if value is None else value

    beta = of("angles", np.array(geometry.angles))
    zero = torch.zeros_like(beta)
    radial = torch.stack([torch.cos(beta), torch.sin(beta), zero], 1)
    tangent = torch.stack([-torch.sin(beta), torch.cos(beta), zero], 1)
    up = torch.stack([zero, zero, zero + 1.0], 1)
    offset = of("offset", geometry.column_offset).reshape(-1, 1)
    aside = -of("axis", 0.0).reshape(-1, 1) * tangent
    u = geometry.column_pitch * tangent
    v = (geometry.row_pitch if geometry.has_rows else 1.0) * up
    if isinstance(geometry, ParallelBeam):
        return -radial, offset * tangent + aside, u, v
    sod, sdd = of("sod", geometry.sod).reshape(-1, 1), of("sdd", geometry.sdd).reshape(-1, 1)
    if bool((sdd <= sod).any()) or bool((sod <= 0).any()):
        raise ValueError("sod must be greater than 0, and sdd greater than sod")
    source = sod * radial + aside
    if geometry.detector == "curved":
        turn = offset / geometry.sdd
        centre = source - geometry.sdd * (torch.cos(turn) * radial - torch.sin(turn) * tangent)
        along = torch.sin(turn) * radial + torch.cos(turn) * tangent
        return source, centre, geometry.column_pitch * along, v
    centre = (sod - sdd) * radial + offset * tangent + aside
    if geometry.has_rows:
        centre = centre + of("row_offset", geometry.row_offset).reshape(-1, 1) * up
    return source, centre, u, v


def _of_vectors(
    geometry: VectorGeometry, given: Mapping[str, Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    poses = torch.tensor(np.array(geometry.poses))
    if "vectors" in given:
        vectors = given["vectors"]
        if geometry.rows is not None:
            poses = vectors.reshape(-1, 4, 3)
        else:
            flat = torch.cat([vectors.reshape(-1, 3, 2), torch.zeros(len(vectors), 3, 1)], 2)
            poses = torch.cat([flat, poses[:, 3:]], 1)
    source, centre, u, v = poses.unbind(1)
    for name, along, own in (
        ("offset", u, geometry.column_offset),
        ("row_offset", v, geometry.row_offset),
    ):
        if name in given:
            unit = along / along.norm(dim=1, keepdim=True)
            centre = centre + (given[name].reshape(-1, 1) - own) * unit
    if "axis" in given:
        beta = torch.tensor(geometry.angles)
        tangent = torch.stack([-torch.sin(beta), torch.cos(beta), 0 * beta], 1)
        aside = -given["axis"].reshape(-1, 1) * tangent
        source, centre = (source if geometry.parallel else source + aside), centre + aside
    return source, centre, u, v


def _rotated(x: Tensor, axis: Tensor, angle: Tensor) -> Tensor:
    """Rodrigues' rotation of ``(views, 3)`` about axes of any length by ``(views, 1)`` or
    ``(1, 1)`` rad."""
    axis = axis / axis.norm(dim=1, keepdim=True)
    c, s = torch.cos(angle), torch.sin(angle)
    return (
        x * c + torch.linalg.cross(axis, x) * s + axis * (axis * x).sum(1, keepdim=True) * (1 - c)
    )


def moved_poses(poses: Tensor, motion: Tensor, axes: int, parallel: bool) -> Tensor:
    """Poses ``(views, 4, 3)`` as an object sees them that moves by ``motion``: ``(views, axes)``
    mm (z,) y, x, and, as a last column, a rotation about the z axis in rad, before it is
    displaced."""
    shift = torch.zeros(len(poses), 3, dtype=poses.dtype)
    shift = torch.cat([motion[:, :axes].flip(1), shift[:, axes:]], 1)
    source, centre, u, v = poses.unbind(1)
    centre = centre - shift
    source = source if parallel else source - shift
    moved = torch.stack([source, centre, u, v], 1)
    if motion.shape[1] == axes:
        return moved
    c, s = torch.cos(motion[:, axes]), torch.sin(motion[:, axes])
    x, y, z = moved.unbind(2)
    c, s = c[:, None], s[:, None]
    return torch.stack([c * x + s * y, c * y - s * x, z], 2)


def windowed_poses(poses: Tensor, window: DetectorWindow, columns: int, bend: float) -> Tensor:
    """Poses of the columns that a window keeps; its rows are counted from elsewhere instead."""
    first = torch.tensor(np.array(window.first_column), dtype=poses.dtype)
    steps = (first + (window.columns - 1) / 2 - (columns - 1) / 2)[:, None]
    source, centre, u, v = poses.unbind(1)
    if not bend:
        return torch.stack([source, centre + steps * u, u, v], 1)
    way, turn = centre - source, steps * bend
    middle = source + torch.cos(turn) * way + torch.sin(turn) / bend * u
    along = torch.cos(turn) * u - bend * torch.sin(turn) * way
    return torch.stack([source, middle, along, v], 1)
