"""Names of methods, filters and tasks, checked before anything that computes is loaded.

What the names stand for is in :mod:`recon.evaluate.methods` and :mod:`recon.evaluate.tasks`.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from recon.names import (
    CONTRASTS,
    FILTERS,
    KERNELS,
    filter_name,
    is_module_name,
    mbir_options,
    meant_method,
    packaged_names,
    split_energies,
)
from torchpcct.validate import choice

__all__ = ["TASKS"]

_FOLDER = resources.files("recon") / "evaluate" / "tasks"
"""Of the tasks that come with the package."""
TASKS = packaged_names(_FOLDER)
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
    spec, energies = split_energies(spec)
    if energies is not None:
        _check_energies(spec, energies)
    head, _, base = spec.partition("@")
    if base:
        check_method(base)
        kind = "filter" if filter_name(head) in FILTERS else "denoiser"
        if kind == "denoiser" and not is_module_name(head):
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
            raise FileNotFoundError(
                f"no such folder: {rest!r}; files:FOLDER needs one with volumes"
            )
    elif not name or (not rest and name != "pwls"):
        known = "fbp:KERNEL, pwls, mbir, FILTER@BASE, package.module:function, files:FOLDER"
        raise ValueError(f"unknown method {spec!r}: one of {known}{meant_method(spec)}")
    elif name == "pwls" and rest:
        raise ValueError(f"pwls has no options, got {spec!r}")


def _check_energies(method: str, energies: str) -> None:
    """Refuse what is no contrast, and methods that are given no scans."""
    if method.startswith("files:"):
        raise ValueError(
            f"energies= weights the bins of a scan, and {method!r} reads volumes: leave it out"
        )
    if energies in ("", "task", *CONTRASTS):
        return
    names = energies.split("/")
    if len(names) != 2:
        raise ValueError(
            f"energies= must be task, {', '.join(CONTRASTS)} or two materials A/B, got {energies!r}"
        )
    from torchpcct.scene.materials import material  # loads numpy

    for name in names:
        material(name)
