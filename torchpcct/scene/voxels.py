"""Scenes of voxels: a CT volume in HU as tissues, so that real patients can be scanned.

A CT number alone does not tell a tissue, but tissues of the body lie close to one line. As in the stoichiometric
calibration of Schneider, Pedroni and Lomax (Phys. Med. Biol. 41, 111, 1996), the CT numbers of reference tissues are
computed for the spectrum of the given volume. A voxel between two of them is their mixture by volume, as in Schneider,
Bortfeld and Schlegel (Phys. Med. Biol. 45, 459, 2000). Attenuation is linear in the shares: the mixture reads exactly
the given number in that spectrum, and in any other what tissues of the body read.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpcct.geometry import VolumeGrid
from torchpcct.scene.materials import MATERIALS, Material, material

__all__ = ["BODY_TISSUES", "VoxelScene"]

Floats = NDArray[np.float64]

BODY_TISSUES = ("air", "lung", "adipose", "skeletal_muscle", "spongiosa", "cortical_bone", "hydroxyapatite")
"""The line of the body's tissues by CT number (ICRU Report 44; Woodard and White 1986)."""


class VoxelScene:
    """A volume of CT numbers, seen as a mixture of tissues.

    Args:
        hu: ``grid.shape`` CT numbers; what lies outside the grid is air. Below the first tissue's number a voxel is the
            first tissue, above the last one's the last.
        grid: 3-D voxel grid in the scanner's frame (mm).
        energies_kev, weights: spectrum that the volume was scanned with, as for
            :meth:`torchpcct.scene.materials.Material.hu`; one number is a mean energy. 70 keV: 120 kVp behind a body.
        tissues: materials or their names, of increasing CT number in that spectrum.

    Attributes:
        numbers: ``(tissues,)`` CT numbers of the tissues in that spectrum.

    Raises:
        ValueError: a shape that is not the grid's, CT numbers that are not finite, fewer than two tissues, tissues that
            are not in order.
        TypeError: a grid or a tissue of the wrong kind.
    """

    def __init__(
        self,
        hu: Any,
        grid: VolumeGrid,
        *,
        energies_kev: Any = 70.0,
        weights: Any = 1.0,
        tissues: Sequence[Material | str] = BODY_TISSUES,
    ) -> None:
        if not isinstance(grid, VolumeGrid):
            raise TypeError(f"grid must be a VolumeGrid, got {type(grid).__name__}")
        values = np.asarray(hu, dtype=np.float32)
        if grid.ndim != 3 or values.shape != grid.shape:
            raise ValueError(f"hu needs the shape (z, y, x) of its grid, {grid.shape}, got {values.shape}")
        if not np.isfinite(values).all():
            raise ValueError(f"{int((~np.isfinite(values)).sum())} voxels are NaN or Inf: give them a CT number")
        self.hu, self.grid = values, grid
        self.tissues = tuple(material(t) for t in tissues)
        if len(self.tissues) < 2:
            raise ValueError(f"tissues must be two or more, got {len(self.tissues)}")
        self.numbers = np.array([t.hu(energies_kev, weights) for t in self.tissues])
        if (np.diff(self.numbers) <= 0).any():
            listed = ", ".join(f"{t.name} {n:.0f}" for t, n in zip(self.tissues, self.numbers, strict=True))
            raise ValueError(f"tissues must be in the order of their CT numbers, got {listed} HU")

    def __repr__(self) -> str:
        return f"VoxelScene({self.grid.shape} voxels: {', '.join(self.names)})"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the tissues."""
        return tuple(t.name for t in self.tissues)

    @property
    def clipped(self) -> float:
        """Share of the voxels that no mixture reaches: below the first tissue's number or above the last one's."""
        return float(((self.hu < self.numbers[0] - 1.0) | (self.hu > self.numbers[-1])).mean())

    def contrast(self, energies: Any) -> Floats:
        """Attenuation of the tissues minus that of air, which fills the rest: ``(tissues, E)`` mm⁻¹."""
        mu = np.stack([np.asarray(t.attenuation(energies), dtype=np.float64) for t in self.tissues])
        return mu - np.asarray(MATERIALS["air"].attenuation(energies), dtype=np.float64)

    def mixed(self, values: Any) -> NDArray[np.float32]:
        """One number per tissue as a map: ``(tissues, components)`` to ``(components, z, y, x)`` float32."""
        of_tissues = np.asarray(values, dtype=np.float64)
        # Interpolation between neighbours in CT number is mixing by volume; beyond both ends the end's value stays.
        maps = [np.interp(self.hu, self.numbers, column).astype(np.float32) for column in of_tissues.T]
        return np.stack(maps) if maps else np.zeros((0, *self.grid.shape), np.float32)
