"""A model of AᵀWA for whole fields of view, of any geometry, made from a few exact projection
pairs.

    AᵀWA ≈ Σ_c D s_c F⁻¹ K_c F s_c D,        D² = AᵀW 1 at each voxel that enough rays meet, Σ_c
    s_c² = 1,

K_c the spectrum of the impulse response in the middle of slice c, s_c the share of a slice in it
(Fessler and Booth 1999, IEEE Trans. Image Process. 8:688, with one K). With the prior's own
spectrum beside K its inverse preconditions conjugate gradients.

A voxel behind bone is seen well by the rays that pass beside the bone, and badly by those through
it, so D² depends on the direction. A wave is seen by the rays along its crests; split into waves of
a few sectors of directions b, with χ_b a partition of unity over the half circle,

    AᵀWA ≈ Σ_b D_b F⁻¹ χ_b K₁ F D_b,        D_b² = AᵀWχ_b 1 over Aᵀχ_b 1 in the middle,

K₁ that of AᵀA.

That is good enough to solve with, together with the prior's curvature where the volume is: a few
iterations for each exact pair, which need neither the accuracy nor the memory of
:class:`recon.gram.gram.Gram`, and save more than half of the pairs.

One K is enough in a plane and for parallel rays. A circular orbit of a cone beam does not: its
middle slice has all frequencies, but 36 mm off it, 400 mm from the source, frequencies (f_r, f_z)
with f_r < 0.09 f_z are seen by no ray (Tuy 1983, SIAM J. Appl. Math. 43:546). A preconditioner that
takes them for well seen hardly moves flat faces there. Nor is any of these a model of such waves
that one could solve with: of a volume those that change slowly in the plane are taken from a
coarser scan (:mod:`recon.least_squares.coarse_scan`), the sectors have the rest.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.conjugate_gradient import conjugate_gradient
from recon.gram.gram import REFERENCE_FREQUENCY, check_weights, information_at
from recon.least_squares.coarse_scan import CoarseScan, coarse_scan
from recon.least_squares.model_solver import mean_share
from recon.least_squares.qggmrf import BoundPrior
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam

if TYPE_CHECKING:
    from torchpcct.projector import Projector


LEAST = 0.02
"""Smallest eigenvalue of K, as a share of the median one: between the views' directions it is 0 or,
cut off, negative."""
NODES = 5
"""Slices that have a K of their own, if waves along z fade towards the outermost of them."""
FACTOR = 3.0
"""How many times weaker than in the middle such waves are seen there."""
DETERMINED = 0.9
"""Voxels that fewer rays meet than this share of those through the middle are not determined by the
data. (A ring beyond the field of view, seen by three quarters of the views, converged a hundred
pairs later than all within.)"""
LEAST_MET = 0.5
"""Voxels that fewer rays meet are scaled as if it were this share, of the same mean weight: scaled
by themselves, slices beyond the rows of a cone beam hang on the prior alone and spoil the condition
number."""
UNMET = 1e-3
"""Voxels below this share are met by no ray: what a backprojector leaves there is rounding, of
either sign."""
SECTORS = 6
"""Sectors of ray directions with a D of their own, in a plane. Of 4 to 12, four took one pair in
five more."""
SECTORS_BESIDE_COARSE_SCAN = 3
"""Those of a volume, where a coarser scan has the slow waves: six take as many pairs."""
FAINTEST = 0.02
"""Smallest D_b², as a share of D²: rays of a sector may all be opaque."""
INNER = (3, 10)
"""Fewest and most iterations on the model for an exact pair."""
INNER_REDUCTION = 0.03
"""They end when the norm of the preconditioned residual has fallen by this factor."""
VIEWS_A_TRANSFORM = 5.0
"""Views that are projected, both ways, in the time of a Fourier transform and its inverse (3 in a
plane, 5.5 in a volume, on one core). As many iterations are made as take the time of one pair."""
INNER_OF_VOLUMES = 8
"""Iterations where the model has a coarser scan. Twice as many save up to a third of the pairs of
hard objects, hardly any of easy ones, and no time: each costs half to two thirds of a pair
(``tests/bench/solver_parts.md``)."""


class FieldModel:
    """Diagonal and circulant model of x ↦ AᵀW A x.

    Args:
        projector: A, with ``A.T``, ``domain_shape``, ``range_shape`` and ``grid``; nothing else is
            asked of it.
        weights: W, inverse variances of the line integrals, ``range_shape``, finite and ≥ 0.

    Attributes:
        seen: AᵀW 1, ``domain_shape``: 0 where no ray of positive weight passes.
        scale: D².
        views: of the scan.
        spectrum: K in the middle, ``rfftn`` layout, > 0.
        determined: bool, ``domain_shape``: voxels that (nearly) all views see. Beyond, in the
            corners of a grid that is wider than the field of view and in slices that some views
            miss, directions are left to the prior alone.

    Raises:
        ValueError, TypeError: weights as :class:`recon.gram.gram.Gram` refuses them, or a grid that
            no ray meets.
    """

    def __init__(self, projector: Projector, weights: Tensor) -> None:
        check_weights(weights, tuple(projector.range_shape))
        self.grid, self.views = projector.grid, int(projector.range_shape[0])
        self.seen: Tensor = projector.T(weights)
        if not bool((self.seen > 0).any()):
            raise ValueError(
                "no ray of positive weight meets the grid: check its centre, in mm, and the "
                "geometry"
            )
        self.at = _central(self.seen)
        met = projector.T((weights > 0).to(weights.dtype))
        met = met / met[self.at]
        self.determined: Tensor = met >= DETERMINED
        unseen = LEAST_MET * self.seen[self.determined].median()
        self.scale = torch.where(met > UNMET, self.seen * (LEAST_MET / met).clamp_min(1.0), unseen)
        self._ways = ray_azimuths(projector)
        self._projector, self._weights = projector, weights
        # One impulse after the other: a batch would need twice the memory.
        self._response = lambda impulse: projector.T(weights * projector(impulse))
        column = torch.zeros_like(self.seen)
        # What a wave that is constant along z sees.
        column[..., self.at[-2], self.at[-1]] = 1.0
        column = self._response(column)
        self._column = column if self.grid.ndim == 3 else column[None]
        self.spectrum = self._spectrum(self.at)

    def _spectrum(self, at: tuple[int, ...]) -> Tensor:
        impulse = torch.zeros_like(self.seen)
        impulse[at] = 1.0
        return _periodic(self._response(impulse) / self.seen[at], at)

    @cached_property
    def nodes(self) -> list[tuple[Tensor, Tensor]]:
        """K_c and s_c, ``(z, 1, 1)``, of slices between the first and the last that is determined
        in the middle.

        Where one K will do, it alone, with the share 1. A volume costs two projection pairs to find
        out, and two more for the other slices, when this is first asked for.
        """
        alone = [(self.spectrum, torch.ones_like(self.spectrum.flatten()[0]))]
        if self.grid.ndim < 3:
            return alone
        column = self.determined[:, self.at[1], self.at[2]].nonzero().flatten()
        first, last = int(column[0]), int(column[-1])
        # In the middle of equal parts: the response of an end slice is cut off.
        slices = [first + round((k + 0.5) / NODES * (last - first)) for k in range(NODES)]
        slices[NODES // 2] = self.at[0]
        if any(b - a < 2 for a, b in itertools.pairwise(slices)):
            return alone
        outer = [self._spectrum((z, *self.at[1:])) for z in (slices[0], slices[-1])]
        if min(float((k / self.spectrum)[:, 0, 0].log().mean()) for k in outer) > -math.log(FACTOR):
            return alone
        inner = [
            self.spectrum if z == self.at[0] else self._spectrum((z, *self.at[1:]))
            for z in slices[1:-1]
        ]
        return list(zip([outer[0], *inner, outer[1]], _shares(slices, self.seen), strict=True))

    @cached_property
    def coarse(self) -> CoarseScan | None:
        """What knows the waves of a volume that change slowly in the plane; None where there is
        none."""
        return coarse_scan(self._projector, self._weights)

    @cached_property
    def terms(self) -> list[tuple[Tensor, Tensor]]:
        """Spectra, ``rfftn`` layout or what broadcasts to it, and D_b of the model's terms.

        By sectors of directions, which cost a backprojection each and one pair when this is first
        asked for; by slices where these have a K of their own, or where the directions of the rays
        are not known.
        """
        rest = 1.0 if self.coarse is None else self.coarse.rest
        if self._ways is None or (self.coarse is None and len(self.nodes) > 1):
            return [(rest * k, share * self.scale.sqrt()) for k, share in self.nodes]
        project, weights, size = self._projector, self._weights, self.grid.shape[-2:]
        impulse = torch.zeros_like(self.seen)
        impulse[self.at] = 1.0
        lines = project(impulse)
        spectrum = rest * _periodic(project.T(lines), self.at)
        # Rays along the crests of a wave see it.
        fy, fx = (
            f(n) / h
            for f, n, h in zip(
                (np.fft.fftfreq, np.fft.rfftfreq), size, self.grid.spacing[-2:], strict=True
            )
        )
        sectors = SECTORS if self.coarse is None else SECTORS_BESIDE_COARSE_SCAN
        waves = _sectors(np.arctan2(fy[:, None], fx) + math.pi / 2, sectors)
        waves[:, 0, 0] = 1.0 / sectors  # what is constant has no direction
        found = []
        for wave, ray in zip(waves, _sectors(self._ways, sectors), strict=True):
            share = torch.from_numpy(ray[:, None] if self.grid.ndim == 3 else ray).to(self.seen)
            whole = (share * lines).sum().clamp_min(1e-6 * lines.sum())
            spread = torch.maximum(
                project.T(weights * share) / whole, FAINTEST * self.scale / lines.sum()
            )
            found.append((spectrum * torch.from_numpy(wave).to(spectrum), spread.sqrt()))
        return found

    def apply(self, x: Tensor) -> Tensor:
        """The model of AᵀWA x, ``(..., *grid.shape)``."""
        axes = tuple(range(-self.grid.ndim, 0))
        out = torch.zeros_like(x) if self.coarse is None else self.coarse.apply(x)
        for spectrum, spread in self.terms:
            waves = torch.fft.rfftn(spread * x, dim=axes).mul_(spectrum)
            out += spread * torch.fft.irfftn(waves, s=self.grid.shape, dim=axes)
        return out

    def information(
        self,
        mu_per_hu: float,
        frequency: float = REFERENCE_FREQUENCY,
        spacing: tuple[float, ...] | None = None,
    ) -> float:
        """The data's information in the middle of the grid, see
        :meth:`recon.gram.gram.Gram.information`.

        Args:
            mu_per_hu: 1 HU in mm⁻¹.
            frequency: of the wave, lp/mm.
            spacing: as if the voxels had this size in mm; None: their own.
        """
        rolled = torch.roll(self._column, [-k for k in self.at[-2:]], (-2, -1))
        # Slices that the rays do not meet say nothing.
        kept = rolled[rolled[..., 0, 0] > 0]
        return information_at(
            frequency,
            torch.fft.rfft2(kept).real,
            (rolled.shape[-2], rolled.shape[-1]),
            spacing or self.grid.spacing,
            mu_per_hu,
        )

    def scaled(self, factor: float) -> FieldModel:
        """The model of ``factor`` · W."""
        other = copy.copy(self)
        other.nodes = self.nodes
        other.coarse = None if self.coarse is None else self.coarse.scaled(factor)
        other.terms = [(k, spread * math.sqrt(factor)) for k, spread in self.terms]
        other.seen, other.scale = self.seen * factor, self.scale * factor
        other._column = self._column * factor
        return other


class GradientStep:
    """Steps of preconditioned conjugate gradients: −Σ_c D⁻¹ s_c F⁻¹ (K_c + η_c R)⁻¹ F s_c D⁻¹ times
    the gradient.

    Args:
        nodes: K_c, ``rfftn`` layout of the grid, > 0, with s_c, which broadcast to the grid.
        prior: its curvature at gradient 0 is R.
        x: volumes ``(batch, *shape)``; only their shape, dtype and device matter.
        scale: D² > 0, the shape of the grid; None: 1.
    """

    def __init__(
        self,
        nodes: Sequence[tuple[Tensor, Tensor]],
        prior: BoundPrior,
        x: Tensor,
        scale: Tensor | None = None,
    ) -> None:
        self.prior = prior
        self._grid = tuple(x.shape[-len(prior.spacing) :])
        self._prior = prior.spectrum(self._grid).to(x)
        self._steps, self._curvature = 0, 1.0
        self._scale: Tensor | None = None
        inverse = torch.ones((), dtype=x.dtype, device=x.device)
        if scale is not None:
            self._scale, inverse = scale.to(x).rsqrt(), scale.to(x).reciprocal()
        # In units of D² the prior weighs more where fewer rays pass: η_c is its mean over the
        # slices of c.
        self._nodes = [(k.to(x), s.to(x), _mean(inverse, s.to(x))) for k, s in nodes]

    def step(self, x: Tensor, data_gradient: Tensor) -> tuple[Tensor, int]:
        """The direction of descent, ``(batch, *shape)``, and 0: no iteration of a model."""
        self._measure_curvature(x)
        return -self._precondition(data_gradient + self.prior.gradient(x)), 0

    def _measure_curvature(self, x: Tensor) -> None:
        """How curved the prior is at x; after 0, 1, 2, 4, 8 … steps: by then x hardly changes."""
        if self._steps & (self._steps - 1) == 0:
            self._curvature = mean_share(self.prior, x)
        self._steps += 1

    def _precondition(self, g: Tensor) -> Tensor:
        axes = tuple(range(-len(self._grid), 0))
        g = g if self._scale is None else g * self._scale
        out = torch.zeros_like(g)
        for data, share, weight in self._nodes:
            part = torch.fft.rfftn(g * share, dim=axes).div_(
                data + self._curvature * weight * self._prior
            )
            out += share * torch.fft.irfftn(part, s=self._grid, dim=axes)
        return out if self._scale is None else out * self._scale


class FieldStep(GradientStep):
    """Steps to the minimum of the model and of the prior's parabola at x, by a few preconditioned
    conjugate gradients.

    Args:
        model: of AᵀWA.
        prior, x: see :class:`GradientStep`.
    """

    def __init__(self, model: FieldModel, prior: BoundPrior, x: Tensor) -> None:
        super().__init__(model.nodes, prior, x, model.scale)
        self._model = model
        if model.coarse is None:
            transforms = len(model.terms) + len(model.nodes)
            least, most = INNER
            affordable = int(model.views / (VIEWS_A_TRANSFORM * transforms))
            self._iterations = min(max(affordable, least), most)
        else:
            self._iterations = INNER_OF_VOLUMES

    def step(self, x: Tensor, data_gradient: Tensor) -> tuple[Tensor, int]:
        """The direction of descent, ``(batch, *shape)``, and how many iterations were allowed."""
        self._measure_curvature(x)
        gradient = data_gradient + self.prior.gradient(x)
        step = conjugate_gradient(
            lambda v: self._model.apply(v) + self.prior.majorizer(x, v),
            -gradient,
            self._precondition,
            iterations=self._iterations,
            tolerance=INNER_REDUCTION,
        )
        return step, self._iterations


def ray_azimuths(projector: Projector) -> NDArray[np.float64] | None:
    """Angle of every ray in the plane of the orbit, ``(views, columns)`` rad; None of other
    operators than projectors of parallel, fan and cone beams."""
    geometry: Any = getattr(projector, "geometry", None)
    window = getattr(projector, "window", None)
    if not isinstance(geometry, (ParallelBeam, FanBeam, ConeBeam)):
        return None
    fan = np.zeros(geometry.columns)
    if not isinstance(geometry, ParallelBeam):
        fan = geometry.fan_angles
    ways: NDArray[np.float64] = geometry.angles[:, None] - fan
    return ways if window is None else np.take_along_axis(ways, window.column_indices, axis=1)


def _sectors(ways: NDArray[np.float64], number: int) -> NDArray[np.float64]:
    """Share of directions, rad, in each sector of the half circle: ``(number, *shape)``, in
    straight lines from one to the next."""
    at = ways % math.pi / math.pi * number
    middles = np.arange(number).reshape(-1, *[1] * ways.ndim)
    away = np.abs((at - middles + number / 2) % number - number / 2)
    shares: NDArray[np.float64] = np.maximum(1.0 - away, 0.0)
    return shares


def _mean(inverse: Tensor, share: Tensor) -> float:
    """Mean of 1 / D² over the slices of a node."""
    value, weight = torch.broadcast_tensors(inverse, share.square())
    return float((value * weight).sum(dtype=torch.float64) / weight.sum(dtype=torch.float64))


def _shares(slices: Sequence[int], like: Tensor) -> list[Tensor]:
    """s_c of every slice, ``(z, 1, 1)``: between two nodes cosine and sine, so that their
    squares add to 1."""
    z = torch.arange(len(like), dtype=torch.float64, device=like.device)
    found = []
    for k, node in enumerate(slices):
        share = torch.ones_like(z)
        if k > 0:
            share = torch.where(z < node, (z - slices[k - 1]) / (node - slices[k - 1]), share)
        if k + 1 < len(slices):
            share = torch.where(z > node, (slices[k + 1] - z) / (slices[k + 1] - node), share)
        found.append((share.clamp(0.0, 1.0) * (math.pi / 2)).sin().to(like).reshape(-1, 1, 1))
    return found


def _central(seen: Tensor) -> tuple[int, ...]:
    """The voxel next to the middle of the grid that at least half the median information of seen
    voxels reaches."""
    enough = seen >= 0.5 * seen[seen > 0].median()
    distance = torch.zeros((), device=seen.device)
    for axis, n in enumerate(seen.shape):
        along = (torch.arange(n, device=seen.device) - (n - 1) / 2).square()
        distance = distance + along.reshape(-1, *[1] * (seen.dim() - 1 - axis))
    nearest = torch.where(enough, distance, torch.full_like(distance, math.inf)).argmin()
    return tuple(int(k) for k in np.unravel_index(int(nearest), tuple(seen.shape)))


def _periodic(response: Tensor, at: tuple[int, ...]) -> Tensor:
    """Eigenvalues of the circulant matrix next to the response at ``at`` (T. Chan 1988),
    ``rfftn`` layout, > 0."""
    for axis, (n, k) in enumerate(zip(response.shape, at, strict=True)):
        lag = (torch.arange(n, device=response.device) - k).abs().to(response)
        response = response * (1 - lag / n).reshape(-1, *[1] * (response.dim() - 1 - axis))
    response = torch.roll(response, [-k for k in at], tuple(range(response.dim())))
    spectrum = torch.fft.rfftn(response).real
    return spectrum.clamp_min(
        LEAST * float(spectrum.median().clamp_min(1e-6 * float(spectrum.max())))
    )
