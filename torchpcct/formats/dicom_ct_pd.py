"""DICOM-CT-PD: clinical CT projections (Chen et al., Med. Phys. 42, 6900, 2015; the Mayo low-dose CT data).

One DICOM file a view. Private tags give the focal spot (angle φ, height z, radius ρ), the detector's shape, spacings
and central element, and the attenuation of water. The focal spot stands at (−ρ sin φ, ρ cos φ, z); element i of a
cylindrical detector is seen at the angle φ + (i − i₀) Δ / d, counter-clockwise.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.formats.damage import check_size, needed, reading
from torchpcct.geometry import ConeBeam
from torchpcct.scan import Scan

__all__ = ["ClinicalProjections", "holds_projections", "read_dicom_ct_pd"]

_TAGS = {
    "spacing": 0x70291002, "row_spacing": 0x70291006, "shape": 0x7029100B, "rows": 0x70291010, "columns": 0x70291011,
    "angle": 0x70311001, "height": 0x70311002, "radius": 0x70311003, "distance": 0x70311031, "centre": 0x70311033,
    "shift_angle": 0x7033100B, "shift_height": 0x7033100C, "shift_radius": 0x7033100D, "spot": 0x7033100E,
    "water": 0x70411001, "photons": 0x70331065,
}  # fmt: skip
_TURN_MM = 0.05
"""Travel of the table from which a scan is a helix."""


class ClinicalProjections(NamedTuple):
    """Projections of a clinical scanner.

    Attributes:
        lines: ``(views, rows, columns)`` line integrals.
        geometry: the circle that the source turns on, at the height of the first view.
        motion: ``(views, 3)`` z, y, x mm: the table's travel as a displacement of the grid, for ``Projector``; None of
            a scan at rest.
        mu_water: mm⁻¹, or None.
        photons: of an unattenuated reading of every column, or None.
        info: provenance.
    """

    lines: Tensor
    geometry: ConeBeam
    motion: NDArray[np.float64] | None
    mu_water: float | None
    photons: NDArray[np.float64] | None
    info: dict[str, Any]

    def scan(self) -> Scan:
        """The scan of a table at rest.

        Raises:
            ValueError: a helical scan.
        """
        if self.motion is not None:
            raise ValueError(
                f"the table travels by {np.ptp(self.motion[:, 0]):.1f} mm: a helical scan has no circular FBP. Use "
                "recon.pwls with Projector(p.geometry, grid, motion=p.motion)"
            )
        photons = None if self.photons is None else np.tile(self.photons, (self.geometry.rows, 1))
        return Scan.from_line_integrals(
            self.lines, self.geometry, photons=photons, mu_water=self.mu_water, info=self.info
        )


def _value(file: Any, name: str, default: Any = None) -> Any:
    """Numbers of a private tag, whether or not the reader knows its type: float32 if it comes as bytes."""
    tag = _TAGS[name]
    if tag not in file:
        if default is None:
            raise ValueError(f"it has no tag ({tag >> 16:04X},{tag & 0xFFFF:04X}), the {name.replace('_', ' ')}")
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
    """Whether a DICOM file, or the first one of a folder, is a projection (tag of the detector's rows), not an image.

    Raises:
        FileNotFoundError: no DICOM files. ValueError: a damaged one. ImportError: pydicom is not installed.
    """
    pydicom = needed("pydicom")
    first = Path(path) if Path(path).is_file() else _files(path)[0]
    with reading(first, "DICOM"):
        return _TAGS["rows"] in pydicom.dcmread(first, stop_before_pixels=True)


def _files(folder: str | os.PathLike[str]) -> list[Path]:
    found = Path(folder).iterdir() if Path(folder).is_dir() else ()
    paths = sorted(p for p in found if p.suffix.lower() in (".dcm", ".ima"))
    if not paths:
        raise FileNotFoundError(f"no .dcm files in {folder}")
    return paths


def read_dicom_ct_pd(folder: str | os.PathLike[str], *, ignore_flying_spot: bool = False) -> ClinicalProjections:
    """Read a folder of DICOM-CT-PD files.

    Args:
        folder: with one ``.dcm`` file a view; the instance numbers give their order.
        ignore_flying_spot: take a deflected focal spot for one at rest: some blur instead of an error.

    Raises:
        FileNotFoundError: no such folder, or no files in it.
        ValueError: a damaged or foreign file, missing views, a flat or spherical detector, a flying focal spot.
        ImportError: pydicom is not installed.
    """
    pydicom = needed("pydicom")
    paths = _files(folder)
    views: list[tuple[int, float, float, float, Any]] = []
    first: dict[str, Any] = {}
    for path in paths:
        with reading(path, "a DICOM-CT-PD projection"):
            file = pydicom.dcmread(path)
            if not first:
                first = _detector(file, ignore_flying_spot)
                check_size((len(paths), first["rows"], first["columns"]), "the scan")
            elif _detector(file, ignore_flying_spot) != first:
                raise ValueError("its detector differs from that of the first file")
            radius = float(_value(file, "radius")[0])
            views.append((int(file.InstanceNumber), float(_value(file, "angle")[0]), float(_value(file, "height")[0]),
                          radius, _pixels(file, first)))  # fmt: skip
            photons = np.asarray(_value(file, "photons", np.zeros(0)), dtype=np.float64)
    views.sort(key=lambda v: v[0])
    numbers = np.array([v[0] for v in views])
    if np.any(np.diff(numbers) != 1):
        raise ValueError(
            f"{folder}: the instance numbers have gaps or repeats after {numbers[np.argmax(np.diff(numbers) != 1)]}"
        )
    radii = np.array([v[3] for v in views])
    if np.ptp(radii) > 1e-3 * radii.mean():
        raise ValueError(f"{folder}: the focal spot's radius changes from {radii.min():g} to {radii.max():g} mm")
    angles, heights = np.array([v[1] for v in views]) + math.pi / 2, np.array([v[2] for v in views])
    g = first
    # Element i is seen counter-clockwise, our columns run clockwise about the source.
    offset = (g["offset"][0], g["offset"][1])
    geometry = ConeBeam(
        angles, float(radii.mean()), g["sdd"], g["columns"], g["rows"], (g["row_pitch"], g["pitch"]), offset, "curved"
    )
    motion = None
    if np.ptp(heights) > _TURN_MM:
        motion = np.zeros((len(views), 3))
        motion[:, 0] = heights[0] - heights
    water = float(g["water"]) if g["water"] else None
    info = {"file": str(folder), "format": "DICOM-CT-PD", "flying_focal_spot": g["spot"]}
    lines = torch.from_numpy(np.stack([v[4] for v in views]))
    use = photons if photons.size == g["columns"] and (photons > 0).all() else None
    return ClinicalProjections(lines, geometry, motion, water, None if use is None else use[::-1].copy(), info)


def _detector(file: Any, ignore_flying_spot: bool) -> dict[str, Any]:
    shape = _value(file, "shape").upper()
    if shape != "CYLINDRICAL":
        raise ValueError(f"its detector is {shape or 'unknown'}: only cylindrical ones are read")
    spot = _value(file, "spot", "FFSNONE").upper()
    shifted = any(float(_value(file, f"shift_{k}", np.zeros(1))[0]) != 0.0 for k in ("angle", "height", "radius"))
    if (spot not in ("", "FFSNONE") or shifted) and not ignore_flying_spot:
        raise ValueError(
            f"its focal spot flies ({spot}), which no geometry here describes: pass ignore_flying_spot=True"
        )
    rows, columns = int(_value(file, "rows")[0]), int(_value(file, "columns")[0])
    pitch, row_pitch = float(_value(file, "spacing")[0]), float(_value(file, "row_spacing")[0])
    column, row = (float(c) for c in _value(file, "centre")[:2])  # counted from 1
    return {
        "rows": rows, "columns": columns, "pitch": pitch, "row_pitch": row_pitch,
        "sdd": float(_value(file, "distance")[0]), "spot": spot,
        "offset": (((rows + 1) / 2 - row) * row_pitch, (column - (columns + 1) / 2) * pitch),
        "water": float(_value(file, "water", np.zeros(1))[0]),
    }  # fmt: skip


def _pixels(file: Any, g: dict[str, Any]) -> Any:
    """``(rows, columns)`` float32, columns in our direction."""
    stored = np.asarray(file.pixel_array, dtype=np.float32)
    shape = (g["columns"], g["rows"])  # the files count channels as image rows
    if stored.shape == shape:
        stored = stored.T
    elif stored.shape != shape[::-1]:
        raise ValueError(f"its image of {stored.shape} is not the detector's {shape}")
    slope, intercept = float(getattr(file, "RescaleSlope", 1.0)), float(getattr(file, "RescaleIntercept", 0.0))
    return np.ascontiguousarray(stored[:, ::-1] * np.float32(slope) + np.float32(intercept))
