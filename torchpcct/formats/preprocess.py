"""Preparation of parallel-beam sinograms by algotom: rotation axis, stripes, outliers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchpcct.formats.damage import needed
from torchpcct.geometry import ParallelBeam
from torchpcct.scan import Scan

__all__ = ["centred", "find_axis", "without_outliers", "without_stripes"]


def _algotom(module: str) -> object:
    needed("algotom")
    return needed(f"algotom.prep.{module}")


def find_axis(scan: Scan) -> float:
    """Column of the rotation axis, of the middle slice, by Vo's method (Opt. Express 22, 19078, 2014).

    Raises:
        ValueError: not a parallel beam, or views that do not cover 180°.
    """
    g = scan.geometry
    if not isinstance(g, ParallelBeam):
        raise ValueError(f"the axis is found from parallel rays, this is a {type(g).__name__}")
    turn = np.mod(g.angles - g.angles[0], 2 * math.pi)
    half = np.flatnonzero(turn <= math.pi + 1e-6)
    order = half[np.argsort(turn[half])]
    step = float(np.median(np.diff(turn[order]))) if order.size > 1 else math.pi
    if turn[order[-1]] < math.pi - 2 * step:
        raise ValueError(f"the views cover {math.degrees(turn[order[-1]]):.0f}° of the 180° that the search needs")
    lines = scan.line_integrals()
    middle = lines[lines.shape[0] // 2] if lines.ndim == 3 else lines
    return float(_algotom("calculation").find_center_vo(middle[order].double().numpy(), dsp=False, ncore=1))  # type: ignore[attr-defined]


def centred(scan: Scan, axis: float | None = None) -> Scan:
    """The same parallel scan with its rotation axis at a column (None: :func:`find_axis`)."""
    g: ParallelBeam = scan.geometry
    column = find_axis(scan) if axis is None else axis
    return replace(scan, geometry=replace(g, offset=((g.columns - 1) / 2 - column) * g.pitch))


def without_stripes(lines: Tensor, *, snr: float = 3.0) -> Tensor:
    """Line integrals ``(..., views, columns)`` without the stripes of bad cells (Vo, Opt. Express 26, 28396, 2018).

    Args:
        snr: how far a stripe must stand out to be taken for one.
    """
    clean = _algotom("removal").remove_all_stripe  # type: ignore[attr-defined]
    flat = lines.reshape(-1, *lines.shape[-2:])
    return torch.stack([torch.from_numpy(clean(s.numpy(), snr=snr)).to(s.dtype) for s in flat]).reshape(lines.shape)


def without_outliers(lines: Tensor, *, threshold: float = 0.08) -> Tensor:
    """Line integrals ``(..., views, columns)`` without single outliers (cosmic rays, "zingers")."""
    clean = _algotom("removal").remove_zinger  # type: ignore[attr-defined]
    flat = lines.reshape(-1, *lines.shape[-2:])
    return torch.stack([torch.from_numpy(clean(s.numpy(), threshold)).to(s.dtype) for s in flat]).reshape(lines.shape)
