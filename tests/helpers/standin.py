"""A device that is not the CPU, on a machine that has none: its tensors hold a CPU tensor and say
that they lie elsewhere.

As on CUDA, tensors of two devices do not meet (but for scalars), numpy cannot look at them, and
what travels to the host is counted. Its name is torch's ``meta``, which needs no driver.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any
from unittest import mock

import torch
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

from recon.analytic.backproject import BackprojectionPlan
from recon.mbir import bilateral, bilateral_triton
from torchpcct.projector.engine import Engine

__all__ = ["DEVICE", "Counter", "Standin", "standin"]

DEVICE = torch.device("meta")
_aten = torch.ops.aten


class Standin(torch.Tensor):
    """A tensor on the stand-in device; ``inner`` holds its values."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner):
        made = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=DEVICE,
        )
        made.inner = inner
        return made

    def new_tensor(self, values, **kwargs):  # torch makes it past the dispatcher
        return Standin(self.inner.new_tensor(values, **kwargs))

    def tolist(self):
        return self.cpu().tolist()

    def __repr__(self):
        return f"Standin({self.inner!r})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {}, None)


class Counter(TorchDispatchMode):
    """Makes what is asked for on the device, and notes what travels to the host.

    Attributes:
        copies: ``(elements, function that asked)`` of every copy to the host.
        scalars: how often a program waited for one number.
    """

    def __init__(self) -> None:
        super().__init__()
        self.copies: list[tuple[int, str]] = []
        self.scalars = 0

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Nothing is compiled here; torch would load its compiler to leave it out."""
        return False

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {}, self)


def _asked() -> str:
    """The package's own function that asked for a copy."""
    for frame, _ in traceback.walk_stack(None):
        file = frame.f_code.co_filename
        if ("/torchpcct/" in file or "/recon/" in file) and "/tests/" not in file:
            return frame.f_code.co_name
    return "test"


def _run(func: Any, args: Any, kwargs: Any, counter: Counter | None) -> Any:
    there, here = list[Standin](), list[torch.Tensor]()
    inner_args = _inner(args, there, here)
    inner_kwargs = {name: _inner(value, there, here) for name, value in kwargs.items()}
    device = kwargs.get("device")
    wanted = None if device is None else torch.device(device)
    moves = func in (_aten._to_copy.default, _aten.copy_.default)
    # As on CUDA, places may be told by indices on the CPU.
    indexed = "index" in func.name() and not any(a.is_floating_point() for a in here)
    if there and not (moves or indexed) and any(a.dim() for a in here):
        raise RuntimeError(f"{func} is given tensors of two devices")
    if func is _aten._local_scalar_dense.default and there and counter is not None:
        counter.scalars += 1
    home = (
        func is _aten._to_copy.default and wanted is not None and wanted != DEVICE and bool(there)
    ) or (func is _aten.copy_.default and not isinstance(args[0], Standin) and bool(there))
    if home and counter is not None:
        counter.copies.append((there[0].numel(), _asked()))
    if wanted == DEVICE:
        inner_kwargs["device"] = torch.device("cpu")
    if func is _aten._conj.default:  # its lazy form is not honoured below the dispatcher
        func = _aten.conj_physical.default
    out = func(*inner_args, **inner_kwargs)
    if home or not (there or wanted == DEVICE):
        return out

    def wrapped(made: Any) -> Any:
        if isinstance(made, (tuple, list)):
            return [wrapped(value) for value in made]
        if not isinstance(made, torch.Tensor):
            return made
        for given in there:
            if given.inner is made:  # in place
                return given
        return Standin(made)

    return wrapped(out)


def _inner(value: Any, there: list[Standin], here: list[torch.Tensor]) -> Any:
    """Of arguments of an operator what the CPU is given; their tensors are added to the two lists.

    By hand: torch's own walk through trees takes most of a test's time.
    """
    if isinstance(value, Standin):
        there.append(value)
        return value.inner
    if isinstance(value, torch.Tensor):
        here.append(value)
    elif isinstance(value, (tuple, list)):
        return [_inner(v, there, here) for v in value]
    return value


class _Passes:
    """The CPU's passes, for tensors there."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine

    def forward(self, x):
        return _there(partial(self.engine._on_cpu, transposed=False), x)

    def adjoint(self, y):
        return _there(partial(self.engine._on_cpu, transposed=True), y)


def _there(function, x):
    with _disable_current_modes():
        return Standin(function(x.inner))


def _backproject(plan, data):
    return _there(plan.forward, data)


def _bilateral(u, g, scale, offsets, weights):
    with _disable_current_modes():
        values, guide, over, near, share = (v.inner for v in (u, g, scale, offsets, weights))
        _, out, total = bilateral.on_cpu(values, guide, over, near.long().numpy(), share.numpy())
    return Standin(out), Standin(total)


@contextmanager
def standin() -> Iterator[Counter]:
    """Within: the stand-in device exists. What Triton's kernels compute there the CPU's do: those
    of Triton are tested by themselves."""
    makers = torch.tensor, torch.as_tensor

    def made(make, values, *args, device=None, **kwargs):  # torch makes it past the dispatcher
        found = make(values, *args, **kwargs)
        return found if device is None else found.to(device)

    def passes(engine, device, dtype):
        assert device == DEVICE
        return _Passes(engine)

    with (
        mock.patch.object(Engine, "_trusted_on", passes),
        mock.patch.object(BackprojectionPlan, "_forward_there", _backproject),
        mock.patch.object(bilateral_triton, "forward", _bilateral),
        mock.patch.object(torch, "autocast", return_value=nullcontext()),
        mock.patch.object(torch, "tensor", partial(made, makers[0])),
        mock.patch.object(torch, "as_tensor", partial(made, makers[1])),
        Counter() as counter,
    ):
        yield counter
