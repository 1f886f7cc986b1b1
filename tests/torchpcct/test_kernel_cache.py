"""A compiled kernel is not older than the functions it holds."""

import importlib
import os
import pkgutil
import textwrap
import time
from pathlib import Path

import pytest
from fresh_python import run_python

import recon
import torchpcct
import train
from torchpcct.kernel_cache import sources

HELPER = """
    from numba import njit
    @njit(cache=True)
    def value(x):
        return x + {}
"""
KERNEL = """
    from numba import njit
    from torchpcct.made_up.helper import value
    from torchpcct.kernel_cache import forget_outdated
    @njit(cache=True)
    def kernel(x):
        return 2 * value(x)
    {}
"""
RUN = """
    import sys, types
    package = types.ModuleType("torchpcct.made_up")
    package.__path__ = [sys.argv[1]]
    sys.modules["torchpcct.made_up"] = package
    from torchpcct.made_up.kernel import kernel
    print(kernel(1), sum(kernel.stats.cache_hits.values()))
"""


def run(folder):
    value, hits = run_python(textwrap.dedent(RUN), folder, NUMBA_CACHE_DIR=str(folder / "cache")).stdout.split()
    return int(value), int(hits)


def edit(path, text, age):
    path.write_text(textwrap.dedent(text))
    then = time.time() + age
    os.utime(path, (then, then))


@pytest.mark.parametrize(
    ("call", "second"), [("forget_outdated(__name__)", 202), pytest.param("", 4, marks=pytest.mark.slow)]
)
def test_an_edited_function_reaches_the_kernels_that_call_it(tmp_path, call, second):
    """Without the call numba gives the old result: if that ends, the module is of no use any more."""
    edit(tmp_path / "helper.py", HELPER.format(1), age=-100)
    edit(tmp_path / "kernel.py", KERNEL.format(call), age=-100)
    assert run(tmp_path) == (4, 0)
    assert run(tmp_path) == (4, 1)  # kept
    edit(tmp_path / "helper.py", HELPER.format(100), age=0)
    assert run(tmp_path)[0] == second
    edit(tmp_path / "helper.py", HELPER.format(1000), age=3600)  # a wrong clock: no process compiles again and again
    assert run(tmp_path) == (second, 1)


def modules():
    for package in (torchpcct, recon, train):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            source = Path(found.module_finder.path, *found.name.rpartition(".")[2:]).with_suffix(".py")
            if source.exists() and "cache=True" in source.read_text(encoding="utf-8"):
                yield found.name, source.read_text(encoding="utf-8")


def test_every_module_whose_kernels_hold_others_forgets_outdated_ones():
    seen = dict(modules())
    assert "torchpcct.projector.cpu.cone_kernels" in seen
    for name in seen:
        importlib.import_module(name)
    missing = [n for n, text in seen.items() if sources(n) and "\nforget_outdated(__name__" not in text]
    assert not missing
    held = {p.name for p in sources("torchpcct.projector.cpu.plane_kernels")}
    assert {"cone_kernels.py", "simd.py", "simd_interpolation.py"} <= held


SCRIPT = """
import hashlib, sys
import numba
import torch
from torchpcct import FanBeam, Projector, VolumeGrid, full_turn

numba.njit(lambda x: x)(1)  # of no concern to ours
print("theirs", file=sys.stderr, flush=True)
A = Projector(FanBeam(full_turn(50), 400.0, 700.0, 64, 2.0), VolumeGrid((40, 40), 1.0))
x = torch.rand(A.domain_shape, generator=torch.Generator().manual_seed(0))
y = A(x)
print([hashlib.sha256(v.numpy().tobytes()).hexdigest() for v in (y, A.T(y))])
"""


def test_a_fresh_process_and_later_ones(tmp_path):
    found = [run_python(SCRIPT, NUMBA_CACHE_DIR=str(tmp_path)) for _ in range(2)]
    theirs, _, ours = found[0].stderr.partition("theirs")
    assert (theirs.count("compiling kernels"), ours.count("compiling kernels")) == (0, 1)
    assert "compiling kernels" not in found[1].stderr
    assert found[0].stdout == found[1].stdout
