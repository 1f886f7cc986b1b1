"""Geometries as ASTRA's per-view vectors, and back.

Fan: ``(source x, y, detector centre x, y, u x, y)``. Parallel: the ray direction in place of the source. Cone:
``(source x, y, z, detector centre x, y, z, u x, y, z, v x, y, z)``. ``u`` is the step to the next column, ``v`` to the
next row; mm. ASTRA's volumes have y growing upwards too, but its 2-D images start with the largest y: flip axis -2.
Import takes fan and cone vectors; a fan's and a parallel beam's look alike.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam
from torchpcct.projector.rays import check_motion
from torchpcct.vector_geometry import VectorGeometry

__all__ = ["as_circular", "from_moving_vectors", "from_vectors", "to_vectors"]


def to_vectors(geometry: Geometry, motion: Any = None) -> NDArray[np.float64]:
    """ASTRA's vectors of a scan with a flat detector, ``(views, 6)`` or, for a cone beam, ``(views, 12)`` float64.

    Args:
        geometry: the scan.
        motion: displacement of the grid per view as for ``Projector``, or None: source and detector are moved the
            other way, so that ASTRA's volume may stand still.

    Raises:
        ValueError: a curved detector, which ASTRA's vectors cannot describe; a motion of the wrong shape.
        TypeError: not a geometry.
    """
    if not isinstance(geometry, ParallelBeam | FanBeam | ConeBeam):
        raise TypeError(f"geometry must be ParallelBeam, FanBeam or ConeBeam, got {type(geometry).__name__}")
    if motion is not None:
        axes = 3 if isinstance(geometry, ConeBeam) else 2
        back = check_motion(motion, geometry.views, axes)[:, ::-1]
        vectors = to_vectors(geometry)
        if not isinstance(geometry, ParallelBeam):
            vectors[:, :axes] -= back
        vectors[:, axes : 2 * axes] -= back
        return vectors
    radial = np.stack([np.cos(geometry.angles), np.sin(geometry.angles)], axis=1)
    tangent = np.stack([-radial[:, 1], radial[:, 0]], axis=1)
    if isinstance(geometry, ParallelBeam):
        return np.concatenate([-radial, geometry.offset * tangent, geometry.pitch * tangent], axis=1)
    if geometry.detector == "curved":
        raise ValueError("ASTRA's vectors describe flat detectors only, this one is curved: use detector='flat'")
    source, foot = geometry.sod * radial, (geometry.sod - geometry.sdd) * radial
    if isinstance(geometry, FanBeam):
        return np.concatenate([source, foot + geometry.offset * tangent, geometry.pitch * tangent], axis=1)
    zero = np.zeros((geometry.views, 1))
    return np.concatenate(
        [
            source, zero, foot + geometry.offset[1] * tangent, zero + geometry.offset[0],
            geometry.pitch[1] * tangent, zero, zero, zero, zero + geometry.pitch[0],
        ],
        axis=1,
    )  # fmt: skip


def from_vectors(vectors: Any, columns: int, rows: int | None = None) -> FanBeam | ConeBeam:
    """The circular scan that ASTRA's fan (6) or cone (12) vectors describe.

    Args:
        vectors: ``(views, 6)`` or ``(views, 12)``, mm.
        columns: detector columns.
        rows: detector rows (cone beam only).

    Raises:
        ValueError: a wrong shape; vectors that are not a circular orbit about z with an upright flat detector whose
            columns grow along the orbit, the same in all views (tolerance 1e-6 of ``sdd``). Source and detector that
            move together against such a scan are read by :func:`from_moving_vectors`.
    """
    v = _checked(vectors, columns, rows)
    angles = np.arctan2(v[:, 1], v[:, 0])
    local = _local(v, angles)
    mean = local.mean(axis=0)
    sod, sdd = float(mean[0]), float(mean[0] - mean[3])
    wanted = np.array([sod, 0, 0, sod - sdd, mean[4], mean[5], 0, mean[7], 0, 0, 0, mean[11]])
    _refuse(local - wanted, sdd, "source", "use from_moving_vectors if source and detector moved together")
    return _scan(angles, sod, sdd, columns, rows, mean)


def from_moving_vectors(
    vectors: Any, columns: int, rows: int | None = None, sod: float | None = None
) -> tuple[FanBeam | ConeBeam, NDArray[np.float64]]:
    """The circular scan and the motion of the grid that ASTRA's fan (6) or cone (12) vectors describe.

    The inverse of ``to_vectors(geometry, motion)``: in every view source and detector may be displaced together. A
    radial displacement and a larger orbit look the same; hence ``sod``.

    Args:
        vectors: ``(views, 6)`` or ``(views, 12)``, mm.
        columns: detector columns.
        rows: detector rows (cone beam only).
        sod: radius of the source's orbit, mm, or None for the one with the smallest motion (root mean square).

    Returns:
        the scan, and the displacement of the grid per view as for ``Projector``, ``(views, 2)`` (y, x) or
        ``(views, 3)`` (z, y, x) float64 mm.

    Raises:
        ValueError: a wrong shape; a detector that is not upright, flat, facing the source in the same way and at
            the same distance in all views (tolerance 1e-6 of the distance); a ``sod`` that is not between 0 and
            the source-detector distance.
    """
    v = _checked(vectors, columns, rows)
    angles = np.arctan2(-v[:, 6], v[:, 7])  # columns grow along (-sin, cos)
    local = _local(v, angles)
    local[:, :3] -= local[:, 3:6]  # from the detector's centre to the source: no displacement in it
    mean = local.mean(axis=0)
    sdd = float(mean[0])
    wanted = np.array([sdd, mean[1], mean[2], *[0.0] * 3, 0, mean[7], 0, 0, 0, mean[11]])
    error = local - wanted
    error[:, 3:6] = 0
    _refuse(error, sdd, "way from detector to source", "no displacement of source and detector together explains it")
    radius = float((v[:, :3] * _frames(angles)[:, 0]).sum(axis=1).mean()) if sod is None else float(sod)
    if not 0 < radius < sdd:
        raise ValueError(f"sod must lie between 0 and the source-detector distance {sdd:g} mm, got {radius:g}")
    mean[4:6] = -mean[1:3]
    geometry = _scan(angles, radius, sdd, columns, rows, mean)
    axes = 2 if rows is None else 3
    back = to_vectors(geometry)[:, :axes] - v[:, :axes]
    return geometry, np.ascontiguousarray(back[:, ::-1])


def as_circular(geometry: VectorGeometry) -> tuple[Geometry, NDArray[np.float64] | None] | None:
    """The circular scan, and the motion of the grid or None, that a scan given by vectors is, to 1e-9; else None."""
    v = np.asarray(geometry.vectors)
    scale = float(np.abs(v).max())
    found: Geometry
    try:
        if not geometry.parallel:
            found, motion = from_moving_vectors(v, geometry.columns, geometry.rows)
        elif geometry.rows is None:
            found, motion = _moving_parallel(v, geometry.columns)
        else:
            return None  # no parallel beam with rows is one of ours
    except ValueError:
        return None
    again = to_vectors(found, motion)
    if isinstance(found, ParallelBeam):  # a ray's direction has no length, and its line no sense
        v = v.copy()
        v[:, :2] *= (np.sign((v[:, :2] * again[:, :2]).sum(1)) / np.linalg.norm(v[:, :2], axis=1))[:, None]
    if np.abs(again - v).max() > 1e-9 * scale:
        return None
    return found, None if np.abs(motion).max() <= 1e-9 * scale else motion


def _moving_parallel(v: NDArray[np.float64], columns: int) -> tuple[ParallelBeam, NDArray[np.float64]]:
    angles = np.arctan2(-v[:, 4], v[:, 5])
    tangent = np.stack([-np.sin(angles), np.cos(angles)], axis=1)
    place = (v[:, 2:4] * tangent).sum(1)
    offset = float(place.mean())
    # What the centre is off along the rays does not matter, but belongs to the vectors.
    back = offset * tangent - v[:, 2:4]
    geometry = ParallelBeam(angles, columns, float(np.linalg.norm(v[:, 4:], axis=1).mean()), offset)
    return geometry, np.ascontiguousarray(back[:, ::-1])


def _checked(vectors: Any, columns: int, rows: int | None) -> NDArray[np.float64]:
    """The vectors of a cone beam; those of a fan become a cone's with a row pitch of 1."""
    v = np.asarray(vectors, dtype=np.float64)
    if v.ndim != 2 or v.shape[1] not in (6, 12):
        raise ValueError(f"vectors must have shape (views, 6) or (views, 12), got {v.shape}")
    if not len(v) or not np.isfinite(v).all():
        raise ValueError("vectors must have at least one view, and finite values only")
    cone = v.shape[1] == 12
    if cone != (rows is not None):
        raise ValueError(f"{v.shape[1]} numbers per view need rows {'≥ 1' if cone else '= None'}, got {rows!r}")
    if cone:
        return v
    zero = np.zeros((len(v), 1))
    return np.concatenate([v[:, :2], zero, v[:, 2:4], zero, v[:, 4:], zero, zero, zero, zero + 1.0], axis=1)


def _frames(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(views, 3, 3)``: radial, tangential and z direction."""
    frame = np.zeros((len(angles), 3, 3))
    frame[:, 0, 0] = frame[:, 1, 1] = np.cos(angles)
    frame[:, 0, 1], frame[:, 1, 0] = np.sin(angles), -np.sin(angles)
    frame[:, 2, 2] = 1.0
    return frame


def _local(v: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """The four vectors of every view along its radial, tangential and z direction."""
    return np.einsum("vij,vpj->vpi", _frames(angles), v.reshape(-1, 4, 3)).reshape(-1, 12)


def _refuse(error: NDArray[np.float64], sdd: float, first: str, remedy: str) -> None:
    largest = np.abs(error).max(axis=0)
    if largest.max() <= 1e-6 * abs(sdd):
        return
    worst = int(largest.argmax())
    part = (first, "detector centre", "u", "v")[worst // 3]
    direction = ("radial", "tangential", "z")[worst % 3]
    raise ValueError(
        f"the vectors are no circular scan with an upright detector: the {direction} part of the {part} is off by "
        f"{largest[worst]:.3g} mm; {remedy}"
    )


def _scan(
    angles: NDArray[np.float64], sod: float, sdd: float, columns: int, rows: int | None, mean: NDArray[np.float64]
) -> FanBeam | ConeBeam:
    if rows is not None:
        return ConeBeam(angles, sod, sdd, columns, rows, (mean[11], mean[7]), (mean[5], mean[4]))
    return FanBeam(angles, sod, sdd, columns, mean[7], mean[4])
