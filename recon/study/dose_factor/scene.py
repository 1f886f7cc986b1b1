"""One scene of the dose-factor study: its scan, its reconstruction problem, and what holds without sampling error."""

from __future__ import annotations

import copy
import logging
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor

from recon.fbp.exact_noise import FILTER_MARGIN_COLUMNS, line_integral_variance, roi_covariance
from recon.fbp.inset import InsetFbp
from recon.pwls.inset_problem import InsetProblem
from recon.study.dose_factor.facts import SceneFacts, fbp_label
from recon.study.dose_factor.measures import OBSERVERS, crop_window, observer_channels
from recon.study.dose_factor.settings import FBP_BASE, MAIN_SCENES, WIDE_ROIS, Settings
from recon.study.dose_factor.store import Store
from recon.study.paper.facts import FULL_VIEWS
from recon.study.paper.plaque_scan import REFERENCE_KERNEL, REFERENCE_VOXEL_MM, enclosing, inset_grid
from torchpcct.detector_window import DetectorWindow, shadow
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.data_limit import information_matrix
from torchpcct.metrics.placement import RoiPair, place_rois, whole_rois
from torchpcct.metrics.roi import axial_grid
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan

if TYPE_CHECKING:
    from torchpcct.scanner import Scanner
    from torchpcct.scene import Scene
    from torchpcct.scene.plaque import Plaque

__all__ = ["StudyScene"]

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]

_GLS_VIEWS = 246
"""Views that the limit is summed over, then scaled: path lengths change slowly from view to view."""

_PITCH = re.compile(r"pitch_(\d\.\d+)mm")
"""The paper's scene on a scanner of another column pitch."""

_SUB_RAYS = 16


@dataclass(frozen=True)
class _Functional:
    """A linear functional of a volume, as :func:`roi_covariance` takes ROIs."""

    weights: Tensor


class StudyScene:
    """A scene by name: a variant of the plaque, or ``"variant:absent"``, the same without its core.

    Args:
        name: see above.
        settings: of the study.
        store: keeps scans and facts.
    """

    def __init__(self, name: str, settings: Settings, store: Store) -> None:
        self.name, self.settings, self.store = name, settings, store
        self.peers: dict[str, StudyScene] = {}
        self._clean: Scan | None = None
        self._problem: InsetProblem | None = None
        self._facts: SceneFacts | None = None

    # -- geometry -------------------------------------------------------------------------------------------------

    @cached_property
    def _pair(self) -> tuple[Scene, Plaque]:
        from torchpcct.scene.plaque.variants import plaque_variant

        variant, _, absent = self.name.partition(":")
        if _PITCH.fullmatch(variant):
            variant = "paper"
        return plaque_variant(variant, core_contrast=0.0) if absent else plaque_variant(variant)

    @cached_property
    def scanner(self) -> Scanner:
        """The paper's, or one with the column pitch of the scene's name."""
        from torchpcct.scanner import presets

        scanner = presets.pcct(views=self.settings.views)
        pitch = _PITCH.match(self.name)
        if pitch is None:
            return scanner
        geometry = scanner.geometry
        return replace(scanner, geometry=replace(geometry, pitch=(geometry.pitch[0], float(pitch[1]))))

    @property
    def scene(self) -> Scene:
        """All bodies."""
        return self._pair[0]

    @property
    def plaque(self) -> Plaque:
        """The plaque's geometry."""
        return self._pair[1]

    @cached_property
    def geometry(self) -> Scene:
        """The plain plaque of the same geometry, without extra bodies: where tissues are, whatever fills them."""
        from torchpcct.scene.plaque import plaque_scene

        return plaque_scene(self.plaque)[0]

    @cached_property
    def core_center(self) -> tuple[float, float, float]:
        """(z, y, x) mm."""
        x, y, z = (float(v) for v in self.plaque.to_scanner(self.plaque.core_center))
        return z, y, x

    @cached_property
    def lumen_center(self) -> tuple[float, float, float]:
        """(z, y, x) mm, in the plaque's middle slice."""
        x, y, _, _ = (float(v) for v in self.plaque.section("lumen", 0.0))
        x, y, z = (float(v) for v in self.plaque.to_scanner((x, y, 0.0)))
        return z, y, x

    @cached_property
    def grid(self) -> VolumeGrid:
        """The methods' grid."""
        return inset_grid(self.plaque, self.settings.voxel_mm)

    @cached_property
    def rois(self) -> RoiPair:
        """The paper's ROIs; a calcification is kept clear of, texture and stent are not (they have no bulk there)."""
        scene = self.scene if "calcification" in self.name else self.geometry
        return place_rois(scene, axial_grid(self.grid.center))

    def wide_rois(self, name: str) -> RoiPair:
        """The ROIs of :data:`WIDE_ROIS`, inside of the crop."""
        z, y, x = self.core_center
        if name == "section":
            image = VolumeGrid((1, 80, 80), 0.04, (self.grid.center[0], y, x))
        elif name == "tissue":
            half = float(self.plaque.core.semi_axes[2])
            image = VolumeGrid((max(1, math.floor(2 * half / 0.05)), 64, 64), 0.05, (z, y, x))
        else:
            raise ValueError(f"rois must be of {', '.join(WIDE_ROIS)}, got {name!r}")
        return whole_rois(self.geometry, image)

    def wide_covariance(self) -> dict[str, Floats]:
        """Exact covariance at 1 s of the means in all wider ROIs of the settings, two each, of every FBP variant."""
        s = self.settings
        key = f"views={s.views} {s.kernels} {s.voxels_mm} {s.rois}"

        def compute() -> dict[str, Any]:
            fbp = InsetFbp(self.clean, [inset_grid(self.plaque, v) for v in s.voxels_mm], s.kernels)
            rows = [[r for name in s.rois for r in self.wide_rois(name).on(grid)] for grid in fbp.grids]
            found = roi_covariance(self.clean, fbp, cast(Any, rows), NOISE_FREE_EXPOSURE_S)
            return {
                fbp_label(kernel, grid.spacing[0]): matrix
                for grid, matrices in zip(fbp.grids, found, strict=True)
                for kernel, matrix in zip(fbp.kernels, matrices, strict=True)
            }

        return self.store.piece(f"scenes/{_file(self.name)}_rois", key, compute)

    # -- scan -----------------------------------------------------------------------------------------------------

    @property
    def clean(self) -> Scan:
        """The noise-free scan, cut to the inset's shadow and the columns whose noise the filter sees."""
        if self._clean is None:
            self._clean = self._load() or self._acquire()
        return self._clean

    @property
    def _path(self) -> Any:
        return self.store.path(f"scans/{_file(self.name)}_{self.settings.views}.h5")

    def _load(self) -> Scan | None:
        if not self._path.exists():
            return None
        try:
            return Scan.load(self._path)
        except ValueError as error:
            log.warning("%s: simulated again", error)
            return None

    def _acquire(self) -> Scan:
        from torchpcct.acquisition.acquire import acquire

        views = self.settings.views
        grids = [inset_grid(self.plaque, v) for v in {*self.settings.voxels_mm, self.settings.voxel_mm, 0.1}]
        # Fewer views stand for the same scan, thinned out: the beam is on for as long as one of its views.
        whole = acquire(self.scene, self.scanner, region=enclosing(grids), duty=min(1.0, views / FULL_VIEWS["PCCT"]))
        assert whole.window is not None
        windows = [shadow(whole.geometry, g, margin=1) for g in grids]
        near = DetectorWindow.union(windows, whole.geometry.columns).widened(FILTER_MARGIN_COLUMNS, whole.window)
        scan = replace(whole, counts=whole.window.crop(whole.counts, near), window=near)
        scan.save(self._path)
        return scan

    def release(self) -> None:
        """Forget the readings (they are on disk)."""
        self._clean = None

    @property
    def problem(self) -> InsetProblem:
        """Gram operator and background; shared by all scenes with this grid, window and surround."""
        if self._problem is None:
            clean = self.clean
            assert clean.surround is not None
            for other in self.peers.values():
                if (
                    other._problem is not None
                    and other.grid == self.grid
                    and other._problem.outer == clean.window
                    and torch.equal(other._problem.background, clean.surround_line_integrals())
                ):
                    self._problem = other._problem
                    break
            else:
                self._problem = InsetProblem(clean, self.grid)
        return self._problem

    def statistic(self, scan: Scan) -> Tensor:
        """b = AᵀW y with the weights of the scan's exposure."""
        return self.problem.statistic(scan).b

    # -- facts ----------------------------------------------------------------------------------------------------

    def facts(self) -> SceneFacts:
        """Computed once, then read from the store."""
        if self._facts is None:
            s = self.settings
            full = self.name == "paper"
            key = f"views={s.views} voxel={s.voxel_mm:g} {s.kernels} {s.voxels_mm} {s.blurs_mm} 2"
            self._facts = SceneFacts.of(
                self.store.piece(f"scenes/{_file(self.name)}", key, lambda: self._compute(full))
            )
        return self._facts

    def _compute(self, full: bool) -> dict[str, Any]:
        clean, s = self.clean, self.settings
        tissues, amplitudes, information = self._least_squares()
        result: dict[str, Any] = {
            "statistic": self.statistic(clean).to(torch.float32).numpy(),
            "tissues": np.array(tissues), "amplitudes_hu": amplitudes, "information": information,
        }  # fmt: skip
        fine = inset_grid(self.plaque, REFERENCE_VOXEL_MM)
        reference = InsetFbp(clean, [fine], [REFERENCE_KERNEL])(clean)[0][0]
        result["reference_hu"] = np.array([float(r(reference)) for r in self.rois.on(fine)])
        main = self.name in MAIN_SCENES
        grids = [inset_grid(self.plaque, v) for v in (s.voxels_mm if main else FBP_BASE[1:])]
        kernels = s.kernels if main else FBP_BASE[:1]
        fbp = InsetFbp(clean, grids, kernels)
        self._images(result, fbp, clean)
        if full or not main:
            self._covariances(result, fbp, clean, full)
        return result

    def _images(self, result: dict[str, Any], fbp: InsetFbp, clean: Scan) -> None:
        """ROI means and crops of every FBP variant."""
        labels, means = [], []
        for grid, volumes in zip(fbp.grids, fbp(clean), strict=True):
            pair, crop = self.rois.on(grid), crop_window(grid, self.core_center)[0]
            for kernel, volume in zip(fbp.kernels, volumes, strict=True):
                base = (kernel, grid.spacing[0]) == FBP_BASE
                for blur in (0.0, *(self.settings.blurs_mm if base else ())):
                    image = _blurred(volume, grid, blur)
                    labels.append(fbp_label(kernel, grid.spacing[0], blur))
                    means.append([float(r(image)) for r in pair])
                    result[f"crop {labels[-1]}"] = image[crop].numpy()
        result["labels"], result["fbp_hu"] = np.array(labels), np.array(means)

    def _covariances(self, result: dict[str, Any], fbp: InsetFbp, clean: Scan, full: bool) -> None:
        functionals = [self._functionals(grid, full) for grid in fbp.grids]
        found = roi_covariance(clean, fbp, cast(Any, functionals), NOISE_FREE_EXPOSURE_S)
        for grid, matrices in zip(fbp.grids, found, strict=True):
            for kernel, matrix in zip(fbp.kernels, matrices, strict=True):
                result[f"covariance {fbp_label(kernel, grid.spacing[0])}"] = matrix
        if not full:
            return
        base = copy.copy(fbp)
        base.kernels = FBP_BASE[:1]
        base.grids = tuple(g for g in fbp.grids if g.spacing[0] == FBP_BASE[1])
        blurs = self.settings.blurs_mm
        grid = base.grids[0]
        rows = [_Functional(_blurred(r.weights, grid, b)) for b in blurs for r in self.rois.on(grid)]
        if not rows:
            return
        matrix = roi_covariance(clean, base, cast(Any, [rows]), NOISE_FREE_EXPOSURE_S)[0][0]
        for k, blur in enumerate(blurs):
            part = slice(2 * k, 2 * k + 2)
            result[f"covariance {fbp_label(*FBP_BASE, blur)}"] = matrix[part, part]

    def _functionals(self, grid: VolumeGrid, channels: bool) -> list[Any]:
        rows: list[Any] = list(self.rois.on(grid))
        if channels:
            place = crop_window(grid, self.core_center)[0]
            for observer in OBSERVERS:
                for channel in observer_channels(self, grid, observer):
                    weights = torch.zeros(grid.shape, dtype=torch.float64)
                    weights[place] = torch.from_numpy(channel)
                    rows.append(_Functional(weights))
        return rows

    def _least_squares(self) -> tuple[list[str], Floats, Floats]:
        """Tissues, their generalised least-squares values in HU, and the information at 1 s."""
        from torchpcct.acquisition.path_lengths import tissue_path_lengths

        clean = self.clean
        w, g = clean.window, clean.geometry
        assert w is not None
        stride = max(1, g.views // _GLS_VIEWS)
        views = list(range(0, g.views, stride))
        groups = _tissue_groups([b.name for b in self.scene.bodies])
        window = DetectorWindow(w.first_column[views], w.columns, w.first_row, w.rows)
        spot = self.scanner.source.focal_spot
        maps = tissue_path_lengths(
            self.scene, list(groups.values()), g.select(views), window, sub_rays=_SUB_RAYS, focal_spot=spot
        )
        weight = 1.0 / line_integral_variance(clean, NOISE_FREE_EXPOSURE_S)[views]
        lines = clean.line_integrals()[views]
        scale = clean.linearisation.mu_ref / 1000.0
        share = g.views / len(views)
        information = information_matrix(maps, weight, scale=scale) * share
        right = [float((m * weight * lines).sum((-1, -2), dtype=torch.float64).sum()) for m in maps]
        amplitudes: Floats = np.asarray(np.linalg.solve(information, scale * share * np.array(right)), np.float64)
        return list(groups), amplitudes - 1000.0, information


def _tissue_groups(names: Sequence[str]) -> dict[str, list[str]]:
    """Tissue → bodies: texture counts to its host, a stent's rings are one tissue, the blood in them is the lumen's."""
    groups: dict[str, list[str]] = {}
    for name in names:
        host = re.sub(r"_texture_\d+$", "", name)
        host = "lumen" if re.fullmatch(r"stent_\d+_blood", host) else re.sub(r"^stent_\d+$", "stent", host)
        groups.setdefault(host, []).append(name)
    return groups


def _blurred(volume: Tensor, grid: VolumeGrid, blur_mm: float) -> Tensor:
    """Gaussian filter of σ = ``blur_mm``, zero outside: its own transpose."""
    if not blur_mm:
        return volume
    sigma = [blur_mm / s for s in grid.spacing]
    return torch.from_numpy(gaussian_filter(volume.numpy(), sigma, mode="constant", truncate=5.0))


def _file(name: str) -> str:
    return name.replace(":", "_core_")
