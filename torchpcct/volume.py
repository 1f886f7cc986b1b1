"""A reconstructed volume in HU, with its grid and its report; files are written whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpcct.files import read_hdf5, written_whole
from torchpcct.geometry import VolumeGrid

__all__ = ["Volume", "check_volume_name", "to_hu"]

_NIFTI, _HDF5 = (".nii", ".nii.gz"), (".h5", ".hdf5")


def to_hu(attenuation: Tensor, mu_water: float) -> Tensor:
    """CT numbers from attenuation in mm⁻¹: 1000 (μ / μ_water − 1), so that water reads 0 and air −1000."""
    return 1000.0 * (attenuation / mu_water - 1.0)


def check_volume_name(path: str | os.PathLike[str]) -> None:
    """Raise ``ValueError`` unless the ending of ``path`` names a volume format."""
    if not str(path).endswith((*_NIFTI, *_HDF5)):
        raise ValueError(f"unknown volume format {Path(path).name!r}: use .nii, .nii.gz or .h5")


@dataclass(frozen=True)
class Volume:
    """A volume in HU.

    Args:
        data: ``(..., z, y, x)`` HU, float32 or float64.
        grid: its voxel grid.
        report: how it was made: method, kernel, iterations, residual, seconds, …
    """

    data: Tensor
    grid: VolumeGrid
    report: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.data, Tensor) or not self.data.is_floating_point():
            raise TypeError(f"data must be a floating point tensor in HU, got {type(self.data).__name__}")
        if tuple(self.data.shape[-self.grid.ndim :]) != self.grid.shape:
            raise ValueError(f"data has shape {tuple(self.data.shape)}, its grid {self.grid.shape}")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``.nii`` / ``.nii.gz`` (NIfTI-1, mm, RAS) or ``.h5`` (HDF5 with grid and report).

        Raises:
            ValueError: another ending, or a batch of volumes (save them one by one).
        """
        check_volume_name(path)
        if self.data.ndim != self.grid.ndim:
            raise ValueError(f"save one volume at a time, this one has shape {tuple(self.data.shape)}")
        if str(path).endswith(_NIFTI):
            self._save_nifti(path)
        else:
            self._save_hdf5(path)

    def _save_nifti(self, path: str | os.PathLike[str]) -> None:
        import nibabel

        if self.grid.ndim != 3:
            raise ValueError("NIfTI needs a 3-D volume; save a 2-D image as .h5")
        affine = np.diag([*self.grid.spacing[::-1], 1.0])
        affine[:3, 3] = [axis[0] for axis in self.grid.axes[::-1]]
        # NIfTI stores (x, y, z).
        image = nibabel.Nifti1Image(self.data.detach().cpu().to(torch.float32).numpy().transpose(2, 1, 0), affine)
        image.header.set_xyzt_units("mm")
        image.header["descrip"] = b"torchpcct, HU"
        with written_whole(path) as part:
            nibabel.save(image, part)

    def _save_hdf5(self, path: str | os.PathLike[str]) -> None:
        import h5py

        with written_whole(path) as part, h5py.File(part, "w") as file:
            file.attrs["format"] = "torchpcct-volume"
            file.attrs["unit"] = "HU"
            file.attrs["spacing_mm"] = self.grid.spacing
            file.attrs["center_mm"] = self.grid.center
            file.attrs["report"] = json.dumps(dict(self.report), default=str)
            file.create_dataset("data", data=self.data.detach().cpu().numpy())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Volume:
        """Read a volume written by :meth:`save` as HDF5.

        Raises:
            ValueError: the file is truncated, or is no torchpcct volume.
        """
        with read_hdf5(path, "volume") as file:
            data = torch.from_numpy(file["data"][()])
            grid = VolumeGrid(
                tuple(int(n) for n in data.shape), tuple(file.attrs["spacing_mm"]), tuple(file.attrs["center_mm"])
            )
            return cls(data, grid, json.loads(file.attrs["report"]))
