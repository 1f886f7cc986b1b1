"""Open a scan file of any supported format."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from torchpcct.checks.rotation_axis import at_axis
from torchpcct.files import is_sealed
from torchpcct.formats.catsim import read_catsim
from torchpcct.formats.damage import reading
from torchpcct.formats.data_exchange import read_data_exchange
from torchpcct.formats.dicom_ct_pd import read_dicom_ct_pd
from torchpcct.formats.stack import read_stack
from torchpcct.geometry import Geometry, ParallelBeam
from torchpcct.scan import Scan
from torchpcct.scan_file import slice_axis, sliced
from torchpcct.validate import number
from torchpcct.vector_geometry import VectorGeometry

__all__ = ["adapted", "check_scan_name", "open_scan", "own_options"]

_HDF5, _YAML, _CATSIM = (".h5", ".hdf5", ".hdf"), (".yaml", ".yml"), (".prep", ".scan")


def check_scan_name(path: str | os.PathLike[str]) -> None:
    """Raise ``ValueError`` unless the ending of ``path`` names a scan format (a folder: DICOM-CT-PD)."""
    name = Path(path)
    if not (name.is_dir() or name.suffix.lower() in (*_HDF5, *_YAML, *_CATSIM)):
        raise ValueError(
            f"unknown scan format {name.name!r}: use .h5 (torchpcct or Data Exchange), .yaml (TIFF or NumPy stack), "
            ".prep or .scan (CatSim), or a folder of DICOM-CT-PD files"
        )


_COUNTS = {"gain", "flux", "dead", "electronic_noise", "linearisation", "exposure_s"}
_LINES = {"dead", "linearisation", "exposure_s"}
_OPTIONS = {
    "Data Exchange": {"slices"} | _COUNTS,
    "CatSim's readings": _COUNTS,
    "CatSim's line integrals": _LINES | {"photons"},
    "a torchpcct scan": {"slices"},
    "a .yaml stack": {"slices", "gain", "electronic_noise", "photons"},
    "a DICOM-CT-PD folder": {"ignore_flying_spot"},
}
"""What the readers take themselves: what has to be known while reading, or is the format's own."""
_ANY = {"axis", "pitch", "slices", "mu_water", "photons"}


def open_scan(path: str | os.PathLike[str], geometry: Geometry | None = None, **options: Any) -> Scan:
    """A scan from a file or folder, by its ending and contents.

    Args:
        path: ``.h5`` (torchpcct, or Data Exchange by its contents), ``.yaml``, CatSim's ``.prep`` or ``.scan``, or a
            folder of DICOM-CT-PD files.
        geometry: of files that do not hold one (CatSim, a stack without); or, for any file, a
            :class:`~torchpcct.vector_geometry.VectorGeometry` that takes the place of the nominal one. The slices of a
            parallel stack are then the detector's rows, if it has rows.
        options: of :func:`adapted`, for every format; of :meth:`torchpcct.Scan.from_counts` for Data Exchange, of it
            or :meth:`torchpcct.Scan.from_line_integrals` for CatSim; ``ignore_flying_spot`` for DICOM-CT-PD.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unknown ending, a damaged file, a geometry that is missing or too many, an option that this scan
            cannot follow.
        TypeError: an option that the format does not take.
    """
    check_scan_name(path)
    name = Path(path)
    what = _format(name)
    own = {k: v for k, v in options.items() if k in _OPTIONS.get(what, ()) and v is not None}
    unknown = sorted(set(options) - _ANY - _OPTIONS.get(what, set()))
    if unknown:
        takes = sorted(_ANY | _OPTIONS.get(what, set()))
        raise TypeError(f"{', '.join(unknown)}: no option of {what}, which takes {', '.join(takes)}")
    return adapted(_read(name, what, geometry, own), **{k: v for k, v in options.items() if k not in own and k in _ANY})


def own_options(path: str | os.PathLike[str]) -> set[str]:
    """Options that the reader of a file takes itself; with "slices" it reads no more of the file than those."""
    check_scan_name(path)
    return _OPTIONS.get(_format(Path(path)), set())


def _format(name: Path) -> str:
    ending = name.suffix.lower()
    if ending in _CATSIM:
        return "CatSim's line integrals" if name.with_suffix(".prep").exists() else "CatSim's readings"
    if ending in _YAML:
        return "a .yaml stack"
    if name.is_dir():
        return "a DICOM-CT-PD folder"
    return "a torchpcct scan" if _is_own(name) else "Data Exchange"


def _read(name: Path, what: str, geometry: Geometry | None, options: dict[str, Any]) -> Scan:
    if what.startswith("CatSim"):
        if geometry is None:
            raise ValueError(f"{name.name}: CatSim's files do not hold the geometry, give it")
        return read_catsim(name, geometry, **options)
    if what == "a .yaml stack":
        return read_stack(name, geometry, **options)
    if geometry is not None and not isinstance(geometry, VectorGeometry):
        raise ValueError(
            f"{name.name} holds its geometry: leave out geometry, or give a VectorGeometry (kind: vectors) in its place"
        )
    if what == "a DICOM-CT-PD folder":
        scan = read_dicom_ct_pd(name, **options).scan()
    else:
        scan = Scan.load(name, **options) if what == "a torchpcct scan" else read_data_exchange(name, **options)
    return scan if geometry is None else _placed(scan, geometry)


def adapted(
    scan: Scan,
    *,
    axis: float | None = None,
    pitch: float | None = None,
    slices: slice | None = None,
    mu_water: float | None = None,
    photons: float | None = None,
) -> Scan:
    """The same scan with what its file does not know, or has wrong; each None: as it is.

    Args:
        scan: of any format.
        axis: column that the rotation axis projects onto (may be fractional).
        pitch: cell width in mm, of parallel beams.
        slices: of parallel and fan beams ``(slices, views, columns)``: those to keep; of a cone beam its rows.
        mu_water: attenuation of water in mm⁻¹: volumes in HU.
        photons: of an unattenuated reading, of scans that were given as line integrals.

    Raises:
        ValueError: a scan that has no such thing, or knows it already; a value out of range.
        TypeError: a value of the wrong kind.
    """
    g = scan.geometry
    kind = type(g).__name__
    if slices is not None:
        scan = _sliced(scan, slices)
        g = scan.geometry
    if pitch is not None:
        if not isinstance(g, ParallelBeam):
            raise ValueError(f"pitch= is the cell width of parallel beams, this is a {kind}: its geometry says it")
        wide = number("pitch", pitch, positive=True, unit="mm")
        g = replace(g, pitch=wide, offset=g.offset * wide / g.pitch)
        scan = replace(scan, geometry=g, unit="mm^-1" if scan.unit == "pixel^-1" else scan.unit)
    if axis is not None:
        if isinstance(g, VectorGeometry) or scan.window is not None:
            raise ValueError(f"axis= needs the whole detector of a scan on a circle, this is a {kind}")
        scan = replace(scan, geometry=at_axis(g, number("axis", axis, low=0.0, high=g.columns - 1.0)))
    if mu_water is not None:
        mu = number("mu_water", mu_water, positive=True, unit="mm⁻¹")
        if scan.unit != "mm^-1":
            known = "it does not know the size of its pixels: give pitch=, too" if scan.unit == "pixel^-1" else (
                f"the attenuation of water, {scan.linearisation.mu_ref:.5g} mm⁻¹, is known to the scan"
            )  # fmt: skip
            raise ValueError(f"mu_water= does not fit this scan: {known}")
        scan = replace(scan, linearisation=replace(scan.linearisation, mu_ref=mu), unit="HU")
    if photons is not None:
        if not scan.logged:
            raise ValueError("photons= belongs to line integrals, this scan holds readings, which tell their photons")
        air = torch.full_like(scan.air, number("photons", photons, positive=True))
        ratio = (air / scan.air).unsqueeze(-len(g.shape))
        scan = replace(scan, counts=scan.counts * ratio, air=air, info={**scan.info, "photons": "given"})
    return scan


def _sliced(scan: Scan, slices: slice) -> Scan:
    axis = slice_axis(scan.geometry, tuple(scan.counts.shape), scan.window)
    geometry, kept = sliced(scan.geometry, slices, scan.counts.shape[axis])
    at = (slice(None),) * axis + (slice(*kept[:2]),)
    changed = scan.each(lambda readings: readings[at])
    return replace(scan, geometry=geometry, air=scan.air[at[-1:]], info={**scan.info, "slices": kept}, **changed)


def _placed(scan: Scan, geometry: VectorGeometry) -> Scan:
    """The same readings, of a geometry that was measured view by view."""
    if scan.window is not None:
        raise ValueError("this scan holds a part of the detector: a VectorGeometry needs all of it")
    turned = geometry.has_rows and not scan.geometry.has_rows and scan.counts.ndim == 3
    changed = scan.each(lambda readings: readings.movedim(0, 1).contiguous()) if turned else {}
    return replace(scan, geometry=geometry, **changed)


def _is_own(path: Path) -> bool:
    import h5py

    with reading(path, "HDF5"):
        if is_sealed(path):  # HDF5 sees it after its checksum is verified
            return True
        with h5py.File(path, "r") as file:
            return "format" in file.attrs
