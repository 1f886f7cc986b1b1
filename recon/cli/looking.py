"""The commands that look into files: ``info``, ``view``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

# What loads torch or numba is imported by the commands: help and refusals come at once.
from recon.cli.parsing import (
    SCAN_ENDINGS,
    Commands,
    add_force,
    as_json,
    check_ending,
    check_output,
    is_picture,
    length_of,
    without_ending,
)
from torchpcct.files import written_whole
from torchpcct.validate import number

if TYPE_CHECKING:
    from recon.study.study import ProgressBars

__all__ = ["add_info", "add_view"]

_PICTURE_ENDINGS = (".png", ".pdf", ".svg")
_LEAST_HU = 20.0
"""A volume whose values lie closer together is not in HU, whatever its file says (most do not say)."""


def _is_volume(path: Path) -> bool:
    if path.suffix.lower() in SCAN_ENDINGS:
        import h5py

        from torchpcct.formats.damage import reading

        with reading(path, "HDF5"), h5py.File(path, "r") as file:
            return str(file.attrs.get("format")) == "torchpcct-volume"
    if path.is_dir() or _is_dicom(path):  # a series or an image, or projections
        from torchpcct.formats.dicom_ct_pd import holds_projections

        return not holds_projections(path)
    return str(path).endswith((".nii", ".nii.gz", ".mha"))


def _is_dicom(path: Path) -> bool:
    """Whether a file is DICOM, by its ending or, without one, by its beginning."""
    if path.suffix or not path.is_file():
        return path.suffix.lower() in (".dcm", ".ima") and path.is_file()
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM"


def _info(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    import yaml

    from torchpcct.defects import dead_readings, mended
    from torchpcct.formats.geometry_yaml import geometry_values
    from torchpcct.formats.scans import open_scan
    from torchpcct.volume import Volume

    path: Path = arguments.file
    if _is_volume(path):
        volume = Volume.load(path)
        values, length = volume.data.double(), length_of(volume.unit)
        about: dict[str, Any] = {
            "kind": "volume", "shape": list(volume.grid.shape), f"spacing_{length}": list(volume.grid.spacing),
            f"center_{length}": list(volume.grid.center), "unit": volume.unit, "lowest": float(values.min()),
            "mean": float(values.mean()), "highest": float(values.max()), "report": dict(volume.report),
        }  # fmt: skip
    else:
        scan = open_scan(path)
        about = {
            "kind": "scan", "readings": list(scan.counts.shape), "geometry": geometry_values(scan.geometry),
            "exposure_s": scan.exposure_s, "seed": scan.seed, "counting": scan.counting, "unit": scan.unit,
            "windowed": scan.window is not None, "mean": float(scan.counts.mean()), "zero_share": scan.zero_fraction,
            **({"lengths": "in pixels, the file does not know their size"} if scan.unit == "pixel^-1" else {}),
            "dead_readings": dead_readings(mended(scan)[0]), "info": dict(scan.info),
        }  # fmt: skip
    if arguments.json:
        print(as_json({"file": str(path), **about}))
        return
    for key in ("report", "info"):
        about.pop(key, None)
    print(
        yaml.safe_dump({"file": str(path), **about}, sort_keys=False, allow_unicode=True, default_flow_style=None),
        end="",
    )


def add_info(commands: Commands) -> None:
    parser = commands.add_parser("info", help="what a scan or volume file holds", description="What a file holds.")
    parser.set_defaults(run=_info, device="cpu", no_progress=True, verbose=False)
    parser.add_argument("file", type=Path, help="scan or volume")
    parser.add_argument("--json", action="store_true", help="everything, as JSON")


def _view(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    if arguments.out is None:
        arguments.out = Path(f"{without_ending(arguments.file)}.png")
    check_ending(arguments.out, _PICTURE_ENDINGS)
    check_output(arguments, is_picture, arguments.file)
    if arguments.window is not None:
        number("--window", arguments.window, positive=True)
    if arguments.file.exists() and not _is_volume(arguments.file):
        raise ValueError(
            f"{arguments.file} is a scan, no volume: torchpcct reconstruct it first, info says what it holds"
        )
    import numpy as np
    from matplotlib.figure import Figure

    from torchpcct.volume import Volume

    volume = Volume.load(arguments.file)
    data = volume.data if volume.data.ndim == 3 else volume.data[None]
    axis = "zyx".index(arguments.plane)
    index = data.shape[axis] // 2 if arguments.slice is None else arguments.slice
    if not 0 <= index < data.shape[axis]:
        raise ValueError(f"--slice must lie in 0 … {data.shape[axis] - 1} along {arguments.plane}, got {index}")
    image = data.select(axis, index).numpy()
    axes = volume.grid.axes if volume.grid.ndim == 3 else (np.zeros(1), *volume.grid.axes)
    names = [n for n in (0, 1, 2) if n != axis]
    across, up = axes[names[1]], axes[names[0]]
    figure = Figure(figsize=(6.4, 6.0), dpi=120, layout="constrained")
    panel = figure.subplots()
    level, width = _grey_scale(volume.data, arguments.level, arguments.window)
    low, high = level - width / 2, level + width / 2
    step = [float(a[1] - a[0]) if a.size > 1 else 1.0 for a in (across, up)]
    extent = (across[0] - step[0] / 2, across[-1] + step[0] / 2, up[0] - step[1] / 2, up[-1] + step[1] / 2)
    shown = panel.imshow(image, cmap="gray", vmin=low, vmax=high, origin="lower", extent=extent)
    panel.set(xlabel=f"{'zyx'[names[1]]} / mm", ylabel=f"{'zyx'[names[0]]} / mm",
              title=f"{arguments.plane} = {axes[axis][index]:.2f} mm")  # fmt: skip
    figure.colorbar(shown, ax=panel, label=volume.unit)
    with written_whole(arguments.out) as part:
        figure.savefig(part)
    print(f"{arguments.out}: slice {index} along {arguments.plane}, level {level:.4g}, window {width:.4g}")


def _grey_scale(values: Any, level: float | None, window: float | None) -> tuple[float, float]:
    """Level and window: what was asked for; else 40 and 400 for HU, the values' own range for anything else."""
    import numpy as np

    low, high = np.quantile(values[..., :: max(1, values.numel() // 2**22)].numpy(), [0.001, 0.999])
    hu = high - low > _LEAST_HU
    if level is None:
        level = 40.0 if hu else float(low + high) / 2
    return level, window if window is not None else 400.0 if hu else max(float(high - low), 1e-12)


def add_view(commands: Commands) -> None:
    parser = commands.add_parser("view", help="a slice of a volume as a picture", description="Draw a slice.")
    parser.set_defaults(run=_view, device="cpu", no_progress=True, verbose=False)
    parser.add_argument("file", type=Path, help="volume: .nii, .nii.gz, .mha, .h5, .dcm or a DICOM folder")
    parser.add_argument("--out", type=Path, metavar="PATH", help="picture: .png, .pdf or .svg (default VOLUME.png)")
    add_force(parser)
    parser.add_argument("--plane", choices=("z", "y", "x"), default="z", help="axis across the slice (default z)")
    parser.add_argument("--slice", type=int, metavar="K", help="index along it (default: the middle)")
    parser.add_argument("--level", type=float, help="centre of the grey scale (default 40 HU, mm⁻¹: of the values)")
    parser.add_argument("--window", type=float, help="its width (default 400 HU, mm⁻¹: of the values)")
