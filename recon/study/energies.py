"""What the weights of energy bins bring by themselves: FBP's exact noise beside the limit of one
ray and monochromatic images.

Nothing is drawn. FBP is linear and the noise of every reading known, so that the variance of the
difference of two tissues' means follows from one adjoint pass (:mod:`recon.analytic.exact_noise`):
for the plain sum of the bins, for their weighted sum and for the two basis images that
monochromatic images are mixed from. Their contrast is what the readings lose, per mm, where one
tissue takes the other's place; what FBP makes of it is alike for all. Dose factors compare squared
contrast over variance with that of the plain sum.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from recon.analytic.exact_noise import Functional, functional_covariance, roi_covariance
from recon.analytic.inset import InsetFbp
from recon.evaluate.energies import mean_paths, with_bins
from recon.evaluate.task import Task
from recon.study.study import Progress, silent
from torchpcct.acquisition.acquire import acquire
from torchpcct.acquisition.path_lengths import tissue_path_lengths
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.scene.scene import Scene
from torchpcct.spectral import (
    SpectralModel,
    bin_weights,
    cramer_rao,
    decompose_exterior,
    decompose_scan,
    vmi_curve,
    weighting_gain,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torchpcct.typing import Floats


PAIRS = (("lumen", "fibrous"), ("fibrous", "patient"), ("core", "fibrous"))
"""Bodies of the plaque scene whose contrasts are looked at."""

VIEWS = 120
"""Of the scan that factors are computed from: they are ratios, which all views share."""
_SUB_RAYS = 16
"""Beam samples of path lengths."""

KERNEL = "standard"
"""Kernel of FBP."""
_PURE = 0.99
"""Share of a tissue in the voxels that its mean is taken over."""


def energy_rows(
    task: Task,
    pairs: Sequence[tuple[str, str]] = PAIRS,
    *,
    views: int = VIEWS,
    kernel: str = KERNEL,
    progress: Progress = silent,
) -> list[dict[str, object]]:
    """Dose factors of contrasts between tissues, over the plain sum of the counts.

    Args:
        task: a scene of bodies, its scanner and inset; its signal does not matter.
        pairs: names of two bodies each.
        views: a turn.
        kernel: of FBP.
        progress: called with a text and the finished fraction.

    Returns:
        For each pair ``contrast`` ``[a, b]``, and the factors ``weights`` (FBP of the weighted
        bins, exact), ``limit`` (the best weights of one ray, mean over the columns that see the
        inset), ``energies`` (the same with the energy of every photon), ``vmi`` (the best
        monochromatic image, FBP of the basis images, exact) at ``vmi_kev`` and ``vmi_limit`` (the
        best mix of the two basis images, which is no image at one energy).

    Raises:
        ValueError: a scanner without energy bins, bodies that fill no voxel of the inset.
    """
    scanner = with_bins(task.scanner, f"task {task.name}").with_views(views)
    model = SpectralModel.of(scanner, NOISE_FREE_EXPOSURE_S)
    ones = np.ones((model.bins, model.columns))
    behind = mean_paths(task.scene, task.grid.center)
    functionals = _differences(task, pairs)

    def acquired(scene: Scene) -> Scan:
        return acquire(scene, scanner, region=task.grid, tolerance_hu=task.tolerance_hu)

    progress("energies", 0.0)
    bins = acquired(task.scene)
    assert bins.window is not None
    seen = np.unique(bins.window.column_indices)
    lines = decompose_scan(bins, model).line_integrals
    noise = _basis_noise(bins, lines, model, task, kernel, functionals)
    rows = []
    for k, (pair, functional) in enumerate(zip(pairs, functionals, strict=True)):
        progress("energies", (k + 1) / (len(pairs) + 1))
        first, second = (task.scene.materials[task.scene.index(name)] for name in pair)
        other = acquired(task.scene.replace_material(pair[0], second))
        (path,) = tissue_path_lengths(
            task.scene,
            [pair[0]],
            scanner.geometry,
            bins.window,
            sub_rays=_SUB_RAYS,
            focal_spot=scanner.source.focal_spot,
        )
        weights = bin_weights(scanner, (first, second), behind)
        plain, weighted = (
            _signal_to_noise(
                bins.weighted(w, scanner),
                other.weighted(w, scanner),
                path,
                task,
                kernel,
                functional,
            )
            for w in (ones, weights)
        )
        # Rays beside the body read the same in both scans.
        through = path > 0.0
        there = decompose_scan(other, model, readings=through).line_integrals
        change = _per_mm(lines[:, through] - there, path[through])
        curve = vmi_curve(change, np.zeros(2), noise[k, k], model.basis)
        limit, energies = (
            float(weighting_gain(scanner, (first, second), behind, kind)[seen].mean())
            for kind in ("bins", "energies")
        )
        rows.append(
            {
                "contrast": list(pair),
                "weights": weighted / plain,
                "limit": limit,
                "energies": energies,
                "vmi": float(curve.cnr.max()) ** 2 / plain,
                "vmi_kev": curve.optimum_kev,
                "vmi_limit": curve.limit**2 / plain,
            }
        )
    progress("energies", 1.0)
    return rows


def _differences(task: Task, pairs: Sequence[tuple[str, str]]) -> list[Tensor]:
    """For each pair weights ``grid.shape``: mean over the first body's voxels less that over the
    second one's."""
    shares = dict(zip(task.scene.names, task.scene.volume_fractions(task.grid, 16), strict=True))
    found = []
    for names in pairs:
        masks = [torch.from_numpy(shares[name] > _PURE).double() for name in names]
        for name, mask in zip(names, masks, strict=True):
            if not mask.any():
                raise ValueError(
                    f"task {task.name}: no voxel of the inset lies wholly in {name!r}: take "
                    "smaller voxels"
                )
        found.append(masks[0] / masks[0].sum() - masks[1] / masks[1].sum())
    return found


def _per_mm(change: Tensor, path: Tensor) -> Floats:
    """Least squares for what readings ``(..., *path.shape)`` change by per mm of path."""
    p = path.double()
    return ((change.double() * p).flatten(-p.ndim).sum(-1) / p.square().sum()).numpy()


def _signal_to_noise(
    scan: Scan, other: Scan, path: Tensor, task: Task, kernel: str, functional: Tensor
) -> float:
    """Squared contrast, between two scans that differ in one body with this path, over the variance
    at 1 s of the functional of FBP."""
    hu = 1000.0 / scan.linearisation.mu_ref
    contrast = hu * float(_per_mm(scan.line_integrals() - other.line_integrals(), path))
    roi = Functional(functional)
    fbp = InsetFbp(scan, [task.grid], [kernel])
    (covariance,) = roi_covariance(scan, fbp, [[roi]], NOISE_FREE_EXPOSURE_S)
    return contrast**2 / float(covariance[0, 0, 0])


def _basis_noise(
    bins: Scan,
    lines: Tensor,
    model: SpectralModel,
    task: Task,
    kernel: str,
    functionals: list[Tensor],
) -> Floats:
    """Covariances ``(pairs, pairs, 3)`` at 1 s of the functionals of FBP of the basis images, from
    readings decomposed at their Cramér–Rao bound."""
    columns, scale = model.cells(bins)
    fbp = InsetFbp(bins, [task.grid], [kernel], exterior=decompose_exterior(bins, model))
    rays = cramer_rao(lines, model, columns=columns, scale=scale).float()
    return functional_covariance(fbp, torch.stack(functionals).float(), rays)
