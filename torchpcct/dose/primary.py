"""Absorbed dose by the photons that come straight from the tube: exact paths through analytic
bodies.

At a point r of the slice, at distance d from the focal spot of view β and fan angle γ,

    D(r) = mAs · ⟨ Σ_E Φ(γ, E) · (1 m / d)² · exp(−Σ_b chord_b Δμ_b(E)) · E · (μ_en / ρ)(E) ⟩_β,

Φ being the fluence in air at 1 m per mAs (:func:`torchpcct.dose.air_fluence`). Chords run from the
focal spot to the point. Scattered photons are added by :mod:`torchpcct.dose.scatter`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numba
import numpy as np
from numpy.typing import NDArray

from torchpcct.acquisition.transmission import compress
from torchpcct.dose.coefficients import (
    MGY_PER_KEV_PER_G,
    air_fluence,
    fan_half_angle,
    mass_energy_absorption,
    mass_interaction,
)
from torchpcct.geometry import VolumeGrid
from torchpcct.kernel_cache import forget_outdated
from torchpcct.scanner import Scanner
from torchpcct.scene import Scene
from torchpcct.scene.chord_kernels import interval
from torchpcct.scene.chords import pack
from torchpcct.scene.materials import material
from torchpcct.scene.scene import voxel_centres
from torchpcct.threads import run
from torchpcct.validate import checked, choice, number, whole

if TYPE_CHECKING:
    from torchpcct.scene.materials import Material


__all__ = ["primary_dose"]

Floats = NDArray[np.float64]

QUANTITIES = ("absorbed", "interacted")
"""What is deposited where a photon interacts: the energy that is absorbed, or all that it had."""
_AXIAL = ("plane", "contiguous")
"""Single beam in one plane, or contiguous rotations."""
_FAN_NODES = 1025
"""Fan angles at which the spectrum behind the bowtie is tabulated."""
_GROUP_KEV = 3.0
"""Width of the energy groups."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _dose(
    begin: int,
    end: int,
    xs: Floats,
    ys: Floats,
    z: float,
    cos_b: Floats,
    sin_b: Floats,
    sod: float,
    kinds: NDArray[np.int64],
    params: Floats,
    coefficients: Floats,
    basis: NDArray[np.int64],
    half_fan: float,
    fluence: Floats,
    deposit: Floats,
    medium: NDArray[np.int64],
    falloff: int,
    out: Floats,
) -> None:
    rank, energies = basis.shape
    nodes = fluence.shape[0]
    step = (nodes - 1) / (2.0 * half_fan)
    for i in range(begin, end):
        own = medium[i]
        if own < 0:
            continue
        path = np.empty(rank)
        total = 0.0
        for view in range(cos_b.size):
            ox, oy = sod * cos_b[view], sod * sin_b[view]
            dx, dy = xs[i] - ox, ys[i] - oy
            distance = math.sqrt(dx * dx + dy * dy)
            dx /= distance
            dy /= distance
            # Columns grow along e_t = (−sin β, cos β); the central ray runs along −e_r.
            gamma = math.atan2(
                dy * cos_b[view] - dx * sin_b[view], -(dx * cos_b[view] + dy * sin_b[view])
            )
            place = (gamma + half_fan) * step
            if place < 0.0 or place > nodes - 1:
                continue
            low = min(int(place), nodes - 2)
            share = place - low
            for a in range(rank):
                path[a] = 0.0
            for b in range(kinds.size):
                t0, t1 = interval(kinds[b], params[b], ox, oy, z, dx, dy, 0.0)
                t0, t1 = max(t0, 0.0), min(t1, distance)
                if t1 > t0:
                    for a in range(rank):
                        path[a] += (t1 - t0) * coefficients[b, a]
            view_sum = 0.0
            for e in range(energies):
                line = 0.0
                for a in range(rank):
                    line += path[a] * basis[a, e]
                photons = (1.0 - share) * fluence[low, e] + share * fluence[low + 1, e]
                view_sum += photons * math.exp(-line) * deposit[own, e]
            total += view_sum * (1000.0 / distance) ** 2 * (distance / sod if falloff == 1 else 1.0)
        out[i] = total / cos_b.size


def slice_points(where: object, z_mm: float) -> Floats:
    """Points ``(..., 3)`` of a slice in mm: the voxel centres of a 2-D grid, or points ``(..., 2)``
    of x, y.

    Raises:
        ValueError: a 3-D grid, points of another shape or that are not finite.
    """
    if isinstance(where, VolumeGrid):
        if where.ndim != 2:
            raise ValueError(
                f"the map needs a 2-D (y, x) grid, got {where.ndim} axes: use grid.slice"
            )
        where = voxel_centres(where)[..., :2]
    points = np.asarray(where, dtype=np.float64)
    if points.shape[-1:] != (2,) or not np.isfinite(points).all():
        raise ValueError(
            f"points must be finite and have the shape (..., 2) of x, y in mm, got {points.shape}"
        )
    return np.concatenate([points, np.full((*points.shape[:-1], 1), float(z_mm))], axis=-1)


def check_static(scene: Scene) -> None:
    """Raise ``ValueError`` for a moving scene."""
    if not scene.is_static:
        raise ValueError(
            "the scene moves, and a dose map needs one position: give scene.with_motion(None)"
        )


@checked
def primary_dose(
    scene: Scene,
    scanner: Scanner,
    where: object,
    exposure_s: float,
    *,
    z_mm: float = 0.0,
    views: int = 360,
    medium: Material | str | None = None,
    quantity: str = "absorbed",
    axial: str = "plane",
    group_kev: float = _GROUP_KEV,
) -> Floats:
    """Dose of one rotation by unscattered photons in an axial slice.

    Args:
        scene: bodies at rest; the source circles in the plane of the slice.
        scanner: source, filters, bowties; the fan ends where the detector ends.
        where: 2-D :class:`~torchpcct.geometry.VolumeGrid`, or points ``(..., 2)`` of x, y in mm.
        exposure_s: duration of the rotation in s at the source's current.
        z_mm: height of the slice.
        views: source positions that stand for the continuous rotation; those of the scanner do not
            matter. 360 are exact to 1e-3 inside bodies; behind bone edges give more.
        medium: material or its name in which dose is scored; None: that of the innermost body at
            each point, and 0 in the surroundings. ``"air"`` gives air kerma (then also outside of
            the bodies).
        quantity: ``"absorbed"``: collision kerma, which is the absorbed dose in electron
            equilibrium (ranges here are below 0.3 mm); ``"interacted"``: every interaction deposits
            the photon's whole energy, an upper limit.
        axial: ``"plane"``: in the plane of one thin slice, fluence falls as 1 / d²;
            ``"contiguous"``: mean over contiguous rotations, each as wide at the isocentre as it is
            apart from the next, falls as 1 / d. This is the primary part of CTDI.
        group_kev: width of the energy groups in keV; 3 changes the dose by less than 0.5 %, 0 takes
            every bin.

    Returns:
        mGy, float64, of the grid's shape or ``points.shape[:-1]``.

    Raises:
        ValueError: an unknown option or material, a moving scene, ``exposure_s`` ≤ 0, a point
            outside the orbit.
    """
    choice("quantity", quantity, QUANTITIES)
    choice("axial", axial, _AXIAL)
    whole("views", views)
    number("exposure_s", exposure_s, positive=True, unit="s")
    check_static(scene)
    points = slice_points(where, z_mm)
    g = scanner.geometry
    if points.size and float(np.hypot(points[..., 0], points[..., 1]).max()) >= g.sod:
        raise ValueError(
            f"points reach beyond the source orbit of {g.sod} mm: move or shrink the grid"
        )
    half = fan_half_angle(scanner)
    energies, fluence = air_fluence(
        scanner, np.linspace(-half, half, _FAN_NODES), group_kev=group_kev
    )
    if medium is None:
        labels = scene.labels(points)
        media = list(scene.materials)
    else:
        labels = np.zeros(points.shape[:-1], dtype=np.int64)
        media = [material(medium)]
    per_gram = mass_energy_absorption if quantity == "absorbed" else mass_interaction
    deposit = np.stack([per_gram(m, energies) * energies for m in media]) * MGY_PER_KEV_PER_G

    kinds, params = pack(scene.shapes)
    coefficients, basis = compress(scene.contrast(energies), tolerance=1e-6)
    beta = (np.arange(views) + 0.5) * (2.0 * math.pi / views)
    flat = points.reshape(-1, 3)
    out = np.zeros(len(flat))
    run(
        _dose,
        len(flat),
        np.ascontiguousarray(flat[:, 0]),
        np.ascontiguousarray(flat[:, 1]),
        float(z_mm),
        np.cos(beta),
        np.sin(beta),
        g.sod,
        kinds,
        params,
        coefficients,
        basis,
        half,
        np.ascontiguousarray(fluence),
        deposit,
        labels.reshape(-1),
        _AXIAL.index(axial),
        out,
    )
    return np.asarray((out * (scanner.source.current_ma * exposure_s)).reshape(points.shape[:-1]))


forget_outdated(__name__)
