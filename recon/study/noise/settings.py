"""What the noise study simulates, draws and reconstructs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from recon.study.paper import facts as paper
from recon.study.study import StudySettings

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings(StudySettings):
    """Settings of the noise study.

    Args:
        realizations: paired noise realisations per dose, at least 10 (the paper's number).
        seed: first seed; realisation i uses ``seed + i`` at every dose.
        views: views per rotation. Fewer than the paper's keep the tube load of the whole scan.
        kernels, voxels_mm: of FBP.
        doses: name → exposure in s.
        reconstructed: realisations at the tables' dose that are reconstructed in full, at least 1.
        experiments: number of simulated experiments of 10 realisations.
        eid: whether to set an energy-integrating scan of equal dose beside.
        placements: whether settings with a figure outside its tolerance are computed with ROIs and grid moved.

    Raises:
        TypeError: a value of a wrong type.
        ValueError: a value out of range.
    """

    realizations: int = 200
    seed: int = 0
    views: int = paper.FULL_VIEWS["PCCT"]
    kernels: tuple[str, ...] = paper.KERNELS
    voxels_mm: tuple[float, ...] = paper.VOXELS_MM
    doses: dict[str, float] = field(default_factory=lambda: dict(paper.DOSES))
    reconstructed: int = 3
    experiments: int = 20_000
    eid: bool = True
    placements: bool = True

    # An eighth of the views, two kernels, three voxel sizes, two doses.
    QUICK: ClassVar[dict[str, Any]] = {
        "realizations": 40,
        "views": 246,
        "kernels": ("soft", "standard"),
        "voxels_mm": (0.20, 0.25, 0.40),
        "doses": {"1x": 0.35, "5.7x": 2.00},
        "reconstructed": 2,
        "experiments": 4000,
        "placements": False,
    }

    def __post_init__(self) -> None:
        self.check_whole(realizations=10, seed=0, views=8, reconstructed=1, experiments=100)
        if len(self.kernels) * len(self.voxels_mm) < 2:
            raise ValueError("a ranking needs at least two settings: give more kernels or voxels_mm")
        if len(self.doses) < 2:
            raise ValueError(f"doses must hold at least two exposures, got {self.doses}")

    @property
    def axes(self) -> list[tuple[str, float]]:
        """Every (kernel, voxel size), the voxel size varying slowest."""
        return [(k, v) for v in self.voxels_mm for k in self.kernels]

    @property
    def table_exposure_s(self) -> float:
        """Exposure that the tables are shown for: the paper's, or the last."""
        return paper.table_exposure(self.doses)
