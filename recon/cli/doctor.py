"""What ``doctor`` looks at: the installation, the machine, and whether both compute what they
should."""

from __future__ import annotations

import importlib
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import metadata, resources
from pathlib import Path

from torchpcct import VolumeGrid, __version__
from torchpcct.files import require_writable

_MODULES = {
    "scikit-image": "skimage",
    "pyyaml": "yaml",
    "markdown-it-py": "markdown_it",
    "astra-toolbox": "astra",
    "itk-rtk": "itk",
}
"""Modules of packages with another name."""
_FOR_DEVELOPERS = ("test", "docs", "notebooks")
"""Extras that change nothing of what the package does."""
_LOAD = """
import importlib, sys
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
        said = "loads"
    except BaseException as error:
        said = (str(error).strip().splitlines() or [type(error).__name__])[0]
    print("LOADED", name, said, flush=True)
"""
"""Program that says of each module whether it can be imported."""
_CHECKED_ON = (
    "GPU kernels: checked and timed on one card, an H200 (tests/bench/gpu.md); on another, "
    "tests/bench/gpu.py does the same"
)
"""What is known of the kernels for cards."""
_AGAIN = "install torchpcct again, in its folder: pip install --force-reinstall --no-deps ."
"""Remedy of a broken installation."""


def _versions() -> str:
    found, wrong, wanted = [], [], []
    for requirement in metadata.requires("torchpcct") or []:
        name, _, floor = re.split(r"\s*;", requirement)[0].partition(">=")
        if "extra ==" in requirement:
            continue
        try:
            version = metadata.version(name)
            importlib.import_module(_MODULES.get(name, name))
        # missing, or a binary of another machine: both are what is looked for
        except Exception as error:
            wrong.append(f"{name} does not load ({error})")
        else:
            found.append(f"{name} {version}")
            if _numbers(version) >= _numbers(floor):
                continue
            wrong.append(f"{name} {version} is older than {floor}")
        wanted.append(f"'{name}>={floor}'")
    if wrong:
        raise ValueError(f"{'; '.join(wrong)}: pip install --force-reinstall {' '.join(wanted)}")
    return ", ".join(found)


def _numbers(version: str) -> list[int]:
    return [int(n) for n in re.findall(r"\d+", version)[:3]]


def _extras() -> str:
    extras: dict[str, dict[str, str]] = {}  # extra → package → least version
    for requirement in metadata.requires("torchpcct") or []:
        found = re.match(r"([\w.-]+)(?:>=([\w.]+))?\s*;.*extra == .([\w-]+).", requirement)
        if found and found[3] not in _FOR_DEVELOPERS:
            extras.setdefault(found[3], {})[found[1]] = found[2] or ""
    there = [name for names in extras.values() for name in names if _installed(name)]
    faults = _faults(there)
    parts, wrong = [], []
    for extra, names in extras.items():
        missing = [name for name in names if name not in there]
        parts.append(
            f"{extra} lacks {', '.join(missing)} (pip install 'torchpcct[{extra}]')"
            if missing
            else extra
        )
        for name in (n for n in names if n in there):
            version, least = metadata.version(name), names[name]
            if name in faults:
                wrong.append(
                    f"{name} of {extra} does not load ({faults[name]}): pip install "
                    f"--force-reinstall '{name}'"
                )
            elif _numbers(version) < _numbers(least):
                wrong.append(
                    f"{name} {version} of {extra} is older than {least}: pip install "
                    f"'{name}>={least}'"
                )
    if wrong:
        raise ValueError("; ".join(wrong))
    return "; ".join(parts)


def _faults(names: list[str]) -> dict[str, str]:
    """Why installed packages do not load; in a process of its own, which a broken binary may
    end."""
    modules = {_MODULES.get(name, name).replace("-", "_"): name for name in names}
    faults: dict[str, str] = {}
    left = list(modules)
    while left:
        done = subprocess.run(
            [sys.executable, "-P", "-c", _LOAD, *left], capture_output=True, text=True, check=False
        )
        outcomes = dict(re.findall(r"^LOADED (\S+) (.*)$", done.stdout, re.MULTILINE))
        faults |= {
            modules[name]: outcome for name, outcome in outcomes.items() if outcome != "loads"
        }
        left = [name for name in left if name not in outcomes]
        if left:  # it ended at the first of them
            faults[modules[left.pop(0)]] = f"it ends the process, status {done.returncode}"
    return faults


def _installed(name: str) -> bool:
    try:
        return bool(metadata.version(name))
    except metadata.PackageNotFoundError:
        return False


def _threads() -> str:
    import torch

    from torchpcct.threads import get_num_threads

    names = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OMP_WAIT_POLICY")
    settings = ", ".join(f"{n}={os.environ[n]}" for n in names if n in os.environ)
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    used = f"torch {torch.get_num_threads()}, kernels {get_num_threads()}; {settings}"
    return f"{usable} of {os.cpu_count()} cores usable, {used}"


def _processor() -> str:
    import torch
    from llvmlite import binding

    return (
        f"{platform.machine()}, {binding.get_host_cpu_name()}, "
        f"{torch.backends.cpu.get_cpu_capability()}"
    )


def _gpu() -> str:
    import torch

    if not torch.cuda.is_available():
        return (
            f"none that torch can use (torch {torch.__version__}); everything runs on the "
            f"processor. {_CHECKED_ON}"
        )
    if not _installed("triton"):
        raise ValueError("torch finds one, but the GPU kernels need triton: pip install triton")
    about = torch.cuda.get_device_properties(0)
    versions = f"CUDA {torch.version.cuda}, triton {metadata.version('triton')}"
    return f"{about.name}, {about.total_memory / 2**30:.0f} GiB, {versions}. {_CHECKED_ON}"


def _cache() -> str:
    from torchpcct.cache_folder import is_temporary
    from torchpcct.kernel_cache import folders
    from torchpcct.projector.cpu import cone_kernels

    folder = Path(min(folders(cone_kernels.__name__)))
    try:
        require_writable(folder)
    except OSError as error:
        raise ValueError(
            f"{error.__cause__ or error}: set NUMBA_CACHE_DIR to a folder that you can write"
        ) from None
    brief = (
        " (while this process lives: set NUMBA_CACHE_DIR to a folder that lasts)"
        if is_temporary(folder)
        else ""
    )
    return f"{folder}, writable, {len(list(folder.glob('*.nbc')))} compiled kernels{brief}"


def _weights() -> str:
    from recon.mbir.mbir import Mbir

    card = json.loads(
        (resources.files("recon") / "mbir" / "weights" / "card.json").read_text(encoding="utf-8")
    )
    found = Mbir.load().weights_sha256
    if found != card["sha256_of_tensors"]:
        raise ValueError(f"sha256 {found}, their card says {card['sha256_of_tensors']}: {_AGAIN}")
    return f"sha256 {found}, as their card says"


def _adjoint() -> str:
    import torch

    from torchpcct import ConeBeam, Projector, full_turn

    projector = Projector(
        ConeBeam(full_turn(12), 626.0, 1098.0, 24, 8, 2.0), VolumeGrid((8, 20, 20), 1.2)
    )
    draw = torch.Generator().manual_seed(0)
    x = torch.rand(8, 20, 20, generator=draw)
    forward = projector(x)
    y = torch.rand(forward.shape, generator=draw)
    both = [float((forward.double() * y).sum()), float((x * projector.T(y).double()).sum())]
    error = abs(both[0] - both[1]) / abs(both[0])
    if not error < 1e-5:
        raise ValueError(f"⟨Ax, y⟩ and ⟨x, Aᵀy⟩ differ by {error:.1e} of their value: {_AGAIN}")
    return f"⟨Ax, y⟩ = ⟨x, Aᵀy⟩ to {error:.0e} of their value"


def _disc() -> str:
    import numpy as np

    from recon.api import reconstruct
    from torchpcct import ParallelBeam, Scan

    radius, water = 20.0, 0.02
    geometry = ParallelBeam(np.arange(180) * np.pi / 180, 128, 0.5)
    chords = 2.0 * np.sqrt(np.clip(radius**2 - geometry.column_positions**2, 0.0, None))
    scan = Scan.from_line_integrals(np.tile(water * chords, (180, 1)), geometry, mu_water=water)
    hu = reconstruct(scan, VolumeGrid((40, 40), 0.5), "fbp").data
    error = float(hu.abs().max())
    if not error < 5.0:
        raise ValueError(f"a disc of water reads up to {error:.1f} HU off, 5 are allowed: {_AGAIN}")
    return f"a disc of water reads 0 HU to {error:.1f} HU"


_CHECKS: dict[str, Callable[[], str]] = {
    "torchpcct": lambda: f"{__version__} in {Path(__file__).parents[2]}",
    "python": lambda: f"{platform.python_version()}, {platform.platform()}",
    "packages": _versions,
    "extras": _extras,
    "processor": _processor,
    "threads": _threads,
    "gpu": _gpu,
    "kernel cache": _cache,
    "weights": _weights,
    "adjoint": _adjoint,
    "FBP": _disc,
}
"""What is looked at, in this order: a check says what it finds, and raises what is wrong."""


def outcomes() -> Iterator[tuple[str, bool, str]]:
    """Name, whether it is well, and what was found, check by check."""
    for name, check in _CHECKS.items():
        try:
            yield name, True, check()
        except metadata.PackageNotFoundError:
            yield (
                name,
                False,
                "runs from sources that are not installed: pip install -e . in their folder",
            )
        except Exception as error:
            known = isinstance(error, ValueError)
            yield name, False, str(error) if known else f"{type(error).__name__}: {error}: {_AGAIN}"
