"""Projections as TIFF or NumPy files, described by a YAML file beside them: :data:`EXAMPLE`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchpcct.formats.damage import check_size, needed, read_yaml, reading
from torchpcct.formats.geometry_yaml import geometry_of
from torchpcct.geometry import Geometry
from torchpcct.scan import Scan
from torchpcct.scan_file import slice_axis, sliced
from torchpcct.validate import choice
from torchpcct.vector_geometry import VectorGeometry

__all__ = ["EXAMPLE", "read_array", "read_stack"]

EXAMPLE = """\
# A stack of projections: torchpcct reconstruct scan.yaml; files are looked for beside this one
readings: proj/*.tif        # a pattern, in the order of the names; or one .npy, .zarr, .tif with all views
kind: counts                # or line_integrals: -ln of the transmission
air: flat.tif               # of counts, without the object: a file, a pattern (several frames) or a number
dark: dark.npy              # optional, of counts without beam; as air
# dead: dead.npy            # optional: mask, 1 where a cell is dead
# gain: 12.5                # optional, of counts: reading of one photon (default: from the noise of several air frames)
# electronic_noise: 2.0     # optional, of counts: standard deviation in photons
# photons: 20000            # optional, of line_integrals: of an unattenuated reading
# mu_water: 0.02            # optional: attenuation of water in 1/mm, for HU
# linearisation: [1.0, 0.02]  # optional: beam hardening, c1 p + c2 p^2 + …
geometry:
  kind: cone                # parallel, fan or cone; vectors and rtk: torchpcct/formats/geometry_yaml.py
  angles_deg: {start: 0, step: 0.5, count: 720}   # or a list, or a text file with one angle a line
  sod: 626                  # mm, source to rotation axis (not parallel)
  sdd: 1098                 # mm, source to detector (not parallel)
  columns: 888
  rows: 64                  # cone only; the slices of parallel and fan beams are not named
  pitch: [1.1, 1.0]         # mm, [row, column], or one number
  offset: [0, 0.25]         # mm, of the detector's middle; optional
  detector: flat            # or curved
"""

_COUNTS = {"air", "dark", "dead", "flux", "gain", "electronic_noise", "linearisation", "mu_water", "exposure_s"}
_LINES = {"photons", "dead", "linearisation", "mu_water", "exposure_s"}
_FILES = {"air", "dark", "dead", "flux", "photons"}


def read_array(name: str, folder: Path = Path(), pick: Any = None) -> Any:
    """Numbers of ``.npy``, Zarr or TIFF files: one file, or a pattern whose files are stacked in the order of their
    names.

    Args:
        name: of the file, or a pattern.
        folder: that the name starts from.
        pick: function of the array's shape that returns the index, one slice an axis, of what to read; None: all.

    Raises:
        FileNotFoundError: no file. ValueError: damaged, an unknown ending, files of several shapes.
    """
    paths = sorted(folder.glob(name)) if any(c in name for c in "*?[") else [folder / name]
    if not paths:
        raise FileNotFoundError(f"no file matches {folder / name}")
    if len(paths) == 1:
        return _one(paths[0], pick)
    at = (slice(None),) if pick is None else pick((len(paths), *_one(paths[0]).shape))
    arrays = [_one(path) if pick is None else _one(path, lambda shape: at[1:]) for path in paths[at[0]]]
    shapes = {a.shape for a in arrays}
    if len(shapes) > 1:
        raise ValueError(f"the files of {name} have several shapes: {sorted(shapes)}")
    return np.stack(arrays)


def _one(path: Path, pick: Any = None) -> Any:
    """The numbers of a file; with ``pick``, a function of the number of axes and the first length, no more of them than
    the index that it returns."""
    if path.suffix == ".npy":
        with reading(path, "a NumPy array"):
            values = np.load(path, mmap_mode=None if pick is None else "r", allow_pickle=False)
            return values if pick is None else np.array(values[pick(values.shape)])
    if path.suffix == ".zarr":
        zarr = needed("zarr")
        with reading(path, "a Zarr array"):
            values = zarr.open_array(path, mode="r")
            check_size(values.shape, "the array")
            return values[... if pick is None else pick(values.shape)]
    if path.suffix in (".tif", ".tiff"):
        tifffile = needed("tifffile")
        with reading(path, "a TIFF image"), tifffile.TiffFile(path) as file:
            # A page that is cut off reads as zeros in some readers: sizes are checked before.
            size = path.stat().st_size
            for page in file.pages:
                ends = [o + n for o, n in zip(page.dataoffsets, page.databytecounts, strict=True)]
                if not ends or max(ends) > size:
                    raise ValueError("it ends before its last image")
                if page.compression == 1 and sum(page.databytecounts) < page.nbytes:
                    raise ValueError(f"it holds {sum(page.databytecounts)} bytes of an image of {page.nbytes}")
            shape = file.series[0].shape
            check_size(shape, "the image")
            if pick is None:
                return file.asarray()
            at = pick(shape)
            if len(shape) < 3 or len(file.pages) != shape[0]:
                return file.asarray()[at]
            return np.stack([file.pages[int(k)].asarray()[at[1:]] for k in np.arange(shape[0])[at[0]]])
    raise ValueError(f"{path.name}: readings must be .npy, .zarr, .tif or .tiff")


def read_stack(
    path: str | os.PathLike[str], geometry: Geometry | None = None, slices: slice | None = None, **known: Any
) -> Scan:
    """The scan that a YAML file describes; see :data:`EXAMPLE`.

    Args:
        path: YAML file.
        geometry: where the file has none; a :class:`~torchpcct.vector_geometry.VectorGeometry` also in place of the
            file's.
        slices: those to read, of a cone beam its rows; None: all.
        known: values that take the place of the file's, e.g. ``gain``.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError, TypeError: a damaged file, missing, unknown or bad values.
    """
    folder = Path(path).parent
    text = read_yaml(path, "the description of a scan")
    with reading(path, "the description of a scan"):
        if not isinstance(text, Mapping):
            raise ValueError("it is no mapping with readings, kind and geometry")
        given = {**text, **known}
        kind = choice("kind", given.pop("kind", None), ("counts", "line_integrals"))
        described = given.pop("geometry", None)
        if geometry is None:
            geometry = geometry_of(described, folder)
        elif described is not None and not isinstance(geometry, VectorGeometry):
            raise ValueError("it holds its geometry: leave out geometry, or give a VectorGeometry in its place")
        name = given.pop("readings", None)
        if not isinstance(name, str):
            raise ValueError("readings must name a file or a pattern of files")
        allowed = _COUNTS if kind == "counts" else _LINES
        unknown = sorted(map(str, set(given) - allowed))
        if unknown:
            raise ValueError(
                f"unknown in a scan of {kind}: {', '.join(unknown)}; it takes {', '.join(sorted(allowed))}"
            )
        if kind == "counts" and "air" not in given:
            raise ValueError("counts need air, the readings without the object")
    options = {k: read_array(v, folder) if k in _FILES and isinstance(v, str) else v for k, v in given.items()}
    if "dead" in options:
        options["dead"] = np.asarray(options["dead"]).astype(bool)
    info: dict[str, Any] = {"file": str(path), "format": "stack"}
    views, beam = geometry.views, geometry

    def pick(shape: tuple[int, ...]) -> tuple[slice, ...]:
        axis = slice_axis(beam, shape)
        axis = 1 if shape[0] == views else axis  # images of a camera, view by view
        info["slices"] = sliced(beam, slices, shape[axis])[1]  # type: ignore[arg-type]
        return tuple(slice(*info["slices"][:2]) if k == axis else slice(None) for k in range(3))

    readings = read_array(name, folder, None if slices is None else pick)
    if not geometry.has_rows and readings.ndim == 3 and readings.shape[0] == geometry.views:
        readings = np.moveaxis(readings, 0, 1)
    if slices is not None:
        first, stop, count = info["slices"]
        geometry = sliced(geometry, slices, count)[0]
        for key in _FILES & set(options):
            # One value a cell, (…, slices, columns), or one a reading of a stack, (slices, views, columns).
            shape = np.shape(options[key])
            if len(shape) > 1 and shape[-2] == count:
                options[key] = options[key][..., first:stop, :]
            elif len(shape) == 3 and shape[0] == count:
                options[key] = options[key][first:stop]
    make = Scan.from_counts if kind == "counts" else Scan.from_line_integrals
    return make(readings, geometry, info=info, **options)
