"""The figures of the paper that this package reproduces, and the tolerances that we hold ourselves
to.

Source: Li, Wu, Pack, Wu, De Man, Wang, Nieman, Wang, "Coronary Atherosclerotic Plaque
Characterization with Photon-counting CT: a Simulation-based Feasibility Study", tables "Statistics
on the means of the ROI over 10 realisations" and "Necrotic core detectability measured as the CNR".
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from torchpcct.scanner import presets

FULL_VIEWS = {"PCCT": presets.PCCT_VIEWS, "EID-CT": presets.EID_VIEWS}
"""Views per rotation, by the scanner's name. A study with fewer views stands for the same scan,
thinned out."""

ROTATION_S = 0.35
"""One rotation, s."""

KERNELS = ("soft", "standard", "detail", "bone")
"""Kernels of FBP."""
VOXELS_MM = (0.20, 0.25, 0.30, 0.35, 0.40)
"""Voxel sizes, mm."""
DOSES = {"1x": ROTATION_S, "2x": 0.70, "5.7x": 2.00, "8x": 2.80}
"""Exposure (one rotation) in s of each dose level, at 1000 mA."""

TABLE_EXPOSURE_S = 2.00
"""Exposure of both tables. The paper does not state it; the text of its noise section and the size
of its standard deviations point to the assumed 5.7× dose (an inference of ours)."""

REALISATIONS = 10
"""Noise realisations of each setting."""


NOISE_FREE_ROI_HU = {"foreground": 40.1, "background": 91.8}
"""Noise-free ROI means, standard kernel, 0.1 mm voxels."""

# (kernel, voxel size, (mean, SD)) in HU
FOREGROUND = np.array(
    [
        [[48.76, 11.93], [43.47, 9.73], [49.62, 10.76], [49.30, 10.33], [51.56, 10.44]],
        [[50.05, 14.29], [43.04, 10.54], [49.86, 12.44], [48.97, 11.52], [50.92, 12.42]],
        [[50.58, 14.19], [43.91, 10.45], [50.12, 13.09], [49.43, 11.54], [51.39, 12.77]],
        [[51.26, 17.56], [44.38, 12.05], [47.48, 22.38], [48.14, 14.61], [50.35, 20.36]],
    ]
)
"""Table of the core: mean and standard deviation, HU, by dose, kernel and voxel size."""
BACKGROUND = np.array(
    [
        [[88.38, 27.37], [86.44, 16.91], [84.07, 24.28], [83.48, 21.43], [82.12, 17.30]],
        [[97.51, 34.28], [93.10, 21.92], [90.86, 29.60], [90.01, 24.49], [88.40, 18.25]],
        [[98.40, 34.55], [93.07, 23.35], [90.17, 31.22], [91.28, 24.56], [88.51, 16.58]],
        [[111.06, 47.88], [99.80, 39.66], [91.62, 52.88], [104.60, 32.34], [91.97, 17.85]],
    ]
)
"""The same of fibrous tissue."""
CNR = np.array(
    [
        [1.33, 2.20, 1.30, 1.44, 1.51],
        [1.28, 2.06, 1.28, 1.52, 1.70],
        [1.28, 1.92, 1.18, 1.54, 1.77],
        [1.17, 1.34, 0.77, 1.59, 1.54],
    ]
)
"""Table of the contrast-to-noise ratio, in the same order."""

SPECTRAL = {
    "optimum_kev": 52.0,
    "optimum_tolerance_kev": 5.0,
    "core_visible_up_to": 0.25,
    "core_lost_at": 1.0,
}
"""Spectral characterisation: best energy for core against fibrous tissue (our tolerance:
predictions move by 48–56 keV with the assumed filtration), and the noise levels up to which tissue
maps show the core and at which they do not."""

BOWTIE: dict[str, float] = {
    "skin_reduction_percent": 55.0,
    "total_dose_factor": 8.0,
}
"""Dose study: what the ROI bowtie saves in the thorax's skin, and the factor claimed for denoising
and bowtie together; its other figures stand in the template of the study's report."""

RESOLUTION: dict[str, Any] = {
    "last_kernels_px": (3.75, 5.0),
    "cap_limit_px": 3.75,
    "final_fwhm_mm": 0.43,
}
"""Resolution study, in pixels of 0.035 mm: the Gaussian kernels up to which the core's boundary is
clear; the kernel that the cap's thickness (20 % error) does not allow any more; and the final
resolution recommended in mm, which implies a system of √(0.43² − 0.31²) = 0.30 mm."""

MOTION: dict[str, Any] = {
    "fractions": (0.1, 0.2, 0.4, 0.6, 1.0),
    "eid_fractions": (0.4, 0.6),
    "tolerated": 0.2,
    "lumen_stable_below": 0.4,
}
"""Motion study: residual motions shown for PCCT and EID-CT, of 2 mm; the largest that is tolerated;
and the one below which the lumen's area does not suffer much."""

MATERIALS: Mapping[str, tuple[float, float, Mapping[str, float]]] = {
    "vessel_wall": (
        1.074,
        60.0,
        {"H": 0.1040, "C": 0.1818, "N": 0.0368, "O": 0.6739, "P": 0.0011, "Ca": 0.0024},
    ),
    "fibrous_tissue": (1.113, 100.0, {"H": 0.1089, "C": 0.1378, "N": 0.0178, "O": 0.7355}),
    "necrotic_core": (1.055, 40.0, {"H": 0.1083, "C": 0.1737, "N": 0.0217, "O": 0.6963}),
    "blood_iodine": (
        1.060,
        500.0,
        {
            "H": 0.1010,
            "C": 0.1089,
            "N": 0.0327,
            "O": 0.7376,
            "Na": 0.0010,
            "P": 0.0010,
            "S": 0.0020,
            "Cl": 0.0030,
            "K": 0.0020,
            "Fe": 0.0010,
            "I": 0.0100,
        },
    ),
    "pericoronary_fat": (
        0.950,
        -100.0,
        {
            "H": 0.1140,
            "C": 0.5980,
            "N": 0.0070,
            "O": 0.2780,
            "Na": 0.0010,
            "S": 0.0010,
            "Cl": 0.0010,
        },
    ),
}
"""Phantom: tissue → density in g/cm³, CT number in HU at 100 kVp, mass fractions. The spectrum of
the CT numbers is not stated. The fractions of blood sum to 1.0002."""

PHANTOM_MM: Mapping[str, float] = {
    "core, major axis": 1.97,
    "core, minor axis": 1.20,
    "fibrous cap": 0.17,
    "wall": 0.19,
    "vessel diameter": 3.36,
    "distance from the isocentre": 42.4,
    "patient diameter": 240.0,
}
"""Phantom: lengths in mm. The paper draws it on binary voxels of 0.021 mm."""

PHANTOM_VOXEL_MM = 0.021
"""Edge of its voxels."""
