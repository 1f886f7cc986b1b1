"""The noise realisations of the dose-factor study: b = AᵀW y of drawn readings, and FBP of the same readings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.evaluate.store import Store
from recon.fbp.inset import InsetFbp
from recon.study.dose_factor.measures import crop_window
from recon.study.dose_factor.scene import StudyScene
from recon.study.dose_factor.settings import FBP_BASE, Settings
from torchpcct.scan import Scan

__all__ = ["NOISY_SCENE", "Realisations", "joined"]

NOISY_SCENE = "paper"
"""Its readings are drawn. The other main scenes carry its noise, the same in every one: b = b_paper + clean difference
(the counts behind the core differ by less than 1 %)."""

FILTERED_KERNEL = "bone"
"""FBP that an image-domain prior starts from: the sharpest kernel, which has taken the least away."""


class Realisations:
    """Noise realisations of the study's scenes, in pieces on disk.

    Args:
        settings: of the study.
        store: keeps the pieces.
        scene: gives a scene by its name.
    """

    def __init__(self, settings: Settings, store: Store, scene: Callable[[str], StudyScene]) -> None:
        self.settings, self.store, self.scene = settings, store, scene
        self._fbp: dict[tuple[str, float], InsetFbp] = {}

    @property
    def key(self) -> str:
        """What all pieces depend on."""
        s = self.settings
        return f"views={s.views} voxel={s.voxel_mm:g} seed={s.seed} fast={s.fast_noise}"

    def _filtered(self, scene: StudyScene, kernel: str, voxel_mm: float) -> InsetFbp:
        """FBP; the main scenes share geometry, window and surround."""
        if (kernel, voxel_mm) not in self._fbp:
            self._fbp[kernel, voxel_mm] = InsetFbp(scene.clean, [scene.grid_of(voxel_mm)], [kernel])
        return self._fbp[kernel, voxel_mm]

    def _noisy(self, scene: StudyScene, dose: float, k: int) -> Scan:
        return scene.clean.with_noise(dose, self.settings.seed + k)

    def picture(self, name: str, dose: float) -> Any:
        """Reference FBP of the first realisation, for the figure."""
        scene = self.scene(name)

        def compute() -> dict[str, Any]:
            volume = self._filtered(scene, *FBP_BASE)(self._noisy(scene, dose, 0))[0][0]
            return {"first": volume.numpy().astype(np.float16)}

        return self.store.piece(f"data/picture_{name}_{dose:g}s", self.key, compute)["first"]

    def data(self, name: str, dose: float, block: range) -> dict[str, Any]:
        """b, and ROI means and crop of the reference FBP, of the realisations of one block, from noisy readings."""
        scene = self.scene(name)

        def compute() -> dict[str, Any]:
            grid = scene.grid_of(FBP_BASE[1])
            fbp = self._filtered(scene, *FBP_BASE)
            rois = scene.rois.on(grid)
            crop = crop_window(grid, scene.core_center)[0]
            b, means, crops, first = [], [], [], []
            for k in block:
                scan = self._noisy(scene, dose, k)
                b.append(scene.statistic(scan))
                volume = fbp(scan)[0][0]
                means.append([float(r(volume)) for r in rois])
                crops.append(volume[crop].numpy().astype(np.float16))
                if k == 0:
                    first.append(volume.numpy().astype(np.float16))
            return {
                "b": torch.stack(b).numpy(), "roi": np.array(means), "crop": np.stack(crops),
                **({"first": first[0]} if first else {}),
            }  # fmt: skip

        return self.store.piece(f"data/{name}_{dose:g}s_{block.start}-{block.stop}", self.key, compute)

    def images(self, dose: float, block: range) -> Tensor:
        """G x of the sharpest FBP x of the paper's scene, ``(block, z, y, x)``.

        A method that is given this for AᵀW y takes the FBP image for the data, weighed as the scan's noise is.
        """
        scene = self.scene(NOISY_SCENE)

        def compute() -> dict[str, Any]:
            sharp = self._sharp(scene)
            b = [self._as_statistic(scene, sharp(self._noisy(scene, dose, k))[0][0], dose) for k in block]
            return {"b": torch.stack(b).numpy()}

        place = f"images/{NOISY_SCENE}_{dose:g}s_{block.start}-{block.stop}"
        return torch.from_numpy(self.store.piece(place, f"{self.key} 2", compute)["b"])

    def _sharp(self, scene: StudyScene) -> InsetFbp:
        return self._filtered(scene, FILTERED_KERNEL, self.settings.voxel_mm)

    @staticmethod
    def _as_statistic(scene: StudyScene, volume: Tensor, dose: float) -> Tensor:
        """G x of a volume in HU, x above the background."""
        p = scene.problem
        attenuation = (volume / 1000.0 + 1.0) * p.mu_ref - p.level
        out: Tensor = p.gram.scaled(dose).apply(attenuation.to(torch.float32))
        return out

    def statistic(self, name: str, dose: float, block: range) -> Tensor:
        """b of a main scene, ``(block, z, y, x)``."""
        clean = torch.from_numpy(self.scene(name).facts.statistic) * dose
        if self.settings.fast_noise:
            return clean + self.gram_noise(name, dose, block)
        noisy = torch.from_numpy(self.data(NOISY_SCENE, dose, block)["b"])
        return noisy + (clean - torch.from_numpy(self.scene(NOISY_SCENE).facts.statistic) * dose)

    def image_statistic(self, name: str, dose: float, block: range) -> Tensor:
        """:meth:`images` of a main scene, ``(block, z, y, x)``."""
        noisy = self.images(dose, block)
        if name == NOISY_SCENE:
            return noisy
        here, there = self.scene(name), self.scene(NOISY_SCENE)
        clean = [self._sharp(s)(s.clean)[0][0] for s in (here, there)]
        return noisy + self._as_statistic(here, clean[0], dose) - self._as_statistic(there, clean[1], dose)

    def gram_noise(self, name: str, dose: float, block: range) -> Tensor:
        """Noise of b from its covariance, ``(block, z, y, x)``."""
        gram = self.scene(name).problem.gram.scaled(dose)
        draws = [gram.noise(generator=torch.Generator().manual_seed(self.settings.seed + k)) for k in block]
        return torch.stack(draws).to(torch.float32)


def joined(pieces: list[dict[str, Any]]) -> dict[str, Any]:
    """Pieces one behind the other; what only the first holds is kept."""
    result: dict[str, Any] = {}
    for name in pieces[0]:
        if name == "first":
            result[name] = pieces[0][name]
        elif name != "seconds":
            result[name] = np.concatenate([p[name] for p in pieces])
    return result
