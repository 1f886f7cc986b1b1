"""Volumes of a method from the statistics of a block of realisations, in parts that are kept where they take long."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from itertools import count
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.evaluate.store import Store
from recon.pwls.inset_problem import InsetProblem
from recon.study.dose_factor.methods import Method
from recon.study.dose_factor.settings import LINEAR_METHODS, TISSUE_METHODS

__all__ = ["in_parts", "reconstructed"]

LONG = ("quadratic", "tv", *TISSUE_METHODS)
"""Methods that take seconds a volume, on a busy core half a minute."""
PART, LINEAR_PART = 2, 16
"""Volumes of such a method, and of a linear one, that are reconstructed, and kept, together."""


def reconstructed(
    method: Method, problem: InsetProblem, b: Tensor, dose: float, store: Store, place: str, key: str
) -> tuple[Tensor, float]:
    """Volumes in HU like ``b`` ``(n, z, y, x)``, float32, and the seconds that they took.

    Args:
        method, problem, b, dose: what is reconstructed.
        store: keeps the parts of a long method under ``place`` with ``key``, until they are dropped.

    Raises:
        ValueError: volumes of another shape, NaN or Inf.
    """
    if method.name not in LONG:
        found = _part(method, problem, b, dose, place)
        return found["volume"], found["seconds"]
    return _kept(method, problem, b, dose, store, f"{place}/", key, PART)


def in_parts(method: Method, store: Store, place: str, key: str) -> Callable[[InsetProblem, Tensor, float], Tensor]:
    """A linear method that keeps what it computes, of the same calls in the same order, if it is a long one.

    Args:
        method: of :data:`recon.study.dose_factor.settings.LINEAR_METHODS`.
        store: keeps the parts under ``place`` with ``key``, until they are dropped.
    """
    assert method.name in LINEAR_METHODS
    if method.name not in LONG:
        return method
    calls = count()

    def run(problem: InsetProblem, b: Tensor, dose: float) -> Tensor:
        if torch.is_grad_enabled():
            return method(problem, b, dose)
        return _kept(method, problem, b, dose, store, f"{place}/{next(calls)}_", key, LINEAR_PART)[0]

    return run


def _kept(
    method: Method, problem: InsetProblem, b: Tensor, dose: float, store: Store, start: str, key: str, size: int
) -> tuple[Tensor, float]:
    """Volumes and seconds, ``size`` volumes at a time, each kept under ``start`` and its first volume's position."""
    parts = []
    for first in range(0, len(b), size):
        part = b[first : first + size]
        parts.append(store.piece(f"{start}{first}", key, partial(_as_arrays, method, problem, part, dose, start)))
    volume = torch.from_numpy(np.concatenate([p["volume"] for p in parts]))
    return volume, sum(float(p["seconds"]) for p in parts)


def _part(method: Method, problem: InsetProblem, b: Tensor, dose: float, place: str) -> dict[str, Any]:
    start = time.perf_counter()
    with torch.no_grad():
        volume = method(problem, b, dose)
    seconds = time.perf_counter() - start
    if tuple(volume.shape) != tuple(b.shape) or not bool(torch.isfinite(volume).all()):
        raise ValueError(
            f"the method {method.name!r} gave {tuple(volume.shape)} for {tuple(b.shape)} or NaN or Inf ({place}): "
            "repair it or leave it out with --methods"
        )
    return {"volume": volume.to(torch.float32), "seconds": seconds}


def _as_arrays(*arguments: Any) -> dict[str, Any]:
    found = _part(*arguments)
    return {"volume": found["volume"].numpy(), "seconds": np.array(found["seconds"])}
