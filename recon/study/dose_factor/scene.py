"""One scene of the study: its scan, its reconstruction problem, and what holds of it without sampling error."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.evaluate.store import Store
from recon.fbp.exact_noise import FILTER_MARGIN_COLUMNS
from recon.pwls.inset_problem import InsetProblem
from recon.study.dose_factor.exact_fbp import exact_fbp
from recon.study.dose_factor.settings import FBP_BASE, Settings
from recon.study.dose_factor.tissue_values import least_squares
from recon.study.dose_factor.variant import Variant
from recon.study.paper.facts import FULL_VIEWS
from recon.study.paper.plaque_scan import REFERENCE_VOXEL_MM, duty, enclosing
from recon.study.paper.rods import rod_values
from torchpcct.acquisition.acquire import acquire
from torchpcct.detector_window import DetectorWindow, shadow
from torchpcct.scan import Scan

__all__ = ["SceneFacts", "StudyScene"]

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]

_ROD_VIEWS = 246


@dataclass(frozen=True)
class SceneFacts:
    """What holds of a scene without sampling error, at 1 s.

    Attributes:
        statistic: ``(z, y, x)`` AᵀW y of the noise-free scan.
        tissues: names; information: ``(tissues, tissues)`` HU⁻², of generalised least squares on exact path lengths.
        tissue_hu: true values, by rods of each tissue at the plaque's place (:mod:`recon.study.paper.rods`): of all
            tissues of the paper's scene, of core and fibrous tissue in the others.
        reference_hu: ROI means of noise-free standard FBP on 0.1 mm, ``(2,)``.
        fbp_hu, fbp_covariance: ROI means ``(2,)`` of the noise-free reference FBP, and their covariance ``(2, 2)`` HU²;
            None in the main scenes.
    """

    statistic: NDArray[np.float32]
    tissues: list[str]
    tissue_hu: dict[str, float]
    information: Floats
    reference_hu: Floats
    fbp_hu: Floats | None
    fbp_covariance: Floats | None

    def tissue(self, name: str) -> int:
        """Index of a tissue."""
        return self.tissues.index(name)

    @property
    def truth_hu(self) -> Floats:
        """``(foreground, background)``."""
        return np.array([self.tissue_hu["core"], self.tissue_hu["fibrous"]])

    @property
    def contrast_hu(self) -> float:
        """True contrast, fibrous tissue minus core, HU."""
        core, fibrous = self.truth_hu
        return float(fibrous - core)

    @classmethod
    def of(cls, arrays: dict[str, Any], tissue_hu: Mapping[str, float]) -> SceneFacts:
        """From the arrays of a piece and the true values."""
        return cls(
            statistic=arrays["statistic"],
            tissues=[str(t) for t in arrays["tissues"]],
            tissue_hu=dict(tissue_hu),
            information=arrays["information"],
            reference_hu=arrays["reference_hu"],
            fbp_hu=arrays.get("fbp_hu"),
            fbp_covariance=arrays.get("fbp_covariance"),
        )


class StudyScene(Variant):
    """A scene with its scan.

    Args:
        name, settings: of the variant.
        store: keeps scans and facts.
        peers: the study's scenes by name: one reconstruction problem serves all that agree.
    """

    def __init__(self, name: str, settings: Settings, store: Store, peers: dict[str, StudyScene] | None = None) -> None:
        super().__init__(name, settings)
        self.store = store
        self.peers = {} if peers is None else peers
        self._clean: Scan | None = None
        self._problem: InsetProblem | None = None
        self._known_hu: dict[str, float] = {}

    @property
    def _file(self) -> str:
        return self.name.replace(":", "_core_")

    @property
    def clean(self) -> Scan:
        """The noise-free scan, cut to the inset's shadow and the columns whose noise the filter sees."""
        if self._clean is None:
            path = self.store.path(f"scans/{self._file}_{self.settings.views}.h5")
            self._clean = self._load(path) or self._acquire(path)
        return self._clean

    def _load(self, path: Path) -> Scan | None:
        if not path.exists():
            return None
        try:
            return Scan.load(path)
        except ValueError as error:
            log.warning("%s: simulated again", error)
            return None

    def _acquire(self, path: Path) -> Scan:
        grids = [self.grid_of(v) for v in {FBP_BASE[1], self.settings.voxel_mm, REFERENCE_VOXEL_MM}]
        on = duty(self.scanner, FULL_VIEWS["PCCT"])
        # Thin metal takes minutes to simulate: blocks of views are kept until the scan is on disk.
        place, key = f"scans/{self._file}_{self.settings.views}", f"views={self.settings.views} duty={on:g}"

        def keep(block: str, compute: Callable[[], Tensor]) -> Tensor:
            found = self.store.piece(f"{place}/{block}", key, lambda: {"readings": compute().numpy()})
            return torch.from_numpy(found["readings"])

        whole = acquire(self.scene, self.scanner, region=enclosing(grids), duty=on, keep=keep)
        assert whole.window is not None
        windows = [shadow(whole.geometry, g, margin=1) for g in grids]
        near = DetectorWindow.union(windows, whole.geometry.columns).widened(FILTER_MARGIN_COLUMNS, whole.window)
        scan = replace(whole, counts=whole.window.crop(whole.counts, near), window=near)
        scan.save(path)
        self.store.drop(place)
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

    @cached_property
    def facts(self) -> SceneFacts:
        """Computed once, then read from the store."""
        s = self.settings

        def compute() -> dict[str, Any]:
            tissues, amplitudes, information = least_squares(self, self.clean)
            return {
                "statistic": self.statistic(self.clean).to(torch.float32).numpy(),
                "tissues": np.array(tissues), "amplitudes_hu": amplitudes, "information": information,
                **exact_fbp(self, self.clean),
            }  # fmt: skip

        key = f"views={s.views} voxel={s.voxel_mm:g} 3"
        return SceneFacts.of(self.store.piece(f"scenes/{self._file}", key, compute), self._rods())

    def _rods(self) -> dict[str, float]:
        """True value of every tissue, HU; a material that a scene of the same patient and scanner has is known."""
        wanted = [b.name for b in self.scene.bodies] if self.name == "paper" else ["core", "fibrous"]
        materials = {b.name: b.material for b in self.scene.bodies if b.name in wanted}
        alike = [
            p for p in self.peers.values() if p.scene.bodies[0] == self.scene.bodies[0] and p.scanner == self.scanner
        ]
        known = {str(m): hu for p in alike for m, hu in p._known_hu.items()}

        def compute() -> dict[str, Any]:
            new = {k: m for k, m in materials.items() if str(m) not in known}
            # Few views would leave streaks in the rods: what is true does not hinge on the study's.
            scanner = self.scanner.with_views(max(self.settings.views, _ROD_VIEWS))
            hu = rod_values(self.scene, scanner, tuple(self.plaque.position), tissues=new).hu if new else {}
            hu |= {k: known[str(m)] for k, m in materials.items() if k not in new}
            return {"tissues": np.array(list(hu)), "hu": np.array(list(hu.values()))}

        found = self.store.piece(f"scenes/{self._file}_rods", "246 views", compute)
        values = dict(zip(map(str, found["tissues"]), found["hu"].tolist(), strict=True))
        self._known_hu = {str(m): values[k] for k, m in materials.items()}
        return values
