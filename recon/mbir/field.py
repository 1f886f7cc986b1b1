"""The learned prior on a whole field of view, for scans of any scanner.

Four things differ from an inset (:mod:`recon.mbir.mbir`):

* AᵀWA is applied by the projector itself: the FFT model of an inset does not hold over a whole
  field.
* Noise changes over the field. With s(x) = (AᵀW 1 at the middle / AᵀW 1 at x)^½ the problem is
  solved for u = x / (c s), c the noise scale at the middle. S AᵀWA S has everywhere about the
  spectrum of the middle (Fessler and Booth 1999, IEEE Trans. Image Process. 8:688), so noise looks
  to the network as it did in training. But which directions are starved changes from place to place
  (across the shoulders, along a rib), so that spectrum is averaged over the directions in plane:
  where it is small in a direction and the true one is not, a step towards the data would be mostly
  noise.
* What the inset's exterior is there, a strongly regularised PWLS is here: it takes the body's
  outline, bones and lungs off the data, and the network sees the rest, as in training. It need not
  converge, the data decide about the sum.
* The network sees blocks that overlap, each with its own noise scale as condition.

Voxels: what the network knows is measured in voxels of about a detector cell at the axis. A scan
with cells half as large is the same scan of an object half as large; lengths are counted in voxels,
and grids whose voxels are not within ``VOXELS_PER_CELL`` of a cell are reconstructed on voxels that
are, and averaged. Parallel and fan beams: the slices of a stack are one volume.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from recon.data_term import Quadratic
from recon.gram.gram import REFERENCE_FREQUENCY
from recon.least_squares.field_model import FieldModel
from recon.least_squares.field_problem import FieldProblem, field_prior
from recon.least_squares.memory import require_memory
from recon.least_squares.pwls import pwls
from recon.mbir.mbir import Mbir, average_onto
from recon.mbir.network import REFERENCE_SCALE_HU
from recon.mbir.priors import Prior, same_kind
from recon.mbir.unrolled import bound
from recon.result import RESIDUAL_TEST, Result, tested
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.volume import to_hu

if TYPE_CHECKING:
    from types import EllipsisType

    from torchpcct.geometry import Geometry
    from torchpcct.metrics.residual_test import ResidualTest  # loads scipy.stats

VOXELS_PER_CELL = (0.7, 1.5)
"""Voxel over detector cell at the axis: the training has 0.2 mm voxels on cells of 0.2 mm × 0.29
mm."""
SOLVES = (16, 10)
"""Conjugate gradients of start and data consistency on exact pairs."""
LARGEST_RATIO = 4.0
"""Voxels that rays hardly meet are treated as if their noise were so many times that of the
middle."""
BLOCK = 64
"""Voxels along each axis that a block of the network gives."""
HALO = 16
"""Voxels on each side of it that help only, or fade."""
EDGES_STRENGTH = 10.0
"""Strength of the PWLS that takes off the edges, over that of the default prior."""
EDGES_STEP_HU = 75.0
"""Step from voxel to voxel above which it is an edge, HU. A threshold that follows the noise would
leave a starved scan the outline of the body."""
EDGES_TOLERANCE_HU = 5.0
"""Tolerance of that PWLS, HU."""
EDGES_PAIRS = 60
"""Its projection pairs at most."""


class FieldGram:
    """S AᵀWA S of a whole field, in the form that :class:`recon.data_term.Quadratic`
    asks for.

    Args:
        problem: of the scan.
        weights: of each slice, ``problem.projector.range_shape``; of a cone beam one.
        voxel_mm: size that the network gives its voxels.

    Attributes:
        ratio: s, ``(z, y, x)``.
        determined: bool ``(z, y, x)``, see :class:`recon.least_squares.field_model.FieldModel`.
    """

    def __init__(self, problem: FieldProblem, weights: Sequence[Tensor], voxel_mm: float) -> None:
        self._problem, self._weights, self._voxel_mm = problem, list(weights), voxel_mm
        A = problem.projector
        model = FieldModel(A, self._weights[len(self._weights) // 2])
        self._middle = float(model.seen[model.at])
        rest = (
            model.seen[None]
            if len(self._weights) == 1
            else torch.stack([A.T(w) for w in self._weights])
        )
        seen = rest if problem.plane else rest[0]
        self.ratio = (self._middle / seen.clamp_min(self._middle / LARGEST_RATIO**2)).sqrt()
        self.determined = model.determined.expand(self.ratio.shape)
        self._spectrum = _turned(
            model.spectrum[None] if problem.plane else model.spectrum, self.ratio.shape
        )
        self._spectrum *= self._middle
        self._model = model

    def exact(self, x: Tensor) -> Tensor:
        """AᵀWA of volumes ``(batch, z, y, x)``."""
        A = self._problem.projector
        if not self._problem.plane:
            found: Tensor = A.T(self._weights[0] * A(x))
            return found
        return torch.stack(
            [A.T(w * A(v)) for v, w in zip(x.unbind(1), self._weights, strict=True)], 1
        )

    def apply(self, u: Tensor) -> Tensor:
        """S AᵀWA S u, ``(batch, z, y, x)``."""
        return self.ratio * self.exact(self.ratio * u)

    def periodic_spectrum(self) -> Tensor:
        """Eigenvalues of the circulant model at the middle, ``rfftn`` layout; of slices the same
        at all z."""
        return self._spectrum

    def information(self, mu_per_hu: float, frequency: float = REFERENCE_FREQUENCY) -> float:
        """So that the noise scale of the middle is right, see
        :class:`recon.data_term.Quadratic`."""
        n = self._model.grid.ndim
        spacing = (self._voxel_mm,) * n
        return self._model.information(mu_per_hu, frequency, spacing) * self._voxel_mm ** (n - 3)


def _turned(spectrum: Tensor, shape: Sequence[int]) -> Tensor:
    """Mean of a spectrum (``rfftn`` layout of volumes of ``shape``) over the directions in
    plane."""
    y, x = (torch.fft.fftfreq(n, dtype=torch.float64) for n in shape[-2:])
    radius = torch.hypot(y[:, None], x[: spectrum.shape[-1]].abs()) * min(shape[-2:])
    ring = radius.round().long()
    size = int(ring.max()) + 1
    index = ring.flatten().to(spectrum.device)
    sums = torch.zeros(*spectrum.shape[:-2], size, dtype=spectrum.dtype, device=spectrum.device)
    sums.index_add_(-1, index, spectrum.flatten(-2))
    mean = sums / torch.bincount(index, minlength=size).clamp_min(1).to(spectrum)
    return mean[..., index].reshape(spectrum.shape)


def trained_grid(grid: VolumeGrid, geometry: Geometry) -> VolumeGrid:
    """The grid of cubic voxels that the network can work on; ``grid`` itself if it is one.

    Args:
        grid: ``(y, x)`` or ``(z, y, x)``; the z axis of slices does not matter.
        geometry: of the scan.

    Raises:
        ValueError: a geometry that is given view by view, whose cells may differ.
    """
    if not hasattr(geometry, "pitch"):
        raise ValueError(
            "MBIR knows its voxels by the detector cell of a circular scan, got "
            f'{type(geometry).__name__}: use "pwls"'
        )
    pitch = geometry.pitch[1] if isinstance(geometry.pitch, tuple) else geometry.pitch
    cell = pitch / getattr(geometry, "magnification", 1.0)
    h = grid.spacing[-1]
    cubic = max(abs(s / h - 1.0) for s in grid.spacing) <= 0.01
    if cubic and VOXELS_PER_CELL[0] <= h / cell <= VOXELS_PER_CELL[1]:
        return grid
    return VolumeGrid(
        tuple(max(1, math.ceil(e / cell - 1e-6)) for e in grid.extent), cell, grid.center
    )


def blockwise(
    network: Prior,
    scales: Tensor,
    estimate: Tensor,
    towards: Tensor,
    condition: Tensor,
    smoothed: Tensor | None,
    block: int = BLOCK,
    halo: int = HALO,
) -> Tensor:
    """The network on volumes ``(1, z, y, x)`` of any size, block by block; neighbours fade into
    each other.

    Args:
        network: the learned prior, or what stands for it.
        scales: ``(z, y, x)`` noise scale of each voxel, HU: each block gets its own.
        estimate, towards, condition, smoothed: see :meth:`recon.mbir.network.Network.forward`.
        block: voxels along each axis that a block gives; with those it shares with its neighbours
            ``2 · halo`` more. A multiple of 8, as ``halo``: blocks of voxels must be those of the
            whole.
        halo: voxels on each side that help only, or fade.
    """
    shape = estimate.shape[-3:]

    def condition_of(part: tuple[slice, ...]) -> Tensor:
        level = torch.log(scales[part] / REFERENCE_SCALE_HU).mean().clamp(-3.0, 3.0)
        return torch.cat([level.reshape(1, 1).to(condition), condition[:, 1:]], 1)

    if max(shape) <= block + 2 * halo:
        return same_kind(
            network(estimate, towards, condition_of((slice(None),) * 3), smoothed),
            estimate,
            network,
        )
    total, weight = (
        torch.zeros_like(estimate),
        torch.zeros(shape, dtype=estimate.dtype, device=estimate.device),
    )
    for part in _parts(shape, block, halo):
        here: tuple[EllipsisType | slice, ...] = (..., *part)
        seen = estimate[here]
        out = same_kind(
            network(
                seen,
                towards[here],
                condition_of(part),
                None if smoothed is None else smoothed[here],
            ),
            seen,
            network,
        )
        fade = torch.ones((), dtype=estimate.dtype, device=estimate.device)
        for axis, (s, n) in enumerate(zip(part, shape, strict=True)):
            fade = fade * _fade(s, n, halo).to(estimate).reshape(-1, *[1] * (2 - axis))
        total[here] += out * fade
        weight[part] += fade
    return total / weight


def _parts(shape: Sequence[int], block: int, halo: int) -> Iterator[tuple[slice, ...]]:
    return itertools.product(
        *(
            [slice(max(k - halo, 0), min(k + block + halo, n)) for k in range(0, n, block)]
            for n in shape
        )
    )


def _fade(part: slice, n: int, halo: int) -> Tensor:
    """1 inside, falling linearly over the inner half of the halo; the outer half only helps the
    network."""
    at = torch.arange(part.start, part.stop, dtype=torch.float64)
    low = (at - part.start - halo / 2 + 0.5) / (halo + 1) if part.start > 0 else torch.ones_like(at)
    high = (
        (part.stop - 1 - at - halo / 2 + 0.5) / (halo + 1) if part.stop < n else torch.ones_like(at)
    )
    return torch.minimum(low, high).clamp(1e-6, 1.0)


class Field:
    """Scans of one geometry on one grid of a whole field, for MBIR.

    Args:
        scan: without a known exterior.
        grid: ``(z, y, x)``; of a parallel or fan beam ``(y, x)`` or ``(slices, y, x)``.
        network: with its weights.

    Raises:
        ValueError: see :class:`recon.least_squares.field_problem.FieldProblem`; voxels finer than
            what the detector resolves.
    """

    def __init__(self, scan: Scan, grid: VolumeGrid, network: Mbir) -> None:
        flat = len(scan.geometry.shape) == 2
        self._asked = grid.slice if flat and grid.ndim == 3 else grid
        self._work = trained_grid(self._asked, scan.geometry)
        self.network = network
        fine, cell = grid.spacing[-1], self._work.spacing[-1]
        if cell > 1.01 * fine:
            raise ValueError(
                f"voxels of {fine:g} mm are finer than what the network was trained for on this "
                f"detector, whose cells have {cell:g} mm at the axis: ask for voxels of "
                f'{cell:g} mm or more and resample the result, or use method="pwls"'
            )
        full = self._work
        if self._asked is not grid:
            full = VolumeGrid(
                (grid.shape[0], *self._work.shape),
                (grid.spacing[0], *self._work.spacing),
                (grid.center[0], *self._work.center),
            )
        self.problem = FieldProblem(scan, full)

    def solve(self, scans: Sequence[Scan]) -> list[Result]:
        """The volume of one scan in HU, on the grid that was asked for.

        Raises:
            ValueError: too little memory.
        """
        (scan,) = scans
        problem, network = self.problem, self.network
        slices = problem.slices(scan)
        require_memory(problem.projector, 1, slices[0][0], None)
        with torch.no_grad():
            gram = FieldGram(problem, [w for _, w in slices], network.voxel_mm)
            edges = _edges(problem, slices)
            normal = network.normal(_term(problem, slices, gram, edges, network.voxel_mm))
            scales = normal.unit_hu * gram.ratio
            # Its noise is known on average over directions only: along a starved one, noise would
            # pass for structure, so nothing is put back.
            prior = bound(network.prior, normal, normal.spectrum())
            u = network.with_prior(partial(blockwise, prior, scales)).solution(
                normal, restore=False, solves=SOLVES
            )
            taken = _stacked(problem, edges)[None] / (scales * normal.mu_per_hu)
            rest = (u[0] * scales) * normal.mu_per_hu
            parts = rest if problem.plane else [rest]
            mu = [x + d for x, d in zip(edges, parts, strict=True)]
            volume, report, _, _ = network.results(
                normal, u, problem.hu(mu)[None], normal.left(u), whole=normal.less(-taken)
            )[0]
        seen = scales[gram.determined]
        seen = seen[:: max(1, seen.numel() // 10**6)]
        low, high = (float(q) for q in torch.quantile(seen, seen.new_tensor([0.1, 0.9])))
        report |= {"noise_scale_hu": (low, high), "voxel_mm": self._work.spacing[-1]}
        peak = float(to_hu(_stacked(problem, mu)[gram.determined].max(), problem.mu_ref))
        warnings = [*problem.warnings, *self._strange(len(slices), (low, high))]
        warnings += network.check((low, high), peak, problem.unit, problem.mu_ref)
        tests: list[ResidualTest] = []
        if not scan.noise_free:
            for (y, w), x in zip(slices, mu, strict=True):
                tests += tested(RESIDUAL_TEST, warnings, problem.residual_test, y, w, x)
        if self._work is not self._asked:
            volume = _onto(volume, self._work, self._asked)
        return [Result(volume, report, warnings, tests)]

    def _strange(self, slices: int, scales: tuple[float, float]) -> list[str]:
        """What the network was not trained for."""
        strange = []
        if self.problem.plane and slices == 1:
            strange.append("a single slice, without neighbours along z")
        if self.problem.unit != "HU":
            strange.append(f"values in {self.problem.unit}, not a patient in HU")
        if self.network.noisier_or_quieter(scales):
            strange.append("another noise than that of its scans")
        if not strange:
            return []
        return [f'the network was not trained for this ({"; ".join(strange)}): use method="pwls"']


def _term(
    problem: FieldProblem,
    slices: Sequence[tuple[Tensor, Tensor]],
    gram: FieldGram,
    edges: Sequence[Tensor],
    voxel_mm: float,
) -> Quadratic:
    """The data term of what is to be added to the edges, for volumes that are divided by s."""
    A = problem.projector
    energies, parts = [], []
    for (y, w), x in zip(slices, edges, strict=True):  # the readings of one slice at a time
        rest = y - A(x)
        weighed = w * rest
        energies.append((weighed * rest).sum(dtype=torch.float64))
        parts.append(A.T(weighed))
    b = gram.ratio * _stacked(problem, parts)
    readings = sum(int((w > 0).sum()) for _, w in slices)
    return Quadratic(
        gram,
        b[None],
        torch.ones(1, device=b.device),
        (voxel_mm,) * 3,
        problem.mu_ref,
        energy=torch.stack(energies).sum()[None],
        readings=readings,
    )


def _stacked(problem: FieldProblem, volumes: Sequence[Tensor]) -> Tensor:
    """``(z, y, x)`` of the volumes of all slices."""
    return torch.stack(list(volumes)) if problem.plane else volumes[0]


def _onto(hu: Tensor, source: VolumeGrid, target: VolumeGrid) -> Tensor:
    """Averages over the voxels of another grid, 2-D or 3-D."""
    if source.ndim == 3:
        return average_onto(hu, source, target)
    source3, target3 = (
        VolumeGrid((1, *g.shape), (1.0, *g.spacing), (0.0, *g.center)) for g in (source, target)
    )
    return average_onto(hu.unsqueeze(-3), source3, target3).squeeze(-3)


def _edges(problem: FieldProblem, slices: Sequence[tuple[Tensor, Tensor]]) -> list[Tensor]:
    """The edges of each slice in mm⁻¹: PWLS with :data:`EDGES_STRENGTH` times the strength of
    the default prior."""
    voxel = problem.work.spacing[-1]
    usual = field_prior(voxel, problem.work.ndim)
    prior = replace(
        usual,
        strength=EDGES_STRENGTH * usual.strength,
        threshold=EDGES_STEP_HU / voxel,
        relative=False,
    )
    hu = problem.mu_ref / 1000.0
    found = []
    for y, w in slices:
        result = pwls(
            problem.projector,
            y,
            w,
            prior,
            mu_per_hu=hu,
            start=problem.start(y),
            tolerance=EDGES_TOLERANCE_HU,
            max_exact=EDGES_PAIRS,
        )
        found.append(result.volume)
    return found
