"""Tissue maps of the spectral study: multi-material decomposition, k-means, and what of the tissues they find."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.study.spectral.scan import PlaqueScan
from torchpcct.geometry import VolumeGrid
from torchpcct.scene.scene import Scene
from torchpcct.spectral import MMD_TISSUES, clean, dice, label, mmd, nearest

__all__ = ["BODIES", "RULES", "Tissues", "truth_labels"]

Floats = NDArray[np.float64]

BODIES = {"blood_iodine": "lumen", "necrotic_core": "core", "fibrous_tissue": "fibrous", "pericoronary_fat": "patient"}
"""Tissue of the decomposition → body of the scene. The vessel's wall (0.19 mm) is a fifth material, not among them."""

RULES = {
    "nearest": "the tissue nearest to the mixture, in standard deviations (k-means with centres held at the tissues)",
    "k-means": "k-means of the fractions, slice by slice, started at the tissues",
    "largest": "the largest fraction",
}
"""How a tissue is read from the fractions. The paper names "a standard 2D k-means" and not its features."""

PURE = 0.5
"""A voxel counts as a tissue if that fills more than this share of it."""


def truth_labels(scene: Scene, grid: VolumeGrid) -> Tensor:
    """Index into :data:`~torchpcct.spectral.MMD_TISSUES` of the tissue that fills most of each voxel, ``grid.shape``.

    −1: no tissue fills half of it, or it is vessel wall, which the decomposition does not know.
    """
    fractions = scene.volume_fractions(grid)
    parts = np.stack([fractions[scene.index(BODIES[t])] for t in MMD_TISSUES])
    labels = np.where(parts.max(0) > PURE, parts.argmax(0), -1)
    return torch.from_numpy(labels.astype(np.int64))


class Tissues:
    """Tissue maps of the slices through the core.

    Args:
        plaque: the scan, for geometry, basis and detected spectrum.
        covariance: ``(3,)`` C₁₁, C₁₂, C₂₂ of a voxel of the FBP images, the unit of distances.
    """

    def __init__(self, plaque: PlaqueScan, covariance: Any) -> None:
        self.basis, self.covariance = plaque.basis, np.asarray(covariance, np.float64)
        z = plaque.grid.axes[0]
        core = plaque.scene["core"].shape.bounding_box
        inside = np.flatnonzero((z > core[0, 2]) & (z < core[1, 2]))
        self.slices = slice(int(inside[0]), int(inside[-1]) + 1)
        self.truth = truth_labels(plaque.scene, plaque.grid)[self.slices]
        self.middle = int(np.abs(z[self.slices] - plaque.plaque.position[2]).argmin())
        model = plaque.model(1.0)
        # As the detector sees the tissues behind the patient: iodine's K edge makes blood depend on the spectrum.
        centre = model.columns // 2
        path = plaque.surround[:, plaque.surround.shape[1] // 2, centre].double().numpy()
        detected = model.spectra[centre].sum(0) * np.exp(-path @ model.attenuation)
        self.corners = np.stack(
            [self.basis.coefficients(t, model.energies, detected) for t in MMD_TISSUES], axis=1
        )  # (2, tissues)

    def labels(self, images: Tensor, rule: str = "nearest") -> Tensor:
        """Tissue of every voxel of the slices, ``(slices, y, x)``.

        Args:
            images: ``(2, z, y, x)`` basis coefficients on the inset's grid.
            rule: one of :data:`RULES`.
        """
        fractions = mmd(images[:, self.slices], self.basis, self.corners, self.covariance)
        if rule == "nearest":
            return nearest(fractions, self.basis, self.corners, self.covariance)
        if rule == "k-means":
            return torch.stack([clean(fractions[:, k], window=1) for k in range(fractions.shape[1])])
        if rule == "largest":
            return label(fractions)
        raise ValueError(f"rule must be one of {', '.join(RULES)}, got {rule!r}")

    def dice(self, images: Tensor, rule: str = "nearest") -> Mapping[str, float]:
        """Dice coefficient of every tissue over the slices through the core."""
        return dice(self.labels(images, rule), self.truth)

    def misplaced_core(self, images: Tensor) -> float:
        """Share of the voxels labelled core that lie outside it, among them all that hold several tissues."""
        core = MMD_TISSUES.index("necrotic_core")
        found = self.labels(images) == core
        return float((found & (self.truth != core)).sum() / found.sum().clamp_min(1))

    def separation(self) -> dict[str, float]:
        """Distances in the plane of the basis in standard deviations of a voxel: what noise can hide."""
        c11, c12, c22 = self.covariance
        white = np.linalg.cholesky(np.linalg.inv([[c11, c12], [c12, c22]])).T @ self.corners
        blood, core, fibrous, fat = white.T
        line = (fat - fibrous) / np.linalg.norm(fat - fibrous)
        return {
            "core to fibrous": float(np.linalg.norm(core - fibrous)),
            "core to fat": float(np.linalg.norm(core - fat)),
            "blood to fibrous": float(np.linalg.norm(blood - fibrous)),
            "core to the line from fat to fibrous": float(abs(line[0] * (core - fat)[1] - line[1] * (core - fat)[0])),
        }
