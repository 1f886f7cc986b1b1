"""Open a scan, whatever wrote it."""

from __future__ import annotations

import os
from dataclasses import replace
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
from torchpcct.vector_geometry import VectorGeometry

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
        geometry: of files that do not hold one (CatSim, a stack without); or, for any file, a
            :class:`~torchpcct.vector_geometry.VectorGeometry` that takes the place of the nominal one. The slices of a
            parallel stack are then the detector's rows, if it has rows.
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
        return read_catsim(name, geometry, **options)
    if name.suffix.lower() in _YAML:
        return read_stack(name, geometry, **options)
    if geometry is not None and not isinstance(geometry, VectorGeometry):
        raise ValueError(
            f"{name.name} holds its geometry: leave out geometry, or give a VectorGeometry (kind: vectors) in its place"
        )
    if name.is_dir():
        scan = read_dicom_ct_pd(name, **options).scan()
    else:
        scan = Scan.load(name, **options) if _is_own(name) else read_data_exchange(name, **options)
    return scan if geometry is None else _placed(scan, geometry)


def _placed(scan: Scan, geometry: VectorGeometry) -> Scan:
    """The same readings, of a geometry that was measured view by view."""
    if scan.window is not None:
        raise ValueError("this scan holds a part of the detector: a VectorGeometry needs all of it")
    changed: dict[str, Any] = {"geometry": geometry}
    if geometry.has_rows and not scan.geometry.has_rows and scan.counts.ndim == 3:
        for name in ("counts", "quantum", "dead"):
            values = getattr(scan, name)
            changed[name] = None if values is None else values.movedim(0, 1).contiguous()
    return replace(scan, **changed)


def _is_own(path: Path) -> bool:
    import h5py

    with reading(path, "HDF5"):
        if is_sealed(path):  # HDF5 sees it after its checksum is verified
            return True
        with h5py.File(path, "r") as file:
            return "format" in file.attrs
