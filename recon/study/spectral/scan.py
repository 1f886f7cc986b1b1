"""Scans of the spectral study: the plaque in energy bins, decomposed ray by ray, and water for the check of 0 HU."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.fbp.inset import InsetFbp, static_fbp
from recon.study.compare.measure import inset_grid
from torchpcct.acquisition.acquire import acquire
from torchpcct.acquisition.plan import Effect
from torchpcct.detector_window import DetectorWindow, shadow
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.scanner import presets
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

if TYPE_CHECKING:
    from recon.study.spectral.measure import Settings

__all__ = ["PlaqueScan", "RayStatistics", "second_order_bound", "starved_rays", "water_hu"]

Floats = NDArray[np.float64]

NOISE_COLUMNS = 32
"""Columns kept on either side of the inset's shadow: the ramp filter's tail falls as 1 / n², its square as 1 / n⁴, so
the noise beyond adds less than 1e-4 to the variance of an ROI mean."""

_ROD_MM = 8.0
"""Radius of the water rod at the plaque's place."""

_WATER_ROWS, _WATER_VIEWS = 8, 246


def narrowed(scan: Scan, grid: VolumeGrid, margin: int = NOISE_COLUMNS) -> Scan:
    """The readings of a windowed scan within ``margin`` columns of a grid's shadow; every row is kept."""
    assert scan.window is not None
    part = shadow(scan.geometry, grid, margin=margin)
    columns = min(part.columns, scan.window.columns)
    last = scan.window.first_column + scan.window.columns - columns
    first = np.clip(part.first_column, scan.window.first_column, last)
    window = DetectorWindow(first, columns, scan.window.first_row, scan.window.rows)
    return replace(scan, counts=scan.window.crop(scan.counts, window).contiguous(), window=window)


def every(scan: Scan, step: int) -> Scan:
    """Every ``step``-th view of a windowed scan."""
    w = scan.window
    assert w is not None
    window = DetectorWindow(w.first_column[::step], w.columns, w.first_row, w.rows)
    views = slice(None, None, step)
    return replace(scan, counts=scan.counts[:, views].contiguous(), geometry=scan.geometry.select(views), window=window)


@dataclass(frozen=True)
class RayStatistics:
    """How the decomposed line integrals of noisy rays scatter about the true ones.

    Attributes:
        exposure_s: of the scan; rays: number of rays.
        variance_ratio: mean squared error of each component over its Cramér–Rao bound, ``(2,)``.
        whitened_ratio: half of the mean squared error in the metric of the Fisher information: 1 at the bound.
        bias: mean error of each component in its standard deviations, ``(2,)``.
        zero_bins: share of the readings that counted nothing; at_bound, failed: number of rays.
        rays_per_second: speed of the decomposition by the clock, on ``threads`` threads.
        rays_per_core_second: the same per second of processor time, whatever else the machine does.
    """

    exposure_s: float
    rays: int
    variance_ratio: list[float]
    whitened_ratio: float
    bias: list[float]
    zero_bins: float
    at_bound: int
    failed: int
    rays_per_second: float
    rays_per_core_second: float
    threads: int


class PlaqueScan:
    """The plaque in energy bins: expected counts, their decomposition, and noisy realisations of it.

    Args:
        settings: of the study.
        progress: called with the finished fraction of the simulation.
    """

    def __init__(self, settings: Settings, progress: Callable[[float], None] | None = None) -> None:
        self.settings = settings
        self.scene, self.plaque = plaque_scene()
        self.scanner = presets.pcct(views=settings.views, mode="spectral")
        self.grid = inset_grid(self.plaque, settings.voxel_mm)
        whole = acquire(self.scene, self.scanner, region=self.grid, progress=progress)
        self.info = dict(whole.info)
        self.clean = narrowed(whole, self.grid)
        self.basis = SpectralModel.of(self.scanner, NOISE_FREE_EXPOSURE_S).basis

    def model(self, exposure_s: float) -> SpectralModel:
        """The spectral model at an exposure."""
        return SpectralModel.of(self.scanner, exposure_s)

    @property
    def window(self) -> DetectorWindow:
        """Of :attr:`clean` and all line integrals."""
        assert self.clean.window is not None
        return self.clean.window

    @property
    def effects(self) -> list[Effect]:
        """What the simulation modelled, from its plan."""
        return [Effect(**e) for e in self.info["plan"]["effects"]]

    @cached_property
    def exact(self) -> Decomposition:
        """Decomposition of the expected counts: true line integrals; information of :data:`NOISE_FREE_EXPOSURE_S`."""
        # Newton's method squares the error in every step: after one of 1e-3 standard deviations 1e-6 are left.
        return decompose_scan(self.clean, self.model(NOISE_FREE_EXPOSURE_S), tolerance=1e-3)

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

    def noisy(self, exposure_s: float, seed: int, step: int = 1) -> tuple[Tensor, RayStatistics]:
        """A noisy scan, decomposed: line integrals ``(2, views, rows, columns)`` in mm, and how they scatter.

        Args:
            exposure_s: in s.
            seed: of the noise.
            step: only every so many views.
        """
        import numba

        clean = self.clean if step == 1 else every(self.clean, step)
        scan = clean.with_noise(exposure_s, seed)
        model = self.model(exposure_s)
        start, spent = time.perf_counter(), time.process_time()
        found = decompose_scan(scan, model)
        seconds, spent = time.perf_counter() - start, time.process_time() - spent
        truth, c = self.exact.line_integrals[:, ::step], self.covariance(exposure_s)[:, ::step]
        error = found.line_integrals - truth
        rays = error[0].numel()
        squared = error.square() / c[[0, 2]]
        whitened = c[2] * error[0].square() - 2 * c[1] * error[0] * error[1] + c[0] * error[1].square()
        whitened /= 2 * (c[0] * c[2] - c[1].square())
        statistics = RayStatistics(
            exposure_s, rays,
            [float(v.mean(dtype=torch.float64)) for v in squared],
            float(whitened.mean(dtype=torch.float64)),
            [float(v.mean(dtype=torch.float64)) for v in error / c[[0, 2]].sqrt()],
            scan.zero_fraction, int(found.at_bound.sum()),
            int((~found.converged).sum()) + int((~torch.isfinite(found.line_integrals)).sum()),
            rays / seconds, rays / spent, numba.get_num_threads(),
        )  # fmt: skip
        return found.line_integrals, statistics


def second_order_bound(plaque: PlaqueScan, exposure_s: float) -> float:
    """Excess of Bhattacharyya's bound over Cramér–Rao's for the rays behind the patient: mean of both components.

    No unbiased estimate can come closer to Cramér–Rao than this, however it is made.
    """
    model = plaque.model(exposure_s)
    row = plaque.surround.shape[1] // 2
    columns = np.unique(plaque.window.column_indices)
    lines = plaque.surround[:, row, columns].double()
    first, second = (cramer_rao(lines, model, columns=columns, order=k)[[0, 2]] for k in (1, 2))
    return float((second / first).mean() - 1.0)


def starved_rays(plaque: PlaqueScan, rays: int, seed: int) -> dict[str, float]:
    """Decomposition of rays from no count at all to air: how many fail, and how many end at the bounds.

    Rays pass 0 … 600 mm of water at exposures of 1e-6 … 1 of the study's, evenly in the logarithm, through any column.
    """
    rng = np.random.default_rng(seed)
    model = plaque.model(plaque.settings.exposure_s)
    columns = rng.integers(0, model.columns, rays)
    water = plaque.basis.coefficients("water")
    lengths = torch.from_numpy(np.outer(water, rng.uniform(0.0, 600.0, rays)))
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


def water_hu(plaque: PlaqueScan, energies: Any) -> dict[str, Floats]:
    """HU of water in virtual monochromatic images at every energy, through the whole chain, noise free.

    Returns:
        place → ``(E,)`` HU: a water cylinder of the patient's size at its centre and at the plaque's place, and a rod
        of water at the plaque's place in the patient's fat.
    """
    scanner = presets.pcct(views=_WATER_VIEWS, mode="spectral", rows=_WATER_ROWS)
    x, y, z = PAPER_POSITION
    there = VolumeGrid((2, 16, 16), (0.25, 0.5, 0.5), (z, y, x))
    middle = VolumeGrid((2, 16, 16), (0.25, 0.5, 0.5), 0.0)
    model = SpectralModel.of(scanner, NOISE_FREE_EXPOSURE_S)
    found: dict[str, Floats] = {}

    def record(name: str, images: Tensor) -> None:
        mean = images.double().mean((-1, -2, -3))
        found[name] = vmi(mean, model.basis, energies).numpy()

    cylinder = Scene([Body("water", EllipticCylinder(PATIENT_DIAMETER / 2), "water")])
    scan = acquire(cylinder, scanner, region=there)
    lines = decompose_surround(scan, model)
    record("cylinder, centre", static_fbp(lines, scan.geometry, middle))
    record("cylinder, plaque's place", static_fbp(lines, scan.geometry, there))
    rod = Body("rod", EllipticCylinder(_ROD_MM, position=(x, y, z)), "water", "patient")
    scene = Scene([Body("patient", EllipticCylinder(PATIENT_DIAMETER / 2), "pericoronary_fat"), rod])
    held = VolumeGrid((2, 40, 40), (0.25, 0.5, 0.5), (z, y, x))
    scan = narrowed(acquire(scene, scanner, region=held), held)
    fbp = InsetFbp(scan, [there], ["standard"], surround=decompose_surround(scan, model))
    record("rod in fat, plaque's place", fbp.images(decompose_scan(scan, model).line_integrals)[0][0])
    return found
