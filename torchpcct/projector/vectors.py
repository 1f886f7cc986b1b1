"""Geometries as ASTRA's per-view vectors, and back.

Fan: ``(source x, y, detector centre x, y, u x, y)``. Parallel: the ray direction in place of the source. Cone:
``(source x, y, z, detector centre x, y, z, u x, y, z, v x, y, z)``. ``u`` is the step to the next column, ``v`` to the
next row; mm. ASTRA's volumes have y growing upwards too, but its 2-D images start with the largest y: flip axis -2.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam
from torchpcct.projector.rays import check_motion

__all__ = ["from_vectors", "to_vectors"]


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
            columns grow along the orbit, the same in all views (tolerance 1e-6 of ``sdd``).
    """
    v = np.asarray(vectors, dtype=np.float64)
    if v.ndim != 2 or v.shape[1] not in (6, 12):
        raise ValueError(f"vectors must have shape (views, 6) or (views, 12), got {v.shape}")
    cone = v.shape[1] == 12
    if cone != (rows is not None):
        raise ValueError(f"{v.shape[1]} numbers per view need rows {'≥ 1' if cone else '= None'}, got {rows!r}")
    if not cone:
        zero = np.zeros((len(v), 1))
        v = np.concatenate([v[:, :2], zero, v[:, 2:4], zero, v[:, 4:], zero, zero, zero, zero + 1.0], axis=1)
    source, centre, u, w = v[:, :3], v[:, 3:6], v[:, 6:9], v[:, 9:]
    angles = np.arctan2(source[:, 1], source[:, 0])
    frame = np.zeros((len(v), 3, 3))  # radial, tangent, z
    frame[:, 0, 0] = frame[:, 1, 1] = np.cos(angles)
    frame[:, 0, 1], frame[:, 1, 0] = np.sin(angles), -np.sin(angles)
    frame[:, 2, 2] = 1.0
    local = np.concatenate([np.einsum("vij,vj->vi", frame, part) for part in (source, centre, u, w)], axis=1)
    mean = local.mean(axis=0)
    sod, sdd = float(mean[0]), float(mean[0] - mean[3])
    wanted = np.array([sod, 0, 0, sod - sdd, mean[4], mean[5], 0, mean[7], 0, 0, 0, mean[11]])
    error = np.abs(local - wanted).max(axis=0)
    if error.max() > 1e-6 * abs(sdd):
        worst = int(error.argmax())
        part = ("source", "detector centre", "u", "v")[worst // 3]
        direction = ("radial", "tangential", "z")[worst % 3]
        raise ValueError(
            f"the vectors are no circular scan with an upright detector: the {direction} part of the {part} is off by "
            f"{error[worst]:.3g} mm"
        )
    if cone:
        assert rows is not None
        return ConeBeam(angles, sod, sdd, columns, rows, (mean[11], mean[7]), (mean[5], mean[4]))
    return FanBeam(angles, sod, sdd, columns, mean[7], mean[4])
