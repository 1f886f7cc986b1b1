"""Command line: ``torchpcct compare | dose-factor | study | simulate | reconstruct | verify``."""

from __future__ import annotations

import argparse
import json
import logging
import math
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch

from recon.api import reconstruct
from recon.study import registry, verify
from recon.study.study import ProgressBars
from torchpcct import VolumeGrid, __version__
from torchpcct.acquisition.acquire import acquire
from torchpcct.files import require_folder, written_whole
from torchpcct.scan import Scan
from torchpcct.scanner import presets
from torchpcct.scene.plaque import PAPER_POSITION, plaque_scene
from torchpcct.validate import number
from torchpcct.volume import check_volume_name

__all__ = ["main"]


# --- commands -----------------------------------------------------------------------------------------------------


def _run_study(name: str, settings: Any, arguments: argparse.Namespace, progress: ProgressBars) -> None:
    """Run a study of the registry, save and print its report."""
    minutes = {part: seconds / 60 for part, seconds in settings.estimated_seconds().items()}
    if minutes:
        listed = ", ".join(f"{part} {value:.1f}" for part, value in minutes.items())
        total = f"about {sum(minutes.values()):.0f} min on two idle cores if nothing is finished yet"
        print(f"{total} ({listed})", file=sys.stderr)
    folder = arguments.out or Path("out") / name
    start = time.perf_counter()
    report = registry.run(name, settings, progress, folder)
    progress.close()
    if "command" in report.data:
        report.made_by(shlex.join(["torchpcct", *arguments.command_line]))
    files = report.save(folder)
    print(report.text)
    print(f"\n{time.perf_counter() - start:.0f} s in all. Written: {', '.join(map(str, files))}")


def _study(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    name, changes = arguments.name, arguments.changes
    settings = registry.build_settings(name, quick=arguments.quick, seed=arguments.seed, changes=changes)
    _run_study(name, settings, arguments, progress)


def _own_study(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    """A study that is a command of its own, with options named like its settings."""
    kind = registry.part(arguments.command, "settings").Settings
    given = {f.name: getattr(arguments, f.name, None) for f in fields(kind)}
    changes = {name: tuple(v) if isinstance(v, list) else v for name, v in given.items() if v is not None}
    settings = kind.quick(**changes) if arguments.quick else kind(**changes)
    _run_study(arguments.command, settings, arguments, progress)


def _simulate(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    require_folder(arguments.out)
    from recon.study.paper.plaque_scan import inset_grid  # loads scipy.stats, which takes long

    scene, plaque = plaque_scene()
    scan = acquire(
        scene,
        presets.pcct(views=arguments.views),
        exposure_s=arguments.exposure,
        seed=arguments.seed,
        region=None if arguments.whole else inset_grid(plaque, 0.1),
        progress=progress.of("simulate"),
    )
    progress.close()
    scan.save(arguments.out)
    _tell(
        arguments.out,
        readings=list(scan.counts.shape),
        exposure_s=scan.exposure_s,
        seed=scan.seed,
        mean_count=float(scan.counts.mean()),
        **scan.info,
    )


def _reconstruct(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    require_folder(arguments.out)
    check_volume_name(arguments.out)
    voxel = number("--voxel", arguments.voxel, positive=True, unit="mm")
    scan = Scan.load(arguments.scan)
    from recon.study.paper.plaque_scan import INSET_MM  # loads scipy.stats, which takes long

    shape = tuple(math.ceil(e / voxel - 1e-6) for e in arguments.extent or INSET_MM)
    grid = VolumeGrid(shape, voxel, tuple(arguments.center or PAPER_POSITION[::-1]))
    options = {} if arguments.kernel is None else {"kernel": arguments.kernel}
    volume = reconstruct(
        scan, grid, arguments.method, progress=progress.of(arguments.method), device=arguments.device, **options
    )
    progress.close()
    volume.save(arguments.out)
    _tell(
        arguments.out,
        shape=list(grid.shape),
        spacing_mm=list(grid.spacing),
        center_mm=list(grid.center),
        mean_hu=float(volume.data.mean()),
        **volume.report,
    )


def _verify(arguments: argparse.Namespace, progress: ProgressBars) -> None:
    results, readme = arguments.root / "notebooks", arguments.root / "README.md"
    claims, text = verify.load_claims(results / "claims.yaml"), readme.read_text(encoding="utf-8")
    if arguments.write:
        text = verify.rewrite(text, claims, results)
        with written_whole(readme) as part:
            part.write_text(text, encoding="utf-8")
    wrong = [v for v in verify.verify(text, claims, results) if not v.ok]
    for v in wrong:
        print(f"FAIL  the results say: {v.said}\n      README.md says:  {v.found or 'nothing like it'}")
    bare = list(verify.uncovered(text, claims, verify.RESULTS))
    for line in bare:
        print(f"FAIL  no claim covers the figures of: {line}")
    print(f"{len(claims) - len(wrong)} of {len(claims)} sentences with figures say what the results say")
    changed = []
    for name in arguments.again:
        committed = json.loads((results / registry.folder(name) / "report.json").read_text(encoding="utf-8"))
        settings = registry.settings_of(name, committed["settings"])
        again = json.loads(registry.run(name, settings, progress).json)
        found = list(verify.differences(committed, again))
        progress.close()
        print("\n".join([f"{name}: {len(found)} figures differ from the committed ones", *found]))
        changed += found
    if wrong or bare or changed:
        raise ValueError("README.md and the committed results do not agree: see above (--write mends the README)")


def _tell(file: Path, **summary: Any) -> None:
    """Print what was written, and write it as JSON beside."""
    text = json.dumps({"file": str(file), **summary}, indent=1)
    with written_whole(file.with_name(file.name + ".json")) as part:
        part.write_text(text + "\n", encoding="utf-8")
    print(text)


# --- parsing ------------------------------------------------------------------------------------------------------

_Commands = Any
"""What ``add_subparsers`` gives; argparse does not publish its type."""


def _command(
    commands: _Commands, name: str, run: Callable[..., None], help: str, description: str, out: str, **more: Any
) -> argparse.ArgumentParser:
    """A command with the options of all commands; ``out`` is the help of ``--out``, ``more`` its default or need."""
    parser: argparse.ArgumentParser = commands.add_parser(name, help=help, description=description)
    parser.set_defaults(run=run)
    parser.add_argument("--seed", type=int, default=0, help="first seed of the noise, ≥ 0 (default 0)")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where volumes are kept (default cpu)")
    parser.add_argument("--out", type=Path, metavar="PATH", help=out, **more)
    parser.add_argument("--no-progress", action="store_true", help="no progress bars")
    parser.add_argument("-v", "--verbose", action="store_true", help="log what the library does")
    return parser


def _add_compare(commands: _Commands) -> None:
    parser = _command(
        commands, "compare", _own_study, registry.STUDIES["compare"],
        "Simulate the paper's plaque scan at full size, reconstruct it by FBP (kernels × voxel sizes), PWLS and MBIR "
        "at 1×, 2×, 5.7× and 8× dose, and print what dose MBIR saves and the paper's tables beside its numbers.",
        "folder for report.json, report.md and compare.png (default out/compare)",
    )  # fmt: skip
    parser.add_argument("--realizations", type=int, metavar="N", help="per dose (default 10)")
    parser.add_argument("--quick", action="store_true", help="reduced views and settings: a first look, < 45 s")
    parser.add_argument("--no-pwls", dest="pwls", action="store_const", const=False, help="leave PWLS out")
    parser.add_argument("--no-mbir", dest="mbir", action="store_const", const=False, help="no MBIR, no dose factors")


def _add_dose_factor(commands: _Commands) -> None:
    parser = _command(
        commands, "dose-factor", _own_study, registry.STUDIES["dose-factor"],
        "Reconstruct the same noise realisations of the paper's scan by every method and measure the dose "
        "at which FBP reaches the same figure: the paper's CNR, slope-corrected contrast variance, observer. Finished "
        "pieces in the folder are kept: after an interruption the same command goes on.",
        "folder for pieces, report.json, report.md and figures (default out/dose-factor)",
    )  # fmt: skip
    parser.add_argument("--n", type=int, help="paired realisations per dose and scene (default 200)")
    parser.add_argument("--slow-n", type=int, help="the same for the slow baselines (default 48)")
    parser.add_argument("--scene-n", type=int, help="realisations of each further scene and vessel (default 40)")
    parser.add_argument("--doses", type=float, nargs="+", metavar="S", help="exposures in s")
    parser.add_argument("--scene-doses", type=float, nargs="+", metavar="S", help="of further scenes")
    parser.add_argument("--methods", nargs="+", metavar="M", help="linear quadratic qggmrf tv mbir_one_pass mbir …")
    parser.add_argument("--scenes", nargs="*", metavar="NAME", help="further scenes (none: leave out)")
    parser.add_argument("--scene-methods", nargs="+", metavar="M", help="methods of further scenes and vessels")
    parser.add_argument("--vessels", nargs="*", metavar="NAME", help="vessels of other directions (none: leave out)")
    parser.add_argument(
        "--fast-noise", action="store_const", const=True, help="draw the noise of AᵀW y, not that of the readings"
    )
    parser.add_argument("--quick", action="store_true", help="12 realisations, one dose, 164 views: about a minute")


def _add_study(commands: _Commands) -> None:
    parser = _command(
        commands, "study", _study, "one of the paper's studies; torchpcct study --help lists them",
        "Run a study of the paper at full scale and print its figures beside the published ones.",
        "folder for report.json, report.md and the figures (default out/NAME)",
    )  # fmt: skip
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "studies:\n" + "".join(f"  {name:<12} {text}\n" for name, text in registry.STUDIES.items())
    parser.add_argument("name", metavar="NAME", help="of the study")
    parser.add_argument("--quick", action="store_true", help="reduced settings: a first look, < 60 s")
    parser.add_argument(
        "--set",
        dest="changes",
        action="append",
        default=[],
        metavar="FIELD=VALUE",
        help="change a setting (repeatable)",
    )


def _add_simulate(commands: _Commands) -> None:
    parser = _command(
        commands, "simulate", _simulate, "simulate a scan of the plaque to an HDF5 file",
        "Simulate a scan of the paper's plaque by the deep-silicon PCCT and write it to HDF5.",
        "HDF5 file to write", required=True,
    )  # fmt: skip
    parser.add_argument("--exposure", type=float, metavar="S", help="exposure in s (default: noise free)")
    parser.add_argument(
        "--views", type=int, default=presets.PCCT_VIEWS, help="views per rotation (default %(default)s)"
    )
    parser.add_argument(
        "--whole", action="store_true", help="keep the whole detector, not only the plaque's surroundings"
    )


def _add_reconstruct(commands: _Commands) -> None:
    parser = _command(
        commands, "reconstruct", _reconstruct, "reconstruct a scan file to a volume in HU",
        "Reconstruct an inset of a scan and write it as .nii, .nii.gz or .h5, with a .json report beside.",
        "volume to write: .nii, .nii.gz or .h5", required=True,
    )  # fmt: skip
    parser.add_argument("scan", type=Path, help="scan file written by simulate")
    parser.add_argument("--method", default="fbp", help="fbp, pwls or mbir (default fbp)")
    parser.add_argument("--kernel", help="FBP kernel: soft, standard, detail, bone, ram-lak")
    parser.add_argument("--voxel", type=float, default=0.25, metavar="MM", help="voxel size (default 0.25)")
    axes = ("Z", "Y", "X")
    parser.add_argument("--center", type=float, nargs=3, metavar=axes, help="centre in mm (default: the plaque)")
    parser.add_argument("--extent", type=float, nargs=3, metavar=axes, help="edge lengths in mm (default: the inset)")


def _add_verify(commands: _Commands) -> None:
    text = "Compare every figure of the README with the key of the committed result that it comes from "
    parser = commands.add_parser(
        "verify", help="do the README's figures say what the committed results say?",
        description=f"{text}(notebooks/claims.yaml), and compute studies again if asked.",
    )  # fmt: skip
    parser.set_defaults(run=_verify, device="cpu", no_progress=False, verbose=False)
    parser.add_argument("--root", type=Path, default=Path(), help="folder of the repository (default: this one)")
    parser.add_argument("--write", action="store_true", help="put the committed figures into the README")
    parser.add_argument("--again", nargs="*", default=[], metavar="STUDY", help="compute these studies again, in full")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="torchpcct",
        description="Photon-counting CT: simulate, reconstruct, and measure what model-based reconstruction saves.",
    )
    parser.add_argument("--version", action="version", version=f"torchpcct {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add in (_add_compare, _add_dose_factor, _add_study, _add_simulate, _add_reconstruct, _add_verify):
        add(commands)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status: 0 done, 2 refused input, 130 interrupted."""
    options = _parser().parse_args(arguments)
    options.command_line = list(sys.argv[1:] if arguments is None else arguments)
    logging.basicConfig(
        level=logging.INFO if options.verbose else logging.WARNING, format="%(levelname)s %(name)s: %(message)s"
    )
    progress = ProgressBars(not options.no_progress and sys.stderr.isatty())
    try:
        if options.device == "cuda" and not torch.cuda.is_available():
            raise ValueError("--device cuda: PyTorch finds no CUDA device here; use --device cpu")
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
