"""Noise realisations of a task: one noisy scan with the signal and one without, and what methods
take of them.

Realisation k draws the readings with the seed ``seed + k``, the same at every exposure and for
every method. The scan without the signal carries the same relative noise: its line integrals before
linearisation differ from the scan's by what the signal changes without noise. (The counts behind a
signal that is worth looking for differ by a few per cent at most.) So what is linear is computed
once, and the signal's noise-free part added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, cached_property, partial
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.analytic.exact_noise import Functional, roi_covariance
from recon.analytic.inset import InsetFbp
from recon.data_term import Quadratic
from recon.evaluate.methods import Method, noise_of
from recon.evaluate.response import response, right_hand_side_covariance
from recon.evaluate.task import GroundTruth, Task
from recon.jobs.store import Store
from recon.least_squares.inset_problem import InsetProblem
from recon.least_squares.reconstruct import TOLERANCE_HU
from recon.mbir.mbir import Mbir
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan

_SIGMA_SEEDS = (900_001, 900_002)
"""Realisations that a denoiser's noise level is measured on; none of them is evaluated."""


class _VolumeReader(Protocol):
    """What is read of volumes, as :class:`recon.evaluate.measure.Reader` does."""

    @property
    def weights(self) -> Tensor:
        """``(2 · rois, z, y, x)``, of ROI means."""
        ...


class Realisations:
    """All realisations of one task.

    Args:
        task: what is looked at.
        store: keeps noise-free scans and what does not depend on a method.
        seed: of the first realisation.
        kernels: of FBP that methods ask for.

    Attributes:
        prefix: of the names of cached results.
    """

    prefix = ""

    def __init__(
        self, task: Task, store: Store, seed: int = 0, kernels: Sequence[str] = ()
    ) -> None:
        self.task, self.store, self.seed = task, store, seed
        self.kernels = tuple(dict.fromkeys(kernels))

    @property
    def key(self) -> str:
        """Of what does not depend on a method."""
        return f"2 {self.task.fingerprint}"

    @cached_property
    def clean(self) -> tuple[Scan, Scan]:
        """Noise free, with and without the signal."""
        return self.task.scans(self.store)

    @cached_property
    def ground_truth(self) -> GroundTruth:
        """Of the task."""
        found: GroundTruth = self.store.cached(f"{self.prefix}facts", self.key, self._ground_truth)
        return found

    def _ground_truth(self) -> GroundTruth:
        return self.task.ground_truth(self.store)

    @cached_property
    def problem(self) -> InsetProblem:
        """Of PWLS and MBIR."""
        return InsetProblem(self.clean[1], self.task.grid)

    @cached_property
    def filtered(self) -> InsetFbp:
        """FBP with all kernels."""
        return InsetFbp(self.clean[0], [self.task.grid], self.kernels)

    @cached_property
    def clean_fbp(self) -> tuple[Tensor, Tensor]:
        """FBP without noise, with and without the signal, ``(kernels, z, y, x)`` HU; the same at
        every exposure."""
        return self.filtered(self.clean[0])[0], self.filtered(self.clean[1])[0]

    @cached_property
    def clean_terms(self) -> tuple[Quadratic, Quadratic]:
        """The same of the data term at 1 s."""
        return self.problem.term(self.clean[0]), self.problem.term(self.clean[1])

    def exact_covariances(self, kernels: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """Of the ROI means of FBP at 1 s, kernel → ``(rois, 2, rois, 2)`` HU²; it falls as 1 /
        exposure."""
        regions, key = self.task.regions, self.key
        functionals = [Functional(w) for pair in regions.values() for w in pair]

        @cache
        def together() -> dict[str, NDArray[np.float64]]:
            # What costs most, the transposed backprojection, is the same for all kernels.
            fbp = InsetFbp(self.clean[0], [self.task.grid], kernels)
            found = roi_covariance(self.clean[0], fbp, [functionals], NOISE_FREE_EXPOSURE_S)[0]
            return {
                k: c.reshape(len(regions), 2, len(regions), 2)
                for k, c in zip(kernels, found, strict=True)
            }

        def of(kernel: str) -> NDArray[np.float64]:
            return together()[kernel]

        return {
            k: self.store.cached(f"{self.prefix}exact_{k}", key, partial(of, k)) for k in kernels
        }

    def response(
        self, network: Mbir, reader: _VolumeReader, exposure_s: float
    ) -> dict[str, NDArray[np.float64]]:
        """``adjoints`` ``(2 · rois, z, y, x)`` of MBIR's ROI means, ``mean`` and ``covariance``
        of what they give."""
        both = [self.noise_free(p, exposure_s).term for p in (True, False)]
        g = response(network, self.problem, reader.weights, both[0], exposure_s)
        covariance = right_hand_side_covariance(self.problem, g, exposure_s, self.clean[0])
        rois = len(g) // 2
        mean = np.stack(
            [torch.einsum("zyx,rzyx->r", t.b[0].double(), g).numpy().reshape(rois, 2) for t in both]
        )
        return {
            "adjoints": g.numpy(),
            "mean": mean,
            "covariance": covariance.reshape(rois, 2, rois, 2),
        }

    def noise_free(self, present: bool, exposure_s: float) -> Simulated:
        """Without noise; ``exposure_s`` is what a method gets to know."""
        return Simulated(self, self.clean[0 if present else 1], exposure_s, -1, present)

    def pair(self, exposure_s: float, k: int) -> tuple[Simulated, Simulated]:
        """Realisation ``k`` with and without the signal."""
        noisy = self.clean[0].with_noise(exposure_s, self.seed + k if k < _SIGMA_SEEDS[0] else k)
        present = Simulated(self, noisy, exposure_s, k, True)
        return present, Simulated(self, None, exposure_s, k, False, present)

    def sigma(self, method: Method, exposure_s: float, smooths: float) -> float:
        """Noise in HU of FBP in the largest tissue; kept, since every job of a filter needs it."""

        def compute() -> float:
            largest = max(self.task.flat, key=lambda t: len(self.task.flat[t]), default=None)
            if largest is None:
                raise ValueError(
                    f"task {self.task.name}: no tissue fills a flat part of the inset: enlarge it"
                )
            clean = method.run(self.noise_free(True, exposure_s))
            found = [
                noise_of(
                    method.run(self.pair(exposure_s, k)[0]) - clean,
                    self.task.flat[largest],
                    smooths,
                )
                for k in _SIGMA_SEEDS
            ]
            return float(np.sqrt(np.mean(np.square(found))))

        name = f"{self.prefix}sigma_{method.kernels[0]}_{exposure_s:g}s_{smooths:g}"
        return float(self.store.cached(name, f"{self.key} {exposure_s} {smooths}", compute))


class Simulated:
    """One realisation, as a method sees it.

    Attributes:
        exposure_s: of the scan; grid: of the volume; label: for files.
        vessel_used, warned: whether MBIR has used a vessel model, and has warned of something;
            None: it was not asked.
    """

    def __init__(
        self,
        realisations: Realisations,
        scan: Scan | None,
        exposure_s: float,
        k: int,
        present: bool,
        with_signal: Simulated | None = None,
    ) -> None:
        self._realisations, self._scan, self._with_signal = realisations, scan, with_signal
        self.exposure_s, self.k, self.present = exposure_s, k, present
        self.vessel_used: bool | None = None
        self.warned: bool | None = None

    @property
    def grid(self) -> VolumeGrid:
        return self._realisations.task.grid

    @property
    def label(self) -> str:
        number = "clean" if self.k < 0 else f"{self.k:03d}"
        state = "present" if self.present else "absent"
        return f"{self._realisations.task.name}/{self.exposure_s:g}s_{number}_{state}"

    @property
    def problem(self) -> InsetProblem:
        """The inset's, shared by all realisations."""
        return self._realisations.problem

    @cached_property
    def scan(self) -> Scan:
        """The scan itself."""
        if self._scan is not None:
            return self._scan
        assert self._with_signal is not None
        present, absent = self._realisations.clean
        return replace(
            self._with_signal.scan,
            counts=self._with_signal.scan.counts * (absent.counts / present.counts),
        )

    @cached_property
    def _fbp(self) -> Tensor:
        if self.k < 0:
            return self._realisations.clean_fbp[0 if self.present else 1]
        if self._with_signal is not None:
            present, absent = self._realisations.clean_fbp
            return self._with_signal._fbp - (present - absent)
        return self._realisations.filtered(self.scan)[0]

    def fbp(self, kernel: str) -> Tensor:
        """HU ``(z, y, x)``."""
        if kernel not in self._realisations.kernels:
            raise ValueError(
                f"FBP with the kernel {kernel!r} was not declared: Method(..., "
                f"kernels=({kernel!r},))"
            )
        return self._fbp[self._realisations.kernels.index(kernel)]

    @cached_property
    def term(self) -> Quadratic:
        """What the readings say, for PWLS and MBIR: a batch of one."""
        if self.k < 0:
            return self._realisations.clean_terms[0 if self.present else 1].times(self.exposure_s)
        if self._with_signal is not None:
            present, absent = self._realisations.clean_terms
            other = self._with_signal.term
            b = other.b - self.exposure_s * (present.b - absent.b)
            return replace(other, b=b, energy=None)
        return self.problem.term(self.scan)

    def pwls(self) -> Tensor:
        """HU ``(z, y, x)``, as :func:`recon.reconstruct` gives it: exact projection pairs, its
        prior and tolerance."""
        problem = self.problem
        with torch.no_grad():
            return problem.solve(self.term, problem.prior, tolerance=TOLERANCE_HU)[0][0]

    def mbir(self, network: Mbir) -> Tensor:
        """HU ``(z, y, x)``, as :func:`recon.reconstruct` gives it."""
        with torch.no_grad():
            (found,) = network.solve(self.term)
        self.vessel_used, self.warned = (
            found.report.get("vessel", {}).get("used"),
            bool(found.warnings or found.report["missing_body"]),
        )
        return found.volume

    def sigma(self, method: Method, smooths: float = 0.0) -> float:
        """Noise in HU of a linear method at this exposure in the largest tissue."""
        return self._realisations.sigma(method, self.exposure_s, smooths)
