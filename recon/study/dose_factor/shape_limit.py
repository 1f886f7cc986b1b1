"""The limit of the data when outlines are only roughly known: what separates a method from the ideal."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.limits import deformation_limit, outline_maps
from recon.pwls.inset_problem import InsetProblem
from recon.study.dose_factor.realisations import Realisations
from recon.study.dose_factor.scene import StudyScene
from torchpcct.geometry import VolumeGrid

__all__ = ["CORRELATION_MM", "DISPLACEMENTS_MM", "contrast_sd", "shape_limits"]

DISPLACEMENTS_MM = (0.0, 0.1, 0.2)
"""Standard deviations of the outlines' displacement: half a voxel, and a voxel of 0.2 mm. The wall is 0.19 mm thick."""

CORRELATION_MM = 0.5
_FINE_MM = 0.04
"""Fine voxels that outlines are found on, about."""


def contrast_sd(scene: StudyScene, problem: InsetProblem, dose: float, displacement_mm: float) -> float:
    """Smallest contrast SD in HU with the outlines displaced, on the voxels of the problem.

    With a displacement of 0 a little above the exact limit, which knows the shapes within voxels, too, and sums over
    all readings; otherwise it hinges on the voxels, see :func:`recon.limits.deformation_limit`.
    """
    facts, grid = scene.facts, problem.grid
    factor = round(grid.spacing[-1] / _FINE_MM)
    fine = VolumeGrid(tuple(n * factor for n in grid.shape), grid.spacing[-1] / factor, grid.center)
    labels = np.asarray(scene.plain.labels(fine))
    order = [scene.plain.index(t) for t in facts.tissues]
    tissues = np.full(labels.max() + 1, facts.tissues.index("patient"))
    tissues[order] = np.arange(len(order))
    labels = tissues[labels]
    maps = outline_maps(labels, [facts.tissue_hu[t] for t in facts.tissues], factor, fine.spacing[-1])
    parts = [v for n in grid.shape for v in (n, factor)]
    keep = [k for k, t in enumerate(facts.tissues) if t != "patient"]
    fractions = np.stack([(labels == k).reshape(parts).mean(axis=(1, 3, 5)) for k in keep])
    names = [facts.tissues[k] for k in keep]
    return deformation_limit(
        problem.gram.scaled(dose), fractions, maps, (names.index("fibrous"), names.index("core")),
        hu=problem.mu_ref / 1000.0, voxel_mm=grid.spacing[-1], displacement_mm=displacement_mm,
        correlation_mm=CORRELATION_MM,
    )  # fmt: skip


def shape_limits(noise: Realisations, dose: float) -> dict[float, float]:
    """Displacement in mm → smallest contrast SD in HU in the paper's scene, the fat around the vessel known.

    Args:
        noise: of the study.
        dose: exposure in s.
    """
    scene = noise.scene("paper")

    def compute() -> dict[str, Any]:
        sds = [contrast_sd(scene, scene.problem, dose, d) for d in DISPLACEMENTS_MM]
        return {"displacement_mm": np.array(DISPLACEMENTS_MM), "contrast_sd_hu": np.array(sds)}

    key = f"{noise.key} rods {DISPLACEMENTS_MM} {CORRELATION_MM} {round(scene.grid.spacing[-1] / _FINE_MM)}"
    piece = noise.store.piece(f"limits/{dose:g}s", key, compute)
    return dict(zip(piece["displacement_mm"].tolist(), piece["contrast_sd_hu"].tolist(), strict=True))
