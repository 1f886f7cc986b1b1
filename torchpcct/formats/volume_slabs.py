"""Volumes that are written slab by slab along z, larger than memory: NIfTI (``.nii``) and OME-Zarr
(``.zarr``).

An unfinished volume lies in the same folder, with ``.unfinished`` behind its name, and a journal of
what it holds already (``.unfinished.json``). Nothing takes the name that was asked for before the
last slab is on the disk.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
import re
import shutil
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchpcct.files import WriteError, atomic_write, require_folder
from torchpcct.formats.damage import check_expansion, needed, reading
from torchpcct.formats.lengths import MM, unit_text
from torchpcct.formats.volume_files import nifti_header
from torchpcct.geometry import VolumeGrid
from torchpcct.validate import UNITS

if TYPE_CHECKING:
    from types import EllipsisType

    import zarr
    from numpy.typing import ArrayLike

    from torchpcct.typing import Floats, Floats32, JsonObject, Reals


SLAB_ENDINGS = (".nii", ".zarr")
"""Endings of files that are written slab by slab."""
CHUNK = 32
"""Most slices of a Zarr chunk: slabs hold whole chunks, so that none is written twice."""
_CHUNK_PLANE = 256
"""Edge of a Zarr chunk in a slice, voxels."""


def check_slab_name(path: str | os.PathLike[str]) -> None:
    """Raise ``ValueError`` unless the ending of ``path`` names a format that is written slab by
    slab."""
    if not str(path).lower().endswith(SLAB_ENDINGS):
        raise ValueError(
            f"{Path(path).name!r} cannot be written slab by slab: use .nii or .zarr (OME-Zarr); "
            ".nii.gz, .mha, .h5 and DICOM hold what fits into memory"
        )


class SlabFile:
    """A volume on the disk that grows slab by slab, and goes on where an earlier process was
    stopped.

    Args:
        path: ``.nii`` or ``.zarr``.
        grid: ``(z, y, x)`` of the whole volume.
        unit: of its values.
        key: text that names all that the voxels depend on: what an earlier process wrote under
            another key is begun anew.
        chunk: slices of a chunk of Zarr.

    Attributes:
        store: whether it is an OME-Zarr.
        done: slices, from the lowest, that are on the disk.
        notes: JSON values that are kept with them.

    Raises:
        ValueError: another ending.
        FileExistsError: a folder of that name that holds anything else than such a volume, or files
            of others that have the names of an unfinished one.
        FileNotFoundError: the folder does not exist.
        WriteError: the system refuses to write.
        ImportError: ``zarr`` is not installed.
    """

    def __init__(
        self, path: str | os.PathLike[str], grid: VolumeGrid, unit: str, key: str, chunk: int
    ) -> None:
        check_slab_name(path)
        require_folder(path)
        self.path, self.grid, self.unit, self.key = Path(path), grid, unit, key
        self.part = self.path.with_name(self.path.name + ".unfinished")
        self.journal = self.part.with_name(self.part.name + ".json")
        kept = self._kept()
        for there in (self.part, self.journal):
            if not kept and (there.exists() or there.is_symlink()):
                raise FileExistsError(
                    f"{there} exists and is not an unfinished volume of torchpcct: move it, or "
                    f"name another file than {path}"
                )
        _require_own(self.path)
        self.store = self.path.suffix.lower() == ".zarr"
        resumed = self.part.exists() and kept.get("key") == key
        self.done: int = kept["done"] if resumed else 0
        self.notes: JsonObject = kept["notes"] if resumed else {}
        if not resumed:
            with self._writing():
                self.discard()
                # before anything else, so that whatever is left says whose it is
                self._note(begun=False)
                if self.store:
                    _create(self.part, grid, unit, chunk)
                else:
                    self.part.write_bytes(_nifti_header(grid, unit))
                self._note()

    def write(self, data: ArrayLike) -> None:
        """Put the next slices on the disk, float32 ``(slices, y, x)``."""
        values, first = np.ascontiguousarray(data, dtype="<f4"), self.done
        with self._writing():
            if self.store:
                _fill(
                    needed("zarr").open_group(self.part, mode="r+"),
                    slice(first, first + len(values)),
                    values,
                )
                if hasattr(os, "sync"):
                    os.sync()
            else:
                # Not by a memory map, which a full disk ends with a signal instead of an error.
                with self.part.open("r+b") as file:
                    file.seek(
                        len(_nifti_header(self.grid, self.unit))
                        + 4 * first * int(np.prod(self.grid.shape[1:]))
                    )
                    file.write(values.data)
                    file.flush()
                    os.fsync(file.fileno())
            self.done += len(values)
            self._note()

    def finish(self, report: Mapping[str, object]) -> None:
        """Give the volume its name; an OME-Zarr keeps the report. What had the name before is
        gone then."""
        with self._writing():
            if self.store:
                group = needed("zarr").open_group(self.part, mode="r+")
                text = json.dumps(dict(report), default=str)
                group.attrs["torchpcct"] = _about(self.unit, json.loads(text))
                _seal(self.part)
            _remove_ome_zarr(self.path)
            os.replace(self.part, self.path)
            self.journal.unlink(missing_ok=True)

    def _kept(self) -> JsonObject:
        """What the journal says; empty if there is none, or that is a file of somebody else."""
        try:
            kept = json.loads(self.journal.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        ours = isinstance(kept, dict) and {"key", "done", "notes"} <= kept.keys()
        return kept if ours and not self.part.is_symlink() else {}

    def _note(self, begun: bool = True) -> None:
        kept = {"key": self.key if begun else "", "done": self.done, "notes": self.notes}
        with atomic_write(self.journal) as part:
            part.write_text(json.dumps(kept))

    def discard(self) -> None:
        """Take back what has been begun."""
        if self.part.is_dir():
            shutil.rmtree(self.part)
        self.part.unlink(missing_ok=True)
        self.journal.unlink(missing_ok=True)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            why = os.strerror(error.errno) if error.errno else str(error)
            kept = (
                f"; its slabs up to now are kept in {self.part.name}, the same call goes on with "
                "them"
                if self.done
                else ""
            )
            raise WriteError(f"cannot write {self.path}: {why}{kept}") from error


def _nifti_header(grid: VolumeGrid, unit: str) -> bytes:
    """What stands before the voxels, as :func:`torchpcct.formats.volume_files.write_nifti`
    writes it."""
    return bytes(nifti_header(grid, unit).binaryblock) + bytes(4)


def _create(path: Path, grid: VolumeGrid, unit: str, chunk: int) -> zarr.Group:
    """An empty OME-Zarr 0.5 (https://ngff.openmicroscopy.org/0.5): one resolution, axes z, y, x."""
    zarr = needed("zarr")
    length = {} if unit == "pixel^-1" else {"unit": "millimeter"}
    transforms = [
        {"type": "scale", "scale": list(grid.spacing)},
        {"type": "translation", "translation": [float(axis[0]) for axis in grid.axes]},
    ]
    image = {
        "axes": [{"name": name, "type": "space", **length} for name in "zyx"],
        "datasets": [{"path": "0", "coordinateTransformations": transforms}],
    }
    attributes = {"ome": {"version": "0.5", "multiscales": [image]}, "torchpcct": _about(unit)}
    group = zarr.create_group(path, zarr_format=3, attributes=attributes)
    chunks = (min(chunk, grid.shape[0]), *(min(n, _CHUNK_PLANE) for n in grid.shape[1:]))
    group.create_array(
        "0",
        shape=grid.shape,
        chunks=chunks,
        dtype="float32",
        dimension_names=("z", "y", "x"),
        fill_value=float("nan"),
        compressors=[zarr.codecs.ZstdCodec(), zarr.codecs.Crc32cCodec()],
    )
    return group


def _fill(group: Any, at: EllipsisType | slice, values: Reals) -> None:
    """Write voxels, every chunk of them: one that is not there is lost."""
    group["0"].with_config({"write_empty_chunks": True})[at] = values


def _about(unit: str, report: object = None) -> dict[str, object]:
    """What stands in the attributes beside the format's own; the digest is written by
    :func:`_seal`."""
    return {
        "unit": unit,
        **({} if report is None else {"report": report}),
        "metadata": _DIGEST.format("0" * 64),
    }


_DIGEST = "torchpcct-sha256:{}"
"""Checksum of a volume's metadata as it stands in them."""
_DIGESTS = re.compile(rb"torchpcct-sha256:([0-9a-f]{64})")
"""The same, to find it."""


def _metadata_digest(path: Path) -> tuple[bytes, list[bytes]]:
    """SHA-256 of what describes the voxels, with zeros in the place of the digests in it, and
    those."""
    parts = [(path / "zarr.json").read_bytes(), (path / "0" / "zarr.json").read_bytes()]
    clean = _DIGESTS.sub(b"torchpcct-sha256:" + b"0" * 64, parts[0])
    return hashlib.sha256(clean + b"\0" + parts[1]).hexdigest().encode(), _DIGESTS.findall(parts[0])


def _seal(path: Path) -> None:
    """Write the digest of the metadata into them; voxels have checksums of their own, one a
    chunk."""
    digest, _ = _metadata_digest(path)
    file = path / "zarr.json"
    file.write_bytes(_DIGESTS.sub(b"torchpcct-sha256:" + digest, file.read_bytes()))


def _check_sealed(path: Path) -> None:
    """Raise ``ValueError`` if the metadata of a volume of ours are not what they were when it was
    written.

    Earlier versions wrote no digest, and no checksums of chunks.
    """
    names = [path / "zarr.json", path / "0" / "zarr.json"]
    if not all(name.is_file() for name in names):
        return
    about, array = (name.read_bytes() for name in names)
    digest, written = _metadata_digest(path)
    if written and written != [digest]:
        raise ValueError(
            "its zarr.json is damaged: it does not have the checksum that it was written with"
        )
    for name, content in zip(("zarr.json", "0/zarr.json"), (about, array), strict=True):
        try:
            json.loads(content)
        except ValueError as error:
            raise ValueError(f"its {name} is damaged: {error}") from error
    if not written and b"torchpcct" in about and b"crc32c" in array:
        raise ValueError(
            "its zarr.json is damaged: the checksum that it was written with is not there"
        )


def write_ome_zarr(
    path: str | os.PathLike[str], data: ArrayLike, grid: VolumeGrid, unit: str
) -> None:
    """Write a whole volume ``(z, y, x)`` as OME-Zarr 0.5: a folder, float32, mm.

    Raises:
        FileExistsError: a folder of that name holds anything else than such a volume.
    """
    _require_own(path)
    with atomic_write(path) as part:
        _fill(_create(part, grid, unit, CHUNK), ..., np.asarray(data, dtype=np.float32))
        _seal(part)
        _remove_ome_zarr(Path(path))


_OWN_FILES = re.compile(r"zarr\.json|0/zarr\.json|0/c(/\d+)+")
"""Files of an OME-Zarr volume as this module writes them."""


def _require_own(path: str | os.PathLike[str]) -> None:
    """Raise ``FileExistsError`` for a folder that a volume of this name would replace, and that
    holds anything else than an OME-Zarr as it is written here."""
    folder = Path(path)
    if not folder.is_dir():
        return
    if folder.is_symlink():
        raise FileExistsError(
            f"{folder} is a link to a folder: name another file, or remove the link"
        )
    files = {
        file.relative_to(folder).as_posix()
        for file in folder.rglob("*")
        if file.is_symlink() or not file.is_dir()
    }
    foreign = sorted(name for name in files if not _OWN_FILES.fullmatch(name))
    if files and not foreign:
        try:
            attributes = json.loads((folder / "zarr.json").read_text(encoding="utf-8"))[
                "attributes"
            ]
            foreign = [] if "torchpcct" in attributes else ["zarr.json"]
        except (OSError, ValueError, TypeError, KeyError):
            foreign = ["zarr.json"]
    if foreign:
        raise FileExistsError(
            f"{folder} is a folder that holds {foreign[0]}, which torchpcct did not write there: "
            "name another file, or move the folder"
        )


def _remove_ome_zarr(folder: Path) -> None:
    """Make room for another volume of the name."""
    _require_own(folder)
    if folder.is_dir():
        shutil.rmtree(folder)


def read_ome_zarr(
    path: str | os.PathLike[str], unit: str | None = None
) -> tuple[Floats32, VolumeGrid, str]:
    """Data ``(z, y, x)`` float32, grid in mm and unit of the first resolution of an OME-Zarr 0.4 or
    0.5.

    Axes of time and channel of one are left out.

    Args:
        path: folder.
        unit: of the numbers of other software's files; None: HU.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: a damaged or lost part, which is named; other axes than z, y, x, an unknown unit
            of length.
        ImportError: ``zarr`` is not installed.
    """
    zarr = needed("zarr")
    with reading(path, "an OME-Zarr"):
        _check_sealed(Path(path))
        group = zarr.open_group(path, mode="r")
        about = dict(group.attrs)
        image = about.get("ome", about)["multiscales"][0]
        array = group[image["datasets"][0]["path"]]
        names = [str(axis["name"] if isinstance(axis, dict) else axis) for axis in image["axes"]]
        leading = len(names) - 3
        if [n.lower() for n in names[leading:]] != ["z", "y", "x"] or any(
            n != 1 for n in array.shape[:leading]
        ):
            raise ValueError(
                f"its axes are {', '.join(names)} of {array.shape}, expected one volume of z, y, x:"
                " write it with its axes in that order, and each channel and time by itself"
            )
        own = about.get("torchpcct")
        units = [_unit_of(axis) for axis in image["axes"][leading:]]
        if own is None and not all(units):
            warnings.warn(
                f"{path} gives its lengths no unit: they are taken for millimetres; put the unit "
                "into its axes",
                UserWarning,
                stacklevel=2,
            )
        lengths = [MM[unit or "mm"] for unit in units]
        check_expansion(array.shape, "the volume", array.nbytes_stored)
        spacing, first = _placed(image, leading)
        spacing, first = spacing * lengths, first * lengths
        shape = tuple(array.shape[leading:])
        center = first + spacing * (np.array(shape) - 1) / 2
        stored = None if own is None else own.get("unit", "HU")
        if stored is not None and stored not in UNITS:
            raise ValueError(f"it gives the unit {stored!r}, expected {' or '.join(UNITS)}")
        if stored is not None and unit not in (None, stored):
            raise ValueError(f"it gives the unit {stored!r}, not {unit!r}")
        grid = VolumeGrid(shape, tuple(map(float, spacing)), tuple(map(float, center)))
        data = _chunk_by_chunk(array, Path(path) / image["datasets"][0]["path"], own is not None)
        return data.reshape(shape), grid, stored or unit or "HU"


def _unit_of(axis: object) -> str:
    """Unit of length of an axis of an OME-Zarr, in small letters; empty: it has none.

    Raises:
        ValueError: no known unit.
    """
    given = axis.get("unit") if isinstance(axis, dict) else None
    unit = "" if given is None else unit_text(np.array(given))
    if unit and unit not in MM:
        raise ValueError(
            f"its lengths are in the unknown unit {unit!r}: write them in millimeter, "
            "micrometer or another power of ten of a meter"
        )
    return unit


def _placed(image: Mapping[str, Any], leading: int) -> tuple[Floats, Floats]:
    """Spacing and place of the first voxel of an OME-Zarr in its own units, ``(3,)`` of z, y, x.

    Args:
        image: one of its multiscales.
        leading: axes before z.

    Raises:
        ValueError: no scale, one of another number of axes, or what is none of scale and
            translation.
    """
    spacing, first, scaled = np.ones(3), np.zeros(3), False
    for transforms in (image["datasets"][0], image):  # of the resolution, then of all
        for step in transforms.get("coordinateTransformations", []):
            kind = step["type"]
            if kind == "identity":
                continue
            if kind not in ("scale", "translation"):
                raise ValueError(
                    f"its coordinateTransformations hold an operation {kind!r}: resample it to "
                    "straight axes, which a scale and a translation place"
                )
            if kind not in step:
                raise ValueError(f"its {kind} lies in another file: write its numbers beside it")
            values = np.array(step[kind], dtype=np.float64)
            if values.size != 3 + leading:
                raise ValueError(
                    f"its {kind} has {values.size} numbers, of {3 + leading} axes: one for each"
                )
            values = values[leading:]
            if kind == "scale":
                spacing, first, scaled = spacing * values, first * values, True
            else:
                first = first + values
    if not scaled:
        raise ValueError(
            "its coordinateTransformations have no scale, the size of a voxel: write it there"
        )
    return spacing, first


def _chunk_by_chunk(array: zarr.Array, folder: Path, whole: bool) -> Floats32:
    """All numbers of a Zarr array, float32; a part that cannot be read is named.

    Args:
        array: Zarr array.
        folder: that it lies in.
        whole: whether every chunk was written. Else those of nothing but the fill value may not be
            there.
    """
    data = np.empty(array.shape, dtype=np.float32)
    counts = [math.ceil(n / c) for n, c in zip(array.shape, array.chunks, strict=True)]
    for place in itertools.product(*map(range, counts)):
        name = array.metadata.encode_chunk_key(place)
        if whole and not (folder / name).is_file():
            raise ValueError(f"its chunk {folder.name}/{name} is lost")
        at = tuple(slice(k * c, (k + 1) * c) for k, c in zip(place, array.chunks, strict=True))
        try:
            data[at] = array[at]
        except Exception as error:
            raise ValueError(f"its chunk {folder.name}/{name} is damaged: {error}") from error
    return data
