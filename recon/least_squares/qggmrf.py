"""The q-generalised Gaussian Markov random field: the edge-preserving prior of model-based
reconstruction.

Potential of a gradient t (HU/mm) between two neighbours (Thibault, Sauer, Bouman, Hsieh 2007, Med.
Phys. 34:4526, eq. 18, normalised to curvature 1 at t = 0 for p = 2)::

    ρ(t) = |t|ᵖ T²⁻ᵖ / (p (1 + |t / T|ᵖ⁻ᵠ)),        1 ≤ q ≤ p ≤ 2

Below the threshold T it acts like ``|t|ᵖ`` (smooths noise), above like ``|t|ᵠ`` (lets edges pass);
it is convex. p = q = 2 is the quadratic prior (with half the curvature, see :func:`quadratic`).

The energy is a Riemann sum over the volume, so it does not depend on the voxel size, to first
order::

    R(x) = λ V Σ_{pairs} ω_d ρ((x_j − x_k) / (mu_per_hu d)),      V voxel volume, d distance in mm,

with ω_d ∝ d (the usual weight 1/d on squared differences) and Σ_d ω_d = the number of dimensions: a
linear ramp of g HU/mm costs ½ λ g² per mm³ when g ≪ T. λ is in 1/(HU² mm) and comes from the noise
level, see :meth:`QGGMRF.bind`.

For several channels at once t is the Euclidean length of their common gradient, ``|x_j − x_k| /
(mu_per_hu d)``: an edge in one channel relaxes the penalty of all channels there, as basis images
share the edges of the tissues (vectorial regularisation, Sapiro and Ringach 1996; for spectral CT
Rigie and La Rivière 2015). The length treats all directions in the space of channels alike, so the
channels must be of equal, uncorrelated noise
(:class:`recon.least_squares.basis_problem.Whitening`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.threads import run
from torchpcct.validate import number

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import DTypeLike

    from torchpcct.typing import Array, Reals


__all__ = ["QGGMRF"]

ROUNDING = 1e-3
"""Below p = 2 the curvature at 0 is infinite: gradients are rounded off at this fraction of the
threshold."""


@dataclass(frozen=True)
class QGGMRF:
    """A q-GGMRF prior in noise-normalised units.

    Args:
        strength: s ≥ 0. The prior's curvature equals that of the data at ``frequency · s^(-1/3)``,
            at any dose and voxel size: with the frequency 0.5 lp/mm s = 1 blurs at 0.5 lp/mm, s =
            1/8 at 1 lp/mm. The resolution of small contrasts hence stays and the noise falls as
            dose^(−1/2).
        threshold: T in HU/mm, or, with ``relative=True``, in units of ``(λ mm³)^(−1/2)``, a
            gradient scale that follows the noise (∝ dose^(−1/2)). ``inf`` makes the prior
            quadratic.
        p, q: exponents of small and large gradients, 1 ≤ q ≤ p ≤ 2.
        neighbors: 26 (2-D: 8) or 6 (2-D: 4).
        relative: how to read ``threshold``.
        frequency: line pairs per mm, at which the data are asked how much they know.

    Raises:
        ValueError: a value outside its range.
    """

    strength: float
    threshold: float
    p: float = 2.0
    q: float = 1.0
    neighbors: int = 26
    relative: bool = False
    frequency: float = 0.5

    def __post_init__(self) -> None:
        number("frequency", self.frequency, positive=True, unit="lp/mm")
        number("strength", self.strength, low=0.0)
        number("threshold", self.threshold, positive=True, finite=False)
        if not 1.0 <= self.q <= self.p <= 2.0:
            raise ValueError(
                f"the exponents need 1 ≤ q ≤ p ≤ 2 for a convex prior, got p = {self.p}, q = "
                f"{self.q}"
            )
        if self.neighbors not in (6, 26):
            raise ValueError(f"neighbors must be 6 or 26 (2-D: 4 or 8), got {self.neighbors}")

    def stretched(self, factor: float, dimensions: int = 3) -> QGGMRF:
        """The prior of a scan that has all lengths ``factor`` times as large: its image is the
        same, voxel by voxel.

        Args:
            factor: > 0.
            dimensions: of the volume.
        """
        # With all lengths times m and attenuations divided by it, gradients are divided by m, and
        # the energy keeps its value if λ is divided by m^(dimensions − 2).
        power = dimensions / 2 if self.relative else 1.0
        factor = number("factor", factor, positive=True)
        return replace(
            self, frequency=self.frequency / factor, threshold=self.threshold * factor**-power
        )

    def bind(
        self, information: float, spacing: Sequence[float], mu_per_hu: float, channels: bool = False
    ) -> BoundPrior:
        """The prior for one grid and noise level.

        Args:
            information: the data's information at ``frequency``, in 1/(HU² mm³)
                (``Gram.information(mu_per_hu, frequency)``); the same for each channel.
            spacing: voxel size per axis in mm, (y, x) or (z, y, x).
            mu_per_hu: 1 HU in mm⁻¹ (μ_ref / 1000); the value of the channels that counts as 1 HU.
            channels: for volumes with an axis of channels.
        """
        number("information", information, positive=True)
        lam = self.strength * information / (2.0 * math.pi * self.frequency) ** 2
        threshold = self.threshold
        if self.relative and lam > 0:
            threshold = self.threshold / math.sqrt(lam)
        return BoundPrior(
            lam, threshold, self.p, self.q, self.neighbors, tuple(spacing), mu_per_hu, channels
        )


DEFAULT_PRIOR = QGGMRF(strength=0.3, threshold=16.0, relative=True)
"""Chosen on held-out plaques (not the paper's) at 0.35 and 2 s for the contrast slope of FBP's soft
kernel with the least noise: the curvatures of data and prior are equal at 0.75 line pairs per mm at
every dose. The threshold must follow the noise: one of 300 HU/mm lets that of 0.35 s pass as edges
(338 HU of it in plain fat). A stronger prior lowers the noise of ROI means further, but shrinks the
contrast of a millimetre-sized core: look at means and slope, not at CNR alone."""


def quadratic(strength: float) -> QGGMRF:
    """The quadratic (Gaussian) prior of the same strength: ρ(t) = t² / 2."""
    return QGGMRF(strength, math.inf)


@dataclass(frozen=True)
class BoundPrior:
    """A q-GGMRF energy of volumes ``(..., [channels,] *grid.shape)`` in mm⁻¹. Made by
    :meth:`QGGMRF.bind`.

    Args:
        lam: λ in 1/(HU² mm).
        threshold: T in HU/mm.
        p, q, neighbors: see :class:`QGGMRF`.
        spacing: voxel size per axis in mm.
        mu_per_hu: 1 HU in mm⁻¹.
        channels: whether the volumes have an axis of channels before those of the grid.
    """

    lam: float
    threshold: float
    p: float
    q: float
    neighbors: int
    spacing: tuple[float, ...]
    mu_per_hu: float
    channels: bool = False

    def __post_init__(self) -> None:
        if len(self.spacing) not in (2, 3) or min(self.spacing) <= 0:
            raise ValueError(f"spacing must be 2 or 3 lengths in mm, got {self.spacing}")
        number("mu_per_hu (μ_ref / 1000)", self.mu_per_hu, positive=True, unit="mm⁻¹")
        number("lam", self.lam, low=0.0)

    # -- the potential: the only place where its formula stands ------------------------------------

    def _size(self, t: Tensor) -> Tensor:
        return t.abs() if self.p == 2.0 else torch.sqrt(t * t + (ROUNDING * self._finite) ** 2)

    @property
    def _finite(self) -> float:
        return self.threshold if math.isfinite(self.threshold) else 1.0

    def _bend(self, s: Tensor) -> Tensor:
        """|t / T|^(p − q)."""
        if math.isinf(self.threshold):
            return torch.zeros_like(s)
        r, power = s / self.threshold, self.p - self.q
        return r if power == 1.0 else r.pow(power)

    def potential(self, t: Tensor) -> Tensor:
        """ρ(t) of gradients t in HU/mm."""

        def rho(s: Tensor) -> Tensor:
            u = s * s if self.p == 2.0 else s.pow(self.p) * self._finite ** (2 - self.p)
            return u / (self.p * (1 + self._bend(s)))

        zero = rho(self._size(torch.zeros(1, dtype=t.dtype, device=t.device)))
        return rho(self._size(t)) - zero

    def curvature(self, t: Tensor) -> Tensor:
        """ρ'(t) / t: the curvature of the parabola through (t, ρ(t)) that lies above ρ
        everywhere (Huber)."""
        s = self._size(t)
        bend = self._bend(s)
        head = torch.ones_like(s) if self.p == 2.0 else (s / self._finite).pow(self.p - 2)
        return head * (1 + (self.q / self.p) * bend) / (1 + bend) ** 2

    # -- the energy --------------------------------------------------------------------------------

    @property
    def offsets(self) -> tuple[tuple[tuple[int, ...], float, float], ...]:
        """Half of the neighbours: (index offset, distance in mm, ω)."""
        axes = len(self.spacing)
        found = []
        for step in itertools.product((-1, 0, 1), repeat=axes):
            if step <= (0,) * axes or (self.neighbors == 6 and sum(map(abs, step)) != 1):
                continue
            found.append(
                (
                    step,
                    math.sqrt(sum((i * h) ** 2 for i, h in zip(step, self.spacing, strict=True))),
                )
            )
        total = sum(d for _, d in found)
        return tuple((step, d, axes * d / total) for step, d in found)

    @property
    def axes(self) -> int:
        """Axes of one volume, the one of channels included."""
        return len(self.spacing) + self.channels

    @property
    def _volume(self) -> float:
        return math.prod(self.spacing)

    def _check(self, x: Tensor, **others: Tensor) -> None:
        """Refuse volumes of too few axes or of another kind than float, and others that are not
        like the first."""
        if not isinstance(x, Tensor) or x.dtype not in (torch.float32, torch.float64):
            raise TypeError(
                "x must be a float32 or float64 tensor, got "
                f"{getattr(x, 'dtype', type(x).__name__)}"
            )
        if x.dim() < self.axes:
            raise ValueError(
                f"the prior needs a volume of {self.axes} axes, got shape {tuple(x.shape)}"
            )
        for name, other in others.items():
            if not isinstance(other, Tensor) or (other.dtype, other.device) != (x.dtype, x.device):
                kind = (
                    f"{other.dtype} on {other.device}"
                    if isinstance(other, Tensor)
                    else type(other).__name__
                )
                raise TypeError(
                    f"{name} must be a tensor like x, {x.dtype} on {x.device}, got {kind}"
                )
            if other.shape != x.shape:
                raise ValueError(
                    f"{name} must have the shape of x, {tuple(x.shape)}, got {tuple(other.shape)}"
                )

    def gradients(self, x: Tensor) -> Iterator[Tensor]:
        """Gradient of every pair in HU/mm, one tensor per entry of :attr:`offsets`; of channels its
        length, ``(..., 1, *pairs)``."""
        self._check(x)
        for step, d, _ in self.offsets:
            a, b = _pair(x, step)
            change = (
                torch.linalg.vector_norm(a - b, dim=-self.axes, keepdim=True)
                if self.channels
                else a - b
            )
            yield change / (self.mu_per_hu * d)

    def value(self, x: Tensor) -> Tensor:
        """R(x), ``(...)``, without unit. Differentiable."""
        total = x.new_zeros(())
        axes = tuple(range(-self.axes, 0))
        for t, (_, _, omega) in zip(self.gradients(x), self.offsets, strict=True):
            total = total + omega * self.potential(t).sum(dim=axes)
        return self.lam * self._volume * total

    def gradient(self, x: Tensor) -> Tensor:
        """∇R(x), the shape of x."""
        return self.majorizer(x, x)

    def weights(self, x: Tensor) -> list[Tensor]:
        """Curvature of every pair at x, one tensor per entry of :attr:`offsets`, in mm²."""
        scale = self.lam * self._volume / self.mu_per_hu**2
        return [
            self.curvature(t) * (scale * omega / d**2)
            for t, (_, d, omega) in zip(self.gradients(x), self.offsets, strict=True)
        ]

    def majorizer(self, x: Tensor, direction: Tensor) -> Tensor:
        """Curvature matrix of the parabola that touches R at x and lies above it, times
        ``direction``.

        ``majorizer(x, x)`` is the gradient. Not differentiable (both passes run in numba on the
        CPU).

        Raises:
            ValueError: a direction of another shape than x, fewer axes than a volume has.
            TypeError: tensors that are not float32 or float64, or not alike.
        """
        self._check(x, direction=direction)
        if x.device.type == "cpu":
            return self._fused_majorizer(x, direction)
        return self._plain_majorizer(x, direction)

    def along(self, x: Tensor, direction: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
        """⟨direction, ∇R(x)⟩ and ⟨direction, majorizer(x) other⟩ of each volume, ``(...)`` float64.

        Raises:
            ValueError, TypeError: as :meth:`majorizer`.
        """
        self._check(x, direction=direction, other=other)
        if x.device.type == "cpu":
            return self._fused_along(x, direction, other)
        axes = tuple(range(-self.axes, 0))
        pull, bend = self._plain_majorizer(x, x), self._plain_majorizer(x, other)
        return tuple((direction * v).sum(dim=axes, dtype=torch.float64) for v in (pull, bend))  # type: ignore[return-value]

    def _plain_majorizer(self, x: Tensor, direction: Tensor) -> Tensor:
        out = torch.zeros_like(direction)
        for (step, _, _), w in zip(self.offsets, self.weights(x), strict=True):
            a, b = _pair(direction, step)
            flow = w * (a - b)
            to, back = _pair(out, step)
            to += flow
            back -= flow
        return out

    def _fused_majorizer(self, x: Tensor, direction: Tensor) -> Tensor:
        from recon.least_squares import qggmrf_kernels as kernels  # numba loads with its first use

        a, b = self._volumes(x), self._volumes(direction)
        out = np.empty_like(a)
        self._by_rows(kernels.majorize, a, b, *self._tables(a.dtype, both=True), out)
        return torch.from_numpy(out).reshape(x.shape)

    def _fused_along(self, x: Tensor, direction: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
        from recon.least_squares import qggmrf_kernels as kernels  # numba loads with its first use

        a, v, u = self._volumes(x), self._volumes(direction), self._volumes(other)
        rows = np.empty((a.shape[0], *a.shape[-3:-1], 2))
        self._by_rows(kernels.along, a, u, v, *self._tables(a.dtype, both=False), rows)
        sums = torch.from_numpy(rows.sum(axis=(1, 2))).reshape(*x.shape[: x.dim() - self.axes], 2)
        return sums[..., 0], sums[..., 1]

    def _by_rows(
        self, kernel: Callable[..., None], x: NDArray[np.float32 | np.float64], *rest: object
    ) -> None:
        rows = len(x) * x.shape[-3] * x.shape[-2]
        run(kernel, rows, x, *rest, operations=4 * len(self.offsets) * x.size // rows)

    def _volumes(self, x: Tensor) -> NDArray[np.float32 | np.float64]:
        """``(batch, channels, nz, ny, nx)`` contiguous."""
        n = len(self.spacing)
        shape = (x.shape[-self.axes] if self.channels else 1, *(1,) * (3 - n), *x.shape[-n:])
        return x.detach().reshape(-1, *shape).contiguous().numpy()

    def _tables(self, dtype: DTypeLike, both: bool) -> tuple[Array, Array, Reals, int, Reals]:
        """Arguments of the kernels: neighbours, scales, factors, kind and form of the potential."""
        steps, scales, factors = [], [], []
        for step, d, omega in self.offsets:
            full = (0,) * (3 - len(step)) + step
            for sign in (1, -1) if both else (-1,):
                steps.append([sign * i for i in full])
                scales.append(1.0 / (self.mu_per_hu * d))
                factors.append(self.lam * self._volume * omega / (self.mu_per_hu * d) ** 2)
        power = self.p - self.q
        if self.p == 2.0 and math.isinf(self.threshold):
            kind = 0
        else:
            kind = 1 if self.p == 2.0 and power == 1.0 else 2
        inverse = 1.0 / self._finite
        form = np.array([inverse, power, self.q / self.p, self.p - 2.0, ROUNDING], dtype=dtype)
        return (
            np.array(steps, dtype=np.int64),
            np.array(scales, dtype),
            np.array(factors, dtype),
            kind,
            form,
        )

    def spectrum(self, shape: Sequence[int]) -> Tensor:
        """Eigenvalues of the curvature at t = 0 on a periodic grid, ``rfftn`` layout ``(...,
        shape[-1] // 2 + 1)``."""
        n, dtype = len(shape), torch.float64
        grids = [torch.fft.fftfreq(k, dtype=dtype) for k in shape[:-1]] + [
            torch.fft.rfftfreq(shape[-1], dtype=dtype)
        ]
        mesh = torch.meshgrid(*grids, indexing="ij")
        total = torch.zeros(mesh[0].shape, dtype=dtype)
        at_zero = 1.0 if self.p == 2.0 else ROUNDING ** (self.p - 2)
        for step, d, omega in self.offsets:
            phase = sum(
                (2 * math.pi * mesh[a] * step[a] for a in range(n)), torch.zeros_like(mesh[0])
            )
            total = total + (omega / d**2) * (2 - 2 * torch.cos(phase))
        return total * (self.lam * self._volume * at_zero / self.mu_per_hu**2)


def _pair(x: Tensor, step: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Views of x at the upper and the lower end of every pair that is ``step`` apart."""
    n = x.dim() - len(step)
    upper = [slice(None)] * n + [slice(max(s, 0), None if s >= 0 else s) for s in step]
    lower = [slice(None)] * n + [slice(max(-s, 0), None if s <= 0 else -s) for s in step]
    return x[tuple(upper)], x[tuple(lower)]
