"""The energy-integrating scanner beside the photon-counting one, at equal dose."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.analytic.exact_noise import roi_adjoints
from recon.study.noise.settings import Settings
from recon.study.paper.facts import FULL_VIEWS
from recon.study.paper.plaque_scan import equal_dose, prepare
from recon.study.study import Progress
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene import Scene
from torchpcct.scene.plaque import Plaque

__all__ = ["equal_dose_rows"]

_KERNELS = ("soft", "standard")
_VOXELS_MM = (0.25, 0.40)


def equal_dose_rows(
    settings: Settings, scene: tuple[Scene, Plaque], expected: Any, covariance: Any, progress: Progress
) -> list[dict[str, Any]]:
    """Exact ROI statistics of both scanners for JSON, at the lowest dose and at the tables'.

    Args:
        settings: of the study.
        scene: the plaque.
        expected: ``(S, 2)`` HU, of the photon-counting scanner, in the order of ``settings.axes``.
        covariance: ``(2 S, 2 S)`` HU² at 1 s, of the same.
        progress: called while the scan is simulated.
    """
    kernels = [k for k in _KERNELS if k in settings.kernels]
    voxels = [v for v in _VOXELS_MM if v in settings.voxels_mm]
    if not kernels or not voxels:
        return []
    scanner = presets.eid(views=max(8, FULL_VIEWS["EID-CT"] * settings.views // FULL_VIEWS["PCCT"]))
    scanned = prepare(
        kernels, voxels, scene, scanner, FULL_VIEWS["EID-CT"], lambda fraction: progress("EID-CT", 0.8 * fraction)
    )
    means = scanned.roi_means(scanned.fbp(scanned.clean)).reshape(len(voxels), len(kernels), 2)
    adjoints = roi_adjoints(scanned.clean, scanned.fbp, scanned.pairs)
    per_dose = equal_dose(scanner)
    electronic = _electronic_share(scanned.clean, per_dose * min(settings.doses.values()))
    rows = []
    for exposure in (min(settings.doses.values()), settings.table_exposure_s):
        matrices = adjoints.covariance(scanned.clean, exposure * per_dose)
        for v, voxel in enumerate(voxels):
            for k, kernel in enumerate(kernels):
                i = settings.axes.index((kernel, voxel))
                row = partial(_row, kernel, voxel, exposure)
                rows.append(row("PCCT", expected[i], covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] / exposure))
                rows.append(row("EID-CT", means[v, k], matrices[v][k]))
                rows[-1].update(own_exposure_s=exposure * per_dose, largest_electronic_share=electronic)
    progress("EID-CT", 1.0)
    return rows


def _electronic_share(clean: Scan, exposure_s: float) -> float:
    """Largest share of a reading's variance that the electronics make."""
    assert clean.quantum is not None
    quanta = clean.quantum * clean.counts * exposure_s
    electronics = clean.electronic_noise**2
    return float((electronics / (quanta + electronics)).max())


def _row(
    kernel: str, voxel: float, exposure: float, scanner: str, means: NDArray[Any], covariance: NDArray[Any]
) -> dict[str, Any]:
    sd = np.sqrt(np.diag(covariance))
    return {
        "scanner": scanner,
        "kernel": kernel,
        "voxel_mm": voxel,
        "exposure_s": exposure,
        "mean_hu": means.tolist(),
        "sd_hu": sd.tolist(),
        "contrast_hu": float(means[1] - means[0]),
        "contrast_sd_hu": math.sqrt(float(covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1])),
        "cnr": float((means[1] - means[0]) / math.hypot(*sd)),
    }
