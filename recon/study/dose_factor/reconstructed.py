"""Volumes of a method from the statistics of a block of realisations, in parts that are kept where they take long."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.pwls.inset_problem import InsetProblem
from recon.study.dose_factor.methods import Method
from recon.study.dose_factor.settings import TISSUE_METHODS
from recon.study.store import Store

__all__ = ["reconstructed"]

LONG = ("tv", *TISSUE_METHODS)
"""Methods that take seconds a volume, on a busy core half a minute."""
PART = 2
"""Realisations of such a method that are reconstructed, and kept, together."""


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
    parts = []
    for first in range(0, len(b), PART):
        part = b[first : first + PART]
        kept = store.piece(f"{place}/{first}", key, partial(_as_arrays, method, problem, part, dose, place))
        parts.append(kept)
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
