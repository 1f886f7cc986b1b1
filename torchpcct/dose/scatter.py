"""Absorbed dose by scattered photons: Monte Carlo transport in a slice of the scene that continues
along z.

Model: photoelectric absorption on the spot, Compton scattering off free electrons (Klein and
Nishina) with the bound electrons' total cross-section, coherent scattering with the squared form
factor of independent atoms (Elam tables, Waasmaier and Kirfel form factors, both shipped by
``xraydb``). Not modelled: fluorescence, electron transport, binding and Doppler broadening in the
Compton angle and energy. Materials are read from a map of the slice, which is prolonged along z to
the length of the phantom.

What is scored over ± half of the scan length is, by shift along z, the dose in the middle of a
contiguous scan of that length: with 100 mm, the dose of CTDI100.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torchpcct.counting_noise import seed_key
from torchpcct.dose.coefficients import (
    MGY_PER_KEV_PER_G,
    air_fluence,
    fan_half_angle,
    mass_energy_absorption,
)
from torchpcct.dose.primary import check_static, slice_points
from torchpcct.dose.transport_kernels import BATCHES, transport
from torchpcct.geometry import VolumeGrid
from torchpcct.scanner import Scanner
from torchpcct.scene import Scene
from torchpcct.scene.materials import Material
from torchpcct.threads import run
from torchpcct.validate import checked, number, whole

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


__all__ = ["MonteCarloDose", "monte_carlo_dose"]

Floats = NDArray[np.float64]

SCAN_LENGTH_MM = 100.0
"""Length of the contiguous scan: the pencil chamber of CTDI100."""

PHANTOM_LENGTH_MM = 150.0
"""Length of the object: that of the CTDI phantom. A longer one adds scatter from outside of the
scan, none here."""

_CUTOFF_KEV = 5.0
"""Energy at which a photon is absorbed where it is: in water its range is below a millimetre."""
_TABLE_STEP_KEV = 0.5
"""Step of the tables of cross sections."""
_FAN_NODES = 1024
"""Directions of the fan that photons start in."""
_FORM_NODES = 600
"""Nodes of the tables of form factors, denser towards 0."""
_FORM_END = 16.0
"""Their end in Å⁻¹: sin(θ/2) / λ of 198 keV."""


@dataclass(frozen=True)
class MonteCarloDose:
    """Result of :func:`monte_carlo_dose` on a 2-D grid, in mGy.

    Attributes:
        grid: of the map.
        primary, scattered: ``(y, x)`` dose by unscattered and by scattered photons, mean over the
            scan length.
        batches: ``(B, 2, y, x)`` the independent parts, primary and scattered, each an estimate of
            the whole.
        histories: number of photons.
    """

    grid: VolumeGrid
    primary: Floats
    scattered: Floats
    batches: Floats
    histories: int

    def mean(self, mask: ArrayLike) -> tuple[float, float, float]:
        """Primary dose, scattered dose and the standard error of the latter, mean over the voxels
        of ``mask``.

        Raises:
            ValueError: a mask of another shape, or an empty one.
        """
        inside = np.asarray(mask, dtype=bool)
        if inside.shape != self.grid.shape or not inside.any():
            raise ValueError(
                f"mask must be a non-empty array of the grid's shape {self.grid.shape}"
            )
        parts = self.batches[:, :, inside].mean(-1)
        error = float(parts[:, 1].std(ddof=1) / math.sqrt(len(parts)))
        return float(parts[:, 0].mean()), float(parts[:, 1].mean()), error


@functools.lru_cache(maxsize=64)
def _form_factor(material: Material) -> tuple[Floats, Floats]:
    """Nodes x² and the cumulative integral of F² dx² per atom mixture, from 0."""
    import xraydb  # loads slowly; primary dose does without it

    x = np.linspace(0.0, 1.0, _FORM_NODES) ** 2 * _FORM_END
    square = np.zeros_like(x)
    for element, fraction in material.mass_fractions.items():
        square += (
            fraction
            / xraydb.atomic_mass(element)
            * np.asarray(xraydb.f0(element, np.minimum(x, 6.0))) ** 2
        )
    x2 = x * x
    cumulative = np.concatenate([[0.0], np.cumsum(0.5 * (square[1:] + square[:-1]) * np.diff(x2))])
    # Never flat, so that the inverse exists.
    return x2, cumulative + 1e-12 * cumulative[-1] * np.arange(x.size)


def _tables(materials: list[Material], highest_kev: float) -> tuple[Floats, ...]:
    count = max(math.ceil((highest_kev - _CUTOFF_KEV) / _TABLE_STEP_KEV) + 2, 3)
    energies = _CUTOFF_KEV + _TABLE_STEP_KEV * np.arange(count)
    kinds = {
        kind: np.stack([m.attenuation(energies, kind) for m in materials])
        for kind in ("photo", "incoh", "coh")
    }
    total = kinds["photo"] + kinds["incoh"] + kinds["coh"]
    # per mm: the tally is energy per volume, the density comes in at the end
    absorption = np.stack(
        [mass_energy_absorption(m, energies) * (m.density_g_cm3 / 1000.0) for m in materials]
    )
    squares = _form_factor(materials[0])[0]
    form = np.stack([_form_factor(m)[1] for m in materials])
    return total, kinds["photo"], kinds["incoh"], absorption, total.max(0), squares, form


@checked
def monte_carlo_dose(
    scene: Scene,
    scanner: Scanner,
    grid: VolumeGrid,
    exposure_s: float,
    *,
    z_mm: float = 0.0,
    histories: int = 2_000_000,
    seed: int = 0,
    scan_length_mm: float = SCAN_LENGTH_MM,
    phantom_length_mm: float = PHANTOM_LENGTH_MM,
) -> MonteCarloDose:
    """Dose by primary and scattered photons in the middle of a contiguous scan, mGy per rotation.

    Args:
        scene: bodies at rest; the slice at ``z_mm`` is prolonged along z.
        scanner: source, filters, bowties; the fan ends where the detector ends.
        grid: 2-D ``(y, x)`` grid of square voxels that holds the whole object: it is the map of
            materials and that of the result. 1 mm resolves the 13 mm bores of a CTDI phantom.
        exposure_s: duration of a rotation in s.
        z_mm: height of the slice.
        histories: photons to follow, rounded down to a multiple of 16.
        seed: of the random numbers, a whole number ≥ 0.
        scan_length_mm: length of the contiguous scan, the width of a rotation being its table feed.
        phantom_length_mm: length of the object along z; photons leave at its ends.

    Raises:
        TypeError: a number of histories or a seed that is no whole number.
        ValueError: a moving scene, voxels that are not square, a body outside of the grid, a bad
            length or count.
    """
    check_static(scene)
    points = slice_points(grid, z_mm)
    if abs(grid.spacing[0] / grid.spacing[1] - 1.0) > 1e-9:
        raise ValueError(f"the voxels must be square, got {grid.spacing} mm")
    whole("histories", histories, low=BATCHES)
    if not (0 < scan_length_mm <= phantom_length_mm < math.inf):
        raise ValueError(
            f"lengths must be 0 < scan_length_mm ≤ phantom_length_mm, got {scan_length_mm} and "
            f"{phantom_length_mm} mm"
        )
    number("exposure_s", exposure_s, positive=True, unit="s")
    labels = scene.labels(points)
    if (labels[[0, -1]] >= 0).any() or (labels[:, [0, -1]] >= 0).any():
        raise ValueError(
            "bodies reach the edge of the grid: give a larger grid, so that no scatter is lost"
        )
    if (labels < 0).all():
        raise ValueError(
            f"no body in the slice z = {z_mm:g} mm on this grid: give another z_mm or grid"
        )
    materials = list(dict.fromkeys(scene.materials))
    index = np.array([materials.index(m) for m in scene.materials] + [-1], dtype=np.int64)
    medium = index[labels]
    radius = float(np.hypot(points[..., 0], points[..., 1])[medium >= 0].max()) + grid.spacing[0]
    sod = scanner.geometry.sod
    if radius >= sod:
        raise ValueError(
            f"bodies reach {radius:.4g} mm from the axis, beyond the source orbit of {sod} mm: "
            "shrink or move them"
        )

    half = fan_half_angle(scanner)
    middle = half * (2.0 * (np.arange(_FAN_NODES) + 0.5) / _FAN_NODES - 1.0)
    energies, fluence = air_fluence(scanner, middle)
    keep = energies > _CUTOFF_KEV
    energies, fluence = energies[keep], fluence[:, keep]
    per_angle = fluence.sum(1)
    fan_cdf = np.cumsum(per_angle) / per_angle.sum()
    energy_cdf = np.cumsum(fluence, axis=1) / np.maximum(per_angle, 1e-300)[:, None]
    total, photo, compton, absorption, largest, squares, form = _tables(
        materials, float(energies[-1])
    )
    n = (int(histories) // BATCHES) * BATCHES
    tally = np.zeros((BATCHES, 2, *grid.shape))
    axes = grid.axes
    run(
        transport,
        BATCHES,
        n,
        seed_key(seed),
        medium,
        float(axes[1][0] - grid.spacing[1] / 2),
        float(axes[0][0] - grid.spacing[0] / 2),
        float(grid.spacing[0]),
        radius,
        phantom_length_mm / 2.0,
        scan_length_mm / 2.0,
        sod,
        half,
        fan_cdf,
        np.ascontiguousarray(energy_cdf),
        energies,
        _CUTOFF_KEV,
        _TABLE_STEP_KEV,
        total,
        photo,
        compton,
        absorption,
        largest,
        squares,
        form,
        _CUTOFF_KEV,
        tally,
    )
    # Photons per mAs in the fan and per mm of beam width at the isocentre: fluence at sod × sod dγ.
    photons = per_angle.sum() * (2.0 * half / _FAN_NODES) * 1e6 / sod
    density = np.array([*(m.density_g_cm3 for m in materials), np.inf])[medium] / 1000.0  # g/mm³
    area = grid.spacing[0] * grid.spacing[1]
    scale = photons * scanner.source.current_ma * exposure_s * MGY_PER_KEV_PER_G / (area * density)
    parts = tally * (scale * BATCHES / n)
    mean = parts.mean(0)
    return MonteCarloDose(grid, mean[0], mean[1], parts, n)
