"""Open a scan, whatever wrote it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from torchpcct.files import is_sealed
from torchpcct.formats.catsim import read_catsim
from torchpcct.formats.damage import reading
from torchpcct.formats.data_exchange import read_data_exchange
from torchpcct.formats.dicom_ct_pd import read_dicom_ct_pd
from torchpcct.formats.stack import read_stack
from torchpcct.geometry import Geometry
from torchpcct.scan import Scan

__all__ = ["check_scan_name", "open_scan"]

_HDF5, _YAML, _CATSIM = (".h5", ".hdf5", ".hdf"), (".yaml", ".yml"), (".prep", ".scan")


def check_scan_name(path: str | os.PathLike[str]) -> None:
    """Raise ``ValueError`` unless the ending of ``path`` names a scan format (a folder: DICOM-CT-PD)."""
    name = Path(path)
    if not (name.is_dir() or name.suffix.lower() in (*_HDF5, *_YAML, *_CATSIM)):
        raise ValueError(
            f"unknown scan format {name.name!r}: use .h5 (torchpcct or Data Exchange), .yaml (TIFF or NumPy stack), "
            ".prep or .scan (CatSim), or a folder of DICOM-CT-PD files"
        )


def open_scan(path: str | os.PathLike[str], geometry: Geometry | None = None, **options: Any) -> Scan:
    """A scan from a file or folder, by its ending and contents.

    Args:
        path: ``.h5`` (torchpcct, or Data Exchange by its contents), ``.yaml``, CatSim's ``.prep`` or ``.scan``, or a
            folder of DICOM-CT-PD files.
        geometry: CatSim only, whose files do not hold it.
        options: of the format's reader.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unknown ending, a damaged file, a geometry that is missing or too many.
    """
    check_scan_name(path)
    name = Path(path)
    if name.suffix.lower() in _CATSIM:
        if geometry is None:
            raise ValueError(f"{name.name}: CatSim's files do not hold the geometry, give it")
        return read_catsim(name, geometry, **options)  # type: ignore[arg-type]
    if geometry is not None:
        raise ValueError(f"{name.name} holds its geometry: leave out geometry")
    if name.is_dir():
        return read_dicom_ct_pd(name, **options).scan()
    if name.suffix.lower() in _YAML:
        return read_stack(name, **options)
    if _is_own(name):
        return Scan.load(name, **options)
    return read_data_exchange(name, **options)


def _is_own(path: Path) -> bool:
    import h5py

    with reading(path, "HDF5"):
        if is_sealed(path):  # HDF5 sees it after its checksum is verified
            return True
        with h5py.File(path, "r") as file:
            return "format" in file.attrs
