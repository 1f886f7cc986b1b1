"""Names of methods, filters and tasks, checked before anything that computes is loaded.

What the names stand for is in :mod:`recon.evaluate.methods` and :mod:`recon.evaluate.tasks`.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from recon.names import KERNELS
from torchpcct.validate import choice, meant, number, renamed

__all__ = ["FILTERS", "TASKS", "check_method", "check_task", "mbir_options", "meant_method"]

FILTERS: tuple[str, ...] = ("gaussian", "perona_malik", "bilateral", "nlm", "tv", "bm4d")
"""Of :mod:`recon.evaluate.rivals`."""

_FOLDER = resources.files("recon") / "evaluate" / "tasks"
TASKS: tuple[str, ...] = tuple(sorted(Path(str(p)).stem for p in _FOLDER.iterdir() if str(p).endswith(".yaml")))
"""Names of the tasks that come with the package."""


def check_task(what: str) -> None:
    """Refuse what names no task: neither a ready one nor a YAML file that is there.

    Raises:
        ValueError: no such task. FileNotFoundError: no such file.
    """
    if Path(what).suffix not in (".yaml", ".yml"):
        choice("task", what, TASKS)
    elif not Path(what).is_file():
        raise FileNotFoundError(f"no such file: {what}; torchpcct show-task prints an example")


def check_method(spec: str) -> None:
    """Refuse a name that is no method, as far as its text tells.

    Raises:
        ValueError, TypeError: an unknown name, kernel or option, with those that there are.
        FileNotFoundError: weights or a folder that do not exist.
    """
    head, _, base = spec.partition("@")
    if base:
        check_method(base)
        kind = "filter" if head in FILTERS else "denoiser"
        if kind == "denoiser" and not all(head.partition(":")):
            raise ValueError(
                f"unknown method {head!r}: a function is package.module:function, a filter one of "
                f"{', '.join(FILTERS)}{meant_method(head)}"
            )
        if base.partition(":")[0] != "fbp":
            raise ValueError(f"a {kind} needs FBP before it, got {base!r}: fbp:KERNEL")
        return
    name, _, rest = spec.partition(":")
    if name == "fbp":
        choice("kernel", rest or "standard", KERNELS)
    elif name == "mbir":
        mbir_options(rest)
    elif name == "files":
        if not Path(rest).is_dir() or not rest:
            raise FileNotFoundError(f"no folder {rest!r} with volumes")
    elif not name or (not rest and name != "pwls"):
        known = "fbp:KERNEL, pwls, mbir, FILTER@BASE, package.module:function, files:FOLDER"
        raise ValueError(f"unknown method {spec!r}: one of {known}{meant_method(spec)}")
    elif name == "pwls" and rest:
        raise ValueError(f"pwls has no options, got {spec!r}")


def mbir_options(text: str) -> dict[str, str]:
    """Options of ``mbir:fidelity=1,vessel`` by name.

    Raises:
        ValueError, TypeError: an unknown option, or a value that it does not take.
        FileNotFoundError: weights that do not exist.
    """
    given: dict[str, str] = {}
    for part in filter(None, text.split(",")):
        key, _, value = part.partition("=")
        key = renamed("mbir:look", "mbir:fidelity", "fidelity") if key == "look" else key
        given[choice("option of mbir", key, ("weights", "fidelity", "vessel", "tissues", "prior"))] = value
    if "fidelity" in given:
        number("fidelity", given["fidelity"], low=0.0, high=1.0)
    if "prior" in given:
        choice("prior of mbir", given["prior"], ("bilateral",))
    for name in ("vessel", "tissues"):
        if given.get(name):
            raise ValueError(f"{name} of mbir takes no value, got {given[name]!r}: mbir:{name}")
    if "weights" in given and not Path(given["weights"]).is_file():
        raise FileNotFoundError(f"no such file: {given['weights'] or 'weights= without a name'}")
    return given


def meant_method(head: str) -> str:
    """`` (did you mean 'mbir'?)`` where the first part of a name is like that of a method of the package."""
    return meant(head, ("fbp", "pwls", "mbir", "files", *FILTERS))
