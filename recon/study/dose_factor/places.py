"""Further scenes and vessels: every method on the noise of the place, or exactly where it is linear.

What is found at a place with a method at one exposure:

* of a linear method ``mean`` ``(2, rows)`` with and without the core, ``covariance`` ``(rows, rows)`` HU², and
  ``fat_variance`` HU²;
* of others ``readings`` ``(n, rows)``, ``absent`` ``(k, rows)`` of the first k draws without the core (fibrous tissue
  in its place), ``fat`` ``(n, voxels)``, and linear controls of the same draws: ``controls`` ``(n, controls, rows)``
  with ``control_mean`` ``(controls, rows)`` and ``control_covariance`` ``(controls, rows, controls, rows)``.

The control is the method's own first-order response (:mod:`recon.study.dose_factor.response`), or the study's linear
methods where autograd cannot see through the method. Draws are of the Gram operator's noise, which needs no projector;
the moments of everything linear are those of the place's own readings. So only what a method is beyond linear is told
from Gram noise. Rows: core and fibrous mean of every pair of ROIs.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.pwls.inset_problem import InsetProblem
from recon.study.dose_factor.exact_linear import exact_linear, statistic_covariance
from recon.study.dose_factor.methods import Method, fingerprint, load_methods
from recon.study.dose_factor.realisations import Realisations, joined
from recon.study.dose_factor.reconstructed import reconstructed
from recon.study.dose_factor.response import linear_response
from recon.study.dose_factor.settings import LINEAR_METHODS, TWIN_REALIZATIONS
from recon.study.paper.plaque_scan import Functional
from torchpcct.scan import Scan

__all__ = ["Place", "Places", "ScenePlace"]

Floats = NDArray[np.float64]

_FAT_VOXELS = 4
"""Of a linear method, whose exact variance is averaged."""


class Place(Protocol):
    """What is scanned and what is read."""

    @property
    def name(self) -> str:
        """As files are called."""
        ...

    @property
    def key(self) -> str:
        """What its pieces depend on beside settings and method."""
        ...

    @property
    def noise_of(self) -> str:
        """The scene whose Gram operator the draws are of."""
        ...

    @property
    def problem(self) -> InsetProblem: ...

    @property
    def clean(self) -> Scan:
        """The noise-free scan whose readings' noise it is."""
        ...

    @property
    def statistics(self) -> Tensor:
        """``(2, z, y, x)`` noise-free b at 1 s with the core and without; ``(1, z, y, x)``: there is no twin."""
        ...

    @property
    def weights(self) -> Tensor:
        """``(rows, z, y, x)`` core and fibrous tissue of every pair of ROIs."""
        ...

    @property
    def fat(self) -> NDArray[np.int64]:
        """Voxels of plain fat, places in the flattened volume; empty: its noise is not read."""
        ...


class ScenePlace:
    """A further scene: the paper's ROIs.

    Args:
        noise: of the study; gives the scene.
        name: of the scene.
    """

    key = ""
    fat = np.zeros(0, dtype=np.int64)

    def __init__(self, noise: Realisations, name: str) -> None:
        self.noise, self.name = noise, name
        self.noise_of = name

    @property
    def problem(self) -> InsetProblem:
        return self.noise.scene(self.name).problem

    @property
    def clean(self) -> Scan:
        return self.noise.scene(self.name).clean

    @cached_property
    def statistics(self) -> Tensor:
        names = [self.name] if self.name == "core_for_fibrous" else [self.name, f"{self.name}:absent"]
        return torch.stack([torch.from_numpy(self.noise.scene(n).facts.statistic) for n in names])

    @cached_property
    def weights(self) -> Tensor:
        scene = self.noise.scene(self.name)
        return torch.stack([r.weights for r in scene.rois.on(scene.grid)])


class Places:
    """Methods at places, in pieces on disk.

    Args:
        noise: realisations of the study; give settings and store.
    """

    def __init__(self, noise: Realisations) -> None:
        self.noise, self.settings = noise, noise.settings

    def found(self, method: Method, place: Place, dose: float) -> dict[str, Any]:
        """What is found of a method at a place at an exposure; see above."""
        linear = method.name in LINEAR_METHODS
        known = self._piece(method, place, dose, "known", self._exact if linear else self._control)
        adjoints = known.pop("adjoints", None)
        if linear:
            return known
        parts = [
            self._piece(
                method, place, dose, f"{block.start}-{block.stop}",
                lambda m, p, d, block=block: self._block(m, p, d, block, adjoints, known["control_offset"]),
            )
            for block in self.settings.blocks(self.settings.scene_realizations(method.name))
        ]  # fmt: skip
        return {**joined(parts), **known}

    def _at(self, method: Method, place: Place, dose: float, part: str) -> tuple[str, str]:
        """Name and key of a piece."""
        key = f"{self.noise.key} {place.key} {fingerprint(method)} {self.settings.controls} 4"
        return f"methods/{method.name}/{place.name}_{dose:g}s_{part}", key

    def _piece(self, method: Method, place: Place, dose: float, part: str, compute: Any) -> dict[str, Any]:
        name, key = self._at(method, place, dose, part)
        found = self.noise.store.piece(name, key, lambda: compute(method, place, dose))
        self.noise.store.drop(name)
        return found

    def _drawn_from(self, place: Place) -> Scan | None:
        return None if self.settings.fast_noise else place.clean

    def _exact(self, method: Method, place: Place, dose: float) -> dict[str, Any]:
        """Moments of a linear method."""
        b, count = place.statistics * dose, len(place.weights)
        rows = [*place.weights, *self._fat_rows(place)]
        exact = exact_linear(method, place.problem, [Functional(w) for w in rows], b[0], dose)
        covariance = exact.covariance(place.problem, self._drawn_from(place))
        return {
            "mean": exact.means(b)[:, :count], "covariance": covariance[:count, :count],
            "fat_variance": np.diag(covariance)[count:].mean() if len(rows) > count else np.array(np.nan),
        }  # fmt: skip

    @staticmethod
    def _fat_rows(place: Place) -> list[Tensor]:
        found = []
        for voxel in place.fat[np.linspace(0, len(place.fat) - 1, _FAT_VOXELS).astype(int)] if len(place.fat) else ():
            row = torch.zeros(place.problem.grid.shape, dtype=torch.float64)
            row.view(-1)[int(voxel)] = 1.0
            found.append(row)
        return found

    def _control(self, method: Method, place: Place, dose: float) -> dict[str, Any]:
        """The linear functionals that control a method, and their exact moments."""
        b, scan, weights = place.statistics[0] * dose, self._drawn_from(place), place.weights
        response = linear_response(method, place.problem, weights, b, dose, scan)
        if response is not None:
            g, offset = response.adjoints, np.zeros(len(weights))
            mean, covariance = response.mean, response.covariance
        else:
            rows = [Functional(w) for w in weights]
            of = [exact_linear(m, place.problem, rows, b, dose) for m in load_methods(self.settings.controls)]
            g, offset = torch.cat([c.adjoints for c in of]), np.concatenate([c.offset_hu for c in of])
            mean = np.concatenate([c.means(b) for c in of])
            covariance = statistic_covariance(place.problem, g, dose, scan)
        shape = (-1, len(weights))
        controls = len(mean) // len(weights)
        return {
            "adjoints": g.to(torch.float32).numpy(), "control_offset": offset, "control_mean": mean.reshape(shape),
            "control_covariance": covariance.reshape(controls, shape[1], controls, shape[1]),
        }  # fmt: skip

    def _block(
        self, method: Method, place: Place, dose: float, block: range, adjoints: Any, offset: Floats
    ) -> dict[str, Any]:
        noise = self.noise.gram_noise(place.noise_of, dose, block)
        weights, clean = place.weights, place.statistics * dose

        name, key = self._at(method, place, dose, f"{block.start}-{block.stop}")

        def read(b: Tensor, which: str) -> tuple[Floats, Tensor]:
            volumes, _ = reconstructed(method, place.problem, b, dose, self.noise.store, f"{name}/{which}", key)
            return torch.einsum("nzyx,rzyx->nr", volumes.double(), weights).numpy(), volumes

        b = clean[0] + noise
        readings, volumes = read(b, "there")
        twin = len(clean) > 1 and block.start < TWIN_REALIZATIONS
        seen = torch.einsum("nzyx,rzyx->nr", b.double(), torch.from_numpy(adjoints).double()).numpy() + offset
        return {
            "readings": readings, "absent": read(clean[1] + noise, "absent")[0] if twin else readings[:0],
            "fat": volumes.flatten(1)[:, torch.from_numpy(place.fat)].numpy().astype(np.float16),
            "controls": seen.reshape(len(seen), -1, len(weights)),
        }  # fmt: skip
