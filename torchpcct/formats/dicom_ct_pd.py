"""DICOM-CT-PD: clinical CT projections (Chen et al., Med. Phys. 42, 6900, 2015; the Mayo low-dose
CT data).

One DICOM file a view. Private tags give the focal spot (angle φ, height z, radius ρ), the
detector's shape, spacings and central element, and the attenuation of water. The focal spot stands
at (−ρ sin φ, ρ cos φ, z); element i of a cylindrical detector is seen at the angle φ + (i − i₀) Δ /
d, counter-clockwise.
"""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.formats.damage import check_expansion, reading
from torchpcct.formats.dicom_series import dicom_files, open_dicom
from torchpcct.geometry import ConeBeam
from torchpcct.scan import Scan
from torchpcct.validate import whole

if TYPE_CHECKING:
    import pydicom
    from numpy.typing import ArrayLike

    from torchpcct.typing import Floats32, Ints


__all__ = ["read_dicom_ct_pd"]

_TAGS = {
    "spacing": 0x70291002,
    "row_spacing": 0x70291006,
    "shape": 0x7029100B,
    "rows": 0x70291010,
    "columns": 0x70291011,
    "angle": 0x70311001,
    "height": 0x70311002,
    "radius": 0x70311003,
    "distance": 0x70311031,
    "centre": 0x70311033,
    "shift_angle": 0x7033100B,
    "shift_height": 0x7033100C,
    "shift_radius": 0x7033100D,
    "spot": 0x7033100E,
    "water": 0x70411001,
    "photons": 0x70331065,
}
"""Private tags of DICOM-CT-PD (Chen et al. 2015, Med. Phys. 42:6964)."""
_SAME_SPOT = (2e-5, 0.01, 0.01)
"""Differences of deflections (rad, mm, mm) that are those of one position."""
_SAME_FLUX = 1e-4
"""Relative differences between views of which the source sends as much in all."""
_TURN_MM = 0.05
"""Travel of the table from which a scan is a helix."""


class ClinicalProjections(NamedTuple):
    """Projections of a clinical scanner.

    Attributes:
        lines: ``(views, rows, columns)`` line integrals.
        geometry: the circle that the source turns on, at the height of the first view.
        motion: ``(views, 3)`` z, y, x mm: the table's travel as a displacement of the grid, for
            ``Projector``; None of a scan at rest.
        mu_water: mm⁻¹, or None.
        photons: of an unattenuated reading of every column, mean over the views, or None.
        flux: ``(views,)`` intensity of the source relative to that (tube current modulation), or
            None.
        info: provenance.
    """

    lines: Tensor
    geometry: ConeBeam
    motion: NDArray[np.float64] | None
    mu_water: float | None
    photons: NDArray[np.float64] | None
    flux: NDArray[np.float64] | None
    info: dict[str, object]

    def scan(self) -> Scan:
        """The scan of a table at rest.

        Raises:
            ValueError: a helical scan.
        """
        if self.motion is not None:
            raise ValueError(
                f"the table travels by {np.ptp(self.motion[:, 0]):.1f} mm: a helical scan has no "
                "circular FBP. Use recon.pwls with Projector(p.geometry, grid, motion=p.motion)"
            )
        photons = None if self.photons is None else np.tile(self.photons, (self.geometry.rows, 1))
        return Scan.from_line_integrals(
            self.lines,
            self.geometry,
            photons=photons,
            flux=self.flux,
            mu_water=self.mu_water,
            info=self.info,
        )


def _value(file: pydicom.Dataset, name: str, default: ArrayLike | None = None) -> Any:
    """Numbers of a private tag, whether or not the reader knows its type: float32 if it comes as
    bytes."""
    tag = _TAGS[name]
    if tag not in file:
        if default is None:
            raise ValueError(
                f"it has no tag ({tag >> 16:04X},{tag & 0xFFFF:04X}), the {name.replace('_', ' ')}"
            )
        return default
    value = file[tag].value
    if isinstance(value, bytes):
        if name in ("shape", "spot"):
            return value.decode("ascii").strip("\0 ")
        if name in ("rows", "columns"):
            return np.frombuffer(value, "<u2")
        if name == "water":
            return np.array([float(value.decode("ascii").strip("\0 "))])
        return np.frombuffer(value, "<f4").astype(np.float64)
    if name in ("shape", "spot"):
        return str(value).strip()
    return np.atleast_1d(np.asarray(value, dtype=np.float64))


def holds_projections(path: str | os.PathLike[str]) -> bool:
    """Whether a DICOM file, or the first one of a folder, is a projection (tag of the detector's
    rows), not an image.

    Raises:
        FileNotFoundError: no DICOM files. ValueError: a damaged one. ImportError: pydicom is not
            installed.
    """
    first = Path(path) if Path(path).is_file() else dicom_files(path)[0]
    with reading(first, "DICOM"):
        return _TAGS["rows"] in open_dicom(first, stop_before_pixels=True)


def read_dicom_ct_pd(
    folder: str | os.PathLike[str], *, ignore_flying_spot: bool = False, spot: int | None = None
) -> ClinicalProjections:
    """Read a folder of DICOM-CT-PD files.

    Args:
        folder: with one file a view; the instance numbers give their order.
        ignore_flying_spot: take a deflected focal spot for one at rest: some blur instead of an
            error.
        spot: of a flying focal spot, which of its positions, from 0: only the views are read that
            were taken from it, say every second one, with the source where it was; z counts from
            its height.

    Raises:
        FileNotFoundError: no such folder, or no files in it.
        ValueError: a damaged or foreign file, missing views, a flat or spherical detector, a focal
            spot that flies within the views that are read.
        ImportError: pydicom is not installed.
    """
    paths = dicom_files(folder)
    views: list[_View] = []
    first: _Detector | None = None
    for path in paths:
        with reading(path, "a DICOM-CT-PD projection"):
            file = open_dicom(path)
            detector = _detector(file)
            if first is None:
                first = detector
                size = sum(p.stat().st_size for p in paths)
                check_expansion((len(paths), first.rows, first.columns), "the scan", size)
            elif detector != first:
                raise ValueError("its detector differs from that of the first file")
            angle, height, radius = (
                float(_value(file, name)[0]) for name in ("angle", "height", "radius")
            )
            shift = tuple(
                float(_value(file, f"shift_{k}", np.zeros(1))[0])
                for k in ("angle", "height", "radius")
            )
            photons = np.asarray(_value(file, "photons", np.zeros(0)), dtype=np.float64)
            views.append(
                _View(
                    int(file.InstanceNumber),
                    angle,
                    height,
                    radius,
                    shift,
                    _pixels(file, first),
                    photons[::-1],
                )
            )
    views.sort(key=lambda v: v.number)
    _check_complete(folder, np.array([v.number for v in views]))
    assert first is not None  # dicom_files gives at least one
    g = first
    views, shift = _from_one_spot(folder, views, g.spot, ignore_flying_spot, spot)
    radii = np.array([v.radius for v in views])
    if np.ptp(radii) > 1e-3 * radii.mean():
        raise ValueError(
            f"{folder}: the focal spot's radius changes from {radii.min():g} to {radii.max():g} mm"
        )
    angles, heights = (
        np.array([v.angle for v in views]) + math.pi / 2,
        np.array([v.height for v in views]),
    )
    # Element i is seen counter-clockwise, our columns run clockwise about the source.
    geometry = ConeBeam(
        angles,
        float(radii.mean()),
        g.sdd,
        g.columns,
        g.rows,
        (g.row_pitch, g.pitch),
        g.offset,
        "curved",
    )
    if any(shift):
        geometry = _seen_from(geometry, *shift)
    motion = None
    if np.ptp(heights) > _TURN_MM:
        motion = np.zeros((len(views), 3))
        motion[:, 0] = heights[0] - heights
    water = float(g.water) if g.water else None
    info: dict[str, object] = {
        "file": str(folder),
        "format": "DICOM-CT-PD",
        "flying_focal_spot": g.spot,
    }
    if any(shift):
        info["focal_spot_shift"] = dict(
            zip(("angle_rad", "height_mm", "radius_mm"), shift, strict=True)
        )
    lines = torch.from_numpy(np.stack([v.lines for v in views]))
    return ClinicalProjections(lines, geometry, motion, water, *_photons(views, g.columns), info)


class _View(NamedTuple):
    """A projection: the instance's number, the focal spot at rest, its deflection, the line
    integrals, and the photons of unattenuated readings of the columns, which may be none."""

    number: int
    angle: float
    height: float
    radius: float
    shift: tuple[float, ...]
    lines: Floats32
    photons: NDArray[np.float64]


def _photons(
    views: list[_View], columns: int
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """Photons of unattenuated readings of the columns, and the flux of the views; None where not
    all views have a table, or it is the same in all."""
    if any(v.photons.size != columns or not (v.photons > 0).all() for v in views):
        return None, None
    tables = np.stack([v.photons for v in views])
    flux = tables.mean(1) / tables.mean()
    of_columns = (tables / flux[:, None]).mean(0)
    return of_columns, flux if np.ptp(flux) > _SAME_FLUX else None


def _check_complete(folder: str | os.PathLike[str], numbers: Ints) -> None:
    """Raise ``ValueError`` unless instance numbers count up in equal steps: every view, or every
    second one, …"""
    steps = np.diff(numbers)
    if steps.size and (steps.min() < 1 or np.ptp(steps)):
        usual = max(1, int(np.median(steps)))
        raise ValueError(
            f"{folder}: the instance numbers have gaps or repeats after "
            f"{numbers[np.argmax(steps != usual)]}"
        )


def _from_one_spot(
    folder: str | os.PathLike[str], views: list[_View], kind: str, ignore: bool, spot: int | None
) -> tuple[list[_View], tuple[float, ...]]:
    """Views from one position of the focal spot, and how far that is deflected: angle (rad),
    height, radius (mm)."""
    positions: list[tuple[float, ...]] = []
    of = []
    for view in views:
        near = (
            k
            for k, p in enumerate(positions)
            if (np.abs(np.subtract(p, view.shift)) <= _SAME_SPOT).all()
        )
        of.append(next(near, len(positions)))
        if of[-1] == len(positions):
            positions.append(view.shift)
    if spot is not None:
        whole("spot", spot, low=0)
        if spot >= len(positions):
            raise ValueError(
                f"spot must be one of the {len(positions)} positions of the focal spot, got {spot}"
            )
        views = [view for view, k in zip(views, of, strict=True) if k == spot]
        _check_complete(folder, np.array([v.number for v in views]))
        return views, positions[spot]
    if ignore:
        return views, (0.0, 0.0, 0.0)
    named = kind not in ("", "FFSNONE")
    if len(positions) > 1 or (named and not any(positions[0])):
        where = (
            f"between {len(positions)} positions"
            if len(positions) > 1
            else "to positions that the file does not give"
        )
        raise ValueError(
            f"{folder}: its focal spot flies ({kind}) {where}: pass spot=0 for the views from the "
            "first position, or ignore_flying_spot=True to treat it as fixed"
        )
    return views, positions[0]


def _seen_from(at_rest: ConeBeam, angle: float, height: float, radius: float) -> ConeBeam:
    """The geometry of a source that is deflected against its detector, the same in all views.

    The detector stays an arc about the spot at rest; about the deflected one it is an arc to a
    twentieth of a cell.

    Args:
        at_rest: geometry of the spot at rest.
        angle: by which the spot turns on, rad; height, radius: mm by which it rises, and moves out.
    """
    g = at_rest
    distance = g.sod + radius
    source = distance * np.array([math.cos(angle), math.sin(angle)])
    # of the cells, from the spot at rest at (sod, 0), along e_t = (0, 1)
    seen = np.asarray(g.fan_angles)
    cells = np.stack([g.sod - g.sdd * np.cos(seen), g.sdd * np.sin(seen)], -1) - source
    central = -source / distance
    across = np.array([central[1], -central[0]])  # e_t of the deflected spot
    found = np.arctan2(cells @ across, cells @ central)
    sdd = float(np.hypot(*cells.T).mean())
    step, middle = (
        np.polyfit(np.arange(g.columns) - (g.columns - 1) / 2, found * sdd, 1)
        if g.columns > 1
        else (g.pitch[1], float(found[0] * sdd))
    )
    return replace(
        g,
        angles=g.angles + angle,
        sod=distance,
        sdd=sdd,
        pitch=(g.pitch[0], float(step)),
        offset=(g.offset[0] - height, float(middle)),
    )


class _Detector(NamedTuple):
    """Of one projection; lengths in mm, ``offset`` as (row, column), ``water`` in mm⁻¹."""

    rows: int
    columns: int
    pitch: float
    row_pitch: float
    sdd: float
    spot: str
    offset: tuple[float, float]
    water: float


def _detector(file: pydicom.Dataset) -> _Detector:
    shape = _value(file, "shape").upper()
    if shape != "CYLINDRICAL":
        raise ValueError(f"its detector is {shape or 'unknown'}: only cylindrical ones are read")
    spot = _value(file, "spot", "FFSNONE").upper()
    rows, columns = int(_value(file, "rows")[0]), int(_value(file, "columns")[0])
    pitch, row_pitch = float(_value(file, "spacing")[0]), float(_value(file, "row_spacing")[0])
    column, row = (float(c) for c in _value(file, "centre")[:2])  # counted from 1
    return _Detector(
        rows,
        columns,
        pitch,
        row_pitch,
        sdd=float(_value(file, "distance")[0]),
        spot=spot,
        offset=(((rows + 1) / 2 - row) * row_pitch, (column - (columns + 1) / 2) * pitch),
        water=float(_value(file, "water", np.zeros(1))[0]),
    )


def _pixels(file: pydicom.Dataset, g: _Detector) -> Floats32:
    """``(rows, columns)`` float32, columns in our direction."""
    stored = np.asarray(file.pixel_array, dtype=np.float32)
    shape = (g.columns, g.rows)  # the files count channels as image rows
    if stored.shape == shape:
        stored = stored.T
    elif stored.shape != shape[::-1]:
        raise ValueError(f"its image of {stored.shape} is not the detector's {shape}")
    slope, intercept = (
        float(getattr(file, "RescaleSlope", 1.0)),
        float(getattr(file, "RescaleIntercept", 0.0)),
    )
    return np.ascontiguousarray(stored[:, ::-1] * np.float32(slope) + np.float32(intercept))
