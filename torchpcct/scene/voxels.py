"""Scenes of voxels: a CT volume in HU as tissues, so that real patients can be scanned.

A CT number alone does not tell a tissue, but tissues of the body lie close to one line. As in the
stoichiometric calibration of Schneider, Pedroni and Lomax (Phys. Med. Biol. 41, 111, 1996), the CT
numbers of reference tissues are computed for the spectrum of the given volume. A voxel between two
of them is their mixture by volume, as in Schneider, Bortfeld and Schlegel (Phys. Med. Biol. 45,
459, 2000). Attenuation is linear in the shares: the mixture reads exactly the given number in that
spectrum, and in any other what the tissues read.

Above muscle the line forks: 300 HU are bone or blood with contrast agent, and no CT number tells
which. ``dense`` says it, for all voxels or voxel by voxel.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchpcct.geometry import VolumeGrid
from torchpcct.scene.materials import MATERIALS, Material, material
from torchpcct.validate import checked, choice

__all__ = ["VoxelScene"]

Floats = NDArray[np.float64]

BODY_TISSUES = (
    "air",
    "lung",
    "adipose",
    "skeletal_muscle",
    "spongiosa",
    "cortical_bone",
    "hydroxyapatite",
)
"""The line of the body's tissues by CT number (ICRU Report 44; Woodard and White 1986)."""
_SOFT = BODY_TISSUES[:4]
"""Tissues of a voxel up to muscle, from thin to dense."""

DENSE = ("bone", "iodine", "water")
"""What a voxel above muscle can be, in the order of a label volume's 0, 1, 2."""
_BODY_HU = -500.0
"""A slice with nothing above this is air, and does not count for the body's size."""


def _above(name: str) -> tuple[Material | str, ...]:
    """The line of tissues above muscle."""
    if name == "water":
        return (MATERIALS["water"].with_density(5.0, "dense_water"),)
    return {"bone": BODY_TISSUES[4:], "iodine": ("iodine 200 mg/ml in blood",)}[name]


class VoxelScene:
    """A volume of CT numbers, seen as a mixture of tissues.

    Args:
        hu: ``grid.shape`` CT numbers; what lies outside the grid is air. Below the first tissue's
            number a voxel is the first tissue, above the last one's the last.
        grid: 3-D voxel grid in the scanner's frame (mm).
        energies_kev, weights: spectrum that the volume was scanned with, as for
            :meth:`torchpcct.scene.materials.Material.hu`; one number is a mean energy (70 keV: 120
            kVp behind a body). Iodine of 300 HU at 70 keV then reads about 400 HU at 100 kVp, as it
            does in a patient. None: that of the scanner which scans it, behind water as thick as
            the body; the given numbers come back (see Notes).
        dense: what stands above muscle: ``"bone"`` (spongiosa, cortical bone, hydroxyapatite),
            ``"iodine"`` (contrast agent in blood, more of it the brighter), ``"water"`` (no tissue:
            water of the density that reads the number, the same in every spectrum), or for each
            voxel a whole number of ``grid.shape``: 0 bone, 1 iodine, 2 water, the order of
            :data:`DENSE`.
        tissues: instead of ``dense`` and the body's tissues: materials or their names, of
            increasing CT number in that spectrum.

    Attributes:
        tissues: all materials.
        numbers: ``(tissues,)`` their CT numbers in that spectrum, at 70 keV if it is the scanner's.
        scanners_own: whether that spectrum is the scanner's (``energies_kev`` None).

    Raises:
        ValueError: a shape that is not the grid's, CT numbers that are not finite, fewer than two
            tissues, tissues that are not in order, labels that are none of 0, 1, 2.
        TypeError: a grid, a tissue or labels of the wrong kind.

    Notes:
        With the scanner's own spectrum FBP of a polychromatic scan gives the numbers back: -1000 to
        300 HU within 5 HU (100 kVp silicon; rods of 20 mm in 200 mm of 0 HU; iodine 5.3). Denser
        matter hardens the beam for itself and reads less, as in a patient. Read minus given, rod of
        20 mm (10 mm):

        ======  =============  =============  ===========
        HU      bone           iodine         water
        ======  =============  =============  ===========
        400     -8 (-5)        -11 (-6)       -2 (-4)
        600     -18 (-11)      -26 (-15)      -2 (-7)
        1000    -51 (-31)      -77 (-43)      -4 (-11)
        1500    -111 (-67)     -168 (-97)     -6 (-16)
        ======  =============  =============  ===========

        In 10 mm the blur of cells and kernel takes part (cells of 1 mm, soft kernel).
    """

    @checked
    def __init__(
        self,
        hu: ArrayLike,
        grid: VolumeGrid,
        *,
        energies_kev: ArrayLike | None = None,
        weights: ArrayLike = 1.0,
        dense: object = "bone",
        tissues: Sequence[Material | str] | None = None,
    ) -> None:
        values = np.asarray(hu, dtype=np.float32)
        if grid.ndim != 3 or values.shape != grid.shape:
            raise ValueError(
                f"hu needs the shape (z, y, x) of its grid, {grid.shape}, got {values.shape}"
            )
        if not np.isfinite(values).all():
            raise ValueError(
                f"{int((~np.isfinite(values)).sum())} voxels are NaN or Inf: give them a CT number"
            )
        self.hu, self.grid = values, grid
        self.scanners_own = energies_kev is None
        self.labels: NDArray[np.int64] | None = None
        self._dense: tuple[str, ...] = ()
        if tissues is not None:
            if not (isinstance(dense, str) and dense == "bone"):
                raise ValueError(
                    "give dense or tissues, not both: tissues are the whole line, dense its upper "
                    "end"
                )
            lines = [tuple(material(t) for t in tissues)]
            if len(lines[0]) < 2:
                raise ValueError(f"tissues must be two or more, got {len(lines[0])}")
        else:
            if isinstance(dense, str):
                self._dense = (choice("dense", dense, DENSE),)
            else:
                self.labels, self._dense = _labels(dense, grid), DENSE
            lines = [tuple(material(t) for t in (*_SOFT, *_above(name))) for name in self._dense]
        self.tissues = tuple(dict.fromkeys(t for line in lines for t in line))
        self._lines = [np.array([self.tissues.index(t) for t in line]) for line in lines]
        self._read(70.0 if energies_kev is None else energies_kev, weights)

    def _read(self, energies_kev: ArrayLike, weights: ArrayLike) -> None:
        self.numbers = np.array([t.hu(energies_kev, weights) for t in self.tissues])
        for line in self._lines:
            if (np.diff(self.numbers[line]) <= 0).any():
                listed = ", ".join(f"{self.tissues[k].name} {self.numbers[k]:.0f}" for k in line)
                raise ValueError(
                    f"tissues must be in the order of their CT numbers, got {listed} HU"
                )

    def read_by(self, energies_kev: ArrayLike, weights: ArrayLike) -> VoxelScene:
        """The same volume, its numbers read in a scanner's spectrum behind water as thick as the
        body.

        Args:
            energies_kev, weights: ``(E,)`` the scanner's signal in air.

        Returns:
            this scene, if it has a spectrum of its own.
        """
        if not self.scanners_own:
            return self
        water = MATERIALS["water"].attenuation(energies_kev)
        found = copy.copy(self)
        found._read(energies_kev, np.asarray(weights) * np.exp(-water * self.water_diameter))
        return found

    def __repr__(self) -> str:
        return f"VoxelScene({self.grid.shape} voxels: {', '.join(self.names)})"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the tissues."""
        return tuple(t.name for t in self.tissues)

    @property
    def water_diameter(self) -> float:
        """Water-equivalent diameter in mm (AAPM Report 220): the mean over the slices that hold
        a body; 0: none."""
        body = (self.hu > _BODY_HU).any((1, 2))
        area = (1.0 + self.hu[body].astype(np.float64) / 1000.0).clip(0.0).sum((1, 2))
        sizes = 2.0 * np.sqrt(area * self.grid.spacing[1] * self.grid.spacing[2] / math.pi)
        return float(sizes.mean()) if sizes.size else 0.0

    @property
    def clipped(self) -> float:
        """Share of the voxels that no mixture reaches: below the first tissue's number or above
        the last one's."""
        ends = self._of_voxels([self.numbers[line[-1]] for line in self._lines])
        return float(((self.hu < self.numbers[0] - 1.0) | (self.hu > ends)).mean())

    @property
    def above_muscle(self) -> dict[str, float]:
        """Share of the voxels that read more than muscle, by what they are scanned as (not for
        own ``tissues``)."""
        dense = self.hu > self.numbers[min(3, len(self.numbers) - 1)]
        which = np.zeros(1, np.int64) if self.labels is None else self.labels
        return {name: float((dense & (which == k)).mean()) for k, name in enumerate(self._dense)}

    def contrast(self, energies: ArrayLike) -> Floats:
        """Attenuation of the tissues minus that of air, which fills the rest: ``(tissues, E)``
        mm⁻¹."""
        mu = np.stack([np.asarray(t.attenuation(energies), dtype=np.float64) for t in self.tissues])
        return mu - np.asarray(MATERIALS["air"].attenuation(energies), dtype=np.float64)

    def mixed(self, values: ArrayLike) -> NDArray[np.float32]:
        """One number per tissue as a map: ``(tissues, components)`` to ``(components, z, y, x)``
        float32."""
        of_tissues = np.asarray(values, dtype=np.float64)
        # Interpolation between neighbours in CT number is mixing by volume; beyond both ends the
        # end's value stays.
        maps = [
            self._of_voxels(
                [np.interp(self.hu, self.numbers[line], column[line]) for line in self._lines]
            )
            for column in of_tissues.T
        ]
        return (
            np.stack(maps).astype(np.float32)
            if maps
            else np.zeros((0, *self.grid.shape), np.float32)
        )

    def _of_voxels(self, per_line: list[Floats]) -> Floats:
        """For every voxel the value of its own line of tissues."""
        return per_line[0] if self.labels is None else np.choose(self.labels, per_line)


def _labels(value: object, grid: VolumeGrid) -> NDArray[np.int64]:
    labels = np.asarray(value)
    if labels.dtype.kind not in "biuf":
        raise TypeError(
            f"dense must be one of {', '.join(DENSE)}, or a whole number for each voxel, got "
            f"{value!r}"
        )
    if labels.shape != grid.shape:
        raise ValueError(
            f"dense needs the shape (z, y, x) of the grid, {grid.shape}, got {labels.shape}"
        )
    if not np.isin(labels, range(len(DENSE))).all():
        meaning = ", ".join(f"{k} {name}" for k, name in enumerate(DENSE))
        raise ValueError(f"dense must hold {meaning}, got {np.unique(labels)[:5].tolist()}")
    return labels.astype(np.int64)
