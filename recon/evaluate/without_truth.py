"""Methods on measured data, without a known ground truth: two scans of one object, or one scan in
two halves.

What two independent scans agree on is signal, what they do not is noise. A blur buys low noise with
resolution, so the reference is filtered to each method's resolution, in the plane and along z,
before noise is compared (:mod:`torchpcct.metrics.equal_resolution`): the dose factor is the ratio
of the variances then, in a region that the user knows to be flat, or over all.

FBP takes samples: on voxels coarser than the detector's cells it aliases noise, the more the
sharper its kernel. Then every smoother kernel seems to save dose. FBP of scans is therefore made on
voxels as fine as the cells, and what the coarse ones cannot show is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
import torch
from scipy import fft
from torch import Tensor

from recon.api import reconstruct
from recon.evaluate.measure import volume_of
from recon.evaluate.methods import Method, MethodLike, listed, method_of, noise_of
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.equal_resolution import noise_at_equal_resolution
from torchpcct.metrics.half_split import HalfSplit, halves
from torchpcct.scan import Scan
from torchpcct.scan_grid import cells_at_axis, finite_cells
from torchpcct.validate import checked, numbers, reals, whole

if TYPE_CHECKING:
    from recon.mbir.mbir import Mbir
    from torchpcct.typing import Bools

__all__ = ["evaluate_scans", "evaluate_volumes"]


class Comparison(TypedDict):
    """A method beside the linear reference, as :func:`evaluate_volumes` describes it."""

    method: str
    noise: float
    noise_shared: float
    noise_reference: float
    dose_factor: float
    low: float
    high: float
    f50: float
    f50_z: float
    resolution: float
    resolution_z: float
    why: str
    note: str


_REFERENCE = "fbp:ram-lak"
"""Linear method without apodisation, which shows the resolution that the data hold."""
_COARSE = 1.05
"""Cells at the axis: on voxels that are larger FBP would alias noise."""
_SAME_CELLS = 0.05
"""Difference of ln(cell at the axis) of one scanner's scans, as calibrations find it."""
_SAME_LIGHT = 0.02
"""Difference of ln(mean reading in air) of scans whose views may be exchanged."""


@dataclass(frozen=True, eq=False)
class MeasuredRealisation:
    """A measured scan, in the form that methods ask for.

    Attributes:
        scan, grid: what is reconstructed.
        noise: a linear method → its noise in HU.
    """

    scan: Scan
    grid: VolumeGrid
    noise: Callable[[Method, float], float] | None = None

    @property
    def label(self) -> str:
        """Measured scans have no volumes in files."""
        raise ValueError(
            "files:FOLDER holds volumes of exported scans: for measured ones use evaluate_volumes"
        )

    @property
    def exposure_s(self) -> float:
        """Of the scan."""
        return self.scan.exposure_s or 1.0

    def fbp(self, kernel: str) -> Tensor:
        """HU ``(z, y, x)``."""
        return _unaliased(self.scan, self.grid, kernel)

    def pwls(self) -> Tensor:
        """The same."""
        found: Tensor = reconstruct(self.scan, self.grid, "pwls").data
        return found

    def mbir(self, network: Mbir) -> Tensor:
        """The same."""
        found: Tensor = reconstruct(self.scan, self.grid, "mbir", network=network).data
        return found

    def sigma(self, method: Method, smooths: float = 0.0) -> float:
        """Noise of a linear method in HU."""
        assert self.noise is not None
        return float(self.noise(method, smooths))


@checked
def evaluate_scans(
    scans: Scan | Sequence[Scan],
    grid: VolumeGrid,
    methods: MethodLike | Sequence[MethodLike],
    region: object = None,
    *,
    n: int = 1,
    seed: int = 0,
) -> list[Comparison]:
    """Methods on two scans of one object, or on one scan of the whole detector in two halves of its
    views.

    Args:
        scans: two with the same geometry, or one.
        grid: of the volumes.
        methods: as for :func:`recon.evaluate.experiment`, without files.
        region: bool mask ``grid.shape`` where noise is measured; None: everywhere.
        n: pairs of noise realisations that are measured. The first is the two scans as they are;
            for each further one views drawn at random are exchanged between them, which makes two
            other scans with independent noise.
        seed: of that realisation.

    Returns:
        What :func:`evaluate_volumes` gives, for a dose of ONE of the scans; of ``n`` pairs the
        geometric means. Where the voxels are coarser than the detector's cells at the axis, FBP is
        made on finer ones and resampled without aliasing, and ``note`` says so: its noise is less
        than that of :func:`recon.reconstruct` on the coarse voxels.

    Raises:
        ValueError, TypeError: no two scans of one kind, unit and size of cells; ``n`` > 1 of one
            scan, whose halves have no views in common; what the methods refuse.
    """
    given: Sequence[Scan] = [scans] if isinstance(scans, Scan) else list(scans)
    n, seed = whole("n", n, 1), whole("seed", seed, 0)
    if len(given) == 1:
        if n > 1:
            raise ValueError(
                f"n = {n} pairs need two scans, whose views are exchanged; one scan gives one "
                "pair: leave out n"
            )
        given = halves(given[0])
    if len(given) != 2 or any(not isinstance(s, Scan) for s in given):
        raise ValueError(f"give one scan, or two of the same object, got {len(given)}")
    if given[0].counts.shape != given[1].counts.shape:
        raise ValueError(
            f"the scans have {tuple(given[0].counts.shape)} and {tuple(given[1].counts.shape)} "
            "readings: two scans of one object by one scanner are needed"
        )
    _require_alike(*given)
    if n > 1 and given[0].geometry != given[1].geometry:
        raise ValueError(
            "views can be exchanged between scans of the same geometry only: leave out n"
        )
    if (
        n > 1
        and abs(math.log(float(given[0].air.double().mean() / given[1].air.double().mean())))
        > _SAME_LIGHT
    ):
        raise ValueError(
            "views can be exchanged between scans of the same exposure only: leave out n"
        )
    given, grid = [as_slices(s, grid)[0] for s in given], as_slices(given[0], grid)[1]
    names = [method_of(m) for m in listed(methods)]
    require_no_energies(names)
    generator = np.random.default_rng(seed)
    rows = []
    for k in range(n):
        pair = given if k == 0 else _exchanged(given, generator)
        found, reference = _reconstructed(pair, grid, names)
        measured = evaluate_volumes(found, reference, grid.spacing, region)
        for row in measured:
            row["note"] = _note(given[0], grid)
        rows.append(measured)
    return rows[0] if n == 1 else [_mean(list(same)) for same in zip(*rows, strict=True)]


def _require_alike(first: Scan, second: Scan) -> None:
    """Refuse (ValueError) scans by different scanners or of other units: what tells them apart
    would count as noise."""
    one, other = first.geometry, second.geometry
    if first.unit != second.unit:
        raise ValueError(
            f"the scans give volumes in {first.unit} and {second.unit}: give both the same "
            "mu_water and pitch"
        )
    cells = list(zip(cells_at_axis(one), cells_at_axis(other), strict=True))
    if one.parallel != other.parallel or any(
        a != b and not abs(math.log(a / b)) <= _SAME_CELLS for a, b in cells
    ):
        beams = [
            f"{'parallel' if g.parallel else 'divergent'} rays on cells of "
            f"{_lengths(finite_cells(g))} mm at the axis"
            for g in (one, other)
        ]
        raise ValueError(
            f"the scans have {beams[0]}, and {beams[1]}: two scans of one object by one scanner "
            "are needed"
        )


def require_no_energies(methods: Sequence[Method]) -> None:
    """Refuse methods that weigh energy bins (ValueError): those of a given scan are weighed
    before."""
    weighted = [m.name for m in methods if m.energies is not None]
    if weighted:
        raise ValueError(
            f"{', '.join(weighted)}: energies= applies to simulated scans; sum the bins of a given "
            "scan with weights before, scan.weighted(torchpcct.spectral.bin_weights(…))"
        )


def as_slices(scan: Scan, grid: VolumeGrid) -> tuple[Scan, VolumeGrid]:
    """A scan of one slice and its grid ``(y, x)`` as a stack of one, ``(1, y, x)``: filters work on
    volumes. Others as they are."""
    if grid.ndim == 3:
        return scan, grid
    stack = replace(scan, air=scan.air[None], **scan.each(lambda readings: readings[None]))
    return stack, VolumeGrid(
        (1, *grid.shape), (grid.spacing[0], *grid.spacing), (0.0, *grid.center)
    )


def _exchanged(pair: Sequence[Scan], generator: np.random.Generator) -> list[Scan]:
    """Two scans whose views are those of the two that are given, each of either."""
    first, second = pair
    axes = len(first.geometry.shape)
    views = torch.from_numpy(generator.random(first.geometry.views) < 0.5).to(first.counts.device)
    other = views.reshape(-1, *(1,) * (axes - 1))

    def mixed(a: Scan, b: Scan) -> Scan:
        fields: dict[str, Any] = {}
        missing = {
            "dead": torch.zeros_like(a.counts, dtype=torch.bool),
            "flux": torch.ones(a.geometry.views),
        }
        for name, of_views in (
            ("counts", other),
            ("quantum", other),
            ("dead", other),
            ("flux", views),
        ):
            ours, theirs = getattr(a, name), getattr(b, name)
            if ours is not None or theirs is not None:
                ours, theirs = (missing[name] if v is None else v for v in (ours, theirs))
                fields[name] = torch.where(of_views, theirs, ours)
        return replace(a, **fields)

    return [mixed(first, second), mixed(second, first)]


def _reconstructed(
    pair: Sequence[Scan], grid: VolumeGrid, methods: Sequence[Method]
) -> tuple[dict[str, list[Tensor]], list[Tensor]]:
    """Method → its two volumes; and those of the reference."""
    kept: dict[str, list[Tensor]] = {}

    def volumes(method: Method) -> list[Tensor]:
        if method.name not in kept:
            kept[method.name] = [
                volume_of(method, MeasuredRealisation(scan, grid, noise)) for scan in pair
            ]
        return kept[method.name]

    def noise(method: Method, smooths: float) -> float:
        first, second = volumes(method)
        return noise_of((first - second) / math.sqrt(2.0), torch.arange(first.numel()), smooths)

    return {m.name: volumes(m) for m in methods}, volumes(method_of(_REFERENCE))


def _finer(scan: Scan, grid: VolumeGrid) -> list[int]:
    """Parts an axis into which the voxels are cut, so that none is coarser than the detector's
    cells."""
    cells = cells_at_axis(scan.geometry)[-grid.ndim :]
    return [
        max(1, math.ceil(s / (_COARSE * cell))) for s, cell in zip(grid.spacing, cells, strict=True)
    ]


def _unaliased(scan: Scan, grid: VolumeGrid, kernel: str) -> Tensor:
    """FBP on voxels as fine as the detector's cells, of which the frequencies that the grid shows
    are kept.

    Cosines over all of the grid, sampled at the centres of its voxels, are those of the finer one.
    """
    parts = _finer(scan, grid)
    shape = [n * k for n, k in zip(grid.shape, parts, strict=True)]
    fine = VolumeGrid(shape, [s / k for s, k in zip(grid.spacing, parts, strict=True)], grid.center)
    volume: Tensor = reconstruct(scan, fine, "fbp", kernel=kernel).data
    for axis, (n, k) in enumerate(zip(grid.shape, parts, strict=True)):
        if k > 1:
            hat = fft.dct(volume.numpy(), axis=axis, norm="ortho").take(range(n), axis)
            volume = torch.from_numpy(fft.idct(hat, axis=axis, norm="ortho") / math.sqrt(k))
    return volume.float()


def _lengths(sizes: Sequence[float]) -> str:
    """One length, or as many as differ."""
    return " × ".join(f"{s:.3g}" for s in (sizes if len(set(sizes)) > 1 else sizes[:1]))


def _note(scan: Scan, grid: VolumeGrid) -> str:
    """Remark on FBP that was made on finer voxels."""
    parts = _finer(scan, grid)
    if max(parts) == 1:
        return ""

    cells = finite_cells(scan.geometry)
    voxels, fine = (
        grid.spacing[-len(cells) :],
        [s / k for s, k in zip(grid.spacing, parts, strict=True)][-len(cells) :],
    )
    return (
        f"voxels of {_lengths(voxels)} mm are coarser than the detector's cells, {_lengths(cells)} "
        f"mm at the axis, and FBP on them aliases noise. FBP, {_REFERENCE} too, was therefore "
        f"reconstructed on voxels of {_lengths(fine)} mm and resampled without aliasing, also as "
        "the base of denoisers: its noise is less than on the coarse voxels"
    )


def _mean(rows: list[Comparison]) -> Comparison:
    """Of one method on several pairs: geometric means, without those that could not be
    measured."""
    sound = [r for r in rows if not r["why"]]
    if not sound:
        return rows[0]

    def mean(values: Iterable[float]) -> float:
        return math.exp(float(np.mean([math.log(v) for v in values])))

    return {
        **sound[0],
        "noise": mean(r["noise"] for r in sound),
        "noise_shared": mean(r["noise_shared"] for r in sound),
        "noise_reference": mean(r["noise_reference"] for r in sound),
        "dose_factor": mean(r["dose_factor"] for r in sound),
        "low": mean(r["low"] for r in sound),
        "high": mean(r["high"] for r in sound),
    }


@checked
def evaluate_volumes(
    volumes: Mapping[str, Sequence[object]],
    reference: Sequence[object],
    voxel_mm: float | Sequence[float],
    region: object = None,
    *,
    cells_mm: Sequence[float] | None = None,
) -> list[Comparison]:
    """Noise, resolution and the dose factor of noise at equal resolution of pairs of volumes.

    Args:
        volumes: method → its two volumes ``(z, y, x)`` or ``(y, x)`` in one unit.
        reference: the two of a linear method that has smoothed nothing (FBP, kernel "ram-lak").
        voxel_mm: edge length of the voxels, one or ``(z, y, x)``.
        region: bool mask of a volume where noise is measured; resolution is that of the whole
            volume. None: everywhere.
        cells_mm: of the detector as they are seen at the axis, ([z,] y, x), in mm; None: not known.

    Returns:
        For each method: ``method``; ``noise`` of a voxel of one volume; ``noise_shared``, the same
        at the frequencies that the reference's two volumes agree on; ``noise_reference``: of the
        reference there, as sharp as the method; ``dose_factor``: the ratio of the last two
        variances, ``low`` and ``high`` its 95 % interval; ``f50`` and ``f50_z``, line pairs per mm
        in the plane and along z at which half of the reference's signal is left (inf: it does not
        fall so far as the object shows); ``resolution`` and ``resolution_z``, up to which the
        reference's volumes agree; ``why`` there is no factor, which then is NaN (else empty);
        ``note``: on what the factors depend, as the voxels of the reference must not be coarser
        than the detector's cells (empty: they are not).

    Raises:
        ValueError: no volumes; of other shapes, NaN; constant ones, or two that are the same;
            lengths that are not positive, a region that is no mask.
        TypeError: volumes that hold no real numbers.
    """
    if not volumes:
        raise ValueError("volumes must name a method's two volumes, beside the reference: got none")
    base = _split("reference", reference)
    given = np.ravel(reals("voxel_mm", voxel_mm))
    spacing = tuple(numbers("voxel_mm", given, positive=True, unit="mm"))
    if len(spacing) > 3:
        raise ValueError(f"voxel_mm must be one length or (z, y, x), got {spacing}")
    spacing = (spacing[0], *spacing) if len(spacing) == 2 else spacing * (3 // len(spacing))
    mask = None if region is None else _mask(region, base.first.shape)
    if cells_mm is not None:
        cells_mm = numbers("cells_mm", cells_mm, positive=True, unit="mm")
        if len(cells_mm) > 3:
            raise ValueError(f"cells_mm must be at most three, ([z,] y, x), got {cells_mm}")
    note = _condition(spacing, cells_mm)
    found: list[Comparison] = []
    for name, pair in dict(volumes).items():
        split = _split(name, pair)
        if split.first.shape != base.first.shape:
            raise ValueError(
                f"{name} has volumes of shape {tuple(split.first.shape)}, the reference "
                f"{tuple(base.first.shape)}"
            )
        try:
            seen = noise_at_equal_resolution(split, base, spacing, mask)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
        factor = seen.dose_factor
        found.append(
            {
                "method": name,
                "noise": seen.noise,
                "noise_shared": seen.noise_shared,
                "noise_reference": seen.noise_reference,
                "dose_factor": factor.value,
                "low": factor.low,
                "high": factor.high,
                "f50": seen.f50_plane,
                "f50_z": seen.f50_z,
                "resolution": seen.shown_plane,
                "resolution_z": seen.shown_z,
                "why": seen.why,
                "note": note,
            }
        )
    return found


def _condition(spacing: Sequence[float], cells: Sequence[float] | None) -> str:
    """On what the factors of given volumes depend."""
    if cells is None:
        return (
            "it is taken that the detector's cells at the axis are no smaller than the voxels, "
            f"{max(spacing[1:]):.3g} mm in the plane: on coarser voxels FBP aliases noise, and "
            "every smoother method seems to save dose"
        )
    voxels = spacing[-len(cells) :]
    if all(s <= _COARSE * cell for s, cell in zip(voxels, cells, strict=True)):
        return ""
    return (
        f"these factors are not to be trusted: the voxels of {_lengths(voxels)} mm are coarser "
        f"than the detector's cells, {_lengths(cells)} mm at the axis, so FBP aliases noise and "
        "every smoother method seems to save dose; give a reference on voxels no coarser than the "
        "cells or averaged from such, or the scans (--scans)"
    )


def _mask(region: object, shape: Sequence[int]) -> Bools:
    """A region as a mask of the volumes.

    Raises:
        TypeError, ValueError: another shape, values besides True and False (1 and 0).
    """
    given = reals("region", region)
    if [n for n in given.shape if n > 1] != [n for n in shape if n > 1]:
        raise ValueError(
            f"region must be a mask of the volumes' shape {tuple(shape)}, got {given.shape}"
        )
    if not np.isin(given, (0.0, 1.0)).all():
        raise ValueError("region must be a mask, True where noise is measured: volume > threshold")
    return given.reshape(shape).astype(bool)


def _split(name: str, pair: Sequence[object]) -> HalfSplit:
    if len(pair) != 2:
        raise ValueError(f"{name}: two volumes of two scans are needed, got {len(pair)}")
    first, second = (torch.as_tensor(reals(f"{name}: a volume", v)) for v in pair)
    if first.shape != second.shape or first.ndim not in (2, 3):
        raise ValueError(
            f"{name}: two volumes (z, y, x) of one shape are needed, got {first.shape} and "
            f"{second.shape}"
        )
    for volume in (first, second):
        bad = int((~torch.isfinite(volume)).sum())
        if bad:
            raise ValueError(
                f"{name}: {bad} of {volume.numel()} voxels of a volume are NaN or infinite: make "
                "it again or, where they are padding about the picture, give them the value of air"
            )
    shape = (1, *first.shape)[-3:]
    return HalfSplit(first.reshape(shape), second.reshape(shape))
