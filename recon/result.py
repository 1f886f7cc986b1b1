"""What a solver or a method makes of a scan; :func:`recon.api.reconstruct` makes a volume with a
report of it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from torch import Tensor

if TYPE_CHECKING:
    from torchpcct.metrics.residual_test import ResidualTest  # loads scipy.stats
    from torchpcct.typing import JsonObject

__all__ = ["Result"]

_LOG = logging.getLogger(__name__)

RESIDUAL_TEST = "the test of what the volume leaves of the readings"
"""Name of :mod:`torchpcct.metrics.residual_test` in messages."""

BEYOND_TEST = "the search for what lies beyond the grid"
"""Name of :mod:`recon.least_squares.beyond_grid` in messages."""

T = TypeVar("T")


class Result(NamedTuple):
    """A volume, and what speaks against it.

    Attributes:
        volume: of a method ``grid.shape`` HU, of a solver ``(..., *grid.shape)`` in the units of
            its data term.
        report: how it was made.
        warnings: what speaks against it, but for the findings of ``tests``.
        tests: what is left of the data, slice by slice; none of a noise-free scan.
    """

    volume: Tensor
    report: JsonObject
    warnings: Sequence[str] = ()
    tests: Sequence[ResidualTest] = ()


def tested(name: str, warnings: list[str], test: Callable[..., T], *args: object) -> list[T]:
    """What a test of a finished volume finds. A test that fails must not lose the volume: it
    becomes a warning.

    Args:
        name: of the test, for the warning.
        warnings: of the volume's report; a failure is added.
        test: called with ``args``.

    Returns:
        The test's result alone, or nothing if it failed.
    """
    try:
        return [test(*args)]
    except Exception as error:
        _LOG.debug("%s failed", name, exc_info=True)
        warnings.append(
            f"{name} failed ({type(error).__name__}: {error}), so the volume is not tested by it"
        )
        return []
