"""A reconstructed volume in HU, with its grid and its report; files are written atomically."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchpcct.files import read_hdf5, write_hdf5
from torchpcct.formats.damage import check_expansion
from torchpcct.formats.dicom_series import read_dicom, write_dicom
from torchpcct.formats.volume_files import (
    check_volume_name,
    format_of,
    read_meta_image,
    read_nifti,
    write_meta_image,
    write_nifti,
)
from torchpcct.formats.volume_slabs import read_ome_zarr, write_ome_zarr
from torchpcct.geometry import VolumeGrid
from torchpcct.validate import UNITS, checked, choice

__all__ = ["Volume", "from_hu", "to_hu"]


@checked
def to_hu(attenuation: Tensor, mu_water: float) -> Tensor:
    """CT numbers from attenuation: 1000 (μ / μ_water − 1), so that water reads 0 and air −1000.

    Args:
        attenuation: linear attenuation coefficients in mm⁻¹, of any shape.
        mu_water: that of water, mm⁻¹.

    Returns:
        HU, of the same shape and dtype.
    """
    return 1000.0 * (attenuation / mu_water - 1.0)


@checked
def from_hu(numbers: Tensor, mu_water: float) -> Tensor:
    """Attenuation from CT numbers, the inverse of :func:`to_hu`.

    Args:
        numbers: HU, of any shape.
        mu_water: linear attenuation coefficient of water, mm⁻¹.

    Returns:
        Linear attenuation coefficients in mm⁻¹, of the same shape and dtype.
    """
    return mu_water * (1.0 + numbers / 1000.0)


def in_words(hu: float, unit: str, mu_water: float, difference: bool = True) -> str:
    """A value in HU, or a difference of such values, as a message says it of a scan in ``unit``.

    Args:
        hu: by the scan's ``mu_water``, which of a scan that is not in HU is a mere convention.
        unit: of the scan.
        mu_water: ``linearisation.mu_ref`` of the scan.
        difference: False: a value, whose 0 is water.
    """
    if unit == "HU":
        return f"{hu:.0f} HU" if abs(hu) >= 10.0 else f"{hu:.2g} HU"
    return f"{mu_water * (hu / 1000.0 + (0.0 if difference else 1.0)):.3g} {unit}"


@dataclass(frozen=True)
class Volume:
    """A volume in HU, or in mm⁻¹ (``unit``).

    Args:
        data: ``(..., z, y, x)``, float32 or float64.
        grid: its voxel grid.
        report: how it was made: method, kernel, iterations, residual, seconds, …
        unit: of ``data``: "HU", or "mm^-1" where the scan does not know the attenuation of water,
            "pixel^-1" where it does not know the size of its cells (lengths of the grid are in
            pixels then).

    Raises:
        TypeError: ``data`` that are no floating point tensor.
        ValueError: ``data`` whose last axes are not the grid's, an unknown unit.
    """

    data: Tensor
    grid: VolumeGrid
    report: Mapping[str, Any] = field(default_factory=dict)
    unit: str = "HU"

    def __post_init__(self) -> None:
        if not isinstance(self.data, Tensor) or not self.data.is_floating_point():
            raise TypeError(
                f"data must be a floating point tensor in HU, got {type(self.data).__name__}"
            )
        if tuple(self.data.shape[-self.grid.ndim :]) != self.grid.shape:
            raise ValueError(f"data has shape {tuple(self.data.shape)}, its grid {self.grid.shape}")
        choice("unit", self.unit, UNITS)

    def __repr__(self) -> str:
        low, high = (
            (float(v) for v in self.data.detach().aminmax())
            if self.data.numel()
            else (math.nan, math.nan)
        )
        size, how = " × ".join(map(str, self.data.shape)), self.report.get("method", "no method")
        return f"Volume({size}, {low:.4g} … {high:.4g} {self.unit}, {how}\n       {self.grid!r})"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``.nii`` / ``.nii.gz`` (NIfTI-1), ``.mha`` (MetaImage), ``.h5`` (HDF5 with grid and
        report), ``.zarr`` (OME-Zarr 0.5), or, if the name has no ending, a folder with a DICOM
        series in HU.

        x, y, z of the scanner become right, anterior, superior. DICOM and OME-Zarr need the extra
        ``io``. A 2-D image is written as :meth:`slices` makes it, but to HDF5, which keeps it as it
        is.

        Raises:
            ValueError: another ending, a batch of volumes (save them one by one), or what the
                format cannot hold.
            ImportError: the package that writes the format is not installed.
        """
        check_volume_name(path)
        if self.data.ndim != self.grid.ndim:
            raise ValueError(
                f"save one volume at a time, this one has shape {tuple(self.data.shape)}"
            )
        form = format_of(path)
        if form == "HDF5":
            self._save_hdf5(path)
        else:
            write = {
                "NIfTI": write_nifti,
                "MetaImage": write_meta_image,
                "DICOM": write_dicom,
                "OME-Zarr": write_ome_zarr,
            }[form]
            slices = self.slices()
            write(path, slices.data.detach().cpu().numpy(), slices.grid, self.unit)

    def slices(self) -> Volume:
        """The same with axes z, y, x: a 2-D image as one slice at z = 0, as thick as its pixels
        are wide."""
        if self.grid.ndim == 3:
            return self
        g = self.grid
        grid = VolumeGrid((1, *g.shape), (g.spacing[-1], *g.spacing), (0.0, *g.center))
        return Volume(self.data.unsqueeze(-3), grid, self.report, self.unit)

    def _save_hdf5(self, path: str | os.PathLike[str]) -> None:
        with write_hdf5(path, "volume") as file:
            file.attrs["unit"] = self.unit
            file.attrs["spacing_mm"] = self.grid.spacing
            file.attrs["center_mm"] = self.grid.center
            maps = {k: v for k, v in self.report.items() if isinstance(v, Tensor)}
            file.attrs["report"] = json.dumps(
                {k: v for k, v in self.report.items() if k not in maps}, default=str
            )
            file.create_dataset("data", data=self.data.detach().cpu().numpy())
            for name, values in maps.items():
                file.create_dataset(f"maps/{name}", data=values.detach().cpu().numpy())

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], unit: str | None = None, *, fill: float | None = None
    ) -> Volume:
        """Read a volume of any format that :meth:`save` writes, or one DICOM image (``.dcm``,
        ``.ima``, no ending).

        The report comes back from HDF5 only.

        Args:
            path: file or folder.
            unit: of its numbers, for files of other software, which do not say it: None: HU, and of
                DICOM only values whose unit is given as HU.
            fill: number that takes the place of voxels that are NaN or infinite, e.g. −1000 HU
                where they are padding about the picture; NaN: they stay as they are; None: such a
                volume is refused.

        Raises:
            FileNotFoundError: no such file or folder.
            ValueError: an unknown ending; a file that is damaged, foreign, oblique or incomplete,
                says another unit, or holds voxels that are NaN or infinite.
            ImportError: the package that reads the format is not installed.
        """
        if unit is not None:
            choice("unit", unit, UNITS)
        form = format_of(path)
        if form != "HDF5":
            read = {
                "NIfTI": read_nifti,
                "MetaImage": read_meta_image,
                "DICOM": read_dicom,
                "OME-Zarr": read_ome_zarr,
            }[form]
            values, grid, stored = read(path, unit)
            data = _finite(torch.from_numpy(values), path, stored, fill)
            return cls(data, grid, {"file": str(path)}, stored)
        with read_hdf5(path, "volume") as file:
            held = file["data"]
            check_expansion(held.shape, "the volume", held.id.get_storage_size, held.dtype.itemsize)
            data = torch.from_numpy(held[()])
            grid = VolumeGrid(
                tuple(int(n) for n in data.shape),
                tuple(file.attrs["spacing_mm"]),
                tuple(file.attrs["center_mm"]),
            )
            stored = str(file.attrs["unit"])
            if unit not in (None, stored):
                raise ValueError(f"it gives the unit {stored!r}, not {unit!r}")
            report = json.loads(file.attrs["report"])
            report |= {
                name: torch.from_numpy(values[()]) for name, values in file.get("maps", {}).items()
            }
            return cls(_finite(data, path, stored, fill), grid, report, stored)


def _finite(data: Tensor, path: str | os.PathLike[str], unit: str, fill: float | None) -> Tensor:
    """The voxels of a file, those that are NaN or infinite replaced by ``fill``, as in
    :meth:`Volume.load`.

    Raises:
        ValueError: there are such voxels, and nothing to put in their place.
    """
    # Any one of them, or an overflow, shows in the sum, which takes no memory.
    if math.isfinite(float(data.sum())):
        return data
    finite = torch.isfinite(data)
    bad = data.numel() - int(finite.sum())
    if fill is None and bad:
        air = -1000.0 if unit == "HU" else 0.0
        raise ValueError(
            f"{path}: {bad} of {data.numel()} voxels are NaN or infinite: make it again or, where "
            f"they are padding about the picture, give them the value of air, "
            f"Volume.load(path, fill={air:g}).save(path)"
        )
    if fill is not None and not math.isnan(fill):
        data[~finite] = fill
    return data
