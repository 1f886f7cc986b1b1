"""Scans of the spectral study: the plaque in energy bins, decomposed ray by ray, and water for the check of 0 HU."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.analytic.inset import InsetFbp, static_fbp
from recon.evaluate.store import Pieces
from recon.study.paper.plaque_scan import duty, inset_grid
from recon.study.spectral.settings import Settings
from torchpcct.acquisition.acquire import acquire
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.placement import place_rois
from torchpcct.metrics.roi import axial_grid
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.scanner import Scanner, SiliconDetector, presets
from torchpcct.scene.bodies import EllipticCylinder
from torchpcct.scene.plaque import PAPER_POSITION, PATIENT_DIAMETER, plaque_scene
from torchpcct.scene.scene import Body, Scene
from torchpcct.spectral import (
    Decomposition,
    SpectralModel,
    cramer_rao,
    decompose,
    decompose_scan,
    decompose_surround,
    vmi,
)
from torchpcct.threads import get_num_threads

__all__ = ["SpectralScan", "second_order_bound", "starved_rays", "water_hu"]

NOISE_COLUMNS = 32
"""Columns kept on either side of the inset's footprint: the ramp filter's tail falls as 1 / n², its square as 1 / n⁴,
so the noise beyond adds less than 1e-4 to the variance of an ROI mean."""

_ROD_MM = 8.0
"""Radius of the water rod at the plaque's place."""

_WATER_ROWS, _WATER_VIEWS = 8, 246
"""Of the scans of water; never more views than the study's own scan."""


def _acquired(
    scene: Scene, scanner: Scanner, grid: VolumeGrid, progress: Callable[[float], None] | None = None,
    on: float = 1.0,
) -> tuple[Scan, DetectorWindow]:  # fmt: skip
    """The noise-free readings that the FBP of ``grid`` needs, and their window."""
    scan = acquire(scene, scanner, region=grid, duty=on, progress=progress)
    assert scan.window is not None
    window = footprint(scan.geometry, grid).widened(NOISE_COLUMNS, scan.window)
    return scan.crop(window), window


class SpectralScan:
    """The plaque in energy bins: expected counts, their decomposition, and noisy realisations of it.

    Args:
        settings: of the study.
        progress: called with the finished fraction of the simulation.
        detector: another one than the preset's.
        full_views: of the complete scan that ``settings.views`` stand for, each with its turn of the gantry; None: the
            scan has no more.
        pieces: keep the noise-free scan and its decomposition.

    Attributes:
        scene, plaque, scanner: what is scanned.
        grid: of the inset.
        clean, window: the noise-free scan about the inset, and its window.
        basis: PE and PVC.
    """

    def __init__(
        self, settings: Settings, progress: Callable[[float], None] | None = None,
        detector: SiliconDetector | None = None, full_views: int | None = None,
        pieces: Pieces | None = None,
    ) -> None:  # fmt: skip
        self.settings, self._pieces = settings, pieces or Pieces(None, None)
        self.scene, self.plaque = plaque_scene()
        self.scanner = presets.pcct(views=settings.views, mode="spectral", detector=detector)
        on = 1.0 if full_views is None else duty(self.scanner, full_views)
        self.grid = inset_grid(self.plaque, settings.voxel_mm)
        run = partial(_acquired, self.scene, self.scanner, self.grid, progress, on)
        self.clean, self.window = self._pieces("scan", run)
        self.basis = SpectralModel.of(self.scanner, NOISE_FREE_EXPOSURE_S).basis
        self.rois = place_rois(self.scene, axial_grid(self.grid.center))

    def model(self, exposure_s: float) -> SpectralModel:
        """The spectral model at an exposure."""
        return SpectralModel.of(self.scanner, exposure_s)

    @cached_property
    def exact(self) -> Decomposition:
        """Decomposition of the expected counts: true line integrals; information of :data:`NOISE_FREE_EXPOSURE_S`."""
        # Newton's method squares the error in every step: after one of 1e-3 standard deviations 1e-6 are left.
        run = partial(decompose_scan, self.clean, self.model(NOISE_FREE_EXPOSURE_S), tolerance=1e-3)
        return self._pieces("exact", run)

    @cached_property
    def surround(self) -> Tensor:
        """``(2, rows, columns)`` line integrals in mm outside the window."""
        return decompose_surround(self.clean, self.model(NOISE_FREE_EXPOSURE_S))

    @cached_property
    def fbp(self) -> InsetFbp:
        """FBP of the two basis images."""
        return InsetFbp(self.clean, [self.grid], [self.settings.kernel], surround=self.surround)

    def covariance(self, exposure_s: float) -> Tensor:
        """Cramér–Rao covariance ``(3, views, rows, columns)`` in mm² of every ray."""
        return self.exact.covariance * (NOISE_FREE_EXPOSURE_S / exposure_s)

    def noisy(self, exposure_s: float, seed: int, step: int = 1) -> tuple[Tensor, dict[str, Any]]:
        """A noisy scan, decomposed.

        Args:
            exposure_s: in s.
            seed: of the noise.
            step: only every so many views.

        Returns:
            Line integrals ``(2, views, rows, columns)`` in mm, and how they scatter about the true ones:
            ``variance_ratio``: mean squared error of each component over its Cramér–Rao bound; ``whitened_ratio``:
            half of the mean squared error in the metric of the Fisher information, 1 at the bound; ``bias``: mean error
            of each component in its standard deviations; ``zero_bins``: share of the readings that counted nothing;
            ``rays``, ``at_bound``, ``failed``: numbers of rays; ``rays_per_second``: by the clock, on ``threads``
            threads; ``rays_per_core_second``: of processor time, whatever else the machine does.
        """
        clean, views = self.clean, slice(None, None, step)
        if step > 1:
            geometry, counts = clean.geometry.select(views), clean.counts[:, views].contiguous()
            clean = replace(clean, counts=counts, geometry=geometry, window=self.window.select(views))
        scan, model = clean.with_noise(exposure_s, seed), self.model(exposure_s)
        start, spent = time.perf_counter(), time.process_time()
        found = decompose_scan(scan, model)
        seconds, spent = time.perf_counter() - start, time.process_time() - spent
        truth, c = self.exact.line_integrals[:, views], self.covariance(exposure_s)[:, views]
        error = found.line_integrals - truth
        whitened = c[2] * error[0].square() - 2 * c[1] * error[0] * error[1] + c[0] * error[1].square()
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
            "failed": int((~found.converged).sum()) + int((~torch.isfinite(found.line_integrals)).sum()),
            "rays_per_second": rays / seconds,
            "rays_per_core_second": rays / spent,
            "threads": get_num_threads(),
        }


def _mean(values: Tensor) -> float:
    return float(values.mean(dtype=torch.float64))


def second_order_bound(scan: SpectralScan, exposure_s: float) -> float:
    """Excess of Bhattacharyya's bound over Cramér–Rao's for the rays behind the patient: mean of both components.

    No unbiased estimate can come closer to Cramér–Rao than this, however it is made.
    """
    model = scan.model(exposure_s)
    columns = np.unique(scan.window.column_indices)
    lines = scan.surround[:, scan.surround.shape[1] // 2, columns].double()
    first, second = (cramer_rao(lines, model, columns=columns, order=k)[[0, 2]] for k in (1, 2))
    return float((second / first).mean() - 1.0)


def starved_rays(scan: SpectralScan, rays: int, seed: int) -> dict[str, float]:
    """Decomposition of rays from no count at all to air: how many fail, and how many end at the bounds.

    Rays pass 0 … 600 mm of water at exposures of 1e-6 … 1 of the study's, evenly in the logarithm, through any column.
    """
    rng = np.random.default_rng(seed)
    model = scan.model(scan.settings.exposure_s)
    columns = rng.integers(0, model.columns, rays)
    lengths = torch.from_numpy(np.outer(scan.basis.coefficients("water"), rng.uniform(0.0, 600.0, rays)))
    level = 10.0 ** rng.uniform(-6, 0, rays)
    mean = model.expected(lengths, columns=columns, scale=level)
    counts = torch.from_numpy(rng.poisson(mean.numpy()).astype(np.float64))
    counts[:, :10] = 0.0
    found = decompose(counts, model, columns=columns, scale=level)
    finite = torch.isfinite(found.line_integrals).all(0) & torch.isfinite(found.information).all(0)
    return {
        "rays": rays,
        "without_counts": int((counts.sum(0) == 0).sum()),
        "not_finite": int((~finite).sum()),
        "not_converged": int((~found.converged).sum()),
        "at_bound": int(found.at_bound.sum()),
    }


def water_hu(energies: Any, views: int) -> dict[str, NDArray[np.float64]]:
    """HU of water in virtual monochromatic images at every energy, through the whole chain, noise free.

    Returns:
        place → ``(E,)`` HU: a water cylinder of the patient's size at its centre and at the plaque's place, and a rod
        of water at the plaque's place in the patient's fat.
    """
    scanner = presets.pcct(views=min(views, _WATER_VIEWS), mode="spectral", rows=_WATER_ROWS)
    x, y, z = PAPER_POSITION
    spacing, patient = (0.25, 0.5, 0.5), EllipticCylinder(PATIENT_DIAMETER / 2)
    there, middle = VolumeGrid((2, 16, 16), spacing, (z, y, x)), VolumeGrid((2, 16, 16), spacing, 0.0)
    model = SpectralModel.of(scanner, NOISE_FREE_EXPOSURE_S)
    cylinder = acquire(Scene([Body("water", patient, "water")]), scanner, region=there)
    lines = decompose_surround(cylinder, model)
    rod = Body("rod", EllipticCylinder(_ROD_MM, position=(x, y, z)), "water", "patient")
    scene = Scene([Body("patient", patient, "pericoronary_fat"), rod])
    scan = _acquired(scene, scanner, VolumeGrid((2, 40, 40), spacing, (z, y, x)))[0]
    fbp = InsetFbp(scan, [there], ["standard"], surround=decompose_surround(scan, model))
    images = {
        "cylinder, centre": static_fbp(lines, cylinder.geometry, middle),
        "cylinder, plaque's place": static_fbp(lines, cylinder.geometry, there),
        "rod in fat, plaque's place": fbp.images(decompose_scan(scan, model).line_integrals)[0][0],
    }
    return {k: vmi(v.double().mean((-1, -2, -3)), model.basis, energies).numpy() for k, v in images.items()}
