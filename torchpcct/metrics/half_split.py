"""Noise without a truth: two halves of one real scan hold the same object and independent noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpcct.scan import Scan
from torchpcct.validate import choice, whole

__all__ = ["HalfSplit", "half_split", "halves"]


@dataclass(frozen=True)
class HalfSplit:
    """Two volumes of the halves of one scan.

    Attributes:
        first, second: volumes of the same shape and unit.
    """

    first: Tensor
    second: Tensor

    @property
    def mean(self) -> Tensor:
        """Their mean: of a linear method, the volume of the whole scan."""
        return (self.first + self.second) / 2

    def noise(self, region: Any = None) -> float:
        """Standard deviation of the WHOLE scan's noise in a region: that of half the difference.

        Exact for linear methods. For others it is the noise that remains at half the dose over √2: they smooth more at
        half the dose, so it is a lower limit for the whole scan.

        Args:
            region: bool mask of the volume, or None: all of it.

        Raises:
            ValueError: fewer than two voxels.
        """
        difference = (self.first - self.second).double() / 2
        values = difference.flatten() if region is None else difference[torch.as_tensor(np.asarray(region))]
        if values.numel() < 2:
            raise ValueError("a standard deviation needs a region of two voxels or more")
        return float(values.std())

    def resolution(self, grid_spacing: float, threshold: float = 0.143) -> float:
        """Highest spatial frequency, line pairs per mm, that both halves agree on: Fourier ring correlation.

        The correlation of the halves in rings of one frequency of every slice; it falls below ``threshold`` where noise
        takes over (0.143: Rosenthal and Henderson, J. Mol. Biol. 333, 721, 2003). An image without structure gives 0.

        Args:
            grid_spacing: voxel size in the plane in mm.
            threshold: correlation that counts as agreement.
        """
        a, b = (torch.fft.fft2(v.double().reshape(-1, *v.shape[-2:])) for v in (self.first, self.second))
        ny, nx = a.shape[-2:]
        radius = np.hypot(np.fft.fftfreq(ny)[:, None], np.fft.fftfreq(nx)) * min(ny, nx)
        ring = torch.from_numpy(np.rint(radius).astype(np.int64)).flatten()
        sums = [torch.zeros(int(ring.max()) + 1, dtype=torch.float64) for _ in range(3)]
        for total, part in zip(sums, ((a * b.conj()).real, a.abs() ** 2, b.abs() ** 2), strict=True):
            total.index_add_(0, ring, part.sum(0).flatten())
        correlation = (sums[0] / (sums[1] * sums[2]).sqrt().clamp(min=1e-300))[1 : min(ny, nx) // 2 + 1]
        below = torch.nonzero(correlation < threshold)
        rings = int(below[0]) if below.numel() else correlation.numel()
        return rings / (min(ny, nx) * grid_spacing)


def halves(scan: Scan, how: str = "views", seed: int = 0) -> tuple[Scan, Scan]:
    """Two scans of one.

    Args:
        scan: a noisy scan of the whole detector.
        how: ``"views"``: every other view, in the order of their angles. ``"counts"``: every photon goes to one of the
            two by the toss of a coin, so that both are Poisson, independent, and see all views (needs whole counts).
        seed: of the tosses.

    Raises:
        ValueError: a noise-free or windowed scan, fewer than two views, counts that are not whole numbers.
    """
    choice("how", how, ("views", "counts"))
    if scan.noise_free:
        raise ValueError("a noise-free scan has no noise to measure: draw it with with_noise")
    if scan.window is not None:
        raise ValueError("halves of a windowed scan are not provided: acquire it without region")
    if how == "views":
        order = np.argsort(scan.geometry.angles, kind="stable")
        if order.size < 2:
            raise ValueError("one view cannot be split")
        return _selected(scan, np.sort(order[::2])), _selected(scan, np.sort(order[1::2]))
    if not scan.counting or scan.logged or bool((scan.counts != scan.counts.round()).any()):
        raise ValueError('photons can be split only where counts are whole numbers: use how="views"')
    generator = torch.Generator().manual_seed(whole("seed", seed, low=0))
    one = torch.binomial(scan.counts, torch.full_like(scan.counts, 0.5), generator=generator)
    return tuple(replace(scan, counts=c, air=scan.air / 2) for c in (one, scan.counts - one))  # type: ignore[return-value]


def _selected(scan: Scan, views: Any) -> Scan:
    axis, index = -len(scan.geometry.shape), torch.from_numpy(views)

    def part(values: Tensor | None) -> Tensor | None:
        return None if values is None else values.index_select(axis, index)

    return replace(
        scan,
        geometry=scan.geometry.select(views),
        counts=scan.counts.index_select(axis, index),
        quantum=part(scan.quantum),
        dead=part(scan.dead),
        flux=None if scan.flux is None else scan.flux[index],
    )


def half_split(scan: Scan, reconstruct: Callable[[Scan], Tensor], how: str = "views", seed: int = 0) -> HalfSplit:
    """Reconstruct both halves of a scan by one method.

    Args:
        scan, how, seed: of :func:`halves`.
        reconstruct: of a scan to its volume, e.g. ``lambda s: recon.reconstruct(s, grid, "fbp").data``.

    Raises:
        ValueError: as :func:`halves`.
    """
    first, second = halves(scan, how, seed)
    return HalfSplit(reconstruct(first), reconstruct(second))
