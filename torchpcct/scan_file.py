"""Scans as HDF5 files: :meth:`torchpcct.scan.Scan.save` and :meth:`~torchpcct.scan.Scan.load`."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from torchpcct.detector_window import DetectorWindow
from torchpcct.files import VERSION, write_hdf5
from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam, VolumeGrid
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.vector_geometry import VectorGeometry

if TYPE_CHECKING:
    import h5py
    from torch import Tensor

    from torchpcct.readings import ScanFields


G = TypeVar("G", bound=Geometry)

_VERSION = 6
"""2: energy-integrating scans with their noise model. 3: with a checksum
(:func:`torchpcct.files.write_hdf5`). 4: parallel and fan beams, flux, dead readings, units. 5:
geometries given view by view; the region of a window, which earlier files lack and earlier readers
leave aside. 6: the readings outside of a window are called exterior, before surround."""
_CHUNK_ROWS = 64
"""Readings are compressed in blocks of one view and so many rows: fast to write, and a window of
views, or of rows, can be read without the rest."""
_HDF5_COMPRESSION = {"compression": "lzf", "shuffle": True}
"""Filters of the readings: both come with HDF5."""


class NoSlicesError(ValueError):
    """A scan that has to be read as a whole was asked for some of its slices."""


def write_scan(scan: Any, path: str | os.PathLike[str]) -> None:
    """Write a scan; the file appears under its name only when it is complete."""
    with write_hdf5(path, "scan") as file:
        file.attrs.update(version=_VERSION, software=f"torchpcct {VERSION}")
        file.attrs.update(counting=scan.counting, unit=scan.unit, logged=scan.logged)
        file.attrs["info"] = json.dumps(dict(scan.info), default=str)
        if scan.exposure_s is not None:
            file.attrs["exposure_s"] = scan.exposure_s
        if scan.seed is not None:
            file.attrs["seed"] = scan.seed
        rows, columns = scan.counts.shape[-2:]
        rows = min(rows, _CHUNK_ROWS) if scan.geometry.has_rows else rows
        chunk = (*(1,) * (scan.counts.ndim - 2), rows, columns)
        # Counts that are whole numbers compress as integers, and stay exact.
        whole = (
            scan.counting
            and not (scan.noise_free or scan.logged)
            and float(scan.counts.max()) < 2**31
        )
        whole = whole and bool((scan.counts == scan.counts.round()).all())
        data = scan.counts.to(torch.int32) if whole else scan.counts
        file.create_dataset("counts", data=data.numpy(), chunks=chunk, **_HDF5_COMPRESSION)
        file.create_dataset("air", data=scan.air.numpy())
        if scan.quantum is not None:
            file.create_dataset(
                "quantum_kev", data=scan.quantum.numpy(), chunks=chunk, **_HDF5_COMPRESSION
            )
        file.attrs["electronic_noise_kev"] = scan.electronic_noise
        if scan.flux is not None:
            file["flux"] = scan.flux.numpy()
        if scan.dead is not None:
            file.create_dataset("dead", data=scan.dead.numpy(), chunks=chunk, **_HDF5_COMPRESSION)
        write_geometry(file.create_group("geometry"), scan.geometry)
        scan.linearisation.save(file.create_group("linearisation"))
        if scan.window is not None and scan.exterior is not None:
            window = file.create_group("window")
            window["first_column"] = scan.window.first_column
            window["exterior"] = scan.exterior.numpy()
            window.attrs.update(
                columns=scan.window.columns, first_row=scan.window.first_row, rows=scan.window.rows
            )
            if scan.region is not None:
                r = scan.region
                window.attrs.update(
                    region_shape=r.shape, region_spacing_mm=r.spacing, region_center_mm=r.center
                )
        # Written last: a file without it was cut off.
        file.attrs["complete"] = True


def scan_fields(
    file: h5py.File, path: str | os.PathLike[str], slices: slice | None = None
) -> ScanFields:
    """Fields of the scan in an open HDF5 file; with ``slices`` those of some slices, or rows of a
    cone beam.

    Raises:
        ValueError: a newer format, a file that was not written to its end, or slices of a scan that
            has none.
        KeyError: something is missing.
    """
    if int(file.attrs["version"]) > _VERSION:
        raise ValueError(
            f"{path} has format version {file.attrs['version']}, this software reads up to "
            f"{_VERSION}: update torchpcct"
        )
    if not file.attrs.get("complete", False):
        raise ValueError(f"{path} was not written to its end: simulate it again")
    window = exterior = region = None
    if "window" in file:
        w = file["window"]
        window = DetectorWindow(
            w["first_column"][()],
            int(w.attrs["columns"]),
            int(w.attrs["first_row"]),
            int(w.attrs["rows"]),
        )
        exterior = torch.from_numpy(w["exterior" if "exterior" in w else "surround"][()])
        if "region_shape" in w.attrs:
            shape, spacing, center = (
                w.attrs[f"region_{name}"].tolist() for name in ("shape", "spacing_mm", "center_mm")
            )
            region = VolumeGrid(shape, spacing, center)

    geometry, info = read_geometry(file["geometry"]), json.loads(file.attrs["info"])
    axis = 0
    if slices is not None:
        shape = tuple(file["counts"].shape)
        try:
            axis = slice_axis(geometry, shape, window)
            geometry, info["slices"] = sliced(geometry, slices, shape[axis])
        except ValueError as error:
            # what was asked for is wrong, not the file
            raise type(error)(f"{path}: {error}") from error
        slices = slice(*info["slices"][:2])

    def held(name: str, axis: int = axis) -> Tensor:
        return torch.from_numpy(
            file[name][()] if slices is None else file[name][(slice(None),) * axis + (slices,)]
        )

    return {
        "counts": held("counts").to(torch.float32),
        "air": held("air", 0),
        "geometry": geometry,
        "linearisation": WaterLinearisation.load(file["linearisation"]),
        "exposure_s": float(file.attrs["exposure_s"]) if "exposure_s" in file.attrs else None,
        "seed": int(file.attrs["seed"]) if "seed" in file.attrs else None,
        "window": window,
        "exterior": exterior,
        "counting": bool(file.attrs["counting"]),
        "info": info,
        "quantum": held("quantum_kev") if "quantum_kev" in file else None,
        "electronic_noise": float(file.attrs.get("electronic_noise_kev", 0.0)),
        "flux": torch.from_numpy(file["flux"][()]) if "flux" in file else None,
        "dead": held("dead") if "dead" in file else None,
        "logged": bool(file.attrs.get("logged", False)),
        "unit": str(file.attrs.get("unit", "HU")),
        "region": region,
    }


def slice_axis(
    geometry: Geometry, shape: tuple[int, ...], window: DetectorWindow | None = None
) -> int:
    """Axis of the slices of a stack, or of the rows of a cone beam, in counts of a shape.

    Raises:
        NoSlicesError: there is none.
    """
    if len(shape) != 3 or window is not None or (geometry.has_rows and not geometry.on_circle):
        kind = "part of a detector (a region)" if window is not None else type(geometry).__name__
        raise NoSlicesError(
            "slices= picks slices of parallel and fan beams or rows of a cone beam, this is one "
            f"{kind} of {len(shape)} axes"
        )
    return 1 if geometry.has_rows else 0


def sliced(geometry: G, slices: slice, count: int) -> tuple[G, list[int]]:
    """Geometry of some of ``count`` slices or rows, and what a scan's ``info["slices"]`` says:
    first, stop, count."""
    first, stop, step = slices.indices(count)
    if step != 1 or stop <= first:
        ends = ":".join("" if end is None else str(end) for end in (slices.start, slices.stop))
        what = "rows" if geometry.has_rows else "slices"
        raise ValueError(f"slices= must lie within the {count} {what} of the scan, got {ends}")
    return geometry.with_rows(first, stop - first), [first, stop, count]


def write_geometry(group: h5py.Group, geometry: Geometry) -> None:
    """Write a geometry into an HDF5 group (mm, rad)."""
    g: Any = geometry
    group.attrs.update(kind=type(g).__name__, columns=g.columns)
    if isinstance(g, VectorGeometry):
        group["vectors_mm"] = g.vectors
        group.attrs["parallel"] = g.parallel
        if g.rows is not None:
            group.attrs["rows"] = g.rows
        return
    group["angles_rad"] = g.angles
    group.attrs.update(pitch_mm=g.pitch, offset_mm=g.offset)
    if not g.parallel:
        group.attrs.update(sod_mm=g.sod, sdd_mm=g.sdd, detector=g.detector)
    if g.has_rows:
        group.attrs["rows"] = g.rows


def read_geometry(group: h5py.Group) -> Geometry:
    """Read what :func:`write_geometry` wrote; a group without a kind holds a cone beam.

    Raises:
        KeyError: something is missing. ValueError: values that are no geometry, an unknown kind.
    """
    a = group.attrs
    kind, columns = str(a.get("kind", "ConeBeam")), int(a["columns"])
    if kind == "VectorGeometry":
        return VectorGeometry(
            group["vectors_mm"][()],
            columns,
            int(a["rows"]) if "rows" in a else None,
            bool(a["parallel"]),
        )
    angles = group["angles_rad"][()]
    if kind == "ParallelBeam":
        return ParallelBeam(angles, columns, float(a["pitch_mm"]), float(a["offset_mm"]))
    orbit = (angles, float(a["sod_mm"]), float(a["sdd_mm"]), columns)
    if kind == "FanBeam":
        return FanBeam(*orbit, float(a["pitch_mm"]), float(a["offset_mm"]), str(a["detector"]))
    if kind == "ConeBeam":
        pitch, offset = tuple(a["pitch_mm"]), tuple(a["offset_mm"])
        return ConeBeam(*orbit, int(a["rows"]), pitch, offset, str(a["detector"]))
    raise ValueError(f"unknown geometry {kind!r}")
