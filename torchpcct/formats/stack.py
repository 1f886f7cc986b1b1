"""Projections as TIFF, NumPy, Zarr or MATLAB files, described by a YAML file beside them:
:data:`EXAMPLE`."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchpcct.formats.arrays import read_array
from torchpcct.formats.damage import read_yaml, reading
from torchpcct.formats.file_names import gap_in_numbers, matching
from torchpcct.formats.geometry_yaml import geometry_of
from torchpcct.formats.integer_readings import as_counted
from torchpcct.geometry import Geometry
from torchpcct.scan import Scan
from torchpcct.scan_file import slice_axis, sliced
from torchpcct.validate import choice
from torchpcct.vector_geometry import VectorGeometry

__all__ = ["read_stack"]

EXAMPLE = """\
# A stack of projections: torchpcct reconstruct scan.yaml; files are looked for beside this one
readings: proj/*.tif        # a pattern, in the order of the numbers in the names, or a list; or one
                            # .npy, .zarr, .tif
kind: counts                # or line_integrals: -ln of the transmission
air: flat.tif               # of counts, without the object: a file, a pattern (several frames) or
                            # a number
dark: dark.npy              # optional, of counts without beam; as air
# dead: dead.npy            # optional: mask, 1 where a cell is dead
# gain: 12.5                # optional, of counts: reading of one photon (default: from the noise of
                            # several air frames)
# electronic_noise: 2.0     # optional, of counts: standard deviation in photons
# photons: 20000            # optional, of line_integrals: of an unattenuated reading
# flux: flux.txt            # optional: intensity of the source in each view, relative to air or
                            # photons
# mu_water: 0.02            # optional: attenuation of water in 1/mm, for HU
# linearisation: [1.0, 0.02]  # optional: beam hardening, c1 p + c2 p^2 + …
geometry:
  kind: cone                # parallel, fan or cone; vectors and rtk:
                            # torchpcct/formats/geometry_yaml.py
  angles_deg: {start: 0, step: 0.5, count: 720}   # or a list, or a text file with one angle a line
  sod: 626                  # mm, source to rotation axis (not parallel)
  sdd: 1098                 # mm, source to detector (not parallel)
  columns: 888
  rows: 64                  # cone only; the slices of parallel and fan beams are not named
  pitch: [1.1, 1.0]         # mm, [row, column], or one number
  offset: [0, 0.25]         # mm, of the detector's middle; optional
  detector: flat            # or curved
"""
"""Description of a stack, for the command line's help and the documentation."""

_COUNTS = {
    "air",
    "dark",
    "dead",
    "flux",
    "gain",
    "electronic_noise",
    "linearisation",
    "mu_water",
    "exposure_s",
}
"""Fields of a description of counts."""
_LINES = {"photons", "flux", "dead", "linearisation", "mu_water", "exposure_s"}
"""Of line integrals."""
_FILES = {"air", "dark", "dead", "flux", "photons"}
"""Fields that may name a file."""


def _is_name(value: object) -> bool:
    """Whether a value is the name of a file, a pattern, or a list of names."""
    listed = (
        isinstance(value, list) and len(value) > 0 and all(isinstance(each, str) for each in value)
    )
    return listed or isinstance(value, str)


def _check_gaps(pattern: str, folder: Path) -> None:
    """Warn where a file is missing among views that are evenly spaced, it is said."""
    gap = gap_in_numbers(matching(pattern, folder))
    if gap:
        warnings.warn(
            f"the numbers of {pattern} have a gap between {gap}: if views were not measured or are "
            "lost there, all that follow would be at wrong angles; angles_deg as a list, or the "
            "name of a text file, gives each its own",
            UserWarning,
            stacklevel=3,
        )


def read_stack(
    path: str | os.PathLike[str],
    geometry: Geometry | None = None,
    slices: slice | None = None,
    **known: Any,
) -> Scan:
    """The scan that a YAML file describes; see :data:`EXAMPLE`.

    Args:
        path: YAML file.
        geometry: where the file has none; a :class:`~torchpcct.vector_geometry.VectorGeometry` also
            in place of the file's.
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
            raise ValueError(
                "it is not a mapping with readings, kind and geometry: torchpcct show-config "
                "--stack prints an example"
            )
        given = {**text, **known}
        kind = choice("kind", given.pop("kind", None), ("counts", "line_integrals"))
        described = given.pop("geometry", None)
        if geometry is None:
            geometry = geometry_of(described, folder)
        elif described is not None and not isinstance(geometry, VectorGeometry):
            raise ValueError(
                "it holds its geometry: leave out geometry, or give a VectorGeometry in its place"
            )
        name = given.pop("readings", None)
        if not _is_name(name):
            raise ValueError("readings must name a file, a pattern of files, or be a list of names")
        allowed = _COUNTS if kind == "counts" else _LINES
        unknown = sorted(map(str, set(given) - allowed))
        if unknown:
            raise ValueError(
                f"unknown in a scan of {kind}: {', '.join(unknown)}; it takes "
                f"{', '.join(sorted(allowed))}"
            )
        if kind == "counts" and "air" not in given:
            raise ValueError(
                "kind: counts needs air:, the readings without the object (a file or a number)"
            )
    options: dict[str, Any] = {
        k: read_array(v, folder) if k in _FILES and _is_name(v) else v for k, v in given.items()
    }
    if "dead" in options:
        options["dead"] = np.asarray(options["dead"]).astype(bool)
    evenly = isinstance(described, Mapping) and isinstance(described.get("angles_deg"), Mapping)
    if isinstance(name, str) and evenly:
        _check_gaps(name, folder)
    info: dict[str, object] = {"file": str(path), "format": "stack"}
    views, beam = geometry.views, geometry
    kept: list[int] = []

    def pick(shape: tuple[int, ...]) -> tuple[slice, ...]:
        axis = slice_axis(beam, shape)
        axis = 1 if shape[0] == views else axis  # images of a camera, view by view
        kept[:] = sliced(beam, slices, shape[axis])[1]  # type: ignore[arg-type]
        return tuple(slice(*kept[:2]) if k == axis else slice(None) for k in range(3))

    readings = read_array(name, folder, None if slices is None else pick)
    if kind == "counts":
        held: dict[str, Any] = {
            "readings": readings,
            **{k: options[k] for k in ("air", "dark") if k in options},
        }
        held = as_counted(held, str(path))
        readings = held.pop("readings")
        options |= held
    if not geometry.has_rows and readings.ndim == 3 and readings.shape[0] == geometry.views:
        readings = np.moveaxis(readings, 0, 1)
    if slices is not None:
        first, stop, count = info["slices"] = kept
        geometry = sliced(geometry, slices, count)[0]
        for key in _FILES & set(options):
            # One value a cell, (…, slices, columns), or one a reading of a stack, (slices, views,
            # columns).
            shape = np.shape(options[key])
            if len(shape) > 1 and shape[-2] == count:
                options[key] = options[key][..., first:stop, :]
            elif len(shape) == 3 and shape[0] == count:
                options[key] = options[key][first:stop]
    make = Scan.from_counts if kind == "counts" else Scan.from_line_integrals
    return make(readings, geometry, info=info, **options)
