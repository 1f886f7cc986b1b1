"""What the commands share: their common options, and what they say when they are done."""

from __future__ import annotations

import argparse
import json
import logging
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchpcct.files import written_whole

__all__ = [
    "SCAN_ENDINGS",
    "Commands",
    "as_json",
    "as_options",
    "check_ending",
    "command",
    "length_of",
    "saying",
    "tell",
    "without_ending",
]

SCAN_ENDINGS = (".h5", ".hdf5")

Commands = Any
"""What ``add_subparsers`` gives; argparse does not publish its type."""


def command(
    commands: Commands,
    name: str,
    run: Callable[..., None],
    help: str,
    description: str,
    out: str,
    *,
    required: bool = False,
    seed: int | None = 0,
) -> argparse.ArgumentParser:
    """A command with the options of all commands.

    Args:
        out: help of ``--out``; required: whether it has no default.
        seed: default of ``--seed``; None: the configuration's.
    """
    parser: argparse.ArgumentParser = commands.add_parser(name, help=help, description=description)
    parser.set_defaults(run=run)
    default = "the configuration's, or 0" if seed is None else f"{seed}"
    parser.add_argument("--seed", type=int, default=seed, help=f"first seed of the noise, ≥ 0 (default {default})")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where volumes are kept (default cpu)")
    parser.add_argument("--out", type=Path, metavar="PATH", help=out, required=required)
    parser.add_argument("--no-progress", action="store_true", help="no progress bars")
    parser.add_argument("-v", "--verbose", action="store_true", help="log what the library does")
    return parser


def as_options(text: str, actions: Sequence[argparse.Action]) -> str:
    """A message of the library with the command's options in place of its arguments: ``--pitch MM`` for ``pitch=``.

    Args:
        text: arguments stand in it as ``name=`` or ``name=value``, or before "must" or "needs" at its start.
        actions: of the command's parser.
    """
    for action in actions:
        flag = next((o for o in action.option_strings if o.startswith("--")), "")
        if not flag:
            continue
        kind = action.metavar or (None if action.nargs == 0 else action.dest.upper())
        value = " ".join(kind) if isinstance(kind, tuple) else kind
        text = re.sub(rf"(?<![\w.-]){action.dest}=True\b", flag, text)
        text = re.sub(rf"(?<![\w.-]){action.dest}=[\"']?([\w.-]+\w)[\"']?", rf"{flag} \1", text)
        text = re.sub(rf"(?<![\w.-]){action.dest}=", f"{flag} {value}" if value else flag, text)
        text = re.sub(rf"(^|: ){action.dest}(?=(\[\d\])? (must|needs)\b)", rf"\g<1>{flag}", text)
    return text


class _Said(logging.Handler):
    """Says every text once, on the standard error."""

    def __init__(self, actions: Sequence[argparse.Action]) -> None:
        super().__init__()
        self.actions, self.said = actions, set[str]()

    def warn(self, text: str) -> None:
        """Say a warning, unless it was said before."""
        if text not in self.said:
            self.said.add(text)
            print(f"warning: {as_options(text, self.actions)}", file=sys.stderr)

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.WARNING:
            self.warn(record.getMessage())
        else:
            print(f"{record.name}: {record.getMessage()}", file=sys.stderr)


@contextmanager
def saying(actions: Sequence[argparse.Action], verbose: bool) -> Iterator[Callable[[str], None]]:
    """While a command runs: what the library logs, what it warns of, and what the command adds, each said once.

    Args:
        actions: of the command's parser, for :func:`as_options`.
        verbose: say what is logged below warnings, too.
    """
    handler, root = _Said(actions), logging.getLogger()
    level = root.level
    root.addHandler(handler)
    root.setLevel(logging.INFO if verbose else logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *place, **more: handler.warn(str(message))
            yield handler.warn
    finally:
        root.removeHandler(handler)
        root.setLevel(level)


def as_json(value: Any, inset: str = "") -> str:
    """JSON with a line for every key; lists of numbers and texts, and of such lists, on one line."""
    deeper = inset + " "
    if isinstance(value, Mapping) and value:
        lines = [f"{json.dumps(str(k), ensure_ascii=False)}: {as_json(v, deeper)}" for k, v in value.items()]
        brackets = "{}"
    elif isinstance(value, list | tuple) and any(isinstance(v, Mapping) for v in value):
        lines, brackets = [as_json(v, deeper) for v in value], "[]"
    else:
        return json.dumps(value, ensure_ascii=False, default=str)
    return brackets[0] + ",".join(f"\n{deeper}{line}" for line in lines) + f"\n{inset}{brackets[1]}"


def tell(arguments: argparse.Namespace, short: str, config: dict[str, Any], **summary: Any) -> None:
    """Write summary (JSON) and resolved configuration (YAML) beside the result, and print one line or, asked, all."""
    import yaml

    file: Path = arguments.out
    text = as_json({"file": str(file), **summary})
    for ending, content in ((".json", text), (".yaml", yaml.safe_dump(config, sort_keys=False, allow_unicode=True))):
        with written_whole(file.with_name(file.name + ending)) as part:
            part.write_text(content.rstrip() + "\n", encoding="utf-8")
    print(text if arguments.json else f"{file}: {short}")


def check_ending(path: Path, endings: tuple[str, ...]) -> None:
    """Refuse a name with another ending (ValueError)."""
    if path.suffix.lower() not in endings:
        raise ValueError(f"unknown ending of {path.name!r}: use {', '.join(endings)}")


def length_of(unit: str) -> str:
    """Unit of the lengths of a scan or volume in ``unit``."""
    return "pixels" if unit == "pixel^-1" else "mm"


def without_ending(path: Path) -> str:
    """The name of a scan, a volume or a folder without what says its format."""
    name = path.resolve().name
    return name[: -len(".nii.gz")] if name.endswith(".nii.gz") else name if path.is_dir() else Path(name).stem
