"""Command line: ``torchpcct compare | dose-factor | study | simulate | reconstruct``.

The one module of the package that looks at :mod:`recon`: a command joins what the library keeps apart.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

__all__ = ["main"]


class _Progress:
    """A progress bar per step on the terminal's error stream; silent when it is not a terminal or not wanted."""

    def __init__(self, enabled: bool) -> None:
        self.enabled = enabled
        self.step: str | None = None
        self.bar: Any = None

    def __call__(self, step: str, fraction: float) -> None:
        if not self.enabled:
            return
        from tqdm import tqdm

        if step != self.step:
            self.close()
            self.step = step
            self.bar = tqdm(
                total=100,
                desc=step,
                unit="%",
                leave=True,
                bar_format="{desc:<28} {bar:30} {percentage:3.0f}% {elapsed}<{remaining}",
            )
        self.bar.update(100 * fraction - self.bar.n)

    def of(self, step: str) -> Callable[[float], None]:
        return lambda fraction: self(step, fraction)

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()
            self.bar = None


def _common(
    parser: argparse.ArgumentParser, out_help: str, out_default: str | None, required: bool | None = None
) -> None:
    required = out_default is None if required is None else required
    parser.add_argument("--seed", type=int, default=0, help="first seed of the noise, ≥ 0 (default 0)")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where volumes are kept (default cpu)")
    parser.add_argument("--out", type=Path, default=out_default, required=required, metavar="PATH", help=out_help)
    parser.add_argument("--no-progress", action="store_true", help="no progress bars")
    parser.add_argument("-v", "--verbose", action="store_true", help="log what the library does")


def _parser() -> argparse.ArgumentParser:
    from torchpcct import __version__

    parser = argparse.ArgumentParser(
        prog="torchpcct",
        description="Photon-counting CT: simulate, reconstruct, and measure what model-based reconstruction saves.",
    )
    parser.add_argument("--version", action="version", version=f"torchpcct {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    compare = commands.add_parser(
        "compare",
        help="the paper's CNR tables by FBP and PWLS, with intervals",
        description="Simulate the paper's plaque scan at full size, reconstruct it by FBP (kernels × voxel sizes) and "
        "PWLS at 1×, 2×, 5.7× and 8× dose, and print the paper's tables with 95 %% intervals beside its numbers.",
    )
    _common(compare, "folder for report.json, report.md and compare.png (default out/compare)", "out/compare")
    compare.add_argument("--realizations", type=int, default=None, metavar="N", help="per dose (default 10)")
    compare.add_argument("--quick", action="store_true", help="reduced views and settings: a first look, < 60 s")
    compare.add_argument("--no-pwls", action="store_true", help="FBP only")
    compare.set_defaults(run=_compare)

    factor = commands.add_parser(
        "dose-factor",
        help="the dose that each method saves against FBP, measured, beside what the data allow",
        description="Reconstruct the same noise realisations of the paper's scan by every method and measure the dose "
        "at which FBP reaches the same figure: the paper's CNR, slope-corrected contrast variance, observer. Finished "
        "pieces in the folder are kept: after an interruption the same command goes on.",
    )
    _common(
        factor, "folder for pieces, report.json, report.md and figures (default out/dose-factor)", "out/dose-factor"
    )
    factor.add_argument("--n", type=int, default=None, help="paired realisations per dose and scene (default 200)")
    factor.add_argument("--slow-n", type=int, default=None, help="the same for the slow baselines (default 64)")
    factor.add_argument("--scene-n", type=int, default=None, help="realisations of each further scene (default 40)")
    factor.add_argument("--doses", type=float, nargs="+", default=None, metavar="S", help="exposures in s")
    factor.add_argument("--scene-doses", type=float, nargs="+", default=None, metavar="S", help="of further scenes")
    factor.add_argument(
        "--methods", nargs="+", default=None, metavar="M", help="linear quadratic qggmrf tv mbir_one_pass mbir"
    )
    factor.add_argument("--scenes", nargs="*", default=None, metavar="NAME", help="further scenes (none: leave out)")
    factor.add_argument("--scene-methods", nargs="+", default=None, metavar="M", help="methods of further scenes")
    factor.add_argument("--fast-noise", action="store_true", help="draw the noise of AᵀW y, not that of the readings")
    factor.add_argument("--quick", action="store_true", help="8 realisations, one dose, 246 views: about 90 s")
    factor.set_defaults(run=_dose_factor)

    study = commands.add_parser(
        "study",
        help="one of the paper's studies; torchpcct study --help lists them",
        description="Run a study of the paper at full scale and print its figures beside the published ones.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    # Named when asked for: the list lies beside the studies, whose packages take seconds to load.
    plain = study.format_help
    study.format_help = lambda: f"{plain()}\n{_study_list()}"  # type: ignore[method-assign]
    study.add_argument("name", metavar="NAME", help="of the study")
    _common(study, "folder for report.json, report.md and the figures (default out/NAME)", None, required=False)
    study.add_argument("--quick", action="store_true", help="reduced settings: a first look, < 60 s")
    study.add_argument(
        "--set",
        dest="changes",
        action="append",
        default=[],
        metavar="FIELD=VALUE",
        help="change a setting (repeatable)",
    )
    study.set_defaults(run=_study)

    simulate = commands.add_parser(
        "simulate",
        help="simulate a scan of the plaque to an HDF5 file",
        description="Simulate a scan of the paper's plaque by the deep-silicon PCCT and write it to HDF5.",
    )
    _common(simulate, "HDF5 file to write", None)
    simulate.add_argument(
        "--exposure", type=float, default=None, metavar="S", help="exposure in s (default: noise free)"
    )
    simulate.add_argument("--views", type=int, default=1968, help="views per rotation (default 1968)")
    simulate.add_argument(
        "--whole", action="store_true", help="keep the whole detector, not only the plaque's surroundings"
    )
    simulate.set_defaults(run=_simulate)

    reconstruct = commands.add_parser(
        "reconstruct",
        help="reconstruct a scan file to a volume in HU",
        description="Reconstruct an inset of a scan and write it as .nii, .nii.gz or .h5, with a .json report beside.",
    )
    reconstruct.add_argument("scan", type=Path, help="scan file written by simulate")
    _common(reconstruct, "volume to write: .nii, .nii.gz or .h5", None)
    reconstruct.add_argument("--method", default="fbp", help="fbp, pwls or mbir (default fbp)")
    reconstruct.add_argument("--kernel", default=None, help="FBP kernel: soft, standard, detail, bone, ram-lak")
    reconstruct.add_argument("--voxel", type=float, default=0.25, metavar="MM", help="voxel size (default 0.25)")
    reconstruct.add_argument(
        "--center",
        type=float,
        nargs=3,
        default=None,
        metavar=("Z", "Y", "X"),
        help="centre in mm (default: the plaque)",
    )
    reconstruct.add_argument(
        "--extent",
        type=float,
        nargs=3,
        default=None,
        metavar=("Z", "Y", "X"),
        help="edge lengths in mm (default: the inset)",
    )
    reconstruct.set_defaults(run=_reconstruct)
    return parser


def _study_list() -> str:
    from recon.study.registry import STUDIES

    return "studies:\n" + "".join(f"  {name:<12} {text}\n" for name, text in STUDIES.items())


def _check_device(device: str) -> None:
    import torch

    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: PyTorch finds no CUDA device here; use --device cpu")


def _compare(arguments: argparse.Namespace, progress: _Progress) -> None:
    from recon.study.compare.measure import Settings, run
    from recon.study.compare.report import build_report

    changes: dict[str, Any] = {"seed": arguments.seed, "pwls": not arguments.no_pwls}
    if arguments.realizations is not None:
        changes["realizations"] = arguments.realizations
    settings = Settings.quick(**changes) if arguments.quick else Settings(**changes)
    start = time.perf_counter()
    result = run(settings, progress=progress)
    progress.close()
    report = build_report(result)
    files = report.save(arguments.out)
    print(report.text)
    print(f"\n{time.perf_counter() - start:.0f} s in all. Written: {', '.join(map(str, files))}")


def _dose_factor(arguments: argparse.Namespace, progress: _Progress) -> None:
    import shlex

    from recon.study.dose_factor import Settings, estimate_seconds, run
    from recon.study.dose_factor.report import build_report

    changes: dict[str, Any] = {"seed": arguments.seed}
    for name in ("n", "slow_n", "scene_n", "doses", "scene_doses", "methods", "scenes", "scene_methods"):
        value = getattr(arguments, name)
        if value is not None:
            changes[name] = tuple(value) if isinstance(value, list) else value
    if arguments.fast_noise:
        changes["fast_noise"] = True
    settings = Settings.quick(**changes) if arguments.quick else Settings(**changes)
    parts = estimate_seconds(settings)
    listed = ", ".join(f"{name} {seconds / 60:.1f}" for name, seconds in parts.items())
    print(
        f"about {sum(parts.values()) / 60:.0f} min on two idle cores if nothing is finished yet ({listed})",
        file=sys.stderr,
    )
    start = time.perf_counter()
    result = run(settings, arguments.out, progress=progress)
    progress.close()
    report = build_report(result, time.perf_counter() - start, shlex.join(["torchpcct", *arguments.command_line]))
    files = report.save(arguments.out)
    print(report.text)
    print(f"\n{time.perf_counter() - start:.0f} s in all. Written: {', '.join(map(str, files))}")


def _study(arguments: argparse.Namespace, progress: _Progress) -> None:
    from recon.study import registry

    settings = registry.build_settings(
        arguments.name, quick=arguments.quick, seed=arguments.seed, changes=arguments.changes
    )
    start = time.perf_counter()
    report = registry.run(arguments.name, settings, progress)
    progress.close()
    files = report.save(arguments.out or Path("out") / arguments.name)
    print(report.text)
    print(f"\n{time.perf_counter() - start:.0f} s in all. Written: {', '.join(map(str, files))}")


def _simulate(arguments: argparse.Namespace, progress: _Progress) -> None:
    from recon.study.compare.measure import inset_grid
    from torchpcct.acquisition.acquire import acquire
    from torchpcct.files import require_folder
    from torchpcct.scanner import presets
    from torchpcct.scene.plaque import plaque_scene

    require_folder(arguments.out)
    scene, plaque = plaque_scene()
    region = None if arguments.whole else inset_grid(plaque, 0.1)
    scan = acquire(
        scene,
        presets.pcct(views=arguments.views),
        exposure_s=arguments.exposure,
        seed=arguments.seed,
        region=region,
        progress=progress.of("simulate"),
    )
    progress.close()
    scan.save(arguments.out)
    summary = {
        "file": str(arguments.out),
        "readings": list(scan.counts.shape),
        "exposure_s": scan.exposure_s,
        "seed": scan.seed,
        "mean_count": float(scan.counts.mean()),
        **scan.info,
    }
    _write_json(arguments.out, summary)
    print(json.dumps(summary, indent=1))


def _reconstruct(arguments: argparse.Namespace, progress: _Progress) -> None:
    import math

    from recon import reconstruct
    from recon.study.compare.measure import INSET_MM
    from torchpcct.files import require_folder
    from torchpcct.geometry import VolumeGrid
    from torchpcct.scan import Scan
    from torchpcct.scene.plaque import PAPER_POSITION
    from torchpcct.volume import check_volume_name

    require_folder(arguments.out)
    check_volume_name(arguments.out)
    if not (math.isfinite(arguments.voxel) and arguments.voxel > 0):
        raise ValueError(f"--voxel must be greater than 0 mm, got {arguments.voxel}")
    scan = Scan.load(arguments.scan)
    extent = arguments.extent or INSET_MM
    shape = tuple(math.ceil(e / arguments.voxel - 1e-6) for e in extent)
    grid = VolumeGrid(shape, arguments.voxel, tuple(arguments.center or PAPER_POSITION[::-1]))
    options = {} if arguments.kernel is None else {"kernel": arguments.kernel}
    volume = reconstruct(
        scan, grid, arguments.method, progress=progress.of(arguments.method), device=arguments.device, **options
    )
    progress.close()
    volume.save(arguments.out)
    summary = {
        "file": str(arguments.out),
        "shape": list(grid.shape),
        "spacing_mm": list(grid.spacing),
        "center_mm": list(grid.center),
        "mean_hu": float(volume.data.mean()),
        **volume.report,
    }
    _write_json(arguments.out, summary)
    print(json.dumps(summary, indent=1))


def _write_json(beside: Path, summary: dict[str, Any]) -> None:
    from torchpcct.files import written_whole

    with written_whole(beside.with_name(beside.name + ".json")) as part:
        part.write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status: 0 done, 2 refused input, 130 interrupted."""
    options = _parser().parse_args(arguments)
    options.command_line = list(sys.argv[1:] if arguments is None else arguments)
    logging.basicConfig(
        level=logging.INFO if options.verbose else logging.WARNING, format="%(levelname)s %(name)s: %(message)s"
    )
    progress = _Progress(not options.no_progress and sys.stderr.isatty())
    try:
        _check_device(options.device)
        options.run(options, progress)
    except (ValueError, TypeError, OSError) as error:
        progress.close()
        print(f"torchpcct {options.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        progress.close()
        print(f"torchpcct {options.command}: interrupted, nothing half written", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
