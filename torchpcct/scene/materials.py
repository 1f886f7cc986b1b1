"""Materials: mass fractions of elements, and the linear attenuation that they give.

Cross-sections are the tabulated values of Elam, Ravel and Sieber (2002) as shipped by ``xraydb``.
Attenuation uses the *total* cross-section, coherent scatter included: the narrow-beam value that a
line integral needs.

Compositions: the coronary plaque of Li et al., "Coronary Atherosclerotic Plaque Characterization
with Photon-counting CT" (composition tables), body tissues of ICRU Report 44 (heart: Woodard and
White 1986), and compounds from their chemical formulas.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torchpcct.validate import checked, number, reals

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


__all__ = [
    "MATERIALS",
    "Material",
    "blend",
    "calcification",
    "compound",
    "material",
    "mixture",
    "solution",
]

Floats = NDArray[np.float64]

FRACTION_TOLERANCE = 0.005
"""Largest deviation of a sum of mass fractions from 1: published tables are rounded. Fractions
are normalised."""

ENERGY_RANGE_KEV = (1.0, 500.0)
"""Photon energies accepted by :meth:`Material.attenuation`; the Elam tables are unreliable above
800 keV."""

_KINDS = ("total", "photo", "incoh", "coh")
"""Cross sections: all together, photoelectric, incoherent (Compton), coherent (Rayleigh)."""


_SYMBOLS = (
    "H He Li Be B C N O F Ne Na Mg Al Si P S Cl Ar K Ca Sc Ti V Cr Mn Fe Co Ni Cu Zn Ga Ge As Se "
    "Br Kr Rb Sr Y Zr Nb Mo Tc Ru Rh Pd Ag Cd In Sn Sb Te I Xe Cs Ba La Ce Pr Nd Pm Sm Eu Gd Tb "
    "Dy Ho Er Tm Yb Lu Hf Ta W Re Os Ir Pt Au Hg Tl Pb Bi Po At Rn Fr Ra Ac Th Pa U Np Pu Am Cm "
    "Bk Cf"
)
"""Elements in the cross-section table, Z = 1…98, written out so that building a material needs no
table."""
_ELEMENTS = frozenset(_SYMBOLS.split())
"""The same, to look them up."""


@functools.lru_cache(maxsize=4096)
def _mass_attenuation(element: str, energies: bytes, kind: str) -> Floats:
    """Mass attenuation of an element in cm²/g at packed float64 energies (keV); cached,
    read-only."""
    import xraydb

    values = np.array(
        xraydb.mu_elam(element, np.frombuffer(energies) * 1e3, kind=kind), dtype=np.float64
    )
    values.setflags(write=False)
    return values


@functools.cache
def _atomic_mass(element: str) -> float:
    if element not in _ELEMENTS:
        raise ValueError(
            f"unknown element {element!r}: use chemical symbols such as 'H', 'Ca', 'I'"
        )
    import xraydb

    return float(xraydb.atomic_mass(element))


def _energies(energies_kev: ArrayLike) -> Floats:
    energies = np.array(reals("energies_kev", energies_kev), order="C")
    if not energies.size:
        raise ValueError("energies_kev is empty: give one energy or more")
    low, high = ENERGY_RANGE_KEV
    bad = ~((energies >= low) & (energies <= high))
    if bad.any():
        raise ValueError(
            f"photon energies must lie in {low:g}…{high:g} keV (the cross-section table), got "
            f"{float(energies[bad].flat[0]):g}: energies are in keV, not eV"
        )
    return energies


@dataclass(frozen=True)
class Material:
    """A homogeneous material.

    Args:
        name: what it is called.
        density_g_cm3: mass density in g/cm³.
        mass_fractions: chemical symbol → mass fraction. They must sum to 1 within
            :data:`FRACTION_TOLERANCE` (published tables are rounded) and are then normalised to sum
            to 1 exactly.

    Raises:
        ValueError: density ≤ 0, a negative or non-finite fraction, a sum off by more than the
            tolerance, no element at all, an unknown element.
    """

    name: str
    density_g_cm3: float
    mass_fractions: Mapping[str, float]

    def __post_init__(self) -> None:
        given = reals("density_g_cm3", self.density_g_cm3)
        density = float(given) if given.ndim == 0 else math.nan
        if not (math.isfinite(density) and density > 0):
            raise ValueError(
                f"density of {self.name!r} must be greater than 0 g/cm³, got {self.density_g_cm3!r}"
            )
        if not isinstance(self.mass_fractions, Mapping):
            raise TypeError(
                f"mass_fractions of {self.name!r} must map elements to shares, got "
                f"{self.mass_fractions!r}"
            )
        fractions = {
            str(k): number(f"mass fraction of {k}", v) for k, v in self.mass_fractions.items()
        }
        if not fractions:
            raise ValueError(f"material {self.name!r} needs at least one element")
        for element, fraction in fractions.items():
            if element not in _ELEMENTS:
                raise ValueError(
                    f"unknown element {element!r} in {self.name!r}: use chemical symbols such as "
                    "'H', 'Ca', 'I'"
                )
            if not (math.isfinite(fraction) and fraction >= 0):
                raise ValueError(
                    f"mass fraction of {element} in {self.name!r} must be ≥ 0 and finite, got "
                    f"{fraction}"
                )
        total = math.fsum(fractions.values())
        if abs(total - 1.0) > FRACTION_TOLERANCE:
            raise ValueError(
                f"mass fractions of {self.name!r} sum to {total:.4f}, not 1 ± "
                f"{FRACTION_TOLERANCE}: give fractions (not per cent) of every element"
            )
        if abs(total - 1.0) < 1e-12:
            total = 1.0  # rounding only: leave the values as they are, so that copies compare equal
        normalised = {k: v / total for k, v in fractions.items() if v > 0}
        object.__setattr__(self, "density_g_cm3", density)
        object.__setattr__(self, "mass_fractions", MappingProxyType(normalised))

    def __hash__(self) -> int:
        return hash((self.name, self.density_g_cm3, tuple(self.mass_fractions.items())))

    def __reduce__(self) -> tuple[object, ...]:
        return (Material, (self.name, self.density_g_cm3, dict(self.mass_fractions)))

    def attenuation(self, energies_kev: ArrayLike, kind: str = "total") -> Floats:
        """Linear attenuation coefficient in mm⁻¹.

        Args:
            energies_kev: photon energies in keV, any shape.
            kind: ``"total"`` (coherent scatter included), or one part of it: ``"photo"``
                (photoelectric), ``"incoh"`` (Compton), ``"coh"`` (Rayleigh).

        Returns:
            float64, the shape of ``energies_kev``.

        Raises:
            ValueError: an energy outside the table, an unknown ``kind``.
        """
        if kind not in _KINDS:
            raise ValueError(f"kind must be one of {_KINDS}, got {kind!r}")
        energies = _energies(energies_kev)
        packed = energies.tobytes()
        total = np.zeros(energies.size)
        for element, fraction in self.mass_fractions.items():
            total += fraction * _mass_attenuation(element, packed, kind)
        return (total * (self.density_g_cm3 / 10.0)).reshape(energies.shape)  # cm⁻¹ → mm⁻¹

    def hu(self, energies_kev: ArrayLike, weights: ArrayLike = 1.0) -> float:
        """Effective CT number against water for a spectrum: 1000 (Σ w μ / Σ w μ_water − 1).

        Args:
            energies_kev: energies ``(E,)`` keV, or one energy.
            weights: relative detected signal per energy, broadcast to ``energies_kev``.
        """
        energies = np.atleast_1d(reals("energies_kev", energies_kev))
        if np.shape(weights) not in ((), energies.shape):
            raise ValueError(
                f"weights must be one for each of the {energies.shape} energies_kev, got "
                f"{np.shape(weights)}"
            )
        w = np.broadcast_to(reals("weights", weights), energies.shape)
        if not (np.isfinite(w).all() and (w >= 0).all() and w.sum() > 0):
            raise ValueError("weights must be finite, ≥ 0 and not all zero")
        return float(
            1000.0
            * (
                (w * self.attenuation(energies)).sum()
                / (w * MATERIALS["water"].attenuation(energies)).sum()
                - 1.0
            )
        )

    def with_density(self, density_g_cm3: float, name: str | None = None) -> Material:
        """The same composition at another density.

        Args:
            density_g_cm3: greater than 0.
            name: of the new material; None: that of this one.
        """
        return Material(self.name if name is None else name, density_g_cm3, self.mass_fractions)


@checked
def formula_mass_fractions(formula: Mapping[str, float]) -> dict[str, float]:
    """Mass fractions of a molecular formula, element → number of atoms (which may be
    fractional)."""
    masses = {element: count * _atomic_mass(element) for element, count in formula.items()}
    total = sum(masses.values())
    if not total > 0:
        raise ValueError(f"a formula needs at least one atom, got {dict(formula)!r}")
    return {element: mass / total for element, mass in masses.items()}


@checked
def compound(name: str, density_g_cm3: float, formula: Mapping[str, float]) -> Material:
    """A material from its molecular formula, e.g. ``compound("water", 1.0, {"H": 2, "O": 1})``.

    Args:
        name: of the material.
        density_g_cm3: its density.
        formula: chemical symbol → number of atoms.

    Raises:
        ValueError: an unknown element, no atom at all, a density that is not positive.
    """
    return Material(name, density_g_cm3, formula_mass_fractions(formula))


@checked
def mixture(name: str, density_g_cm3: float, parts: Mapping[Material, float]) -> Material:
    """A mixture by *mass* at a given density.

    Args:
        name: of the mixture.
        density_g_cm3: its density.
        parts: material → mass fraction; they must sum to 1 within :data:`FRACTION_TOLERANCE`.

    Raises:
        ValueError: a fraction below 0 or not finite, fractions with another sum, a density that is
            not positive.
    """
    fractions: dict[str, float] = {}
    for part, share in parts.items():
        if not (math.isfinite(share) and share >= 0):
            raise ValueError(
                f"share of {part.name!r} in {name!r} must be ≥ 0 and finite, got {share}"
            )
        for element, fraction in part.mass_fractions.items():
            fractions[element] = fractions.get(element, 0.0) + share * fraction
    return Material(name, density_g_cm3, fractions)


@checked
def blend(name: str, parts: Mapping[Material, float]) -> Material:
    """A mixture by *volume*: density and attenuation are the volume-weighted means of the parts
    (ideal mixing).

    Args:
        name: of the mixture.
        parts: material → volume fraction; they must sum to 1 within :data:`FRACTION_TOLERANCE`.

    Raises:
        ValueError: a fraction below 0 or not finite, or fractions with another sum.
    """
    shares = {part: float(share) for part, share in parts.items()}
    total = sum(shares.values())
    if abs(total - 1.0) > FRACTION_TOLERANCE:
        raise ValueError(
            f"volume fractions of {name!r} sum to {total:.4f}, not 1 ± {FRACTION_TOLERANCE}"
        )
    density = sum(share * part.density_g_cm3 for part, share in shares.items()) / total
    return mixture(
        name, density, {p: s * p.density_g_cm3 / (total * density) for p, s in shares.items()}
    )


@checked
def solution(
    solute: Material | str, mg_per_ml: float, solvent: Material | str = "water"
) -> Material:
    """A solution of one material in another: contrast agents, calibration rods.

    Volumes add; iodine takes that of the element, 0.2 % for 10 mg/ml. By name: ``"iodine 10 mg/ml
    in blood"``.

    Args:
        solute: the dissolved material or its name.
        mg_per_ml: mass of the solute in a ml of the solution.
        solvent: the other material or its name.

    Raises:
        ValueError: a concentration below 0, or above the density of the solute.
    """
    dissolved, matrix = material(solute), material(solvent)
    most = 1000.0 * dissolved.density_g_cm3
    share = (
        number("mg_per_ml", mg_per_ml, low=0.0, high=most, unit=f"mg/ml of {dissolved.name}") / most
    )
    name = f"{dissolved.name} {float(mg_per_ml):g} mg/ml in {matrix.name}"
    return blend(name, {matrix: 1.0 - share, dissolved: share})


@checked
def calcification(hu: float = 1500.0) -> Material:
    """Hydroxyapatite in fibrous tissue, mixed by volume so that it reads ``hu`` at 64 keV, the mean
    energy of a 100 kVp beam behind 24 cm of adipose tissue.

    Args:
        hu: CT number to reach, between that of fibrous tissue and that of pure hydroxyapatite.

    Raises:
        ValueError: ``hu`` outside what a mixture can reach.
    """
    matrix, mineral = MATERIALS["fibrous_tissue"], MATERIALS["hydroxyapatite"]
    low, high = matrix.hu(_CALCIFIED_KEV), mineral.hu(_CALCIFIED_KEV)
    if not low <= hu <= high:
        raise ValueError(
            f"hu must lie between {low:.0f} ({matrix.name}) and {high:.0f} (hydroxyapatite) HU, "
            f"got {hu}"
        )
    share = (hu - low) / (high - low)  # exact: attenuation is linear in the volume share
    return blend("calcification", {matrix: 1.0 - share, mineral: share})


_CALCIFIED_KEV = 64.0
"""Energy at which a mixture of matrix and mineral has the CT number that is asked for, keV."""


# The plaque tissues carry the *published* element table of Li et al. (rounded to 1e-4); the tests
# derive the same numbers from their recipe.
_TABLES: Mapping[str, tuple[float, Mapping[str, float]]] = {
    # Plaque scene, Li et al.; blood with 1 % iodine sums to 1.0002 and is normalised.
    "vessel_wall": (1.074, dict(H=0.1040, C=0.1818, N=0.0368, O=0.6739, P=0.0011, Ca=0.0024)),
    "fibrous_tissue": (1.113, dict(H=0.1089, C=0.1378, N=0.0178, O=0.7355)),
    "necrotic_core": (1.055, dict(H=0.1083, C=0.1737, N=0.0217, O=0.6963)),
    "blood_iodine": (
        1.060,
        dict(
            H=0.1010,
            C=0.1089,
            N=0.0327,
            O=0.7376,
            Na=0.001,
            P=0.001,
            S=0.002,
            Cl=0.003,
            K=0.002,
            Fe=0.001,
            I=0.0100,
        ),
    ),
    "pericoronary_fat": (
        0.950,
        dict(H=0.114, C=0.598, N=0.007, O=0.278, Na=0.001, S=0.001, Cl=0.001),
    ),
    # Body tissues, ICRU Report 44; lung is given at its inflated density. Heart and spongiosa:
    # Woodard and White 1986.
    "adipose": (0.950, dict(H=0.114, C=0.598, N=0.007, O=0.278, Na=0.001, S=0.001, Cl=0.001)),
    "blood": (
        1.060,
        dict(
            H=0.102,
            C=0.110,
            N=0.033,
            O=0.745,
            Na=0.001,
            P=0.001,
            S=0.002,
            Cl=0.003,
            K=0.002,
            Fe=0.001,
        ),
    ),
    "heart": (
        1.060,
        dict(
            H=0.103,
            C=0.121,
            N=0.032,
            O=0.734,
            Na=0.001,
            P=0.001,
            S=0.002,
            Cl=0.003,
            K=0.002,
            Fe=0.001,
        ),
    ),
    "lung": (
        0.260,
        dict(H=0.103, C=0.105, N=0.031, O=0.749, Na=0.002, P=0.002, S=0.003, Cl=0.003, K=0.002),
    ),
    "skeletal_muscle": (
        1.050,
        dict(H=0.102, C=0.143, N=0.034, O=0.710, Na=0.001, P=0.002, S=0.003, Cl=0.001, K=0.004),
    ),
    "soft_tissue": (
        1.060,
        dict(H=0.102, C=0.143, N=0.034, O=0.708, Na=0.002, P=0.003, S=0.003, Cl=0.002, K=0.003),
    ),
    "skin": (
        1.090,
        dict(H=0.100, C=0.204, N=0.042, O=0.645, Na=0.002, P=0.001, S=0.002, Cl=0.003, K=0.001),
    ),
    "cortical_bone": (
        1.920,
        dict(H=0.034, C=0.155, N=0.042, O=0.435, Na=0.001, Mg=0.002, P=0.103, S=0.003, Ca=0.225),
    ),
    "spongiosa": (
        1.180,
        dict(
            H=0.085,
            C=0.404,
            N=0.028,
            O=0.367,
            Na=0.001,
            Mg=0.001,
            P=0.034,
            S=0.002,
            Cl=0.002,
            K=0.001,
            Ca=0.074,
            Fe=0.001,
        ),
    ),
    "air": (0.001205, dict(C=0.000124, N=0.755268, O=0.231781, Ar=0.012827)),  # dry, 20 °C, NIST
    # Elements.
    "aluminium": (2.699, {"Al": 1.0}),
    "silicon": (2.330, {"Si": 1.0}),
    "titanium": (4.540, {"Ti": 1.0}),
    "copper": (8.960, {"Cu": 1.0}),
    "graphite": (1.700, {"C": 1.0}),
    "molybdenum": (10.22, {"Mo": 1.0}),
    "tungsten": (19.30, {"W": 1.0}),
    "iodine": (4.930, {"I": 1.0}),
    # Alloys by nominal composition.
    "stainless_steel": (8.00, dict(Fe=0.655, Cr=0.17, Ni=0.12, Mo=0.025, Mn=0.02, Si=0.01)),  # 316L
    "cobalt_chromium": (9.10, dict(Co=0.53, Cr=0.20, W=0.15, Ni=0.10, Mn=0.015, Fe=0.005)),  # L605
    "nitinol": (6.45, dict(Ni=0.56, Ti=0.44)),
    # Lumex-like ceramic garnet scintillator Y1.34 Gd0.60 Eu0.06 O3 (Duclos et al. 2003).
    "lumex": (5.950, dict(O=0.177377, Y=0.440259, Eu=0.033695, Gd=0.348670)),
}
"""Name → density in g/cm³, mass fractions."""

_FORMULAS: Mapping[str, tuple[float, Mapping[str, float]]] = {
    "water": (1.000, {"H": 2, "O": 1}),
    "pmma": (1.190, {"C": 5, "H": 8, "O": 2}),
    "polyethylene": (0.930, {"C": 2, "H": 4}),
    "pvc": (1.370, {"C": 2, "H": 3, "Cl": 1}),
    "hydroxyapatite": (3.160, {"H": 1, "Ca": 5, "O": 13, "P": 3}),
    "gos": (7.340, {"Gd": 2, "O": 2, "S": 1}),  # gadolinium oxysulphide
}
"""Name → density in g/cm³, atoms per molecule."""


class _Registry(Mapping[str, Material]):
    """Materials by name, each built when first asked for: compounds need the table of atomic
    masses, a slow import."""

    def __init__(self) -> None:
        self._built: dict[str, Material] = {}

    def __getitem__(self, name: str) -> Material:
        if name not in self._built:
            if name in _FORMULAS:
                self._built[name] = compound(name, *_FORMULAS[name])
            else:
                self._built[name] = Material(name, *_TABLES[name])
        return self._built[name]

    def __iter__(self) -> Iterator[str]:
        return iter((*_TABLES, *_FORMULAS))

    def __len__(self) -> int:
        return len(_TABLES) + len(_FORMULAS)


MATERIALS: Mapping[str, Material] = _Registry()
"""All built-in materials by name (read-only)."""

PLAQUE_MATERIALS = (
    "vessel_wall",
    "fibrous_tissue",
    "necrotic_core",
    "blood_iodine",
    "pericoronary_fat",
)
"""Names of the five tissues of the plaque scene."""


_CONCENTRATION = re.compile(r"(\w+) +([0-9.eE+-]+) *mg/m[lL] +in +(\w+)")
"""``iodine 10 mg/mL in blood``."""


def material(value: Material | str) -> Material:
    """A material from itself, from its name in the registry :data:`MATERIALS`, or from a
    :func:`solution`'s name.

    Raises:
        ValueError: a name that the registry does not hold. TypeError: neither a material nor a
            name.
    """
    if isinstance(value, Material):
        return value
    if not isinstance(value, str):
        raise TypeError(
            f"material must be a Material or its name, got {value!r} ({type(value).__name__})"
        )
    parts = _CONCENTRATION.fullmatch(value)
    if parts is not None:
        return solution(parts[1], number(f"concentration in {value!r}", parts[2]), parts[3])
    if value not in MATERIALS:
        raise ValueError(
            f"unknown material {value!r}: use a Material, one of {', '.join(sorted(MATERIALS))}, "
            "or a concentration such as 'iodine 10 mg/ml in blood'"
        )
    return MATERIALS[value]
