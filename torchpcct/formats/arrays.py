"""Arrays of numbers in NumPy, Zarr, TIFF and MATLAB files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from torchpcct.formats.damage import check_expansion, check_size, needed, reading
from torchpcct.formats.file_names import matching
from torchpcct.hdf5 import inside
from torchpcct.validate import choice

if TYPE_CHECKING:
    from collections.abc import Callable

    from torchpcct.typing import Array


_HDF5_AT = 512
"""Where the HDF5 of a MATLAB file of version 7.3 begins."""
_OF_NUMBERS = (
    "double",
    "single",
    "int8",
    "uint8",
    "int16",
    "uint16",
    "int32",
    "uint32",
    "int64",
    "uint64",
)
"""MATLAB's classes of numbers."""


Pick: TypeAlias = "Callable[[tuple[int, ...]], tuple[slice, ...]]"
"""From an array's shape to the index of what is read, one slice an axis."""


def read_array(name: str | Sequence[str], folder: Path = Path(), pick: Pick | None = None) -> Array:
    """Numbers of ``.npy``, Zarr, TIFF or MATLAB files: one file, or several that are stacked.

    Args:
        name: of the file; a pattern, whose files come in the order of the numbers in their names
            (:func:`torchpcct.formats.file_names.matching`); or a list of names, in its order.
        folder: that the name starts from.
        pick: function of the array's shape that returns the index, one slice an axis, of what to
            read; None: all.

    Raises:
        FileNotFoundError: no file. ValueError: damaged, an unknown ending, files of several shapes.
    """
    paths = matching(name, folder) if isinstance(name, str) else [folder / each for each in name]
    if len(paths) == 1:
        return _read_file(paths[0], pick)
    at = (slice(None),) if pick is None else pick((len(paths), *_read_file(paths[0]).shape))
    arrays = [
        _read_file(path) if pick is None else _read_file(path, lambda shape: at[1:])
        for path in paths[at[0]]
    ]
    shapes = {a.shape for a in arrays}
    if len(shapes) > 1:
        raise ValueError(f"the files of {name} have several shapes: {sorted(shapes)}")
    return np.stack(arrays)


def _read_file(path: Path, pick: Pick | None = None) -> Array:
    """The numbers of a file; with ``pick``, a function of the number of axes and the first length,
    no more of them than the index that it returns."""
    ending = path.suffix.lower()
    if ending == ".npy":
        with reading(path, "a NumPy array"):
            # A map of the file fails where its header promises more than there is.
            values = np.load(path, mmap_mode="r", allow_pickle=False)
            return np.array(values if pick is None else values[pick(values.shape)])
    if ending == ".mat":
        values = read_mat(path)
        return values if pick is None else values[pick(values.shape)]
    if ending == ".zarr":
        zarr = needed("zarr")
        with reading(path, "a Zarr array"):
            values = zarr.open_array(path, mode="r")
            check_size(values.shape, "the array")
            at = tuple(slice(None) for _ in values.shape) if pick is None else pick(values.shape)
            read = [len(range(*part.indices(n))) for part, n in zip(at, values.shape, strict=True)]
            check_expansion(read, "the array", values.nbytes_stored, values.dtype.itemsize)
            return values[at]
    if ending in (".tif", ".tiff"):
        return _tiff(path, pick)
    raise ValueError(f"{path.name}: readings must be .npy, .zarr, .tif, .tiff or .mat")


def _tiff(path: Path, pick: Pick | None) -> Array:
    tifffile = needed("tifffile")
    with reading(path, "a TIFF image"), tifffile.TiffFile(path) as file:
        # A page that is cut off reads as zeros in some readers: sizes are checked before.
        size = path.stat().st_size
        for page in file.pages:
            ends = [o + n for o, n in zip(page.dataoffsets, page.databytecounts, strict=True)]
            if not ends or max(ends) > size:
                raise ValueError("it ends before its last image")
            if page.compression == 1 and sum(page.databytecounts) < page.nbytes:
                raise ValueError(
                    f"it holds {sum(page.databytecounts)} bytes of an image of {page.nbytes}"
                )
        if len(file.series) > 1:
            shapes = ", ".join(str(series.shape) for series in file.series[:4])
            raise ValueError(
                f"it holds images of several kinds, {shapes}: keep those of the scan in their own "
                "file"
            )
        shape, each = file.series[0].shape, file.series[0].dtype.itemsize
        check_size(shape, "the image")
        if pick is None or len(shape) < 3 or len(file.pages) != shape[0]:
            check_expansion(shape, "the image", size, each)
            return file.asarray() if pick is None else file.asarray()[pick(shape)]
        check_expansion(shape[1:], "the image", size, each)
        at = pick(shape)
        return np.stack([file.pages[int(k)].asarray()[at[1:]] for k in np.arange(shape[0])[at[0]]])


def given_array(given: object) -> Any:
    """A number or an array as it is, or that of the file or pattern that is named
    (:func:`read_array`)."""
    return read_array(os.fspath(given)) if isinstance(given, str | os.PathLike) else given


def read_mat(path: str | os.PathLike[str], variable: str | None = None) -> Array:
    """An array of a MATLAB file, its axes in MATLAB's order.

    Args:
        path: file.
        variable: its name; None: the only array of more than one column and row.

    Raises:
        FileNotFoundError: no such file.
        ValueError: damaged, no such variable, several arrays and no name, something else than real
            numbers.
    """
    with reading(path, "a MATLAB file"):
        with open(path, "rb") as file:
            file.seek(_HDF5_AT)
            new = file.read(8) == b"\x89HDF\r\n\x1a\n"
        values = _new(path, variable) if new else _old(path, variable)
        if values.dtype.kind not in "iuf":
            raise ValueError(f"its variable holds {values.dtype}, no real numbers")
        return values


def _picked(found: dict[str, tuple[int, ...]], variable: str | None) -> str:
    """Name of the variable to read, of those that hold numbers."""
    if variable is not None:
        return choice("variable", variable, tuple(found))
    arrays = [name for name, shape in found.items() if sum(n > 1 for n in shape) > 1]
    if not found:
        raise ValueError(
            "it holds no array of numbers of its own: structures, cells, sparse and logical arrays "
            "are not read; save the array itself, as double, single or an integer type"
        )
    if len(arrays) != 1:
        listed = ", ".join(f"{name} {shape}" for name, shape in found.items())
        how = (
            f"arrays: give variable=, one of {listed:.300}"
            if arrays
            else f"arrays of more than one row and column, only {listed:.300}: save the readings "
            "with an axis of views and one of columns, or give variable= if they are of one view"
        )
        raise ValueError(f"it holds {len(arrays)} {how}")
    return arrays[0]


def _old(path: str | os.PathLike[str], variable: str | None) -> Array:
    from scipy.io import loadmat, whosmat

    held = {name: shape for name, shape, kind in whosmat(path) if kind in _OF_NUMBERS}
    name = _picked(held, variable)
    check_expansion(held[name], f"the variable {name}", Path(path).stat().st_size, 8)
    return loadmat(path, variable_names=[name])[name]


def _new(path: str | os.PathLike[str], variable: str | None) -> Array:
    import h5py

    with h5py.File(path, "r") as file:
        held = {}
        for name in file:
            data = inside(file, name)
            if isinstance(data, h5py.Dataset) and data.dtype.kind in "iuf" and data.ndim:
                held[name] = data.shape[::-1]
        data = file[_picked(held, variable)]
        check_expansion(
            data.shape,
            f"the variable {data.name[1:]}",
            data.id.get_storage_size,
            data.dtype.itemsize,
        )
        return np.asarray(data[()]).T  # MATLAB counts the first axis fastest
