"""The built-in materials: composition tables and chemical formulas.

The plaque tissues carry the *published* element table of Li et al. (rounded to 1e-4); the tests derive the same numbers
from their recipe.
"""

from __future__ import annotations

from collections.abc import Mapping

__all__ = ["FORMULAS", "TABLES"]

TABLES: Mapping[str, tuple[float, Mapping[str, float]]] = {
    # Plaque scene, Li et al.; blood with 1 % iodine sums to 1.0002 and is normalised.
    "vessel_wall": (1.074, dict(H=0.1040, C=0.1818, N=0.0368, O=0.6739, P=0.0011, Ca=0.0024)),
    "fibrous_tissue": (1.113, dict(H=0.1089, C=0.1378, N=0.0178, O=0.7355)),
    "necrotic_core": (1.055, dict(H=0.1083, C=0.1737, N=0.0217, O=0.6963)),
    "blood_iodine": (
        1.060,
        dict(H=0.1010, C=0.1089, N=0.0327, O=0.7376, Na=0.001, P=0.001, S=0.002, Cl=0.003, K=0.002, Fe=0.001, I=0.0100),
    ),
    "pericoronary_fat": (0.950, dict(H=0.114, C=0.598, N=0.007, O=0.278, Na=0.001, S=0.001, Cl=0.001)),
    # Body tissues, ICRU Report 44; lung is given at its inflated density. Heart and spongiosa: Woodard and White 1986.
    "adipose": (0.950, dict(H=0.114, C=0.598, N=0.007, O=0.278, Na=0.001, S=0.001, Cl=0.001)),
    "blood": (
        1.060,
        dict(H=0.102, C=0.110, N=0.033, O=0.745, Na=0.001, P=0.001, S=0.002, Cl=0.003, K=0.002, Fe=0.001),
    ),
    "heart": (
        1.060,
        dict(H=0.103, C=0.121, N=0.032, O=0.734, Na=0.001, P=0.001, S=0.002, Cl=0.003, K=0.002, Fe=0.001),
    ),
    "lung": (0.260, dict(H=0.103, C=0.105, N=0.031, O=0.749, Na=0.002, P=0.002, S=0.003, Cl=0.003, K=0.002)),
    "skeletal_muscle": (
        1.050,
        dict(H=0.102, C=0.143, N=0.034, O=0.710, Na=0.001, P=0.002, S=0.003, Cl=0.001, K=0.004),
    ),
    "soft_tissue": (1.060, dict(H=0.102, C=0.143, N=0.034, O=0.708, Na=0.002, P=0.003, S=0.003, Cl=0.002, K=0.003)),
    "skin": (1.090, dict(H=0.100, C=0.204, N=0.042, O=0.645, Na=0.002, P=0.001, S=0.002, Cl=0.003, K=0.001)),
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

FORMULAS: Mapping[str, tuple[float, Mapping[str, float]]] = {
    "water": (1.000, {"H": 2, "O": 1}),
    "pmma": (1.190, {"C": 5, "H": 8, "O": 2}),
    "polyethylene": (0.930, {"C": 2, "H": 4}),
    "pvc": (1.370, {"C": 2, "H": 3, "Cl": 1}),
    "hydroxyapatite": (3.160, {"H": 1, "Ca": 5, "O": 13, "P": 3}),
    "gos": (7.340, {"Gd": 2, "O": 2, "S": 1}),  # gadolinium oxysulphide
}
"""Name → density in g/cm³, atoms per molecule."""
