"""What the commands share: their common options, and what they say when they are done."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torchpcct.files import written_whole

__all__ = ["SCAN_ENDINGS", "Commands", "check_ending", "command", "tell", "without_ending"]

SCAN_ENDINGS = (".h5", ".hdf5")

Commands = Any
"""What ``add_subparsers`` gives; argparse does not publish its type."""


def command(
    commands: Commands, name: str, run: Callable[..., None], help: str, description: str, out: str, **more: Any
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


def tell(arguments: argparse.Namespace, short: str, config: dict[str, Any], **summary: Any) -> None:
    """Write summary (JSON) and resolved configuration (YAML) beside the result, and print one line or, asked, all."""
    import yaml

    file: Path = arguments.out
    text = json.dumps({"file": str(file), **summary}, indent=1, default=str)
    for ending, content in ((".json", text), (".yaml", yaml.safe_dump(config, sort_keys=False, allow_unicode=True))):
        with written_whole(file.with_name(file.name + ending)) as part:
            part.write_text(content.rstrip() + "\n", encoding="utf-8")
    print(text if arguments.json else f"{file}: {short}")


def check_ending(path: Path, endings: tuple[str, ...]) -> None:
    """Refuse a name with another ending (ValueError)."""
    if path.suffix.lower() not in endings:
        raise ValueError(f"unknown ending of {path.name!r}: use {', '.join(endings)}")


def without_ending(path: Path) -> str:
    """The name of a scan, a volume or a folder without what says its format."""
    name = path.resolve().name
    return name[: -len(".nii.gz")] if name.endswith(".nii.gz") else name if path.is_dir() else Path(name).stem
