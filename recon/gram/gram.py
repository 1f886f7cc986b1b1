"""AᵀWA of a small inset by FFT: fast enough for hundreds of applications, close enough to correct
exactly.

For an inset much smaller than its distance to the source, AᵀWA is nearly shift invariant in the
plane: FFT in (y, x), a banded matrix along z for every frequency (see
:mod:`recon.gram.impulse_response`). Its slow change across the inset (path lengths, bowtie,
magnification) is taken to first or second order in position at the midpoint of the two voxels:

    G x = K₀x + ½ Σ_c [ b_c · (K_c x) + K_c (b_c · x) ],      b = y, x (, y², yx, x²),

with the K_c fitted to exact impulse responses at a few nodes. The form is self-adjoint. What it
cannot hold is the irregular beat of the voxel lattice with the detector's cells: 2–3 % on white
noise at 0.2 mm voxels, 0.1 % on tissue shapes. It is a model: who needs the exact operator removes
its error with exact projections.

Exact impulse responses carry that beat: the fitted spectrum is indefinite at some frequencies,
which would let a weakly regularised solution escape there, so :func:`make_definite` changes it. Low
frequencies are left as they are (``LOW``): what makes them indefinite is that the square of lags is
cut off, and that harms nobody on the grid itself, whereas tissues have most of their energy there.
"""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from torch import Tensor

from recon.gram.impulse_response import Nodes, kernel_at, node_positions, slice_reach
from torchpcct.projector.operator import apply_linear
from torchpcct.switches import undisturbed
from torchpcct.threads import run
from torchpcct.validate import number

if TYPE_CHECKING:
    from torchpcct.projector import Projector


__all__ = ["Gram"]

LOW = 6.0
"""Frequencies in plane up to so many steps of the padded grid's are not made definite. With them
changed as well, the error on a vessel was 0.25 % (1968 views of the paper's scan), 1.7 % (360
views) and 2.7 % (40° of those missing), without 0.1 % each, and the least eigenvalue on the grid is
the same."""
LOW_PER_VOXEL = 0.06
"""Those frequencies in periods per voxel, at most."""
LEAST_PIVOT = 1e-4
"""Smallest pivot, as a share of the diagonal, that a definite spectrum must have."""
STIFFNESS = 2e-2
"""Stiffness added between two neighbouring slices at a time, as a share of the mean diagonal.
Indefinite modes alternate from slice to slice, so this leaves objects that are smooth along z
alone."""
ADDITIONS = 600
"""How often stiffness is added to a frequency, at most."""
KEPT = (0.5, 0.2, 0.0)
"""Where stiffness does not help: shares of the position-dependent terms that are kept."""
SHIFTS = (3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 3.0)
"""Where that does not help either: shifts of the diagonal, as shares of its mean."""


def cholesky(kernel: Tensor) -> tuple[Tensor, NDArray[np.bool_]]:
    """Banded L with L Lᴴ = kernel, ``(reach + 1, nz, ...)``, and where the kernel is positive
    definite, ``(...)``."""
    from recon.gram.kernels import banded_cholesky  # numba loads with its first use

    if kernel.ndim < 2 or kernel.shape[0] > max(kernel.shape[1], 1):
        raise ValueError(
            "kernel must be (reach + 1, nz, ...) with reach < nz, got the shape "
            f"{tuple(kernel.shape)}"
        )
    flat = kernel.cpu().reshape(*kernel.shape[:2], -1).to(torch.complex128).contiguous().numpy()
    lower = np.zeros_like(flat)
    definite = np.zeros(flat.shape[2], dtype=np.bool_)
    work = 4 * lower[..., 0].size * len(lower)
    run(banded_cholesky, definite.size, flat, LEAST_PIVOT, lower, definite, operations=work)
    return torch.from_numpy(lower).reshape(kernel.shape).to(kernel), definite.reshape(
        tuple(kernel.shape[2:])
    )


def make_definite(spectra: Tensor) -> Tensor:
    """Shift and damp spectra as little as needed.

    Args:
        spectra: ``(terms, reach + 1, nz, fy, fx)`` complex lower bands of K_c; terms 1, 3 (y, x) or
            6 (… y², yx, x²).

    Returns:
        Spectra of the same shape for which Σ_c b_c K_c is positive definite at the centre, the
        corners and the edge midpoints of the grid, b_c ∈ monomials of y, x ∈ {−1, 0, 1}.

    Raises:
        ValueError: another shape.
    """
    if (
        spectra.ndim != 5
        or spectra.shape[0] not in (1, 3, 6)
        or spectra.shape[1] > spectra.shape[2]
    ):
        raise ValueError(
            "spectra must be (terms, reach + 1, nz, fy, fx) of 1, 3 or 6 terms and reach < nz, "
            f"got the shape {tuple(spectra.shape)}"
        )
    terms, bands, nz = spectra.shape[:3]
    given = spectra.reshape(terms, bands, nz, -1)
    flat = given.to(torch.complex128, copy=True).numpy()
    level = np.abs(flat[0, 0].real).mean(axis=0)

    from recon.gram.kernels import damp, stiffen  # numba loads with its first use

    definite = np.zeros(flat.shape[-1], dtype=np.bool_)
    run(stiffen, definite.size, flat, _points(terms), LEAST_PIVOT, STIFFNESS, ADDITIONS, definite)
    todo = np.flatnonzero(~definite)
    flat[..., todo] = given[..., todo].numpy()
    kept = np.array(KEPT if terms > 1 else ())
    least = 1e-9 * level.max()
    run(
        damp,
        todo.size,
        flat,
        _points(terms),
        LEAST_PIVOT,
        kept,
        np.array(SHIFTS),
        level,
        least,
        todo,
    )
    return torch.from_numpy(flat).reshape(spectra.shape).to(spectra)


def _points(terms: int) -> NDArray[np.float64]:
    """Polynomials b_c at the centre, the corners and the edge midpoints of the grid, ``(points,
    terms)``."""
    at = (-1, 0, 1) if terms > 1 else (0,)
    return np.array(
        [[1, y, x, y * y, y * x, x * x][:terms] for y in at for x in at], dtype=np.float64
    )


BAND_ENERGY = 1e-13
"""Bands along z whose energy is below this share of the kernel's are dropped (float32 rounding)."""
IN_CACHE = 2**17
"""Complex numbers that a core has at hand. Spectra of a batch in pieces of about so many are 1.7
times as fast as at once, on both of two cores (12 volumes of 40 x 32 x 32 each)."""
REFERENCE_FREQUENCY = 0.5
"""Usual frequency of `information`, line pairs per mm."""
AROUND = 0.2
"""Share of that frequency by which others are still averaged over."""
HIGHEST_PER_VOXEL = 0.25
"""Highest frequency per voxel that is looked at: beyond, the corners of the voxels' own spectrum
say little, and may be negative."""
LEAST_INFORMATION = 0.1
"""Of the information that a voxel's own response stands for: less is rounding, or cut off with the
grid."""


class Gram:
    """A fast, self-adjoint model of x ↦ AᵀW A x on an inset.

    Args:
        projector: the exact operator A (:class:`torchpcct.projector.Projector`) of the inset,
            usually with a window; it is not kept.
        weights: W, inverse variances of the line integrals, ``range_shape``, finite and ≥ 0 (zeros
            are dead readings). The model is fitted on the CPU and lies where they do.
        nodes: positions at which the exact impulse response is taken: 1 (shift invariant, fastest),
            5 (linear in position) or 9 (quadratic, most accurate). Each costs about one pass of the
            projector; the result can be kept for all noise realisations of a scan and, with
            :meth:`scaled`, for all its exposures.

    Raises:
        ValueError: weights of a wrong shape, negative, not finite or all zero; an unknown
            ``nodes``.
        TypeError: weights that are not a float tensor.
    """

    @undisturbed
    def __init__(self, projector: Projector, weights: Tensor, nodes: int = 9) -> None:
        check_weights(weights, projector.range_shape)
        self.dtype = weights.dtype
        self.grid = projector.grid
        self.factor = 1.0
        self._flat = self.grid.ndim == 2
        ny, nx = self.grid.shape[-2:]
        self.padded = (next_fast_len(2 * ny - 1, real=True), next_fast_len(2 * nx - 1, real=True))
        positions = node_positions(nodes if min(ny, nx) > 4 else 1)
        kernels = self._fit(projector, weights.detach().cpu(), positions)
        self._periodic = _periodic_mean(kernels[0])
        fitted = _spectra(kernels, self.padded)
        definite = make_definite(fitted)
        self._spectra = torch.where(_low(self.padded), fitted, definite)
        self._of_noise = definite[0]
        self._basis = self._polynomials(len(self._spectra)).to(self.dtype)
        self._factor: Tensor | None = None
        self._information: dict[tuple[float, float], float] = {}
        if weights.device.type != "cpu":  # fitted here, applied there
            self.__dict__ |= self.to(weights.device).__dict__

    # -- construction ------------------------------------------------------------------------------

    def _fit(self, projector: Projector, weights: Tensor, positions: Nodes) -> Tensor:
        """Kernels K_c, ``(terms, bands, nz, 2·ny − 1, 2·nx − 1)``."""
        ny, nx = self.grid.shape[-2:]
        reach = slice_reach(projector.geometry, self.grid)
        at, found = [], []
        for y, x in positions:
            node = (round((ny - 1) / 2 * (1 + y)), round((nx - 1) / 2 * (1 + x)))
            at.append((2 * node[0] / max(ny - 1, 1) - 1, 2 * node[1] / max(nx - 1, 1) - 1))
            found.append(kernel_at(projector, weights, node, reach))
        energy = torch.stack([(k.double() ** 2).sum(dim=(1, 2, 3)) for k in found]).sum(0)
        keep = int(torch.nonzero(energy > BAND_ENERGY * energy.sum()).abs().sub(reach).abs().max())
        stack = torch.stack(found)[:, reach - keep : reach + keep + 1]
        terms = {1: 1, 5: 3, 9: 6}[len(positions)]
        u = torch.tensor(at, dtype=torch.float64)
        fit = torch.linalg.pinv(_monomials(u[:, 0], u[:, 1], terms)).to(stack.dtype)
        return torch.einsum("cn,n...->c...", fit, stack)

    def _polynomials(self, terms: int) -> Tensor:
        ny, nx = self.grid.shape[-2:]
        y = (
            torch.linspace(-1, 1, ny, dtype=torch.float64)
            if ny > 1
            else torch.zeros(1, dtype=torch.float64)
        )
        x = (
            torch.linspace(-1, 1, nx, dtype=torch.float64)
            if nx > 1
            else torch.zeros(1, dtype=torch.float64)
        )
        yy, xx = torch.meshgrid(y, x, indexing="ij")
        return _monomials(yy, xx, terms).movedim(-1, 0).contiguous()

    def scaled(self, factor: float) -> Gram:
        """The Gram operator of ``factor`` · W (another exposure); shares the kernels."""
        other = copy.copy(self)
        other.factor = self.factor * number("factor", factor, positive=True)
        return other

    def to(self, device: torch.device | str) -> Gram:
        """The same operator with its kernels on ``device``."""
        other = copy.copy(self)
        other._spectra, other._basis = self._spectra.to(device), self._basis.to(device)
        other._periodic, other._of_noise = self._periodic.to(device), self._of_noise.to(device)
        other._factor = None if self._factor is None else self._factor.to(device)
        return other

    # -- application -------------------------------------------------------------------------------

    def apply(self, x: Tensor) -> Tensor:
        """G x, ``(..., *grid.shape)``, any leading batch dimensions, differentiable; dtype and
        device of x.

        Raises:
            ValueError: a wrong shape.
        """
        if tuple(x.shape[-self.grid.ndim :]) != self.grid.shape:
            raise ValueError(
                f"x must have shape (..., {', '.join(map(str, self.grid.shape))}), got "
                f"{tuple(x.shape)}"
            )
        return apply_linear(x, self._apply, self._apply)  # it is its own adjoint

    __call__ = apply

    def _apply(self, x: Tensor) -> Tensor:
        if not x.numel():
            return torch.zeros_like(x)  # the Fourier transform takes no empty batch
        x3 = x.unsqueeze(-3) if self._flat else x
        volumes = x3.reshape(-1, *x3.shape[-3:])
        many = len(volumes)
        if x.device.type == "cpu":
            py, px = self.padded
            many = max(1, IN_CACHE // (x3.shape[-3] * py * (px // 2 + 1)))
        out = torch.cat([self._of_some(v) for v in volumes.split(many)]).reshape(x3.shape)
        return out.squeeze(-3) if self._flat else out

    def _of_some(self, x3: Tensor) -> Tensor:
        """G x of volumes ``(batch, z, y, x)``, all at once."""
        double = x3.dtype == torch.float64
        spectra = self._spectra.to(torch.complex128) if double else self._spectra
        basis = self._basis.to(x3.dtype)
        plain = self._transform(x3)
        total = torch.zeros_like(plain)
        _banded_add(spectra[0], plain, self.factor, total)
        out: Tensor | float = 0.0
        for b, kernel in zip(basis[1:], spectra[1:], strict=True):
            _banded_add(kernel, self._transform(b * x3), 0.5 * self.factor, total)
            part = torch.zeros_like(plain)
            _banded_add(kernel, plain, 0.5 * self.factor, part)
            out = out + b * self._inverse(part)
        return out + self._inverse(total)

    def _transform(self, x: Tensor) -> Tensor:
        """Zero-padded in-plane spectra."""
        return torch.fft.rfft2(x, s=self.padded).contiguous()

    def _inverse(self, spectrum: Tensor) -> Tensor:
        ny, nx = self.grid.shape[-2:]
        # Only the rows that are kept are transformed along x.
        rows = torch.fft.ifft(spectrum, dim=-2)[..., :ny, :]
        return torch.fft.irfft(rows, n=self.padded[1], dim=-1)[..., :nx]

    # -- what solvers, priors and training need ----------------------------------------------------

    def periodic_spectrum(self) -> Tensor:
        """Eigenvalues of the best circulant approximation (T. Chan 1988), ``rfftn`` layout of
        the grid, ≥ 0."""
        spectrum = self._periodic * self.factor
        return spectrum[0] if self._flat else spectrum

    @undisturbed
    def lag_kernels(self) -> Tensor:
        """The K_c in space, factor included: ``(terms, reach + 1, nz, py, px)``, lags (y, x) on the
        padded ring.

        Entry [c, b, z, ly, lx] couples slice z to slice z + b at the in-plane lag (to minus from)
        modulo ``padded``, so G between two voxels is K₀ plus the mean of both polynomials times K_c
        (:attr:`polynomials`).
        """
        return torch.fft.irfft2(self._spectra, s=self.padded) * self.factor

    @property
    def polynomials(self) -> Tensor:
        """The b_c on the in-plane grid, ``(terms, ny, nx)``; the first is 1."""
        return self._basis

    @undisturbed
    def information(self, mu_per_hu: float, frequency: float = REFERENCE_FREQUENCY) -> float:
        """The data's information on an in-plane wave, in 1/(HU² mm³) (2-D: 1/(HU² mm²)).

        Its inverse is the noise power that unregularised least squares has there, in HU² mm³. It is
        proportional to the exposure and hardly depends on the voxel size.

        Args:
            mu_per_hu: 1 HU in mm⁻¹ (μ_ref / 1000).
            frequency: of the wave, lp/mm.
        """
        key = (mu_per_hu, frequency)
        if key not in self._information:
            kernel = self._spectra[0]
            # A wave that is constant along z sees the sum over the bands.
            summed = (kernel[:1].real + 2 * kernel[1:].real.sum(0, keepdim=True)).sum(0)
            self._information[key] = information_at(
                frequency, summed, self.padded, self.grid.spacing, mu_per_hu
            )
        return self._information[key] * self.factor

    def noise(self, batch: tuple[int, ...] = (), *, generator: torch.Generator) -> Tensor:
        """Draw AᵀW n for counting noise n ~ N(0, W⁻¹) without a projector: covariance G (stationary
        part).

        So ``apply(x) + noise(...)`` is a realisation of the right-hand side AᵀW y of a noisy scan
        of x.

        Args:
            batch: leading shape of the result.
            generator: source of randomness, on any device: one on the CPU gives the same noise
                everywhere.

        Returns:
            ``(*batch, *grid.shape)`` in the dtype of the weights, on the device of the kernels.
        """
        return self.coloured(self.white(batch, generator=generator))

    @undisturbed
    def white(self, batch: tuple[int, ...] = (), *, generator: torch.Generator) -> Tensor:
        """White noise for :meth:`coloured`, ``(*batch, slices, *padded)``; arguments of
        :meth:`noise`."""
        nz = 1 if self._flat else self.grid.shape[0]
        drawn = torch.randn(
            (*batch, nz, *self.padded),
            generator=generator,
            dtype=self.dtype,
            device=generator.device,
        )
        return drawn.to(self._of_noise.device)

    @undisturbed
    def coloured(self, white: Tensor) -> Tensor:
        """Noise of covariance G (stationary part) from that of :meth:`white`, ``(*batch,
        *grid.shape)``."""
        if self._factor is None:
            self._factor = cholesky(self._of_noise)[0]
        nz, (ny, nx) = white.shape[-3], self.grid.shape[-2:]
        if not white.numel():
            out = white[..., :ny, :nx]
            return out.squeeze(-3) if self._flat else out
        spectrum = torch.fft.rfft2(white)
        lower = self._factor
        mixed = torch.zeros_like(spectrum)
        for b in range(lower.shape[0]):
            mixed[..., b:, :, :] += lower[b, : nz - b] * spectrum[..., : nz - b, :, :]
        out = torch.fft.irfft2(mixed, s=self.padded)[..., :ny, :nx] * math.sqrt(self.factor)
        return out.squeeze(-3) if self._flat else out


def information_at(
    frequency: float,
    spectra: Tensor,
    period: tuple[int, int],
    spacing: tuple[float, ...],
    mu_per_hu: float,
) -> float:
    """Information on an in-plane wave that is constant along z, in 1/(HU² mm³) (2-D: 1/(HU² mm²));
    > 0.

    Args:
        frequency: of the wave, lp/mm. What voxels or grid do not hold is read off the nearest that
            they do, by the law of the ramp, S ∝ 1/f.
        spectra: ``(slices, period[0], period[1] // 2 + 1)`` in-plane spectra of what AᵀWA answers
            to such waves.
        period: voxels of the ring that the spectra are of.
        spacing: voxel size per axis in mm.
        mu_per_hu: 1 HU in mm⁻¹.
    """
    hy, hx = spacing[-2:]
    f = torch.hypot(
        torch.fft.fftfreq(period[0], hy, dtype=torch.float64, device=spectra.device)[:, None],
        torch.fft.rfftfreq(period[1], hx, dtype=torch.float64, device=spectra.device)[None, :],
    )
    spectra = spectra.double()
    wanted = min(frequency, HIGHEST_PER_VOXEL / max(hy, hx))
    distance = (f - wanted).abs() + torch.where(f == 0, math.inf, 0.0)
    # Rounding must not decide about frequencies on the ring's edge: the unit of length would, too.
    ring = distance <= max(AROUND * wanted, float(distance.min()) * 1.001) * (1.0 + 1e-9)
    per_slice = (spectra[:, ring] * (f[ring] / frequency)).mean(1)
    # A voxel's own response is the mean of the spectrum over the square of frequencies that voxels
    # hold, on which the mean of 1/f is 4 ln(1 + √2) voxels. So it tells c of S = c / f where a grid
    # of few voxels tells nothing else.
    own = torch.fft.irfft2(spectra, s=period)[:, 0, 0] / (
        4.0 * math.log(1.0 + math.sqrt(2.0)) * math.sqrt(hy * hx)
    )
    found = max(float(per_slice.median()), LEAST_INFORMATION * float(own.median()) / frequency)
    return found * mu_per_hu**2 / math.prod(spacing)


def check_weights(weights: object, shape: tuple[int, ...]) -> None:
    """Refuse weights that are not finite, ≥ 0 and of the given shape, or all 0 (TypeError,
    ValueError)."""
    if not isinstance(weights, Tensor) or weights.dtype not in (torch.float32, torch.float64):
        raise TypeError(
            "weights must be a float32 or float64 tensor, got "
            f"{getattr(weights, 'dtype', type(weights))}"
        )
    if tuple(weights.shape) != tuple(shape):
        raise ValueError(
            f"weights must have the shape of the projector's range {tuple(shape)}, got "
            f"{tuple(weights.shape)}"
        )
    if not torch.isfinite(weights).all():
        raise ValueError("weights must be finite: give readings without information the weight 0")
    if weights.min() < 0:
        raise ValueError(
            f"weights must be at least 0 (inverse variances), got {float(weights.min())}"
        )
    if weights.max() == 0:
        raise ValueError("all weights are 0: no reading carries information")


def _low(padded: tuple[int, int]) -> Tensor:
    """Which frequencies are low, ``(fy, fx)`` of ``rfft2``."""
    y, x = torch.fft.fftfreq(padded[0]), torch.fft.rfftfreq(padded[1])
    radius = torch.hypot(y[:, None], x)
    steps = torch.hypot(y[:, None] * padded[0], x * padded[1])
    return (steps < LOW) & (radius < LOW_PER_VOXEL)


def _monomials(y: Tensor, x: Tensor, terms: int) -> Tensor:
    return torch.stack([torch.ones_like(y), y, x, y * y, y * x, x * x][:terms], dim=-1)


def _spectra(kernels: Tensor, padded: tuple[int, int]) -> Tensor:
    """Lower bands of the in-plane spectra, ``(terms, reach + 1, nz, py, px // 2 + 1)`` complex."""
    reach = kernels.shape[1] // 2
    lower = kernels[:, reach:]
    for axis in (-2, -1):
        lower = _wrap(lower, padded[axis], axis)
    out = torch.fft.rfft2(lower)
    out[:, 0].imag.zero_()
    return out


def _wrap(kernel: Tensor, period: int, axis: int) -> Tensor:
    """Lags −(n−1)…n−1 on a ring of ``period``; the lags beyond, which nothing reads, join both
    ends linearly."""
    kernel = kernel.movedim(axis, -1)
    n = (kernel.shape[-1] + 1) // 2
    positive, negative = kernel[..., n - 1 :], kernel[..., : n - 1]
    gap = period - (2 * n - 1)
    if gap:
        t = torch.arange(1, gap + 1, dtype=kernel.dtype) / (gap + 1)
        between = (1 - t) * kernel[..., -1:] + t * kernel[..., :1]
        ring = torch.cat([positive, between, negative], dim=-1)
    else:
        ring = torch.cat([positive, negative], dim=-1)
    return ring.movedim(-1, axis)


def _banded_add(kernel: Tensor, x: Tensor, scale: float, out: Tensor) -> None:
    """out += scale · K x, K Hermitian and banded along z: lower bands ``(reach + 1, nz, fy,
    fx)``."""
    nz = x.shape[-3]
    if x.device.type == "cpu":
        from recon.gram.kernels import banded_add  # numba loads with its first use

        real = kernel.real.numpy().dtype.type
        k, v, to = (
            torch.view_as_real(a).flatten(-2).numpy()
            for a in (kernel, x.reshape(-1, *x.shape[-3:]), out)
        )
        row = 4 * x.shape[-1] * kernel.shape[0] * x[..., 0, 0].numel()
        run(banded_add, x.shape[-2], k, v, real(scale), to.reshape(v.shape), operations=row)
        return
    out += (scale * kernel[0].real) * x
    for b in range(1, kernel.shape[0]):
        band = scale * kernel[b, : nz - b]
        out[..., b:, :, :] += band * x[..., : nz - b, :, :]
        out[..., : nz - b, :, :] += band.conj() * x[..., b:, :, :]


def _periodic_mean(kernel: Tensor) -> Tensor:
    """Spectrum of the circulant matrix nearest to the kernel's Toeplitz matrix, floored at 1e-6
    of its maximum."""
    bands, nz, wy, wx = kernel.shape
    ny, nx = (wy + 1) // 2, (wx + 1) // 2
    ring = torch.zeros(nz, ny, nx, dtype=torch.float64)
    index_y = torch.arange(-(ny - 1), ny) % ny
    index_x = torch.arange(-(nx - 1), nx) % nx
    share_y = 1 - torch.arange(-(ny - 1), ny).abs() / ny
    share_x = 1 - torch.arange(-(nx - 1), nx).abs() / nx
    mean = kernel.double().sum(1) / nz * share_y[:, None] * share_x
    folded = torch.zeros(bands, ny, wx, dtype=torch.float64).index_add_(1, index_y, mean)
    folded = torch.zeros(bands, ny, nx, dtype=torch.float64).index_add_(2, index_x, folded)
    for b in range(bands):
        ring[(b - bands // 2) % nz] += folded[b]
    spectrum = torch.fft.rfftn(ring).real
    return spectrum.clamp_min(1e-6 * float(spectrum.max())).to(kernel.dtype)
