"""What a program may switch for all of torch and numpy, set to what this package's numbers are made
for.

A user's own code may have set another default dtype or device, work under autocast, or have numpy
raise floating-point errors. None of that shall change a result. :func:`unswitched` puts the
switches back for the length of a call; :func:`torchpcct.validate.checked` does so for every
function that it makes, so that what such a function calls need not name dtype and device in every
line.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from functools import wraps
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np

if TYPE_CHECKING:
    from types import ModuleType


_ERRORS = {"divide": "warn", "over": "warn", "under": "ignore", "invalid": "warn"}
"""As numpy has them."""
_NOTHING = nullcontext()
"""Where no switch has to be put back."""

F = TypeVar("F", bound=Callable[..., object])


def unswitched() -> AbstractContextManager[object]:
    """Within: numpy's errors as numpy has them, float32 and the CPU as torch's defaults, no
    autocast.

    Where nothing is switched, which costs a microsecond to find out, nothing is done. The default
    dtype is that of all threads of the process while the call runs.
    """
    torch: ModuleType | None = sys.modules.get("torch")  # what does not need it does not load it
    numpy_as_ever = np.geterr() == _ERRORS
    if torch is None or not hasattr(torch, "compiler") or torch.compiler.is_compiling():
        return _NOTHING if numpy_as_ever else np.errstate(**_ERRORS)  # type: ignore[arg-type]
    same = (
        numpy_as_ever
        and torch.get_default_dtype() is torch.float32
        and torch.get_default_device().type == "cpu"
        and not torch.is_autocast_enabled("cpu")
        and not torch.is_autocast_enabled("cuda")
    )
    return _NOTHING if same else _all(torch)


@contextmanager
def _all(torch: ModuleType) -> Iterator[None]:
    dtype = torch.get_default_dtype()
    with ExitStack() as stack:
        stack.enter_context(np.errstate(**_ERRORS))  # type: ignore[arg-type]
        stack.enter_context(torch.device("cpu"))
        for kind in ("cpu", "cuda"):
            if torch.is_autocast_enabled(kind):
                stack.enter_context(torch.autocast(kind, enabled=False))
        if dtype is not torch.float32:
            stack.callback(torch.set_default_dtype, dtype)
            torch.set_default_dtype(torch.float32)
        yield


def undisturbed(function: F) -> F:
    """A function that runs :func:`unswitched`."""

    @wraps(function)
    def call(*args: object, **kwargs: object) -> object:
        with unswitched():
            return function(*args, **kwargs)

    return cast(F, call)
