"""What the commands share: their common options, and what they say when they are done."""

from __future__ import annotations

import argparse
import json
import logging
import os
import re
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias

from torchpcct.files import WriteError, require_folder, require_writable, write_together
from torchpcct.validate import meant, number, numbers, whole

if TYPE_CHECKING:
    from concurrent.futures import Executor
    from types import FrameType

    from torchpcct.typing import Json
    from torchpcct.validate import Limits


SCAN_ENDINGS = (".h5", ".hdf5")
"""Endings of scan files."""
_BESIDE = (".json", ".yaml")
"""Endings of summary and configuration, which :func:`write_summary` adds to the result's name."""

Commands: TypeAlias = "argparse._SubParsersAction[Parser]"
"""What ``add_subparsers`` gives."""


_COMMON = "common options"
"""Heading of the options that all commands have."""
_SEED = {"low": 0, "high": 2**62}
"""Limits of a seed."""
MOST = 4096
"""More processes or threads than a machine has use for."""
MANY = 10**6
"""More views, realisations or particles than anything here can hold."""
REALISATIONS: Limits = {"low": 8, "high": MANY}
"""Limits of numbers of noise realisations."""
LENGTH: Limits = {"positive": True, "high": 1e12, "unit": "mm"}
"""Limits of lengths: scans of any unit of length pass, slips of a power of ten by far do not."""
EXPOSURE: Limits = {"positive": True, "high": 1e6, "unit": "s"}
"""Limits of exposures."""
PLACE: Limits = {"low": -1e12, "high": 1e12, "unit": "mm"}
"""Limits of positions, as of lengths."""
FORCE = ("--force", bool, None, "replace a file that another command or software has made")
"""Option of all commands that write."""
PLAN_OPTIONS = (
    ("--dry-run", bool, None, "print the plan, memory and time; compute nothing"),
    ("--json", bool, None, "print the whole summary as JSON"),
)
"""Options of commands that make scans and volumes."""


class _Help(argparse.HelpFormatter):
    """Wraps descriptions, and leaves texts that have lines of their own (examples, lists) as
    they are."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if "\n" in text else super()._fill_text(text, width, indent)


class Parser(argparse.ArgumentParser):
    """Its errors say what may have been meant; its help ends with the options that all commands
    have.

    Attributes:
        listing: what stands in the help in place of argparse's list of commands.
        limits: of the values of options, see :func:`add_options`.
        read: options that name what is read.
    """

    listing = ""

    def __init__(self, **options: Any) -> None:
        super().__init__(formatter_class=_Help, **options)
        self.limits: dict[str, dict[str, Any]] = {}
        self.read: list[str] = []

    def error(self, message: str) -> NoReturn:
        """Say it with the nearest command, option or value, and exit with status 2."""
        flags = [flag for action in self._actions for flag in action.option_strings]
        if found := re.match(
            r"argument (\S+): invalid choice: '(.*?)' \(choose from (.*)\)", message
        ):
            name, given, rest = found.groups()
            choices = re.findall(r"[\w-]+", rest)
            if name == "COMMAND":
                message = f"unknown command {given!r}"
            message += meant(given, choices)
        elif found := re.match("unrecognized arguments: (-[^ =]+)", message):
            message += meant(found[1], flags)
        self.exit(2, f"{self.prog}: {message}; {self.prog} --help says more\n")

    def format_help(self) -> str:
        """The help, the common options last."""
        self._action_groups.sort(key=lambda group: group.title == _COMMON)
        if not self.listing:
            return super().format_help()
        formatter = self._get_formatter()
        formatter.add_text(self.description)
        formatter.add_text(self.listing)
        formatter.start_section("options")
        formatter.add_arguments(self._get_optional_actions())
        formatter.end_section()
        formatter.add_text(self.epilog)
        return self.format_usage() + "\n" + formatter.format_help()


def _path(text: str) -> Path:
    return Path(_text(text))


def _text(text: str) -> str:
    if not text.strip():
        raise argparse.ArgumentTypeError("it is empty")
    return text


_TYPES: dict[type, Callable[[str], object]] = {Path: _path, str: _text}
"""What nobody means by an empty text: a path would be the current folder."""
_HINTS = {
    "scan": " (torchpcct simulate makes scans)",
    "config": " (torchpcct show-config prints an example)",
}
"""Where a missing file may come from, by the argument's name."""


def is_path(action: argparse.Action) -> bool:
    """Whether an option takes a path."""
    return action.type is _path


def examples(parser: argparse.ArgumentParser, *lines: str, before: str = "") -> None:
    """Example commands, and what stands before them, at the end of a command's help."""
    word = "example" if len(lines) == 1 else "examples"
    parser.epilog = before + f"{word}:\n" + "".join(f"  {line}\n" for line in lines)


def add_options(parser: Parser, *rows: tuple[Any, ...], group: str = "") -> None:
    """Declare options from a table, with the limits that :func:`check_limits` holds their values
    to.

    Args:
        parser: of the command.
        rows: flags (without dashes: an argument), type (``bool``: a switch), metavar or None, help,
            and, where there is more to say, a mapping of ``limits`` (of
            :func:`torchpcct.validate.number`, for several values of each; of whole numbers ``low``
            and ``high``), ``read`` (True: files that must be there), and of what ``add_argument``
            takes.
        group: title of the group in the help; "": with the others.
    """
    to = parser.add_argument_group(group) if group else parser
    for flag, kind, metavar, text, *more in rows:
        keys: dict[str, Any] = dict(more[0]) if more else {}
        limits, read = keys.pop("limits", None), keys.pop("read", False)
        keys |= (
            {"action": "store_true"}
            if kind is bool
            else {"type": _TYPES.get(kind, kind), "metavar": metavar}
        )
        action = to.add_argument(*flag.split(), help=text, **keys)
        if limits is not None:
            parser.limits[action.dest] = limits
        if read:
            parser.read.append(action.dest)


def check_limits(arguments: argparse.Namespace, parser: Parser) -> None:
    """Refuse, before a command does anything, values beyond the limits of their options, and files
    that are not there.

    Raises:
        ValueError: a value out of range. FileNotFoundError: no such file.
    """
    for name, limits in parser.limits.items():
        value = getattr(arguments, name)
        flag = next(
            o
            for a in parser._actions
            if a.dest == name
            for o in a.option_strings
            if o.startswith("--")
        )
        if isinstance(value, int):
            whole(flag, value, **limits)
        elif isinstance(value, float):
            number(flag, value, **limits)
        elif value is not None:
            numbers(flag, value, **limits)
    for name in parser.read:
        given = getattr(arguments, name) or []
        for path in given if isinstance(given, list) else [given]:
            if not path.exists():
                raise FileNotFoundError(f"no such file: {path}{hint_of_missing(name, path)}")


def hint_of_missing(name: str, path: Path) -> str:
    """Where a file that is not there may come from, by the argument's name; of a pattern, that the
    shell was kept from replacing it, or found nothing."""
    if any(character in str(path) for character in "*?["):
        return " (the shell replaces a pattern: write it without quotes, or does no file match?)"
    return _HINTS.get(name, "")


def command(
    commands: Commands,
    name: str,
    run: Callable[..., object],
    help: str,
    description: str,
    *lines: str,
    out: str = "",
    before: str = "",
    required: bool = False,
    seed: int | None = 0,
    draws: bool = True,
    on_device: bool = False,
) -> Parser:
    """A command with its examples and, if it makes files, with the options of all that do.

    Args:
        lines: example commands; before: what stands before them.
        out: help of ``--out``; "": the command has none of the common options. required: ``--out``
            has no default.
        seed: default of ``--seed``; None: the configuration's.
        draws: whether the command uses random numbers and so has ``--seed``.
        on_device: whether it computes on a GPU; otherwise ``--device`` is not shown, and refused
            with a remedy if it is given.
    """
    parser: Parser = commands.add_parser(name, help=help, description=description)
    examples(parser, *lines, before=before)
    if not out:
        parser.set_defaults(run=run, device="cpu", no_progress=True, verbose=False)
        return parser
    parser.set_defaults(run=run)
    default = "the configuration's, or 0" if seed is None else f"{seed}"
    add_options(parser, ("--out", Path, "PATH", out, {"required": required}))
    seeds = (
        "--seed",
        int,
        None,
        f"seed of the random numbers, of the first realisation if there are several, ≥ 0 (default "
        f"{default})",
        {"default": seed, "limits": _SEED},
    )
    add_options(
        parser,
        *((seeds,) if draws else ()),
        (
            "--device",
            str,
            None,
            "where to compute (default cpu)" if on_device else argparse.SUPPRESS,
            {"choices": ("cpu", "cuda"), "default": "cpu"},
        ),
        FORCE,
        ("--no-progress", bool, None, "no progress bars"),
        ("-v --verbose", bool, None, "log what the library does"),
        group=_COMMON,
    )
    return parser


_ENDS = r"(?=[,;:.)]*(?:\s|$))"
"""After a word of a sentence: a name that goes on is a part of a path or of a value."""


def _in_brackets(deep: int) -> str:
    """Pattern of what stands between a pair of brackets, with pairs in it so many levels deep."""
    return r"[^()]*" if deep == 0 else rf"(?:[^()]|\({_in_brackets(deep - 1)}\))*"


_OF_FILE = " cannot be read as "
"""Before what is wrong within a file (:func:`torchpcct.formats.damage.reading`)."""
_VALUES = re.compile(
    # VolumeGrid(shape=(8, 8), center=(0.0, 0.0)): what an object prints
    rf"[A-Za-z_][\w.]*\({_in_brackets(4)}\)"
    r"""|(?<![\w=])'[^']*'(?!\w)|(?<![\w=])"[^"]*"(?!\w)"""  # what the user gave
)
"""Values in a message, which are no names of arguments."""


def as_options(text: str, actions: Sequence[argparse.Action]) -> str:
    """A message of the library with the command's options in place of its arguments: ``--pitch MM``
    for ``pitch=``.

    Values that the message shows stay as they are: quoted ones, printed objects, paths.

    Args:
        text: arguments stand in it as ``name=`` or ``name=value``, or before "must" or "needs" at
            its start.
        actions: of the command's parser.
    """
    shown = _VALUES.findall(text)
    text = _VALUES.sub("\0", text)
    for action in actions:
        flag = next((o for o in action.option_strings if o.startswith("--")), "")
        if not flag:
            continue
        kind = action.metavar or (None if action.nargs == 0 else action.dest.upper())
        value = " ".join(kind) if isinstance(kind, tuple) else kind
        name = rf"(?<![^\s(]){action.dest}"
        text = re.sub(rf"{name}=True{_ENDS}", flag, text)
        text = re.sub(rf"{name}=([\"']?)([+-]?[\w-]+(?:\.\d+)?)\1{_ENDS}", rf"{flag} \2", text)
        text = re.sub(rf"{name}={_ENDS}", f"{flag} {value}" if value else flag, text)
        # What a file says of itself is no option, though it may be called like one.
        said, of_file, rest = text.partition(_OF_FILE)
        said = re.sub(rf"(^|: ){action.dest}(?=(\[\d\])? (must|needs)\b)", rf"\g<1>{flag}", said)
        text = said + of_file + rest
    return re.sub("\0", lambda _: shown.pop(0), text)


class _ShownOnce(logging.Handler):
    """Shows every text once, on the standard error."""

    def __init__(self, actions: Sequence[argparse.Action]) -> None:
        super().__init__()
        self.actions, self.shown = actions, set[str]()

    def warn(self, text: str) -> None:
        """Show a warning, unless it was shown before."""
        if text not in self.shown:
            self.shown.add(text)
            print(f"warning: {as_options(text, self.actions)}", file=sys.stderr)

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.WARNING:
            self.warn(record.getMessage())
        else:
            print(f"{record.name}: {record.getMessage()}", file=sys.stderr)


@contextmanager
def showing_messages(
    actions: Sequence[argparse.Action], verbose: bool
) -> Iterator[Callable[[str], None]]:
    """While a command runs: what the library logs, what it warns of, and what the command adds,
    each shown once.

    Args:
        actions: of the command's parser, for :func:`as_options`.
        verbose: say what is logged below warnings, too.
    """
    handler, root = _ShownOnce(actions), logging.getLogger()
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


def as_json(value: object, inset: str = "") -> str:
    """JSON with a line for every key; lists of numbers and texts, and of such lists, on one
    line."""
    deeper = inset + " "
    if isinstance(value, Mapping) and value:
        lines = [
            f"{json.dumps(str(k), ensure_ascii=False)}: {as_json(v, deeper)}"
            for k, v in value.items()
        ]
        brackets = "{}"
    elif isinstance(value, list | tuple) and any(isinstance(v, Mapping) for v in value):
        lines, brackets = [as_json(v, deeper) for v in value], "[]"
    else:
        return json.dumps(value, ensure_ascii=False, default=str)
    return brackets[0] + ",".join(f"\n{deeper}{line}" for line in lines) + f"\n{inset}{brackets[1]}"


def write_summary(
    arguments: argparse.Namespace, short: str, config: dict[str, object], **summary: object
) -> None:
    """Write summary (JSON) and resolved configuration (YAML) beside the result, and print one
    line or, asked, all."""
    import yaml

    file: Path = arguments.out
    text = as_json({"file": str(file), **summary})
    done = yaml.safe_dump(config, sort_keys=False, allow_unicode=True)
    contents = {
        file.name + ending: f"{content.rstrip()}\n".encode()
        for ending, content in zip(_BESIDE, (text, done), strict=True)
    }
    try:
        write_together(file.parent, contents)
    except WriteError as error:
        raise WriteError(f"{error}; {file} itself is written") from error
    print(text if arguments.json else f"{file}: {short}")


def _address(text: str) -> str:
    if not (
        re.fullmatch(r"(\w+://)?[^\s/:]+:\d+/?", text)
        or "://" in text
        or Path(_text(text)).is_file()
    ):
        raise argparse.ArgumentTypeError(
            f"{text!r} is neither an address, tcp://HOST:PORT, nor a scheduler's file"
        )
    return text


def add_execution(parser: Parser, dry_run: bool = True) -> None:
    """Where jobs are run, for :func:`executing`; ``dry_run``: False of a command that has this
    option already."""
    scheduler = os.environ.get("DASK_SCHEDULER_ADDRESS")
    add_options(
        parser,
        (
            "--workers",
            int,
            "N",
            "processes of this machine (default: this one alone)",
            {"limits": {"high": MOST}},
        ),
        (
            "--scheduler",
            _address,
            "ADDRESS",
            "Dask scheduler, tcp://HOST:PORT or its file (default: "
            "$DASK_SCHEDULER_ADDRESS); extra: cluster",
            {"default": scheduler},
        ),
        (
            "--threads",
            int,
            "K",
            "threads of each worker (default: cores / N; Dask: 1)",
            {"limits": {"high": MOST}},
        ),
        *(
            [("--dry-run", bool, None, "list the jobs, their time and memory; run none")]
            if dry_run
            else []
        ),
        group="several processes or machines",
    )


_WORKERS_LOAD = "recon.evaluate.experiment"
"""What workers load while the first jobs are thought of; this process may not need it."""


@contextmanager
def executing(arguments: argparse.Namespace, out: Path) -> Iterator[Executor | None]:
    """Run the jobs of a block where the options say, noted in ``OUT/jobs-DATE.log``; ``--dry-run``
    lists them.

    Yields:
        The executor; None: everything is done here, one after another.
    """
    if arguments.threads is not None and arguments.workers is None and not arguments.scheduler:
        raise ValueError(
            "--threads K applies to workers: give --workers N or --scheduler ADDRESS with it"
        )
    from recon.jobs import execute

    executor: Any = None
    if arguments.dry_run:
        executor = execute.Planner()
    elif arguments.workers is not None:
        executor = execute.Processes(arguments.workers, arguments.threads, _WORKERS_LOAD)
    elif arguments.scheduler:
        executor = execute.Cluster(arguments.scheduler, arguments.threads, _WORKERS_LOAD)
        print(f"{executor.workers} workers, dashboard: {executor.dashboard}", file=sys.stderr)
    if executor is not None:
        executor.log = out / f"jobs-{time.strftime('%Y%m%d-%H%M%S')}.log"
    try:
        with nullcontext() if executor is None else executor, execute.using(executor):
            yield executor
    except execute.Planned as plan:
        print(plan)


class Ended(KeyboardInterrupt):
    """A signal of the system asks the command to end, as Ctrl-C does; ``number`` is the
    signal's."""

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(f"ended by {signal.Signals(number).name}")


@contextmanager
def ending_by_signals() -> Iterator[None]:
    """SIGTERM (a batch system's time is up) and SIGHUP (the terminal is closed) raise
    :class:`Ended` in a block.

    Processes are then ended and files taken back that are half written. What is ignored (``nohup``)
    stays so, and what comes on the way out is.
    """
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    main = threading.current_thread() is threading.main_thread()
    mine = [n for n in numbers if main and signal.getsignal(n) is signal.SIG_DFL]

    def on_signal(number: int, frame: FrameType | None) -> None:
        for n in mine:
            signal.signal(n, signal.SIG_IGN)
        raise Ended(number)

    try:
        for n in mine:
            signal.signal(n, on_signal)
        yield
    finally:
        for n in mine:
            signal.signal(n, signal.SIG_DFL)


def check_output(
    arguments: argparse.Namespace,
    is_own: Callable[[Path], bool],
    *inputs: str | Path | None,
    beside: bool = False,
) -> None:
    """See, before anything is computed, that ``--out`` can be written and that nothing of the
    user's is lost by it.

    Args:
        is_own: whether an existing file is one that this command would have made.
        inputs: files that the command reads, by whatever name.
        beside: whether :func:`write_summary` writes beside it.

    Raises:
        ValueError: an input, also by another name, or without ``--force`` something else is there
            already; a folder.
        OSError: there is no such folder, or nothing can be written into it.
    """
    out: Path = arguments.out
    require_folder(out)
    require_writable(out.parent)
    summary, config = (out.with_name(out.name + ending) for ending in _BESIDE)
    for path in (out, summary, config) if beside else (out,):
        if not path.exists():
            continue
        if any(one is not None and Path(one).exists() and path.samefile(one) for one in inputs):
            raise ValueError(
                f"--out {out} would write onto {path}, which is read: name another file"
            )
        own = is_own(path) if path is out else "file" in _json(summary)
        if path.is_dir() and not own:
            raise ValueError(f"{path} is a folder: name a file to write")
        if not (own or arguments.force):
            raise ValueError(
                f"{path} exists and was not made by torchpcct {arguments.command}: name another "
                "file, or --force"
            )


def check_results(
    arguments: argparse.Namespace,
    folder: Path,
    is_own: Callable[[dict[str, Json]], bool],
    *patterns: str,
) -> None:
    """The same for a folder of results: files of these names are replaced if its ``report.json`` is
    of this command.

    Raises:
        ValueError: without ``--force``, files of another origin. OSError: nothing can be written
            there.
    """
    require_writable(next(p for p in (folder, *folder.absolute().parents) if p.exists()))
    there = sorted({path.name for pattern in patterns for path in folder.glob(pattern)})
    if there and not is_own(_json(folder / "report.json")) and not arguments.force:
        raise ValueError(
            f"{folder} holds {', '.join(there[:3])}{' …' if there[3:] else ''}, not made by "
            f"torchpcct {arguments.command}: name another folder, or --force"
        )


def is_picture(path: Path) -> bool:
    """Whether a file begins as its ending says: PNG, PDF or SVG."""
    with path.open("rb") as file:
        head = file.read(512)
    return {".png": head.startswith(b"\x89PNG"), ".pdf": head.startswith(b"%PDF")}.get(
        path.suffix, b"<svg" in head
    )


def _json(path: Path) -> dict[str, Json]:
    """A JSON object in a file; empty if there is none."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def check_ending(path: Path, endings: tuple[str, ...]) -> None:
    """Refuse a name with another ending (ValueError)."""
    if path.suffix.lower() not in endings:
        raise ValueError(f"unknown ending of {path.name!r}: use {', '.join(endings)}")


def length_of(unit: str) -> str:
    """Unit of the lengths of a scan or volume in ``unit``."""
    return "pixels" if unit == "pixel^-1" else "mm"


def find_modules_here() -> None:
    """The user's own modules may lie where the command is run; none hides another one."""
    here = os.getcwd()
    if here not in sys.path:
        sys.path.append(here)


def difference_beside(volume: Path) -> Path:
    """File beside a volume for its difference, in HU, from the one without a vessel model."""
    name = without_ending(volume)
    return volume.with_name(f"{name}_vessel_difference{volume.name[len(name) :]}")


def motion_beside(volume: Path) -> tuple[Path, Path]:
    """Table and picture of the path that was taken out of a volume, beside it."""
    name = without_ending(volume)
    return volume.with_name(f"{name}_motion.csv"), volume.with_name(f"{name}_motion.png")


def without_ending(path: Path) -> str:
    """The name of a scan, a volume or a folder without what says its format."""
    name = path.resolve().name
    return (
        name[: -len(".nii.gz")]
        if name.lower().endswith(".nii.gz")
        else name
        if path.is_dir()
        else Path(name).stem
    )
