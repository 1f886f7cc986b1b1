"""The plaque scanned in energy bins and decomposed ray by ray, and tissue maps of its basis
images."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from recon.analytic.inset import InsetFbp
from recon.jobs.store import StudyCache
from recon.study.paper.plaque_scan import duty, inset_grid
from torchpcct.acquisition.acquire import acquire
from torchpcct.detector_window import footprint
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.placement import place_rois
from torchpcct.metrics.plaque_measures import dice
from torchpcct.metrics.roi import axial_grid
from torchpcct.scan import NOISE_FREE_EXPOSURE_S
from torchpcct.scanner import SiliconDetector, presets
from torchpcct.scene import Scene
from torchpcct.scene.plaque import plaque_scene
from torchpcct.spectral import (
    MMD_TISSUES,
    Decomposition,
    SpectralModel,
    clean,
    decompose_exterior,
    decompose_scan,
    label,
    mmd,
    nearest,
)
from torchpcct.threads import get_num_threads
from torchpcct.validate import choice

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from torchpcct.detector_window import DetectorWindow
    from torchpcct.scan import Scan


FAT_MM = 3.2
"""From the vessel's axis on there is only fat."""

NOISE_COLUMNS = 32
"""Columns kept on either side of the inset's footprint: the ramp filter's tail falls as 1 / n², its
square as 1 / n⁴, so the noise beyond adds less than 1e-4 to the variance of an ROI mean."""

BODIES = {
    "blood_iodine": "lumen",
    "necrotic_core": "core",
    "fibrous_tissue": "fibrous",
    "pericoronary_fat": "patient",
}
"""Tissue of the decomposition → body of the scene. The vessel's wall (0.19 mm) is a fifth
material, not among them."""

RULES = {
    "nearest": "FBP",
    "k-means": "FBP, k-means of fractions",
    "largest": "FBP, largest fraction",
}
"""How a tissue is read from the fractions → name in reports. The paper names "a standard 2D
k-means" and not its features. ``nearest``: the tissue nearest to the mixture, in standard
deviations (k-means with centres held at the tissues); ``k-means``: of the fractions, slice by
slice, started at the tissues; ``largest``: the largest fraction."""

PURE = 0.5
"""A voxel counts as a tissue if that fills more than this share of it."""


class SpectralScan:
    """The plaque in energy bins: expected counts, their decomposition, and noisy realisations of
    it.

    Args:
        settings: of the study.
        progress: called with the finished fraction of the simulation.
        detector: another one than the preset's.
        full_views: of the complete scan that ``settings.views`` stand for, each with its turn of
            the gantry; None: the scan has no more.
        cache: for the noise-free scan and its decomposition.

    Attributes:
        scene, plaque, scanner: what is scanned.
        grid: of the inset.
        clean, window: the noise-free scan about the inset, and its window.
        basis: PE and PVC.
    """

    def __init__(
        self,
        settings: Any,
        progress: Callable[[float], None] | None = None,
        detector: SiliconDetector | None = None,
        full_views: int | None = None,
        cache: StudyCache | None = None,
    ) -> None:
        self.settings, self._cache = settings, cache or StudyCache(None, None)
        self.scene, self.plaque = plaque_scene()
        self.scanner = presets.pcct(views=settings.views, mode="spectral", detector=detector)
        on = 1.0 if full_views is None else duty(self.scanner, full_views)
        self.grid = inset_grid(self.plaque, settings.voxel_mm)

        def run() -> tuple[Scan, DetectorWindow]:
            scan = acquire(self.scene, self.scanner, region=self.grid, duty=on, progress=progress)
            assert scan.window is not None
            window = footprint(scan.geometry, self.grid).widened(NOISE_COLUMNS, scan.window)
            return scan.crop(window), window

        self.clean, self.window = self._cache("scan", run)
        self.basis = SpectralModel.of(self.scanner, NOISE_FREE_EXPOSURE_S).basis
        self.rois = place_rois(self.scene, axial_grid(self.grid.center))

    def model(self, exposure_s: float) -> SpectralModel:
        """The spectral model at an exposure."""
        return SpectralModel.of(self.scanner, exposure_s)

    @cached_property
    def exact(self) -> Decomposition:
        """Decomposition of the expected counts: true line integrals; information of
        :data:`NOISE_FREE_EXPOSURE_S`."""
        # Newton's method squares the error in every step: after one of 1e-3 standard deviations
        # 1e-6 are left.
        run = partial(decompose_scan, self.clean, self.model(NOISE_FREE_EXPOSURE_S), tolerance=1e-3)
        return self._cache("exact", run)

    @cached_property
    def exterior(self) -> Tensor:
        """``(2, rows, columns)`` line integrals in mm outside the window."""
        return decompose_exterior(self.clean, self.model(NOISE_FREE_EXPOSURE_S))

    @cached_property
    def fbp(self) -> InsetFbp:
        """FBP of the two basis images."""
        return InsetFbp(self.clean, [self.grid], [self.settings.kernel], exterior=self.exterior)

    @cached_property
    def fat(self) -> Tensor:
        """Mask ``grid.shape`` of voxels of fat, in the slices about the middle."""
        _, y, x = (a - c for a, c in zip(self.grid.axes, self.grid.center, strict=True))
        middle, mask = self.grid.shape[0] // 2, torch.zeros(self.grid.shape, dtype=torch.bool)
        mask[middle - 4 : middle + 4] = torch.from_numpy(np.hypot(y[:, None], x) > FAT_MM)
        return mask

    def covariance(self, exposure_s: float) -> Tensor:
        """Cramér–Rao covariance ``(3, views, rows, columns)`` in mm² of every ray."""
        return self.exact.covariance * (NOISE_FREE_EXPOSURE_S / exposure_s)

    def noisy(
        self, exposure_s: float, seed: int, step: int = 1
    ) -> tuple[Tensor, dict[str, object]]:
        """A noisy scan, only every ``step``-th view of it, decomposed.

        Returns:
            Line integrals ``(2, views, rows, columns)`` in mm, and how they scatter about the true
            ones: ``variance_ratio``: mean squared error of each component over its Cramér–Rao
            bound; ``whitened_ratio``: half of the mean squared error in the metric of the Fisher
            information, 1 at the bound; ``bias``: mean error of each component in its standard
            deviations; ``zero_bins``: share of the readings that counted nothing; ``rays``,
            ``at_bound``, ``failed``: numbers of rays; ``rays_per_second``: by the clock, on
            ``threads`` threads; ``rays_per_core_second``: of processor time, whatever else the
            machine does.
        """
        clean, views = self.clean, slice(None, None, step)
        if step > 1:
            clean = clean.select(views)
        scan, model = clean.with_noise(exposure_s, seed), self.model(exposure_s)
        start, spent = time.perf_counter(), time.process_time()
        found = decompose_scan(scan, model)
        seconds, spent = time.perf_counter() - start, time.process_time() - spent
        truth, c = self.exact.line_integrals[:, views], self.covariance(exposure_s)[:, views]
        error = found.line_integrals - truth
        whitened = (
            c[2] * error[0].square() - 2 * c[1] * error[0] * error[1] + c[0] * error[1].square()
        )
        whitened /= 2 * (c[0] * c[2] - c[1].square())
        rays = error[0].numel()
        return found.line_integrals, {
            "exposure_s": exposure_s,
            "rays": rays,
            "variance_ratio": [_mean(v) for v in error.square() / c[[0, 2]]],
            "whitened_ratio": _mean(whitened),
            "bias": [_mean(v) for v in error / c[[0, 2]].sqrt()],
            "zero_bins": scan.zero_fraction,
            "at_bound": int(found.at_bound.sum()),
            "failed": int((~found.converged).sum())
            + int((~torch.isfinite(found.line_integrals)).sum()),
            "rays_per_second": rays / seconds,
            "rays_per_core_second": rays / spent,
            "threads": get_num_threads(),
        }


def _mean(values: Tensor) -> float:
    return float(values.mean(dtype=torch.float64))


def truth_labels(scene: Scene, grid: VolumeGrid) -> Tensor:
    """Index into :data:`~torchpcct.spectral.MMD_TISSUES` of the tissue that fills most of each
    voxel, ``grid.shape``.

    −1: no tissue fills half of it, or it is vessel wall, which the decomposition does not know.
    """
    fractions = scene.volume_fractions(grid)
    parts = np.stack([fractions[scene.index(BODIES[t])] for t in MMD_TISSUES])
    labels = np.where(parts.max(0) > PURE, parts.argmax(0), -1)
    return torch.from_numpy(labels.astype(np.int64))


class Tissues:
    """Tissue maps of the slices through the core.

    Args:
        scan: for geometry, basis and detected spectrum.
        covariance: ``(3,)`` C₁₁, C₁₂, C₂₂ of a voxel of the FBP images, the unit of distances.

    Attributes:
        slices, middle: the slices through the core, and which of them is the plaque's middle.
        truth: labels of these slices.
        corners: ``(2, tissues)`` coefficients of the tissues.
    """

    def __init__(self, scan: SpectralScan, covariance: ArrayLike) -> None:
        self.basis, self.covariance = scan.basis, np.asarray(covariance, np.float64)
        z = scan.grid.axes[0]
        core = scan.scene["core"].shape.bounding_box
        inside = np.flatnonzero((z > core[0, 2]) & (z < core[1, 2]))
        self.slices = slice(int(inside[0]), int(inside[-1]) + 1)
        self.truth = truth_labels(scan.scene, scan.grid)[self.slices]
        self.middle = int(np.abs(z[self.slices] - scan.plaque.position[2]).argmin())
        model = scan.model(1.0)
        # As the detector sees the tissues behind the patient: iodine's K edge makes blood depend on
        # the spectrum.
        centre = model.columns // 2
        path = scan.exterior[:, scan.exterior.shape[1] // 2, centre].double().numpy()
        detected = model.spectra[centre].sum(0) * np.exp(-path @ model.attenuation)
        corners = [self.basis.coefficients(t, model.energies, detected) for t in MMD_TISSUES]
        self.corners = np.stack(corners, axis=1)

    def labels(self, images: Tensor, rule: str = "nearest") -> Tensor:
        """Tissue of every voxel of the slices, ``(slices, y, x)``, from basis images ``(2, z, y,
        x)`` by one of :data:`RULES`."""
        choice("rule", rule, RULES)
        fractions = mmd(images[:, self.slices], self.basis, self.corners, self.covariance)
        if rule == "nearest":
            return nearest(fractions, self.basis, self.corners, self.covariance)
        if rule == "k-means":
            return torch.stack([clean(fractions[:, k]) for k in range(fractions.shape[1])])
        return label(fractions)

    def dice(self, images: Tensor, rule: str = "nearest") -> list[float]:
        """Dice coefficient of every tissue over the slices through the core; voxels without a
        true tissue left out."""
        known = self.truth >= 0
        found, truth = self.labels(images, rule)[known], self.truth[known]
        return [dice(found == k, truth == k) for k in range(len(MMD_TISSUES))]
