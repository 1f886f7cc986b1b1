"""Methods on energy bins that are summed with weights: ``fbp:soft,energies=iodine``.

The option says for which contrast the weights are made (:func:`torchpcct.spectral.bin_weights`):

* ``energies`` or ``energies=task``: the task's own, signal against background;
* ``energies=iodine``: the contrast-filled lumen against fibrous tissue;
* ``energies=A/B``: any two materials.

The scanner is the task's own with its energy bins read one by one, and the rays cross what the
scene's bodies put in their way on the way through the middle of the inset. The counts of the bins
are those of the same realisation: the summed counts that every other method is given are split
among the bins (:func:`torchpcct.counting_noise.split`), which leaves independent Poisson counts.
What is read of weighted scans is in HU of their own, as it is at another tube voltage: their true
values, slopes, errors and limits are those of weighted noise-free scans, and dose factors of
contrasts compare variances in units of the true contrast.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from recon.evaluate.realisations import Realisations, Simulated
from recon.evaluate.task import GroundTruth, Task
from recon.jobs.sources import source_digest
from recon.jobs.store import Store
from recon.names import CONTRASTS
from torchpcct.counting_noise import split
from torchpcct.geometry import full_turn
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.scanner import SiliconDetector
from torchpcct.scanner.scanner import Scanner
from torchpcct.scene.chords import chord_lengths
from torchpcct.scene.materials import Material, material
from torchpcct.scene.scene import Scene
from torchpcct.spectral.weighting import BinWeights, bin_weights, weighted_sum

BINS = "bins"
"""Folder of a task's noise-free scans in energy bins."""
_DIRECTIONS = 72
"""Directions in the plane over which the way through a scene is averaged."""


def contrast_of(energies: str, task: Task) -> tuple[Material, ...]:
    """The two materials that an option ``energies=`` names at a task.

    Raises:
        ValueError: a material that does not exist.
    """
    if energies in ("", "task"):
        scene = task.scene
        return tuple(scene.materials[scene.index(n)] for n in (task.signal[0], task.background))
    first_name, _, second_name = energies.partition("/")
    names = CONTRASTS.get(energies, (first_name, second_name))
    return material(names[0]), material(names[1])


def with_bins(scanner: Scanner, name: str = "the scanner") -> Scanner:
    """The same scanner, its energy bins read one by one.

    Raises:
        ValueError: it has none.
    """
    if not isinstance(scanner.detector, SiliconDetector):
        raise ValueError(
            f"{name} has a {type(scanner.detector).__name__} without energy bins: energies= needs "
            "a photon-counting detector"
        )
    return scanner.replace(detector=replace(scanner.detector, mode="spectral"))


def mean_paths(
    scene: Scene, center: Sequence[float], without: Sequence[str] = ()
) -> dict[Material, float]:
    """Mean way through each material of rays in the plane through a point, mm.

    Args:
        scene: at rest.
        center: ``(z, y, x)`` mm.
        without: bodies that are left out, with what lies inside them.
    """
    angles = full_turn(2 * _DIRECTIONS)[:_DIRECTIONS]
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(_DIRECTIONS)], axis=1)
    lengths = chord_lengths(scene, np.asarray(center, float)[::-1], directions).mean(1)
    inside = {n for body in without for n in (body, *scene.inside(body))}
    paths: dict[Material, float] = {}
    for k, body in enumerate(scene.bodies):
        if body.name in inside:
            continue
        children = [
            j
            for j, parent in enumerate(scene.parents)
            if parent == k and scene.names[j] not in inside
        ]
        own = float(lengths[k] - lengths[children].sum())
        tissue = scene.materials[k]
        paths[tissue] = paths.get(tissue, 0.0) + max(own, 0.0)
    return paths


class EnergyRealisations(Realisations):
    """All realisations of one task, their energy bins summed with weights.

    Args:
        base: of the plain sums.
        energies: see the module.
        kernels: of FBP that methods with this option ask for.

    Raises:
        ValueError: a task whose tissues are given in HU, a scanner without energy bins, materials
            that do not exist or do not differ.
    """

    def __init__(self, base: Realisations, energies: str, kernels: Sequence[str]) -> None:
        task = base.task
        super().__init__(task, base.store, base.seed, kernels or base.kernels[:1])
        if not task.has_energies:
            raise ValueError(
                f"task {task.name} has no energies: its tissues are given in HU; energies= takes "
                "tasks whose scene is made of bodies alone"
            )
        self.base, self.scanner = base, with_bins(task.scanner, f"task {task.name}")
        contrast = contrast_of(energies, task)
        self.weights: BinWeights = bin_weights(
            self.scanner, contrast, mean_paths(task.scene, task.grid.center)
        )
        self.prefix = f"energies_{contrast[0].name}_{contrast[1].name}_".replace(" ", "_").replace(
            "/", "_"
        )

    @property
    def key(self) -> str:
        """See :attr:`Realisations.key`."""
        return f"{super().key} {source_digest(__name__)}"

    def _in_bins(self, signal: str) -> Scan:
        """Noise-free scan in energy bins with the signal ``"present"`` or ``"absent"``."""
        task = replace(self.task, scanner=self.scanner)
        return task.scan(Store(self.store.folder / BINS), signal)

    @cached_property
    def bins(self) -> Scan:
        """Noise-free scan in energy bins, with the signal."""
        return self._in_bins("present")

    @cached_property
    def clean(self) -> tuple[Scan, Scan]:
        """See :attr:`Realisations.clean`."""
        # Of the scan without the signal no bins are kept: they take as much memory as those with
        # it, and realisations need the latter alone.
        return self.bins.weighted(self.weights), self._in_bins("absent").weighted(self.weights)

    def _ground_truth(self) -> GroundTruth:
        return self.task.ground_truth_of(*self.clean)

    def pair(self, exposure_s: float, k: int) -> tuple[Simulated, Simulated]:
        """See :meth:`Realisations.pair`: the same photons, each in its bin."""
        summed = self.base.pair(exposure_s, k)[0].scan
        clean, bins = self.clean[0], self.bins
        counts = split(summed.counts, bins.counts, summed._first_index(), int(summed.seed or 0))
        readings = weighted_sum(bins, counts, np.asarray(self.weights))
        scale = exposure_s / NOISE_FREE_EXPOSURE_S
        noisy = replace(
            clean,
            counts=readings,
            air=clean.air * scale,
            exterior=None if clean.exterior is None else clean.exterior * scale,
            exposure_s=float(exposure_s),
            seed=summed.seed,
        )
        present = Simulated(self, noisy, exposure_s, k, True)
        return present, Simulated(self, None, exposure_s, k, False, present)
