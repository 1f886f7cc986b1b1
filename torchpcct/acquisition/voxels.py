"""Scans of voxel volumes: line integrals of a few basis maps, then the spectrum."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchpcct.acquisition.detection import detected, signal_spectra
from torchpcct.acquisition.transmission import compress
from torchpcct.geometry import ConeBeam
from torchpcct.projector import Projector
from torchpcct.scan import Scan
from torchpcct.scanner.scanner import Scanner
from torchpcct.scene.voxels import VoxelScene

__all__ = ["acquire_voxels"]

_TOLERANCE = 1e-5
"""Error of a line integral over a metre of body by the number of basis maps."""
_SUB_COLUMNS = 2
"""Parts of a cell whose transmissions are averaged: a cell records the mean of the photons, not of the path lengths."""
_LEFT_OUT = "focal spot, gantry turn during a view, scatter; voxels are uniform, and edges as coarse as they are"


def acquire_voxels(
    scene: VoxelScene,
    scanner: Scanner,
    *,
    progress: Callable[[float], None] | None = None,
    sub_columns: int = _SUB_COLUMNS,
) -> Scan:
    """The noise-free scan of a voxel volume, whole detector; called by :func:`torchpcct.acquire`.

    The attenuation of all tissues at all energies is compressed to a few basis maps
    (:func:`~torchpcct.acquisition.transmission.compress`), which the distance-driven projector integrates over parts of
    each cell; the polychromatic transmission is exact from there.

    Args:
        scene: tissues in voxels.
        scanner: what scans it.
        progress: called with the finished fraction.
        sub_columns: parts of each cell.

    Raises:
        ValueError: a source inside the grid.
    """
    start = time.perf_counter()
    g: ConeBeam = scanner.geometry
    energies, spectra, air = signal_spectra(scanner)
    scene = scene.read_by(energies, spectra[: scanner.detector.bins, g.columns // 2].sum(0))
    coefficients, basis = compress(scene.contrast(energies), tolerance=_TOLERANCE)
    maps = torch.from_numpy(scene.mixed(coefficients))
    fine = replace(g, columns=g.columns * sub_columns, pitch=(g.pitch[0], g.pitch[1] / sub_columns))
    weight = torch.from_numpy((spectra / sub_columns).astype(np.float32))  # (bins, columns, energies)
    bins = weight.shape[0]
    rows = torch.from_numpy(np.asarray(scanner.row_factor, dtype=np.float32))
    spectrum = torch.from_numpy(basis.astype(np.float32))
    counts = torch.empty((bins, *g.shape), dtype=torch.float32)
    block = max(1, min(g.views, 2**24 // (max(len(basis), 1) * g.rows * fine.columns)))
    for v0 in range(0, g.views, block):
        part = fine.select(slice(v0, min(v0 + block, g.views)))
        lines = Projector(part, scene.grid)(maps)  # (rank, views, rows, fine columns)
        for v in range(part.views):
            counts[:, v0 + v] = _readings(lines[:, v], spectrum, weight, sub_columns) * rows[:, None]
        if progress is not None:
            progress((v0 + part.views) / g.views)
    info = {
        "scanner": scanner.name,
        "scene": list(scene.names),
        "plan": {
            "basis_maps": len(basis),
            "sub_columns": sub_columns,
            "left_out": _LEFT_OUT,
            "clipped": scene.clipped,
            "above_muscle": scene.above_muscle,
        },
        "seconds": round(time.perf_counter() - start, 2),
    }
    return detected(scanner, counts, air, energies, info)


def _readings(lines: Tensor, spectrum: Tensor, weight: Tensor, sub_columns: int) -> Tensor:
    """``(bins, rows, columns)`` of one view: ``lines (rank, rows, columns · sub)``, ``spectrum (rank, energies)``."""
    out = lines.new_empty((weight.shape[0], lines.shape[1], weight.shape[1]))
    for r in range(lines.shape[1]):
        transmitted = torch.exp(-(lines[:, r].T @ spectrum))  # (columns · sub, energies)
        cells = transmitted.view(-1, sub_columns, spectrum.shape[1]).sum(1)
        out[:, r] = (weight * cells).sum(-1)
    return out
