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
* What the inset's surround is there, a strongly regularised PWLS is here: it takes the body's
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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from recon.gram.gram import REFERENCE_FREQUENCY
from recon.least_squares.field_model import FieldModel
from recon.least_squares.field_problem import FieldProblem, field_prior
from recon.least_squares.memory import require_memory
from recon.least_squares.pwls import pwls
from recon.mbir.mbir import Mbir, average_onto
from recon.mbir.network import REFERENCE_SCALE_HU
from recon.mbir.priors import Prior, same_kind
from recon.mbir.problem import NormalisedProblem
from recon.mbir.unrolled import bound, low_residual
from recon.solution import RESIDUAL_TEST, Solution, tested
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.volume import to_hu

if TYPE_CHECKING:
    from torchpcct.metrics.residual_test import ResidualTest  # loads scipy.stats

__all__ = ["FieldGram", "blockwise", "field_solutions", "trained_grid"]

VOXELS_PER_CELL = (0.7, 1.5)
"""Voxel over detector cell at the axis: the training has 0.2 mm voxels on cells of 0.2 mm × 0.29
mm."""
SOLVES = (16, 10)
"""Conjugate gradients of start and data consistency on exact pairs."""
LARGEST_RATIO = 4.0
"""Voxels that rays hardly meet are treated as if their noise were so many times that of the
middle."""
BLOCK = 64
HALO = 16
SURROUND_STRENGTH = 10.0
SURROUND_STEP_HU = 75.0
"""Of the PWLS that takes off the edges: strength over that of the default prior, and the step from
voxel to voxel above which it is one. A threshold that follows the noise would leave a starved scan
the outline of the body."""
SURROUND_HU = 5.0
SURROUND_PAIRS = 60
"""Its tolerance, and the most projection pairs."""


class FieldGram:
    """S AᵀWA S of a whole field, in the form that :class:`recon.mbir.problem.NormalisedProblem`
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
        :class:`recon.mbir.problem.NormalisedProblem`."""
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


def trained_grid(grid: VolumeGrid, geometry: Any) -> VolumeGrid:
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
        scales: ``(z, y, x)`` noise scale of each voxel, HU: each block is told its own.
        estimate, towards, condition, smoothed: see :meth:`recon.mbir.network.Network.forward`.
        block: voxels along each axis that a block gives; with those it shares with its neighbours
            ``2 · halo`` more. A multiple of 8, as ``halo``: blocks of voxels must be those of the
            whole.
        halo: voxels on each side that help only, or fade.
    """
    shape = estimate.shape[-3:]

    def told(part: tuple[slice, ...]) -> Tensor:
        level = torch.log(scales[part] / REFERENCE_SCALE_HU).mean().clamp(-3.0, 3.0)
        return torch.cat([level.reshape(1, 1).to(condition), condition[:, 1:]], 1)

    if max(shape) <= block + 2 * halo:
        return same_kind(
            network(estimate, towards, told((slice(None),) * 3), smoothed), estimate, network
        )
    total, weight = (
        torch.zeros_like(estimate),
        torch.zeros(shape, dtype=estimate.dtype, device=estimate.device),
    )
    for part in _parts(shape, block, halo):
        here: Any = (..., *part)
        seen = estimate[here]
        out = same_kind(
            network(seen, towards[here], told(part), None if smoothed is None else smoothed[here]),
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


def field_solutions(
    scans: Sequence[Scan], grid: VolumeGrid, network: Mbir, progress: Callable[[float], None]
) -> Iterator[list[Solution]]:
    """Unrolled MBIR of whole fields, see :func:`recon.mbir.reconstruct.reconstruct_mbir`.

    Args:
        scans: without a known surround, of one geometry.
        grid: ``(z, y, x)``; of a parallel or fan beam ``(y, x)`` or ``(slices, y, x)``.
        network: with its weights and fidelity.
        progress: called with the finished fraction.

    Yields:
        Volumes in HU; the report also holds ``noise_scale_hu`` (10 and 90 % of the voxels),
        ``voxel_mm`` (of the grid that was worked on).

    Raises:
        ValueError: see :class:`recon.least_squares.field_problem.FieldProblem`; too little memory;
            voxels finer than what the detector resolves.
    """
    flat = len(scans[0].geometry.shape) == 2
    asked = grid.slice if flat and grid.ndim == 3 else grid
    work = trained_grid(asked, scans[0].geometry)
    fine, cell = grid.spacing[-1], work.spacing[-1]
    if cell > 1.01 * fine:
        raise ValueError(
            f"voxels of {fine:g} mm are finer than what the network was trained for on this "
            "detector, whose cells have "
            f"{cell:g} mm at the axis: ask for voxels of {cell:g} mm or more and resample the "
            "result, or use "
            'method="pwls"'
        )
    full = work
    if asked is not grid:
        full = VolumeGrid(
            (grid.shape[0], *work.shape),
            (grid.spacing[0], *work.spacing),
            (grid.center[0], *work.center),
        )
    problem = FieldProblem(scans[0], full)
    for i, scan in enumerate(scans):
        slices = problem.slices(scan)
        require_memory(problem.projector, slices[0][0], None)
        found, report, warnings = _one(problem, slices, network)
        tests: list[ResidualTest] = []
        if not scan.noise_free:
            for (y, w), x in zip(slices, found, strict=True):
                tests += tested(RESIDUAL_TEST, warnings, problem.residual_test, y, w, x)
        hu = problem.hu(found)
        if work is not asked:
            hu = _onto(hu, work, asked)
        yield [Solution(hu, {**report, "voxel_mm": cell}, [*problem.warnings, *warnings], tests)]
        progress((i + 1) / len(scans))


def _onto(hu: Tensor, source: VolumeGrid, target: VolumeGrid) -> Tensor:
    """Averages over the voxels of another grid, 2-D or 3-D."""
    if source.ndim == 3:
        return average_onto(hu, source, target)
    source3, target3 = (
        VolumeGrid((1, *g.shape), (1.0, *g.spacing), (0.0, *g.center)) for g in (source, target)
    )
    return average_onto(hu.unsqueeze(-3), source3, target3).squeeze(-3)


@torch.no_grad()
def _one(
    problem: FieldProblem, slices: Sequence[tuple[Tensor, Tensor]], network: Mbir
) -> tuple[list[Tensor], dict[str, Any], list[str]]:
    """The volume of each slice in mm⁻¹ (of a cone beam one), the report, and warnings."""
    A, model, hu = problem.projector, network.model, problem.mu_ref / 1000.0
    gram = FieldGram(problem, [w for _, w in slices], network.voxel_mm)
    around = _surround(problem, slices)
    projected = [A.T(w * (y - A(x))) for (y, w), x in zip(slices, around, strict=True)]
    b = gram.ratio * _stacked(problem, projected)
    normal = NormalisedProblem.from_statistic(gram, b[None], torch.ones(1), hu, network.voxel_mm)
    scales = normal.scale_hu * gram.ratio
    # Its noise is known on average over directions only: along a starved one, noise would pass for
    # structure.
    prior = bound(network.parts.get("prior", model.network), normal, normal.spectrum())
    u = network.with_prior(partial(blockwise, prior, scales)).solution(
        normal, restore=False, solves=SOLVES
    )
    left = normal.beta - normal.apply(u)
    whole = normal.beta + normal.apply(_stacked(problem, around)[None] / (scales * hu))
    rest = (u[0] * scales) * hu
    found = [x + d for x, d in zip(around, rest if problem.plane else [rest], strict=True)]
    squares = [
        (w * (y - A(x)).square()).sum(dtype=torch.float64)
        for (y, w), x in zip(slices, found, strict=True)
    ]
    readings = sum(int((w > 0).sum()) for _, w in slices)
    seen = scales[gram.determined]
    seen = seen[:: max(1, seen.numel() // 10**6)]
    low, high = (float(q) for q in torch.quantile(seen, seen.new_tensor([0.1, 0.9])))
    peak = float(to_hu(_stacked(problem, found)[gram.determined].max(), problem.mu_ref))
    warnings = network.check((low, high), peak, problem.unit, problem.mu_ref)
    strange = []
    if problem.plane and len(slices) == 1:
        strange.append("a single slice, without neighbours along z")
    if problem.unit != "HU":
        strange.append(f"values in {problem.unit}, not a patient in HU")
    if network.noisier_or_quieter((low, high)):
        strange.append("another noise than that of its scans")
    if strange:
        warnings.insert(
            0, f'the network was not trained for this ({"; ".join(strange)}): use method="pwls"'
        )
    report = {
        "method": "mbir",
        "iterations": model.steps,
        "fidelity": network.fidelity,
        "residual": float(low_residual(replace(normal, beta=whole), left, network.fidelity)),
        "chi2": float(torch.stack(squares).sum()) / max(readings, 1),
        "noise_scale_hu": (low, high),
        **network.made_with,
    }
    return found, report, warnings


def _stacked(problem: FieldProblem, volumes: Sequence[Tensor]) -> Tensor:
    """``(z, y, x)`` of the volumes of all slices."""
    return torch.stack(list(volumes)) if problem.plane else volumes[0]


def _surround(problem: FieldProblem, slices: Sequence[tuple[Tensor, Tensor]]) -> list[Tensor]:
    """The edges of each slice in mm⁻¹: PWLS with :data:`SURROUND_STRENGTH` times the strength of
    the default prior."""
    voxel = problem.work.spacing[-1]
    usual = field_prior(voxel, problem.work.ndim)
    prior = replace(
        usual,
        strength=SURROUND_STRENGTH * usual.strength,
        threshold=SURROUND_STEP_HU / voxel,
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
            tolerance=SURROUND_HU,
            max_exact=SURROUND_PAIRS,
        )
        found.append(result.x)
    return found
