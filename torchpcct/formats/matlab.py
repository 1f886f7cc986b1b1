"""Scans in MATLAB files (``.mat``): an array of numbers, of versions 4 to 7 by SciPy, of 7.3 by
HDF5."""

from __future__ import annotations

import os
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from torchpcct.formats.arrays import given_array, read_mat
from torchpcct.formats.integer_readings import as_counted
from torchpcct.geometry import Geometry
from torchpcct.scan import Scan

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from torchpcct.typing import Array


__all__ = ["read_mat_scan"]


def read_mat_scan(
    path: str | os.PathLike[str],
    geometry: Geometry,
    *,
    variable: str | None = None,
    air: ArrayLike | str | os.PathLike[str] | None = None,
    dark: ArrayLike | str | os.PathLike[str] | None = None,
    **options: Any,
) -> Scan:
    """A scan of a MATLAB array: line integrals or, with ``air``, readings.

    The array's axes may stand in the geometry's order (views, [rows,] columns) or turned over, as
    in a sinogram of (columns, views); its shape tells.

    Args:
        path: file.
        geometry: of the scan.
        variable: of :func:`read_mat`.
        air: readings without the object, one number or an array of the geometry's order; None: the
            array holds line integrals, −ln of the transmission.
        dark: readings without beam, as ``air``.
        options: of :meth:`torchpcct.Scan.from_line_integrals` or
            :meth:`~torchpcct.Scan.from_counts`.

    Raises:
        ValueError: damaged, several arrays, a shape that is not the geometry's, or that is it both
            ways.
    """
    values, air, dark = read_mat(path, variable), given_array(air), given_array(dark)
    info = {"file": str(path), "format": "MATLAB"}
    if air is None:
        if dark is not None:
            raise ValueError("dark= belongs to readings: give air=, too")
        return Scan.from_line_integrals(
            _in_order(values, geometry, path), geometry, info=info, **options
        )
    held = as_counted(
        {
            "readings": _in_order(values, geometry, path),
            "air": air,
            "dark": 0.0 if dark is None else dark,
        },
        str(path),
    )
    readings = held.pop("readings")
    return Scan.from_counts(readings, geometry, info=info, **held, **options)


def _in_order(values: Array, geometry: Geometry, path: str | os.PathLike[str]) -> Array:
    """Readings with the geometry's axes last: as they are, turned over, or with the last axis
    first."""
    shape = geometry.shape
    orders = [
        ("as it stands", values),
        ("turned over", values.T),
        ("the last axis first", np.moveaxis(values, -1, 0)),
    ]
    orders = orders[: values.ndim]  # of two axes the last ways are one
    fits = [
        (how, a)
        for how, a in orders
        if a.shape[-len(shape) :] == shape and a.ndim <= len(shape) + 1
    ]
    if not fits:
        raise ValueError(
            f"{path}: its array of {values.shape} is not the geometry's {shape}, turned over or not"
        )
    if len(fits) > 1:
        ways = ", or ".join(how for how, _ in fits)
        warnings.warn(
            f"{path}: an array of {values.shape} fits the geometry {shape} in several ways "
            f"({ways}): it is taken {fits[0][0]}; give its transpose, if that is wrong",
            UserWarning,
            stacklevel=3,
        )
    return fits[0][1]
