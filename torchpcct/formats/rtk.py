"""Per-view geometry of RTK's ``ThreeDCircularProjectionGeometry`` XML, as a
:class:`~torchpcct.vector_geometry.VectorGeometry`.

Each ``<Projection>`` holds a 3 × 4 ``<Matrix>`` that maps points of the world in mm to homogeneous
detector coordinates in mm. RTK turns about its y axis; here z is the axis, x RTK's z and y RTK's x.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from typing import TYPE_CHECKING

import numpy as np

from torchpcct.formats.damage import read_text, reading
from torchpcct.validate import number, per_axis, whole
from torchpcct.vector_geometry import VectorGeometry

if TYPE_CHECKING:
    from torchpcct.typing import Floats


__all__ = ["read_rtk"]

_OURS = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""RTK's (x, y, z) to ours."""


def read_rtk(
    path: str | os.PathLike[str], columns: int, rows: int, pitch: object, origin: object = None
) -> VectorGeometry:
    """A cone beam, view by view: for ``Projector`` and ``recon.analytic.fbp.fbp``.

    Args:
        path: XML file.
        columns, rows: of the projections.
        pitch: ``(row, column)`` spacing of the projections in mm, or one number.
        origin: ``(row, column)`` detector coordinates in mm of the first pixel; None: the middle of
            the image is 0.

    Raises:
        FileNotFoundError: no such file. ValueError: damaged, no projections, a matrix that is no
            projection.
    """
    whole("columns", columns), whole("rows", rows)
    dv, du = per_axis("pitch", pitch, 2, positive=True, unit="mm")
    v0, u0 = (
        (-(rows - 1) / 2 * dv, -(columns - 1) / 2 * du)
        if origin is None
        else per_axis("origin", origin, 2)
    )
    u, v = u0 + (columns - 1) / 2 * du, v0 + (rows - 1) / 2 * dv
    text = read_text(path, "an RTK geometry")
    with reading(path, "an RTK geometry"):
        if "<!ENTITY" in text:
            raise ValueError("it defines XML entities, which no geometry needs")
        root = ElementTree.fromstring(text)
        shared = root.findtext("SourceToDetectorDistance")
        found = root.findall("Projection")
        if not found:
            raise ValueError("it has no <Projection>")
        vectors = []
        for projection in found:
            matrix = np.array((projection.findtext("Matrix") or "").split(), dtype=np.float64)
            if matrix.size != 12 or not np.isfinite(matrix).all():
                raise ValueError("a <Projection> has no 3 × 4 <Matrix>")
            distance = projection.findtext("SourceToDetectorDistance") or shared
            if distance is None:
                raise ValueError("a <Projection> has no <SourceToDetectorDistance>")
            sdd = number("SourceToDetectorDistance", distance, positive=True, unit="mm")
            vectors.append(_vector(matrix.reshape(3, 4), sdd, (u, v), (du, dv)))
    return VectorGeometry(np.array(vectors), columns, rows)


def _vector(
    p: Floats, sdd: float, middle: tuple[float, float], step: tuple[float, float]
) -> Floats:
    inverse = np.linalg.inv(p[:, :3])
    source = -inverse @ p[:, 3]
    centre = inverse @ np.array([*middle, 1.0])
    if centre @ source > 0:  # the sign of a homogeneous matrix is free
        inverse, centre = -inverse, -centre
    # The plane at distance sdd along the detector's normal.
    normal = np.cross(inverse[:, 0], inverse[:, 1])
    scale = sdd / abs(float(centre @ normal) / float(np.linalg.norm(normal)))
    parts = (
        source,
        source + scale * centre,
        scale * step[0] * inverse[:, 0],
        scale * step[1] * inverse[:, 1],
    )
    return np.concatenate([_OURS @ part for part in parts])
