"""Open a scan file of any supported format."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torchpcct.checks.rotation_axis import at_axis
from torchpcct.files import is_sealed
from torchpcct.formats.catsim import read_catsim
from torchpcct.formats.damage import reading
from torchpcct.formats.data_exchange import read_data_exchange
from torchpcct.formats.dicom_ct_pd import read_dicom_ct_pd
from torchpcct.formats.matlab import read_mat_scan
from torchpcct.formats.nexus import holds_nexus, read_nexus
from torchpcct.formats.nikon import read_xtekct
from torchpcct.formats.stack import read_stack
from torchpcct.formats.zeiss import read_txrm
from torchpcct.geometry import Geometry
from torchpcct.hdf5 import inside
from torchpcct.scan import Scan
from torchpcct.scan_file import slice_axis, sliced
from torchpcct.validate import number
from torchpcct.vector_geometry import VectorGeometry

__all__ = ["adapted", "open_scan"]


class _Reader(NamedTuple):
    """How scans of a format are read.

    Attributes:
        name: of the format, in messages.
        endings: of its files.
        is_one: whether a file of such an ending is of the format.
        read: function of the path, and of the geometry if ``geometry`` is not "own", and of its
            options.
        options: that it takes itself: what has to be known while reading, or is the format's own.
        geometry: "own": the files hold it, "given": they do not, "both": some do.
    """

    name: str
    endings: tuple[str, ...]
    is_one: Callable[[Path], bool]
    read: Callable[..., Scan]
    options: frozenset[str]
    geometry: str = "own"


_COUNTS = {"gain", "flux", "dead", "electronic_noise", "linearisation", "exposure_s"}
"""Options of readers of counts."""
_LINES = {"flux", "dead", "linearisation", "exposure_s"}
"""Of readers of line integrals."""
_FRAMES = {"air", "dark"}
"""Frames that may be given in place of the file's."""
_HDF5 = (".h5", ".hdf5", ".hdf", ".nxs", ".nx5", ".nx")
"""Endings of HDF5 files."""
_CATSIM = (".prep", ".scan")
"""Of CatSim's files."""


def _any(path: Path) -> bool:
    return True


def _catsim(path: Path, geometry: Geometry, **options: Any) -> Scan:
    return read_catsim(path, geometry, **options)


_READERS = (
    _Reader(
        "a DICOM-CT-PD folder",
        (),
        _any,
        lambda path, **options: read_dicom_ct_pd(path, **options).scan(),
        frozenset({"ignore_flying_spot", "spot"}),
    ),
    _Reader(
        "a torchpcct scan", _HDF5, lambda path: _is_own(path), Scan.load, frozenset({"slices"})
    ),
    _Reader(
        "Data Exchange",
        _HDF5,
        lambda path: _holds(path, "exchange/data"),
        read_data_exchange,
        frozenset({"slices", "angles_deg"} | _FRAMES | _COUNTS),
    ),
    _Reader(
        "NeXus",
        _HDF5,
        lambda path: _holds(path, None),
        read_nexus,
        frozenset({"slices", "angles_deg", "entry"} | _FRAMES | _COUNTS),
    ),
    _Reader(
        "a .yaml stack",
        (".yaml", ".yml"),
        _any,
        read_stack,
        frozenset({"slices", "gain", "electronic_noise", "photons"}),
        "both",
    ),
    _Reader(
        "CatSim's line integrals",
        _CATSIM,
        lambda path: path.with_suffix(".prep").exists(),
        _catsim,
        frozenset(_LINES | {"photons"}),
        "given",
    ),
    _Reader("CatSim's readings", _CATSIM, _any, _catsim, frozenset(_COUNTS), "given"),
    _Reader(
        "a Nikon scan",
        (".xtekct",),
        _any,
        read_xtekct,
        frozenset({"slices", "angles_deg"} | _FRAMES | _COUNTS),
    ),
    _Reader("a Zeiss scan", (".txrm",), _any, read_txrm, frozenset({"slices"} | _FRAMES | _COUNTS)),
    _Reader(
        "a MATLAB array",
        (".mat",),
        _any,
        read_mat_scan,
        frozenset({"variable", "photons"} | _FRAMES | _COUNTS),
        "given",
    ),
)
"""In the order in which they are asked; a folder is the first one's."""

_ANY = {"axis", "pitch", "slices", "mu_water", "photons"}
"""Options that every scan is changed by, or refuses (:func:`adapted`), whatever its format."""


def check_scan_name(path: str | os.PathLike[str]) -> None:
    """Raise ``ValueError`` unless the ending of ``path`` names a scan format (a folder:
    DICOM-CT-PD)."""
    name = Path(path)
    if not (name.is_dir() or any(name.suffix.lower() in reader.endings for reader in _READERS)):
        raise ValueError(
            f"unknown scan format {name.name!r}: use .h5 (torchpcct, Data Exchange or NeXus), "
            ".yaml (TIFF, NumPy or MATLAB stack), .xtekct (Nikon), .txrm (Zeiss), .mat (MATLAB), "
            ".prep or .scan (CatSim), or a folder of DICOM-CT-PD files"
        )


def open_scan(
    path: str | os.PathLike[str], geometry: Geometry | None = None, **options: Any
) -> Scan:
    """A scan from a file or folder, by its ending and contents.

    Args:
        path: ``.h5`` (torchpcct, Data Exchange or NeXus by its contents), ``.yaml``, Nikon's
            ``.xtekct``, Zeiss' ``.txrm``, ``.mat``, CatSim's ``.prep`` or ``.scan``, or a folder of
            DICOM-CT-PD files.
        geometry: of files that do not hold one (CatSim, MATLAB, a stack without); or, for any file,
            a :class:`~torchpcct.vector_geometry.VectorGeometry` that takes the place of the nominal
            one, in mm, which also says the size of cells where the file does not. Parallel rays on
            cells of width 1, as a calibration of such a file has them, stay in pixels: give
            ``pitch``, too. The slices of a parallel stack are then the detector's rows, if it has
            rows.
        options: of :func:`adapted`, for every format; of :meth:`torchpcct.Scan.from_counts` for
            Data Exchange, NeXus, Nikon and Zeiss, of it or
            :meth:`torchpcct.Scan.from_line_integrals` for CatSim and MATLAB; ``angles_deg`` and,
            there and for the microscopes, ``air`` and ``dark`` in the place of what the file holds;
            ``entry`` of NeXus, ``variable`` of MATLAB; ``spot`` and ``ignore_flying_spot`` of
            DICOM-CT-PD.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unknown ending, a damaged file, a geometry that is missing or too many, an
            option that this scan cannot follow.
        TypeError: an option that the format does not take.
    """
    check_scan_name(path)
    name = Path(path)
    reader = _reader(name)
    own = {k: v for k, v in options.items() if k in reader.options and v is not None}
    unknown = sorted(set(options) - _ANY - reader.options)
    if unknown:
        takes = sorted(_ANY | reader.options)
        raise TypeError(
            f"{', '.join(unknown)}: no option of {reader.name}, which takes {', '.join(takes)}"
        )
    rest = {k: v for k, v in options.items() if k not in own and k in _ANY}
    return adapted(_read(name, reader, geometry, own), **rest)


def own_options(path: str | os.PathLike[str]) -> set[str]:
    """Options that the reader of a file takes itself; with "slices" it reads no more of the file
    than those."""
    check_scan_name(path)
    return set(_reader(Path(path)).options)


def _reader(name: Path) -> _Reader:
    """Of a file by its ending and contents; of a folder the first.

    Raises:
        FileNotFoundError: no such HDF5 file. ValueError: an HDF5 file of no known format.
    """
    if name.is_dir():
        return _READERS[0]
    for reader in _READERS:
        if name.suffix.lower() in reader.endings and reader.is_one(name):
            return reader
    raise ValueError(
        f"{name} is no scan of a known format: neither of torchpcct, nor Data Exchange "
        "(/exchange/data), nor NeXus (image_key)"
    )


def _read(name: Path, reader: _Reader, geometry: Geometry | None, options: dict[str, Any]) -> Scan:
    if reader.geometry == "given" and geometry is None:
        raise ValueError(
            f"{name.name}, {reader.name}: such files do not hold the geometry, give it"
        )
    if reader.geometry != "own":
        return reader.read(name, geometry, **options)
    if geometry is not None and not isinstance(geometry, VectorGeometry):
        raise ValueError(
            f"{name.name} holds its geometry: leave out geometry, or give a VectorGeometry (kind: "
            "vectors) in its place"
        )
    scan = reader.read(name, **options)
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
        pitch: cell width in mm, of parallel beams; of vectors only where lengths are in pixels.
        slices: of parallel and fan beams ``(slices, views, columns)``: those to keep; of a cone
            beam its rows.
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
        in_pixels = isinstance(g, VectorGeometry) and g.parallel and scan.unit == "pixel^-1"
        if not (g.parallel and (g.on_circle or in_pixels)):
            raise ValueError(
                f"pitch= is the cell width of parallel beams, this is a {kind}, whose geometry has "
                "it: leave it out"
            )
        wide = number("pitch", pitch, positive=True, unit="mm")
        if isinstance(g, VectorGeometry):
            g = replace(g, vectors=g.vectors * (wide / g.column_pitch))
        else:
            g = replace(g, pitch=wide, offset=g.offset * wide / g.pitch)
        scan = replace(scan, geometry=g, unit="mm^-1" if scan.unit == "pixel^-1" else scan.unit)
    if axis is not None:
        if not g.on_circle or scan.window is not None:
            raise ValueError(
                f"axis= needs the whole detector of a scan on a circle, this is a {kind}"
            )
        scan = replace(
            scan, geometry=at_axis(g, number("axis", axis, low=0.0, high=g.columns - 1.0))
        )
    if mu_water is not None:
        mu = number("mu_water", mu_water, positive=True, unit="mm⁻¹")
        if scan.unit != "mm^-1":
            known = (
                "the size of its pixels is unknown: give pitch=, too"
                if scan.unit == "pixel^-1"
                else (
                    f"the attenuation of water, {scan.linearisation.mu_ref:.5g} mm⁻¹, is known to "
                    "the scan"
                )
            )
            raise ValueError(f"mu_water= does not fit this scan: {known}")
        scan = replace(scan, linearisation=replace(scan.linearisation, mu_ref=mu), unit="HU")
    if photons is not None:
        if not scan.logged:
            raise ValueError(
                "photons= applies to line integrals; this scan has readings, which determine the "
                "number of photons: leave it out"
            )
        air = torch.full_like(scan.air, number("photons", photons, positive=True))
        ratio = (air / scan.air).unsqueeze(-len(g.shape))
        scan = replace(
            scan, counts=scan.counts * ratio, air=air, info={**scan.info, "photons": "given"}
        )
    return scan


def _sliced(scan: Scan, slices: slice) -> Scan:
    axis = slice_axis(scan.geometry, tuple(scan.counts.shape), scan.window)
    geometry, kept = sliced(scan.geometry, slices, scan.counts.shape[axis])
    at = (slice(None),) * axis + (slice(*kept[:2]),)
    changed = scan.each(lambda readings: readings[at])
    return replace(
        scan,
        geometry=geometry,
        air=scan.air[at[-1:]],
        info={**scan.info, "slices": kept},
        **changed,
    )


def _placed(scan: Scan, geometry: VectorGeometry) -> Scan:
    """The same readings, of a geometry that was measured view by view."""
    if scan.window is not None:
        raise ValueError("this scan holds a part of the detector: a VectorGeometry needs all of it")
    unit = scan.unit
    if unit == "pixel^-1" and not (
        geometry.parallel and math.isclose(geometry.column_pitch, 1.0, rel_tol=1e-6)
    ):
        unit = "mm^-1"
    turned = geometry.has_rows and not scan.geometry.has_rows and scan.counts.ndim == 3
    if turned:
        changed = scan.each(lambda readings: readings.movedim(0, 1).contiguous())
        return replace(scan, geometry=geometry, unit=unit, **changed)
    return replace(scan, geometry=geometry, unit=unit)


def _is_own(path: Path) -> bool:
    import h5py

    with reading(path, "HDF5"):
        if is_sealed(path):  # HDF5 sees it after its checksum is verified
            return True
        with h5py.File(path, "r") as file:
            return "format" in file.attrs


def _holds(path: Path, name: str | None) -> bool:
    """Whether an HDF5 file has something by a path; None: whether it is NeXus."""
    import h5py

    with reading(path, "HDF5"), h5py.File(path, "r") as file:
        return holds_nexus(file) if name is None else inside(file, name) is not None
