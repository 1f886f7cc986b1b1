"""Noise without a truth: two halves of one real scan hold the same object and independent noise."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.metrics.resolution import first_below
from torchpcct.scan import Scan
from torchpcct.validate import checked

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


__all__ = ["HalfSplit", "half_split"]

Floats = NDArray[np.float64]
AGREE = 0.143
"""Correlation down to which two halves agree: there their mean correlates by ½ with
what a scan without noise shows (Rosenthal and Henderson, J. Mol. Biol. 333 (2003) 721)."""


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

    def noise(self, region: ArrayLike | None = None) -> float:
        """Standard deviation of the WHOLE scan's noise in a region: that of half the difference.

        Exact for linear methods. For others it is the noise that remains at half the dose over √2:
        they smooth more at half the dose, so it is a lower limit for the whole scan.

        Args:
            region: bool mask of the volume, or None: all of it.

        Raises:
            ValueError: fewer than two voxels.
        """
        difference = (self.first - self.second).double() / 2
        values = (
            difference.flatten()
            if region is None
            else difference[torch.as_tensor(np.asarray(region))]
        )
        if values.numel() < 2:
            raise ValueError("a standard deviation needs a region of two voxels or more")
        return float(values.std())

    def resolution(self, grid_spacing: float) -> float:
        """Highest spatial frequency, line pairs per mm, that both halves agree on: Fourier ring
        correlation.

        The correlation of the halves in rings of one frequency of every slice; it falls below 0.143
        where noise takes over (Rosenthal and Henderson, J. Mol. Biol. 333, 721, 2003). An image
        without structure gives 0.

        Args:
            grid_spacing: voxel size in the plane in mm.
        """
        a, b = _spectra(self)
        cross, one, two = (
            _rings(part) for part in ((a * b.conj()).real, a.abs() ** 2, b.abs() ** 2)
        )
        correlation = cross / (one * two).sqrt().clamp(min=1e-300)
        below = torch.nonzero(correlation < AGREE)
        rings = int(below[0]) if below.numel() else correlation.numel()
        return rings / (min(a.shape[-2:]) * grid_spacing)

    def transfer(self, reference: HalfSplit, grid_spacing: float) -> tuple[Floats, Floats]:
        """What of the reference's signal this method shows at each spatial frequency.

        The Fourier ring correlation cannot tell: a blur takes signal and noise alike. Here one half
        by the method meets the OTHER half by the reference, whose noise is independent: the noise
        drops out of the sums, and Re(M₁ R₂* + M₂ R₁*) / 2 Re(R₁ R₂*) in rings of one frequency is
        the method's transfer relative to the reference's, whatever the object. Sums over three
        neighbouring rings.

        Args:
            reference: of the same scan and split, sharper: FBP without smoothing (kernel
                "ram-lak").
            grid_spacing: voxel size in the plane in mm.

        Returns:
            Frequencies in line pairs per mm, up to where the reference's halves no longer agree
            (:meth:`resolution`), and the transfer, 1 where the method shows all.

        Raises:
            ValueError: volumes of another shape.
        """
        if reference.first.shape != self.first.shape:
            raise ValueError(
                f"reference has the shape {tuple(reference.first.shape)}, not "
                f"{tuple(self.first.shape)}"
            )
        (a, b), (c, d) = _spectra(self), _spectra(reference)
        cross, own = _rings((a * d.conj() + b * c.conj()).real), _rings(2 * (c * d.conj()).real)
        size = min(a.shape[-2:]) * grid_spacing
        rings = max(1, round(reference.resolution(grid_spacing) * size))
        shown, given = (
            np.convolve(part.numpy(), np.ones(3), "same")[:rings] for part in (cross, own)
        )
        frequency: Floats = (np.arange(rings, dtype=np.float64) + 1.0) / size
        return frequency, np.asarray(shown / np.maximum(given, 1e-300), dtype=np.float64)

    def f50(self, reference: HalfSplit, grid_spacing: float) -> float:
        """Spatial frequency at which :meth:`transfer` falls to ½.

        Args:
            reference: halves of a reconstruction of the same scan without smoothing.
            grid_spacing: of the voxels in the slice, mm.

        Returns:
            Line pairs per mm; inf if the transfer stays above ½ at all measured frequencies.

        Raises:
            ValueError: another shape than that of the reference.
        """
        return first_below(*self.transfer(reference, grid_spacing), 0.5, math.inf)

    def within(self, rows: slice, columns: slice) -> HalfSplit:
        """A rectangle of every slice, whose frequencies are then measured without those of strong
        edges elsewhere in the image.

        The mean of the rectangle is subtracted and a Hann window fades it to 0 at its border, so
        that the cut itself is no edge.

        Args:
            rows, columns: of the rectangle, slices along y and x.

        Returns:
            Halves of the shape ``(…, rows, columns)``, float64.
        """

        def part(volume: Tensor) -> Tensor:
            cut = volume[..., rows, columns].double()
            fade = [
                torch.hann_window(n, periodic=True, dtype=torch.float64) for n in cut.shape[-2:]
            ]
            return (cut - cut.mean((-2, -1), keepdim=True)) * fade[0][:, None] * fade[1]

        return HalfSplit(part(self.first), part(self.second))

    def blurred(self, f50: float, grid_spacing: float) -> HalfSplit:
        """Both halves with a Gaussian in the plane whose transfer is ½ at ``f50``: equally sharp,
        to compare noise.

        Args:
            f50: line pairs per mm; inf: as they are.
            grid_spacing: voxel size in the plane in mm.

        Raises:
            ValueError: ``f50`` ≤ 0.
        """
        if not f50 > 0:
            raise ValueError(f"f50 must be greater than 0 line pairs per mm, got {f50!r}")
        ny, nx = self.first.shape[-2:]
        square = np.fft.fftfreq(ny)[:, None] ** 2 + np.fft.rfftfreq(nx) ** 2
        gauss = torch.from_numpy(0.5 ** (square / (f50 * grid_spacing) ** 2))
        smooth = (
            torch.fft.irfft2(torch.fft.rfft2(v.double()) * gauss, s=(ny, nx)).to(v)
            for v in (self.first, self.second)
        )
        return HalfSplit(*smooth)


def _spectra(pair: HalfSplit) -> tuple[Tensor, ...]:
    """Fourier transforms of the slices of both halves, ``(slices, y, x)``."""
    return tuple(
        torch.fft.fft2(v.double().reshape(-1, *v.shape[-2:])) for v in (pair.first, pair.second)
    )


def _rings(values: Tensor) -> Tensor:
    """Sums of ``(slices, y, x)`` over rings of one frequency: 1, 2, … cycles per shorter side,
    up to Nyquist's."""
    ny, nx = values.shape[-2:]
    radius = np.hypot(np.fft.fftfreq(ny)[:, None], np.fft.fftfreq(nx)) * min(ny, nx)
    ring = torch.from_numpy(np.rint(radius).astype(np.int64)).flatten()
    total = torch.zeros(int(ring.max()) + 1, dtype=torch.float64)
    return total.index_add_(0, ring, values.sum(0).flatten())[1 : min(ny, nx) // 2 + 1]


@checked
def halves(scan: Scan) -> tuple[Scan, Scan]:
    """Two scans of one: every other view, in the order of their angles.

    Args:
        scan: a noisy scan of the whole detector.

    Raises:
        ValueError: a noise-free or windowed scan, fewer than two views.
    """
    if scan.noise_free:
        raise ValueError("a noise-free scan has no noise to measure: draw it with with_noise")
    if scan.window is not None:
        raise ValueError("halves of a windowed scan are not provided: acquire it without region")
    angles = scan.geometry.angles
    # known but for whole turns, and those of a helix differ
    if not scan.geometry.on_circle:
        angles = np.unwrap(angles)
    order = np.argsort(angles, kind="stable")
    if order.size < 2:
        raise ValueError("one view cannot be split")
    return scan.select(np.sort(order[::2])), scan.select(np.sort(order[1::2]))


@checked
def half_split(scan: Scan, reconstruct: Callable[[Scan], Tensor]) -> HalfSplit:
    """Reconstruct both halves of a scan by one method.

    Args:
        scan: of :func:`halves`.
        reconstruct: of a scan to its volume, e.g. ``lambda s: recon.reconstruct(s, grid,
            "fbp").data``.

    Raises:
        ValueError: as :func:`halves`.
    """
    first, second = halves(scan)
    return HalfSplit(reconstruct(first), reconstruct(second))
