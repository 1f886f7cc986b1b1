"""The tissues of a scene as its scanner sees them, and how well the data can tell them: generalised least squares."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from recon.fbp.exact_noise import line_integral_variance
from recon.study.dose_factor.variant import Variant
from torchpcct.acquisition.path_lengths import tissue_path_lengths
from torchpcct.detector_window import DetectorWindow
from torchpcct.metrics.data_limit import information_matrix
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan

__all__ = ["least_squares", "tissue_groups"]

Floats = NDArray[np.float64]

_VIEWS = 246
"""Views that the limit is summed over, then scaled: path lengths change slowly from view to view."""

_SUB_RAYS = 16


def least_squares(variant: Variant, clean: Scan) -> tuple[list[str], Floats, Floats]:
    """Tissues, their values in HU by exact path lengths of the noise-free scan, and the information at 1 s, HU⁻²."""
    w, g = clean.window, clean.geometry
    assert w is not None
    stride = max(1, g.views // _VIEWS)
    views = list(range(0, g.views, stride))
    groups = tissue_groups([b.name for b in variant.scene.bodies])
    window = DetectorWindow(w.first_column[views], w.columns, w.first_row, w.rows)
    spot = variant.scanner.source.focal_spot
    maps = tissue_path_lengths(
        variant.scene, list(groups.values()), g.select(views), window, sub_rays=_SUB_RAYS, focal_spot=spot
    )
    weight = 1.0 / line_integral_variance(clean, NOISE_FREE_EXPOSURE_S)[views]
    lines = clean.line_integrals()[views]
    scale = clean.linearisation.mu_ref / 1000.0
    share = g.views / len(views)
    information = information_matrix(maps, weight, scale=scale) * share
    right = [float((m * weight * lines).sum((-1, -2), dtype=torch.float64).sum()) for m in maps]
    amplitudes: Floats = np.asarray(np.linalg.solve(information, scale * share * np.array(right)), np.float64)
    return list(groups), amplitudes - 1000.0, information


def tissue_groups(names: Sequence[str]) -> dict[str, list[str]]:
    """Tissue → bodies: texture counts to its host, a stent's rings are one tissue, the blood in them is the lumen's."""
    groups: dict[str, list[str]] = {}
    for name in names:
        host = re.sub(r"_texture_\d+$", "", name)
        host = "lumen" if re.fullmatch(r"stent_\d+_blood", host) else re.sub(r"^stent_\d+$", "stent", host)
        groups.setdefault(host, []).append(name)
    return groups
