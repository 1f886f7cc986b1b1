"""Methods on measured data, where nobody knows the truth: two scans of one object, or one scan in two halves.

What two independent scans agree on is signal, what they do not is noise (:mod:`torchpcct.metrics.half_split`). A blur
buys low noise with resolution, so the reference is blurred in the plane to each method's resolution before noise is
compared: the dose factor is the ratio of the variances then, in a region that the user knows to be flat, or over all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.api import reconstruct
from recon.evaluate.measure import volume_of
from recon.evaluate.methods import Method, method_of, noise_of
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.half_split import HalfSplit, halves
from torchpcct.scan import Scan
from torchpcct.validate import checked

__all__ = ["MeasuredDraw", "evaluate_scans", "evaluate_volumes"]

_REFERENCE = "fbp:ram-lak"


@dataclass(frozen=True, eq=False)
class MeasuredDraw:
    """A measured scan, in the form that methods ask for.

    Attributes:
        scan, grid: what is reconstructed.
        noise: a linear method → its noise in HU.
    """

    scan: Scan
    grid: VolumeGrid
    noise: Any = None

    @property
    def label(self) -> str:
        """Measured scans have no volumes in files."""
        raise ValueError("files:FOLDER holds volumes of exported scans: for measured ones use evaluate_volumes")

    @property
    def exposure_s(self) -> float:
        """Of the scan."""
        return self.scan.exposure_s or 1.0

    def fbp(self, kernel: str) -> Tensor:
        """HU ``(z, y, x)``."""
        found: Tensor = reconstruct(self.scan, self.grid, "fbp", kernel=kernel).data
        return found

    def pwls(self) -> Tensor:
        """The same."""
        found: Tensor = reconstruct(self.scan, self.grid, "pwls").data
        return found

    def mbir(self, network: Any) -> Tensor:
        """The same."""
        found: Tensor = reconstruct(self.scan, self.grid, "mbir", network=network).data
        return found

    def sigma(self, method: Method, smooths: float = 0.0) -> float:
        """Noise of a linear method in HU."""
        return float(self.noise(method, smooths))


@checked
def evaluate_scans(scans: Any, grid: VolumeGrid, methods: Any, region: Any = None) -> list[dict[str, Any]]:
    """Methods on two scans of one object, or on one scan of the whole detector in two halves of its views.

    Args:
        scans: two with the same geometry, or one.
        grid: of the volumes.
        methods: as for :func:`recon.evaluate.experiment`, without files.
        region: bool mask ``grid.shape`` where noise is measured; None: everywhere.

    Returns:
        What :func:`evaluate_volumes` gives, for a dose of ONE of the scans.

    Raises:
        ValueError, TypeError: no two scans of one kind; what the methods refuse.
    """
    given: Sequence[Scan] = [scans] if isinstance(scans, Scan) else list(scans)
    if len(given) == 1:
        given = halves(given[0])
    if len(given) != 2 or any(not isinstance(s, Scan) for s in given):
        raise ValueError(f"give one scan, or two of the same object, got {len(given)}")
    if given[0].counts.shape != given[1].counts.shape:
        raise ValueError(
            f"the scans have {tuple(given[0].counts.shape)} and {tuple(given[1].counts.shape)} readings: two scans of "
            "one object by one scanner are needed"
        )
    kept: dict[str, list[Tensor]] = {}

    def volumes(method: Method) -> list[Tensor]:
        if method.name not in kept:
            kept[method.name] = [volume_of(method, MeasuredDraw(scan, grid, noise)) for scan in given]
        return kept[method.name]

    def noise(method: Method, smooths: float) -> float:
        first, second = volumes(method)
        return noise_of((first - second) / math.sqrt(2.0), torch.arange(first.numel()), smooths)

    names = methods if isinstance(methods, list | tuple) else [methods]
    found = {m.name: volumes(m) for m in map(method_of, names)}
    return evaluate_volumes(found, volumes(method_of(_REFERENCE)), grid.spacing[-1], region)


@checked
def evaluate_volumes(volumes: Any, reference: Any, voxel_mm: float, region: Any = None) -> list[dict[str, Any]]:
    """Noise, resolution and the dose factor of noise at equal resolution of pairs of volumes.

    Args:
        volumes: method → its two volumes ``(z, y, x)`` in one unit.
        reference: the two of a linear method that has smoothed nothing (FBP, kernel "ram-lak").
        voxel_mm: in the plane.
        region: bool mask of a volume; None: everywhere.

    Returns:
        For each method: ``method``; ``noise`` of one volume; ``f50``, line pairs per mm at which half of the
        reference's signal is left; ``resolution``, up to which both volumes agree; ``noise_reference``: of the
        reference, as sharp; ``dose_factor``: the ratio of the variances. Where the volumes have no structure fine
        enough to tell how sharp the method is, f50 is inf, and the last two are NaN.

    Raises:
        ValueError: volumes of other shapes, NaN.
    """
    base = _split("reference", reference)
    found = []
    for name, pair in dict(volumes).items():
        split = _split(name, pair)
        if split.first.shape != base.first.shape:
            raise ValueError(
                f"{name} has volumes of shape {tuple(split.first.shape)}, the reference {tuple(base.first.shape)}"
            )
        f50 = split.f50(base, voxel_mm)
        # Of one volume, not of the mean of both.
        noise = math.sqrt(2.0) * split.noise(region)
        other = math.sqrt(2.0) * base.blurred(f50, voxel_mm).noise(region) if math.isfinite(f50) else math.nan
        factor = (other / noise) ** 2 if noise > 0 else math.inf
        found.append({
            "method": name, "noise": noise, "f50": f50, "resolution": split.resolution(voxel_mm),
            "noise_reference": other, "dose_factor": factor,
        })  # fmt: skip
    return found


def _split(name: str, pair: Any) -> HalfSplit:
    first, second = (torch.as_tensor(np.asarray(v)).double() for v in pair)
    if first.shape != second.shape or first.ndim != 3:
        raise ValueError(f"{name}: two volumes (z, y, x) of one shape are needed, got {first.shape} and {second.shape}")
    if not (torch.isfinite(first).all() and torch.isfinite(second).all()):
        raise ValueError(f"{name}: a volume holds NaN or Inf")
    return HalfSplit(first, second)
