"""Is ``mu_water`` given in another unit? What an object of tissue or plastic reads then, no object
of that size does."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, binary_fill_holes, minimum_filter
from torch import Tensor

from recon.analytic.angular_weights import angular_weights
from recon.analytic.backproject import backproject
from recon.analytic.filter_plan import FilterPlan
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import FanBeam, Geometry, ParallelBeam, VolumeGrid, beam

_UNITS = {
    10.0: "is mu_water given in cm⁻¹?",
    100.0: "was mu_water converted from cm⁻¹ the wrong way?",
    1000.0: "is mu_water given in m⁻¹?",
    0.1: "is mu_water divided by 10 twice?",
}
"""How many times too large ``mu_water`` is, and the question that this raises."""
_WATER_MM = (0.014, 0.1)
"""Attenuation of water, mm⁻¹, for photons of 190 to 18 keV (NIST XCOM): of X-ray tubes, behind
objects that are opaque to less."""
_OPAQUE = 5.0
"""Line integral of water of the object's width from which nobody would have chosen such photons for
what is as dense as water. Thinner objects of little density are scanned with them on purpose."""
_ROUGHLY = 5.0
"""Factor within which the darkest ray of an object as dense as water shows that density, bones and
an oblong shape left in."""
_SOFT = {10.0: (0.7, 2.0), 100.0: (0.7, 2.0), 1000.0: (0.7, 2.0), 0.1: (0.85, 1.2)}
"""Attenuation over that of water of what is taken for tissue or plastic. What is ten times denser
than water, lead in a beam of megavolts, is close to iron (7.2) and copper (7.4)."""
_SOLID = 0.25
"""Share of the object's attenuation that must lie in such plateaus: none do in foam of pores that
are seen, in shells, nor in several small bodies apart."""
_DENSE = 0.02
"""Share of the object's attenuation that may lie in what is half as dense as ``mu_water`` says or
more. The walls of a hollow object are."""
_WALL = 0.28
"""Share of the attenuation that may lie in a denser wall about the object: 0.23 in a skull of 6 mm;
walls of plastic about foam, smeared by the cells, hold more."""
_WALL_VOXELS = 4
"""How far such a wall reaches into the object, in voxels."""
_DENSER = 1.3
"""Times the plateau from which something is denser."""
_REACH = 5
"""Width, in voxels, over which a plateau has no border, so that no thin wall is one that the cells
have smeared."""
_SHADOW = 0.1
"""Share of the highest line integral that is the object's shadow."""
_FLAT = (0.8, 0.85)
"""Share of the darkest rays, and of the shadow in which all rays are that dark: from there on it is
the readings that stop, since no light is left. Of a disc three fifths of the shadow are."""
_ALIKE = 0.7
"""Share of a row's highest line integral that the rows beside it show, too. Of what is thinner than
a row no thickness is known."""
_MOST_CELLS = 128
"""Cells of a row, joined, from which its image is made."""


def unit_warnings(lines: Tensor, geometry: Geometry, mu_water: float) -> list[str]:
    """Whether all of an object reads as tissue or plastic does where ``mu_water`` is of another
    unit: ten times too large, say. Of other errors of ``mu_water`` no data can tell, nor of this
    one in an object that is hollow, of thin walls, of metal, or small.

    Args:
        lines: line integrals ``(views, [rows,] columns)``.
        geometry: parallel, fan or cone beam.
        mu_water: mm⁻¹.

    Returns:
        One sentence, or none.
    """
    units = [factor for factor in _UNITS if _WATER_MM[0] <= mu_water / factor <= _WATER_MM[1]]
    if not units:
        return []
    p = lines.reshape(geometry.views, -1, geometry.columns).double()
    row = _row(p.amax((0, 2)).numpy())
    if row is None:
        return []
    p = p[:, row]
    # No object is thinner along all rays than it is wide in its narrowest view.
    cell = np.abs(np.gradient(beam(geometry).ray_distances))
    values = p.numpy()
    seen = values > _SHADOW * float(values.max())
    across = float((seen * cell).sum(1).min())
    darkest = float(np.quantile(values.max(1), 0.9))
    if not seen.any() or (values[seen] > _FLAT[0] * darkest).mean() > _FLAT[1]:
        return []
    for factor in units:
        expected = mu_water / factor * across
        if factor > 1.0 and factor * expected < _OPAQUE:
            continue
        if not expected / _ROUGHLY < darkest < _ROUGHLY * expected:
            continue
        found = _plateau(p, geometry, mu_water, factor)
        if found is not None:
            return [
                f"the object reads {found:.2g} times water of mu_water = {mu_water:.3g} mm⁻¹ "
                f"throughout, {1000.0 * (found - 1.0):.0f} HU: {_UNITS[factor]} An object of "
                f"tissue or plastic would read so if {mu_water / factor:.3g} mm⁻¹ is meant; only "
                f"{'foam' if factor > 1.0 else 'heavy metal'} reads so otherwise"
            ]
    return []


def _row(darkest: NDArray[np.float64]) -> int | None:
    """The row of the highest line integral whose neighbours show nearly as much; None: there is
    none."""
    if len(darkest) == 1:
        return 0
    neighbours = np.minimum(darkest[:-2], darkest[2:])
    alike = np.flatnonzero(neighbours > _ALIKE * darkest[1:-1]) + 1
    return int(alike[np.argmax(darkest[alike])]) if alike.size else None


def _plateau(p: Tensor, geometry: Geometry, mu_water: float, factor: float) -> float | None:
    """Median attenuation, over ``mu_water``, of an object that is all of tissue or plastic if
    ``mu_water`` is ``factor`` times too large; None: it is another one, or a part of a turn is too
    short for an image of it.

    Args:
        p: line integrals of a row, ``(views, columns)``.
        geometry: of the scan.
        mu_water: mm⁻¹.
        factor: one of ``_UNITS``.
    """
    image = row_image(p, geometry)
    if image is None:
        return None
    density = np.maximum(image, 0.0) / mu_water
    total = float(density.sum())
    low, high = (bound / factor for bound in _SOFT[factor])
    solid = minimum_filter(density, _REACH, mode="constant") > 0.5 * density
    soft = density[solid & (density > low) & (density < high)]
    if not soft.sum() > _SOLID * total:
        return None
    plateau = float(np.median(soft))
    if factor > 1.0:
        walls = density[_rim(density > 0.5 * plateau) & (density > _DENSER * plateau)]
        if density[density > 0.5].sum() > _DENSE * total or walls.sum() > _WALL * total:
            return None
    return plateau


def _rim(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The border of an object, ``_WALL_VOXELS`` wide: holes have none."""
    filled = binary_fill_holes(inside)
    rim: NDArray[np.bool_] = filled & ~binary_erosion(filled, iterations=_WALL_VOXELS)
    return rim


def row_image(p: Tensor, geometry: Any) -> NDArray[np.float64] | None:
    """A small image of the whole field of view from a row's line integrals ``(views, columns)``,
    taken for those of a beam in its plane, mm⁻¹; None: a part of a turn is too short for it."""
    lines, plane = _plane(p, geometry)
    side = max(2, math.ceil(2.0 * plane.fov_radius / plane.cell))
    whole = DetectorWindow.full(plane)
    try:
        weights = angular_weights(plane)
    except ValueError:
        return None
    filtered = FilterPlan(plane, ("soft",), weights, whole, whole).forward(lines.unsqueeze(-2))
    image = backproject(filtered[0, :, 0], plane, VolumeGrid((side, side), plane.cell))
    found: NDArray[np.float64] = image.double().numpy()
    return found


def _plane(p: Tensor, geometry: Any) -> tuple[Tensor, ParallelBeam | FanBeam]:
    """A row as that of a beam in its plane, cells joined to at most ``_MOST_CELLS``."""
    joined = math.ceil(geometry.columns / _MOST_CELLS)
    kept = geometry.columns // joined
    lines = p[:, : kept * joined].reshape(len(p), kept, joined).mean(-1)
    pitch = joined * geometry.column_pitch
    offset = geometry.column_offset - (geometry.columns - kept * joined) / 2 * geometry.column_pitch
    if geometry.parallel:
        return lines, ParallelBeam(geometry.angles, kept, pitch, offset)
    return lines, FanBeam(
        geometry.angles, geometry.sod, geometry.sdd, kept, pitch, offset, geometry.detector
    )
