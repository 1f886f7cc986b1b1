"""The commands that look into files: ``info``, ``view``."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.parsing import (
    FORCE,
    MANY,
    SCAN_ENDINGS,
    Commands,
    add_options,
    as_json,
    check_ending,
    check_output,
    command,
    difference_beside,
    hint_of_missing,
    is_picture,
    length_of,
    without_ending,
)
from torchpcct.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from torch import Tensor

    from recon.study.study import ProgressBars
    from torchpcct.volume import Volume

_PICTURE_ENDINGS = (".png", ".pdf", ".svg")
"""Endings of pictures."""
_LEAST_HU = 20.0
"""Range of values above which a volume without a unit is taken to be in HU: one whose values lie
closer together is not, whatever its file says (most do not say)."""
_SCALE_OF_DIFFERENCES = 0.0, 200.0
"""Level and window in HU of the difference that a vessel model makes."""


def _is_volume(path: Path) -> bool:
    if path.suffix.lower() in SCAN_ENDINGS:
        import h5py

        from torchpcct.formats.damage import reading

        with reading(path, "HDF5"), h5py.File(path, "r") as file:
            return str(file.attrs.get("format")) == "torchpcct-volume"
    if path.name.lower().endswith((".nii", ".nii.gz", ".mha", ".zarr")):
        return True
    if path.is_dir() or _is_dicom(path):  # a series or an image, or projections
        from torchpcct.formats.dicom_ct_pd import holds_projections

        return not holds_projections(path)
    return False


def _is_dicom(path: Path) -> bool:
    """Whether a file is DICOM, by its ending or, without one, by its beginning."""
    from torchpcct.formats.dicom_series import DICOM_ENDINGS

    if path.suffix or not path.is_file():
        return path.suffix.lower() in DICOM_ENDINGS and path.is_file()
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM"


def _info(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    import yaml

    from torchpcct.checks.defects import dead_readings, repair_defects
    from torchpcct.formats.geometry_yaml import geometry_values
    from torchpcct.formats.scans import open_scan
    from torchpcct.volume import Volume

    path: Path = arguments.file
    if _is_volume(path):
        # Looked at, a volume may hold anything; what computes with it refuses what is not finite.
        volume = Volume.load(path, fill=math.nan)
        values, length = volume.data.double(), length_of(volume.unit)
        finite = values.isfinite()
        bad = values.numel() - int(finite.sum())
        values = values[finite] if 0 < bad < values.numel() else values
        about: dict[str, object] = {
            "kind": "volume",
            "shape": list(volume.grid.shape),
            f"spacing_{length}": list(volume.grid.spacing),
            f"center_{length}": list(volume.grid.center),
            "unit": volume.unit,
            "lowest": float(values.min()),
            "mean": float(values.mean()),
            "highest": float(values.max()),
            **({"voxels_not_finite": bad} if bad else {}),
            "report": dict(volume.report),
        }
    else:
        scan = open_scan(path)
        about = {
            "kind": "scan",
            "readings": list(scan.counts.shape),
            "geometry": geometry_values(scan.geometry),
            "exposure_s": scan.exposure_s,
            "seed": scan.seed,
            "counting": scan.counting,
            "unit": scan.unit,
            "windowed": scan.window is not None,
            "mean": float(scan.counts.mean()),
            "zero_share": scan.zero_fraction,
            **(
                {"lengths": "in pixels, the file does not know their size"}
                if scan.unit == "pixel^-1"
                else {}
            ),
            "dead_readings": dead_readings(repair_defects(scan)[0]),
            "info": dict(scan.info),
        }
    if arguments.json:
        print(as_json({"file": str(path), **about}))
        return
    for key in ("report", "info"):
        about.pop(key, None)
    print(
        yaml.safe_dump(
            {"file": str(path), **about},
            sort_keys=False,
            allow_unicode=True,
            default_flow_style=None,
        ),
        end="",
    )


def add_info(commands: Commands) -> None:
    parser = command(
        commands,
        "info",
        _info,
        "what a scan or volume file holds",
        "What a file holds.",
        "torchpcct info scan.h5",
        "torchpcct info volume.nii.gz --json",
    )
    add_options(
        parser,
        ("file", Path, "FILE", "scan or volume", {"read": True}),
        ("--json", bool, None, "everything, as JSON"),
    )


def _view(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    files, page = arguments.files, arguments.html is not None
    if not page and len(files) > 1:
        raise ValueError("several volumes are shown in a page for the browser: add --html FILE")
    if page and arguments.out is not None:
        raise ValueError("--html FILE or --out PATH: a page or a picture, one at a time")
    if page and (arguments.slice is not None or arguments.plane != "z"):
        raise ValueError(
            "--slice and --plane belong to a picture (--out); a page of --html shows all of them"
        )
    arguments.out = arguments.html or arguments.out or Path(f"{without_ending(files[0])}.png")
    check_ending(arguments.out, (".html", ".htm") if page else _PICTURE_ENDINGS)
    check_output(arguments, _is_page if page else is_picture, *files)
    for file in files:
        if not file.exists():
            raise FileNotFoundError(f"no such file: {file}{hint_of_missing('files', file)}")
        if not _is_volume(file):
            raise ValueError(
                f"{file} is a scan, not a volume: torchpcct reconstruct makes one, torchpcct info "
                "describes the scan"
            )
    from torchpcct.volume import Volume

    changes = [difference_beside(file) for file in files] if page else []
    files = [*files, *(path for path in changes if path.exists() and path not in files)]
    volumes = [Volume.load(file, fill=math.nan) for file in files]
    for file, volume in zip(files, volumes, strict=True):
        if not bool(volume.data.isfinite().any()):
            raise ValueError(f"{file} has no finite value: reconstruct it again")
    scales = [
        _SCALE_OF_DIFFERENCES
        if file in changes
        else _grey_scale(v.data, arguments.level, arguments.window)
        for file, v in zip(files, volumes, strict=True)
    ]
    if page:
        from torchpcct.viz import viewer_page

        names = [without_ending(file) for file in files]
        labels = [n if names.count(n) == 1 else str(f) for n, f in zip(names, files, strict=True)]
        shown = [
            (label, v, *scale) for label, v, scale in zip(labels, volumes, scales, strict=True)
        ]
        with atomic_write(arguments.out) as part:
            part.write_text(viewer_page(shown, ", ".join(labels)), encoding="utf-8")
        size = arguments.out.stat().st_size / 1e6
        print(
            f"{arguments.out}: {', '.join(labels)}, {size:.1f} MB; open it in a browser (no "
            "network is needed)"
        )
        return
    level, width = scales[0]
    figure, index = _draw_slice(volumes[0], arguments.plane, arguments.slice, level, width)
    with atomic_write(arguments.out) as part:
        figure.savefig(part)
    print(
        f"{arguments.out}: slice {index} along {arguments.plane}, level {level:.4g}, window "
        f"{width:.4g}"
    )


def _is_page(path: Path) -> bool:
    """Whether a file is a page of ``view --html``."""
    with path.open("rb") as file:
        return b'content="torchpcct view"' in file.read(512)


def _draw_slice(
    volume: Volume, plane: str, index: int | None, level: float, width: float
) -> tuple[Figure, int]:
    """Figure of a slice across the axis ``plane``, and its index (the middle, if None is given)."""
    import numpy as np
    from matplotlib.figure import Figure

    data = volume.data if volume.data.ndim == 3 else volume.data[None]
    axis = "zyx".index(plane)
    index = data.shape[axis] // 2 if index is None else index
    if not 0 <= index < data.shape[axis]:
        raise ValueError(
            f"--slice must lie in 0 … {data.shape[axis] - 1} along {plane}, got {index}"
        )
    axes = volume.grid.axes if volume.grid.ndim == 3 else (np.zeros(1), *volume.grid.axes)
    names = [n for n in (0, 1, 2) if n != axis]
    across, up = axes[names[1]], axes[names[0]]
    figure = Figure(figsize=(6.4, 6.0), dpi=120, layout="constrained")
    panel = figure.subplots()
    low, high = level - width / 2, level + width / 2
    step = [float(a[1] - a[0]) if a.size > 1 else 1.0 for a in (across, up)]
    extent = (
        across[0] - step[0] / 2,
        across[-1] + step[0] / 2,
        up[0] - step[1] / 2,
        up[-1] + step[1] / 2,
    )
    image = data.select(axis, index).numpy()
    shown = panel.imshow(image, cmap="gray", vmin=low, vmax=high, origin="lower", extent=extent)
    panel.set(
        xlabel=f"{'zyx'[names[1]]} / mm",
        ylabel=f"{'zyx'[names[0]]} / mm",
        title=f"{plane} = {axes[axis][index]:.2f} mm",
    )
    figure.colorbar(shown, ax=panel, label=volume.unit)
    return figure, index


def _grey_scale(values: Tensor, level: float | None, window: float | None) -> tuple[float, float]:
    """Level and window: what was asked for; else 40 and 400 for HU, the values' own range for
    anything else."""
    import numpy as np

    some = values[..., :: max(1, values.numel() // 2**22)]
    some = some[some.isfinite()] if bool(some.isfinite().any()) else values[values.isfinite()]
    low, high = np.quantile(some.numpy(), [0.001, 0.999])
    hu = high - low > _LEAST_HU
    if level is None:
        level = 40.0 if hu else float(low + high) / 2
    return level, window if window is not None else 400.0 if hu else max(float(high - low), 1e-12)


def add_view(commands: Commands) -> None:
    parser = command(
        commands,
        "view",
        _view,
        "volumes in a page for the browser, or a slice as a picture",
        "Draw a slice of a volume, or, with --html, make a page that shows volumes side by side "
        "in any browser: three planes, wheel through the slices, window by dragging, one cursor "
        "in all volumes, values and ROIs. The page is one file and needs no network.",
        "torchpcct view fbp.nii.gz mbir.nii.gz --level 150 --window 600 --html view.html",
        "torchpcct view mbir.nii.gz --plane x --slice 18 --out sagittal.png",
    )
    add_options(
        parser,
        (
            "files",
            Path,
            "VOLUME",
            ".nii, .nii.gz, .mha, .h5, .dcm or a DICOM folder",
            {"nargs": "+"},
        ),
        ("--html", Path, "FILE", "page to write (.html), of one volume or several"),
        ("--out", Path, "PATH", "picture: .png, .pdf or .svg (default VOLUME.png)"),
        (
            "--level",
            float,
            None,
            "centre of the grey scale (default 40 HU; in mm⁻¹ by the values)",
            {"limits": {"low": -1e9, "high": 1e9}},
        ),
        (
            "--window",
            float,
            None,
            "its width (default 400 HU; in mm⁻¹ by the values)",
            {"limits": {"positive": True, "high": 1e9}},
        ),
        FORCE,
    )
    add_options(
        parser,
        (
            "--plane",
            str,
            None,
            "axis across the slice (default z)",
            {"choices": ("z", "y", "x"), "default": "z"},
        ),
        (
            "--slice",
            int,
            "K",
            "index along it (default: the middle)",
            {"limits": {"low": 0, "high": MANY}},
        ),
        group="the picture",
    )
