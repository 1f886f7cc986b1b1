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
from torchpcct.validate import choice
from torchpcct.vector_geometry import VectorGeometry

__all__ = ["EXAMPLE", "read_array", "read_stack"]

EXAMPLE = """\
# A stack of projections: torchpcct reconstruct scan.yaml; files are looked for beside this one
readings: proj/*.tif        # a pattern, in the order of the names; or one .npy, .tif with all views
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


def read_array(name: str, folder: Path = Path()) -> Any:
    """Numbers of ``.npy`` or TIFF files: one file, or a pattern whose files are stacked in the order of their names.

    Raises:
        FileNotFoundError: no file. ValueError: damaged, an unknown ending, files of several shapes.
    """
    paths = sorted(folder.glob(name)) if any(c in name for c in "*?[") else [folder / name]
    if not paths:
        raise FileNotFoundError(f"no file matches {folder / name}")
    arrays = [_one(path) for path in paths]
    if len(arrays) == 1:
        return arrays[0]
    shapes = {a.shape for a in arrays}
    if len(shapes) > 1:
        raise ValueError(f"the files of {name} have several shapes: {sorted(shapes)}")
    return np.stack(arrays)


def _one(path: Path) -> Any:
    if path.suffix == ".npy":
        with reading(path, "a NumPy array"):
            return np.load(path, allow_pickle=False)
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
            check_size(file.series[0].shape, "the image")
            return file.asarray()
    raise ValueError(f"{path.name}: readings must be .npy, .tif or .tiff")


def read_stack(path: str | os.PathLike[str], geometry: Geometry | None = None) -> Scan:
    """The scan that a YAML file describes; see :data:`EXAMPLE`.

    Args:
        path: YAML file.
        geometry: where the file has none; a :class:`~torchpcct.vector_geometry.VectorGeometry` also in place of the
            file's.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError, TypeError: a damaged file, missing, unknown or bad values.
    """
    folder = Path(path).parent
    text = read_yaml(path, "the description of a scan")
    with reading(path, "the description of a scan"):
        if not isinstance(text, Mapping):
            raise ValueError("it is no mapping with readings, kind and geometry")
        given = dict(text)
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
    readings = read_array(name, folder)
    if not geometry.has_rows and readings.ndim == 3 and readings.shape[0] == geometry.views:
        # Images of a camera, view by view: slices first.
        readings = np.moveaxis(readings, 0, 1)
    make = Scan.from_counts if kind == "counts" else Scan.from_line_integrals
    return make(readings, geometry, info={"file": str(path), "format": "stack"}, **options)
