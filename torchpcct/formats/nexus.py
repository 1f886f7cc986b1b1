"""NeXus files of tomography, NXtomo
(https://manual.nexusformat.org/classes/applications/NXtomo.html).

One data set of all frames, of which ``image_key`` says what each is: 0 projection, 1 flat, 2 dark
field, 3 invalid.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from torchpcct.formats.damage import check_expansion, check_size, reading
from torchpcct.formats.data_exchange import Frames, angles_in, given_frames, length_in
from torchpcct.formats.geometry_yaml import angles_of
from torchpcct.formats.lengths import MM, unit_text
from torchpcct.hdf5 import inside
from torchpcct.scan import Scan
from torchpcct.validate import choice

if TYPE_CHECKING:
    import h5py
    from numpy.typing import ArrayLike

    from torchpcct.typing import Bools, CountsOptions, Floats, Ints


__all__ = ["read_nexus"]

_PROJECTION = 0
"""NXtomo's image key of a projection."""
_FLAT = 1
"""Of an image of the open beam."""
_DARK = 2
"""Of an image without beam."""
_INVALID = 3
"""Of an image that is not to be used."""
_ALIGNMENT = -1
"""In ``image_key_control``, which the ESRF's files have beside the key (package nxtomo): of an
image taken after the scan to see whether the object has moved. NXtomo's key calls it a
projection."""
_DEEPEST = 5
"""Groups between the file and its detector."""
_SAME_TIME = 1e-3
"""Relative difference of exposures that are the same."""
_CURRENT = ("a", "ma", "ampere", "milliampere")
"""Units of a ring's current, which is no sum over an exposure."""
_MOST_FLUX = 2.0
"""Factor by which a monitor may change between frames: beyond it, it has measured something else
than the beam, or the beam was lost."""


def _detectors(group: h5py.Group, depth: int = 0) -> Iterator[h5py.Group]:
    """Groups of the file itself that hold ``data`` and ``image_key``."""
    import h5py

    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        found = group[name]
        if isinstance(found, h5py.Group):
            if all(_is_array(found, each) for each in ("image_key", "data")):
                yield found
            elif depth < _DEEPEST:
                yield from _detectors(found, depth + 1)


def _is_array(group: h5py.Group, name: str) -> bool:
    """Whether a group has something by a name that is a data set, or a link, which is not
    followed."""
    import h5py

    link = group.get(name, getlink=True)
    return link is not None and not (
        isinstance(link, h5py.HardLink) and isinstance(group[name], h5py.Group)
    )


def holds_nexus(file: h5py.File) -> bool:
    """Whether an open HDF5 file says that it is NeXus, or holds frames with an image key."""
    classes = [
        unit_text(file[name].attrs["NX_class"])
        for name in file
        if _own_group(file, name) and "NX_class" in file[name].attrs
    ]
    return "nxentry" in classes or next(_detectors(file), None) is not None


def _is_detector(group: h5py.Group) -> bool:
    """Whether a group is where the frames are at home, and no view of them for plotting
    (NXdata)."""
    return unit_text(group.attrs.get("NX_class", "")) == "nxdetector"


def _own_group(file: h5py.Group, name: str) -> bool:
    import h5py

    return isinstance(file.get(name, getlink=True), h5py.HardLink) and isinstance(
        file[name], h5py.Group
    )


def read_nexus(
    path: str | os.PathLike[str],
    *,
    entry: str | None = None,
    pitch: float | None = None,
    slices: slice | None = None,
    angles_deg: object = None,
    air: ArrayLike | str | os.PathLike[str] | None = None,
    dark: ArrayLike | str | os.PathLike[str] | None = None,
    mu_water: float | None = None,
    **options: Unpack[CountsOptions],
) -> Scan:
    """A parallel-beam scan of an NXtomo file, the mean of its flat and of its dark frames as air
    and dark.

    Flats that were taken with another ``count_time`` than the projections count by the ratio. What
    a monitor of the beam read during each frame (``control/data``: counts, or the ring's current)
    is the flux of the views relative to the flats.

    Args:
        path: HDF5 file.
        entry: name of the NXentry, of a file that holds several scans.
        pitch: cell width in mm; None: the detector's ``x_pixel_size``. If the file knows none,
            lengths are in pixels.
        slices: rows to read; None: all.
        angles_deg, air, dark: of :func:`torchpcct.formats.data_exchange.read_data_exchange`, in the
            place of the file's; ``angles_deg`` of the projections alone.
        mu_water, options: of :meth:`torchpcct.Scan.from_counts`.

    Returns:
        Scan with counts ``(slices, views, columns)``, the rotation axis in the detector's middle.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no NXtomo, damaged, several scans and no ``entry``, one that keeps data in other
            files; a key that NXtomo does not know, no flats, angles in an unknown unit.
    """
    import h5py

    with reading(path, "a NeXus tomography"), h5py.File(path, "r") as file:
        detector = _detector(file, entry)
        data, key = inside(file, f"{detector}/data"), _keys(file, detector)
        check_size(data.shape, data.name)
        if data.ndim != 3 or key.size != data.shape[0]:
            raise ValueError(
                f"{data.name} has the shape {data.shape}, expected (frames, rows, columns) of "
                f"{key.size} keys"
            )
        rows = slice(None) if slices is None else slices
        views = np.flatnonzero(key == _PROJECTION)
        if not views.size:
            raise ValueError(f"{detector}/image_key names no projections (0)")
        held = {
            "air": _taken(data, key == _FLAT, rows)
            if air is None
            else given_frames(air, data.shape, rows),
            "dark": _taken(data, key == _DARK, rows)
            if dark is None
            else given_frames(dark, data.shape, rows),
        }
        if held["air"] is None:
            raise ValueError(
                f"{detector}/image_key names no flat fields (1): give air=, the reading without "
                "the object"
            )
        black = 0.0 if held["dark"] is None else held["dark"]
        white = (
            held["air"] if air is not None else _as_long(file, detector, key, held["air"], black)
        )
        size = inside(file, f"{detector}/x_pixel_size")
        source = "the file does not know its pixel size"
        if pitch is not None:
            source = f"given, {pitch} mm"
        elif size is not None:
            pitch, source = length_in(size)
        if options.get("flux") is None:
            options["flux"] = _flux(file, detector, key)
        _check_at_rest(file, detector, key, pitch)
        part = None if slices is None else [*slices.indices(data.shape[1])[:2], data.shape[1]]
        return Frames(
            str(path),
            "NeXus",
            _taken(data, key == _PROJECTION, rows),
            white,
            black,
            _angles(file, detector, key, angles_deg),
            pitch,
            source,
            part,
        ).scan(mu_water, **options)


def _detector(file: h5py.File, entry: str | None) -> str:
    """Path of the detector's group."""
    import h5py

    found: dict[str, str] = {}
    for name in file:
        if _own_group(file, name):
            groups = sorted(_detectors(file[name]), key=lambda group: not _is_detector(group))
            if groups:
                found[name] = groups[0].name
        elif isinstance(file.get(name, getlink=True), h5py.ExternalLink):
            inside(file, name)  # says so
    if not found:
        raise ValueError("it has no detector with data and image_key (NXtomo)")
    if entry is not None:
        return str(found[choice("entry", entry, tuple(found))])
    if len(found) > 1:
        raise ValueError(f"it holds {len(found)} scans: give entry=, one of {', '.join(found)}")
    return str(next(iter(found.values())))


def _keys(file: h5py.File, detector: str) -> Ints:
    """What each frame is; images of alignment are not to be used."""
    name = f"{detector}/image_key"
    given = np.ravel(np.asarray(inside(file, name)[()]))
    known = (_PROJECTION, _FLAT, _DARK, _INVALID)
    wrong = given[~np.isin(given, known)]
    if wrong.size:
        raise ValueError(
            f"{name} holds {wrong[0].item()!r}, of frame "
            f"{int(np.flatnonzero(~np.isin(given, known))[0])}: NXtomo knows 0 (projection), 1 "
            "(flat), 2 (dark) and 3 (invalid); mark frames that are not to be used by 3"
        )
    key = given.astype(np.int64)
    control = inside(file, f"{name}_control")
    if control is not None and control.size == key.size:
        key[np.ravel(control[()]) == _ALIGNMENT] = _INVALID
    return key


def _taken(data: h5py.Dataset, which: Bools, rows: slice) -> Any:
    """Some rows of the frames that are marked, in runs of neighbours; None: there are none."""
    at = np.flatnonzero(which)
    if not at.size:
        return None
    height = max(1, len(range(*rows.indices(data.shape[1]))))
    check_expansion(
        (at.size, height, data.shape[2]), data.name, data.id.get_storage_size, data.dtype.itemsize
    )
    runs = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
    return np.concatenate([data[run[0] : run[-1] + 1, rows] for run in runs])


def _times(file: h5py.File, detector: str, key: Ints) -> tuple[float, float] | None:
    """Exposures of projections and of flats, None where the file does not know both."""
    given = inside(file, f"{detector}/count_time")
    times = np.zeros(0) if given is None else np.ravel(given[()]).astype(np.float64)
    if times.size != key.size or not (key == _FLAT).any():
        return None
    view, flat = (float(np.median(times[key == kind])) for kind in (_PROJECTION, _FLAT))
    return (view, flat) if view > 0 and flat > 0 else None


def _as_long(file: h5py.File, detector: str, key: Ints, white: Any, black: Any) -> Any:
    """Flat frames as they would read if they had been exposed as long as the projections."""
    times = _times(file, detector, key)
    if times is None or abs(times[0] / times[1] - 1) < _SAME_TIME:
        return white
    below = black if np.ndim(black) < 3 else np.mean(black, axis=0)
    return below + (white.mean(0) - below) * (times[0] / times[1])


def _flux(file: h5py.File, detector: str, key: Ints) -> Floats | None:
    """Intensity of the beam in each projection relative to the flats, or to the mean of the
    projections where there are none; None: no monitor has measured it."""
    data = _held(file, detector, "control/data")
    if data is None or data.size != key.size or data.dtype.kind not in "iuf":
        return None
    read = np.ravel(data[()]).astype(np.float64)
    used = read[(key == _PROJECTION) | (key == _FLAT)]
    if not used.any():
        return None  # no monitor was there
    where = f"{data.name} (the beam's monitor)"
    if not (np.isfinite(used).all() and (used > 0).all() and used.max() < _MOST_FLUX * used.min()):
        _leave_out(f"{where} changes from {used.min():g} to {used.max():g}, give flux= for it")
        return None
    times = _times(file, detector, key)
    current = unit_text(data.attrs.get("units", "")) in _CURRENT
    if not current and times is not None and abs(times[0] / times[1] - 1) >= _SAME_TIME:
        _leave_out(f"{where} may hold sums over exposures, which differ, give flux= for it")
        return None
    flats = read[key == _FLAT]
    return read[key == _PROJECTION] / (flats if flats.size else read[key == _PROJECTION]).mean()


def _check_at_rest(file: h5py.File, detector: str, key: Ints, pitch: float | None) -> None:
    """Warn of an object that was moved by half a cell or more during the projections."""
    for name in ("x_translation", "y_translation", "z_translation"):
        data = _held(file, detector, f"sample/{name}")
        unit = None if data is None else MM.get(unit_text(data.attrs.get("units", "m")))
        if data is None or unit is None or pitch is None or data.size != key.size:
            continue
        moved = unit * float(np.ptp(np.ravel(data[()])[key == _PROJECTION].astype(np.float64)))
        if moved > 0.5 * pitch:
            warnings.warn(
                f"{data.name} changes by {moved:.3g} mm during the projections: the object was "
                "moved (a helix, a stitched or a shaken scan), which is left out; give a "
                "VectorGeometry for it",
                UserWarning,
                stacklevel=3,
            )


def _leave_out(why: str) -> None:
    warnings.warn(f"{why}: it is left out", UserWarning, stacklevel=5)


def _held(file: h5py.File, detector: str, name: str) -> h5py.Dataset | None:
    """The data set of a name in the nearest group around the detector's that has one."""
    import h5py

    for entry in _entries(detector):
        try:
            found = inside(file, f"{entry}/{name}")
        except ValueError as error:  # in another file
            _leave_out(str(error))
            return None
        if isinstance(found, h5py.Dataset):
            return found
    return None


def _entries(detector: str) -> list[str]:
    """Groups around the detector's, from the nearest on."""
    above = detector.split("/")[1:-1]
    return ["/" + "/".join(above[:n]) for n in range(len(above), 0, -1)]


def _angles(file: h5py.File, detector: str, key: Ints, given: object) -> Floats:
    """Angles of the projections in rad."""
    views = int((key == _PROJECTION).sum())
    if given is not None:
        return angles_of(given, views=views)
    entries = _entries(detector)
    for name in (
        f"{entry}/{part}/rotation_angle" for entry in entries for part in ("sample", "data")
    ):
        data = inside(file, name)
        if data is not None and data.size == key.size:
            return angles_in(data, key.size, f"{detector}/data", key == _PROJECTION)
        if data is not None:
            return angles_in(data, views, f"{detector}/data without flats and darks")
    raise ValueError(f"it has no angles, {entries[-1]}/sample/rotation_angle: give angles_deg=")
