"""What would this method show of a lesion in this scan? Contrast recovery, by insertion.

A ball of known size and contrast is added to the readings of a scan, measured or simulated, and the
scan is reconstructed with it and without it. The difference of the two volumes is what the method
shows of the ball, on the same noise and in the same surroundings, whether the method is linear or
not. Its mean over the ball's voxels, over the ball's own, is the *contrast recovery*.

A linear method has one contrast recovery for a size, the same at any dose. A method with a prior
shows less of what it takes for noise: of what is small or faint, at a low dose. So soft FBP of the
same scan with the same ball stands beside it: where a prior shows less than that, it shows less
than the data hold.

What is shown says nothing of noise. So the *detectability* d′ of each ball in the readings stands
there, too: the signal-to-noise ratio of an ideal observer who knows all but whether the ball is
there, d′² = Σ p² / σ² over the readings, p what the ball adds to a line integral and σ² its
variance (Barrett, Myers 2004, Foundations of Image Science, 13.2.8). No method does better, and
to find a body by searching takes a d′ of about 5 (Rose 1948, J. Opt. Soc. Am. 38:196). Far below
that, a prior that shows less of it is right; above, it is not.

Balls at several places are inserted together, so far apart that the difference around one is its
own. They are sampled on voxels of a fraction of the detector's cells and projected exactly
(averages over cells). Readings with a ball are those without it times its transmission: their
noise is right to first order in the ball's contrast.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import EllipsisType

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.api import reconstruct
from recon.evaluate.measure import volume_of
from recon.evaluate.methods import Method, MethodLike, listed, method_of, noise_of
from recon.evaluate.without_truth import MeasuredRealisation, as_slices, require_no_energies
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.recovery import recovered_contrast
from torchpcct.projector import Projector
from torchpcct.scan import Scan
from torchpcct.scan_grid import finite_cells
from torchpcct.validate import checked, number, whole
from torchpcct.volume import from_hu

__all__ = ["ContrastRecovery", "InsertedBall", "contrast_recovery", "recovery_table"]

Floats = NDArray[np.float64]

REFERENCE = "fbp:soft"
"""The linear method that stands beside all others."""
APART = 4.0
"""Balls are so many diameters apart, from middle to middle."""
APART_VOXELS = 8.0
"""And so many voxels, however small they are: what a kernel or a prior spreads stays between."""
_MARGIN_VOXELS = 3.0
"""A ball keeps so many voxels from the border of the grid."""
_FINE = 4
"""Voxels of the inserted ball in a detector cell, and in its radius."""
_SAMPLES = 6
"""Points per axis of a voxel that decide how much of it lies in a ball."""
_OBJECT_HU = -500.0
"""Voxels above are object, below air."""
_CANDIDATES = 4000
"""Voxels among which places are chosen."""


@dataclass(frozen=True)
class InsertedBall:
    """A ball of one contrast; in a slice a disc.

    Args:
        diameter_mm: of the ball.
        contrast_hu: what it adds to what is there, HU; below 0 it takes away.
    """

    diameter_mm: float
    contrast_hu: float

    def __post_init__(self) -> None:
        number("diameter_mm", self.diameter_mm, positive=True, unit="mm")
        if number("contrast_hu", self.contrast_hu, unit="HU") == 0.0:
            raise ValueError("contrast_hu must not be 0: a ball without contrast shows nothing")

    def __str__(self) -> str:
        return f"{self.diameter_mm:g} mm, {self.contrast_hu:+g} HU"

    def volume_fractions(self, grid: VolumeGrid, places: Floats) -> Floats:
        """How much of each voxel lies in balls at ``places`` ``(n, axes)``, ``grid.shape``."""
        found = np.zeros(grid.shape)
        offsets = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
        radius = 0.5 * self.diameter_mm
        for place in places:
            near, squares = [], []
            for axis, step, at in zip(grid.axes, grid.spacing, place, strict=True):
                close = np.flatnonzero(np.abs(axis - at) < radius + step)
                points = axis[close][:, None] + offsets * step - at
                near.append(slice(close[0], close[-1] + 1) if close.size else slice(0, 0))
                squares.append(np.square(points).reshape(-1))
            distance = sum(np.meshgrid(*squares, indexing="ij", sparse=True))
            inside = np.asarray(distance) < radius**2
            cut = [n for s in near for n in (s.stop - s.start, _SAMPLES)]
            mean = inside.reshape(cut).mean(axis=tuple(range(1, len(cut), 2)))
            found[tuple(near)] = np.maximum(found[tuple(near)], mean)
        return found


@dataclass(frozen=True)
class ContrastRecovery:
    """What a method shows of a ball.

    Args:
        method: its name.
        ball: that was inserted.
        values: contrast recovery at each place.
        reference: that of soft FBP at the same places.
        places: ``(z, y, x)`` or ``(y, x)`` mm.
        detectability: d′ of the ball in the readings, mean over the places; None of a scan without
            noise, or one whose noise is not known.
    """

    method: str
    ball: InsertedBall
    values: tuple[float, ...]
    reference: tuple[float, ...]
    places: tuple[tuple[float, ...], ...]
    detectability: float | None = None

    @property
    def mean(self) -> float:
        """Mean over the places."""
        return float(np.mean(self.values))

    @property
    def standard_error(self) -> float:
        """Of the mean, from the scatter between places (noise and surroundings); NaN of one."""
        return _standard_error(self.values)

    @property
    def reference_mean(self) -> float:
        """Mean over the places, of soft FBP."""
        return float(np.mean(self.reference))

    @property
    def verdict(self) -> str:
        """``more`` or ``less`` than soft FBP shows, by more than two standard errors of the paired
        difference, else ``as much``."""
        d = np.subtract(self.values, self.reference)
        if len(d) < 2 or abs(float(d.mean())) <= 2.0 * _standard_error(d):
            return "as much"
        return "more" if d.mean() > 0 else "less"

    @property
    def in_percent(self) -> str:
        """The mean ± two standard errors, in words."""
        if len(self.values) == 1:
            return f"{100 * self.mean:.0f} %"
        return f"{100 * self.mean:.0f} ± {200 * self.standard_error:.0f} %"

    def as_dict(self) -> dict[str, object]:
        """JSON values."""
        return {
            "method": self.method,
            "diameter_mm": self.ball.diameter_mm,
            "contrast_hu": self.ball.contrast_hu,
            "recovered": self.mean,
            "standard_error": self.standard_error if len(self.values) > 1 else None,
            "soft_fbp": self.reference_mean,
            "verdict": self.verdict,
            "detectability": self.detectability,
            "values": list(self.values),
            "reference": list(self.reference),
            "places_mm": [list(p) for p in self.places],
        }

    def __str__(self) -> str:
        return (
            f"a ball of {self.ball}: {self.method} shows {self.in_percent} of its contrast, "
            f"{self.verdict} {'as' if self.verdict == 'as much' else 'than'} "
            f"{REFERENCE} ({100 * self.reference_mean:.0f} %)"
        )


def _standard_error(values: Sequence[float] | Floats) -> float:
    """Of the mean; NaN of one value."""
    n = len(values)
    return float(np.std(values, ddof=1) / math.sqrt(n)) if n > 1 else math.nan


def recovery_table(found: Sequence[ContrastRecovery]) -> str:
    """A table in text: for each ball what each method shows of its contrast."""
    rows = [("ball", "places", "d′", "method", "contrast shown", "soft FBP", "")]
    for one in found:
        rows.append(
            (
                str(one.ball),
                str(len(one.values)),
                "" if one.detectability is None else f"{one.detectability:.1f}",
                one.method,
                one.in_percent,
                f"{100 * one.reference_mean:.0f} %",
                one.verdict,
            )
        )
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = [
        "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    note = (
        "Mean over the places ± two standard errors. less, more: than soft FBP of the same scan "
        "shows, by more than two standard errors of the difference. d′: signal-to-noise ratio of "
        "the ball in the readings, for an ideal observer who knows all but whether it is there."
    )
    return "\n".join([*lines, "", *textwrap.wrap(note, 100)])


@checked
def contrast_recovery(
    scan: Scan,
    grid: VolumeGrid,
    methods: MethodLike | Sequence[MethodLike] = "mbir",
    balls: Sequence[InsertedBall] = (InsertedBall(1.0, 100.0),),
    *,
    places: Sequence[Sequence[float]] | None = None,
    n: int = 8,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> list[ContrastRecovery]:
    """Contrast recovery of methods in a scan, ball by ball, method by method.

    Args:
        scan: any that :func:`recon.reconstruct` takes.
        grid: as there. Voxels that are coarse beside a ball show what such voxels can show of it.
        methods: one, or a list of them, as for :func:`recon.evaluate.evaluate` (``"mbir"``,
            ``"mbir:fidelity=1"``, ``"bilateral@fbp:detail"``, a function of ``(scan, grid)``),
            without files and ``energies=``.
        balls: to insert, one kind at a time.
        places: middles of the balls in mm, one row ``(z, y, x)`` or ``(y, x)`` each; None: found
            in the object (:func:`insertion_places`).
        n: how many places are looked for; fewer if there is no room.
        seed: of the places.
        progress: called with the finished fraction, 0…1.

    Returns:
        In the order of ``balls``, for each in the order of ``methods``.

    Raises:
        ValueError: places outside of the grid or too close to each other, no room for a ball;
            energy bins (weigh them before); see :func:`recon.reconstruct`.
        TypeError: methods or balls of another kind.
    """
    if not balls or not all(isinstance(b, InsertedBall) for b in balls):
        raise TypeError(f"balls must be a sequence of InsertedBall, got {balls!r}")
    asked = [method_of(m) for m in listed(methods)]
    if not asked:
        raise ValueError("methods must name at least one method")
    require_no_energies(asked)
    if scan.counts.ndim > len(scan.geometry.shape) and scan.geometry.has_rows:
        raise ValueError(
            "the scan has several energy bins: sum them with weights before (Scan.weighted)"
        )
    whole("n", n, low=1)
    axes = grid.ndim
    scan, grid = as_slices(scan, grid)
    if places is not None:
        asked_at = {ball: _checked_places(places, axes, scan, grid, ball) for ball in balls}
    soft = method_of(REFERENCE)
    steps = {m.name: m for m in [soft, *asked]}
    noise, weights = _noise(scan, grid), noise_weights(scan)
    tell, done, total = progress or (lambda _: None), 0, len(steps) * (1 + len(balls))

    def volumes(of: Scan) -> dict[str, Tensor]:
        nonlocal done
        found = {}
        for name, method in steps.items():
            found[name] = volume_of(method, _InsertedRealisation(of, grid, noise))
            done += 1
            tell(done / total)
        return found

    before = volumes(scan)
    results = []
    for ball in balls:
        at = (
            insertion_places(scan, grid, ball, before[REFERENCE], n=n, seed=seed)
            if places is None
            else asked_at[ball]
        )
        with_them, detectability = with_balls(scan, grid, ball, at, weights)
        after = volumes(with_them)
        truth = _truth(scan, grid, ball, at)
        cells = _territories(grid, at)

        shares = {
            name: tuple(
                recovered_contrast((after[name] - before[name])[c], truth[c]) for c in cells
            )
            for name in steps
        }
        at_mm = tuple(tuple(map(float, place[-axes:])) for place in at)
        results += [
            ContrastRecovery(m.name, ball, shares[m.name], shares[REFERENCE], at_mm, detectability)
            for m in asked
        ]
    return results


@dataclass(frozen=True, eq=False)
class _InsertedRealisation(MeasuredRealisation):
    """The scan as methods ask for it, FBP as :func:`recon.reconstruct` gives it."""

    def fbp(self, kernel: str) -> Tensor:
        found: Tensor = reconstruct(self.scan, self.grid, "fbp", kernel=kernel).data
        return found


def _noise(scan: Scan, grid: VolumeGrid) -> Callable[[Method, float], float]:
    """A linear method → the noise of its volume in HU: half of what the volumes of every other
    view differ by."""
    kept: dict[str, Tensor] = {}

    def noise(method: Method, smooths: float) -> float:
        if method.name not in kept:
            first, second = (
                method.run(_InsertedRealisation(scan.select(slice(k, None, 2)), grid))
                for k in (0, 1)
            )
            kept[method.name] = 0.5 * (first - second)
        return noise_of(kept[method.name], torch.arange(grid.voxels), smooths)

    return noise


def noise_weights(scan: Scan) -> Tensor | None:
    """Inverse variances of the line integrals; None of a scan without noise, or one whose noise is
    not known."""
    if scan.noise_free:
        return None
    try:
        return scan.weights()
    except ValueError:
        return None


def with_balls(
    scan: Scan, grid: VolumeGrid, ball: InsertedBall, places: Floats, weights: Tensor | None = None
) -> tuple[Scan, float | None]:
    """The scan with balls at ``places`` ``(n, axes)`` in mm inserted; and d′ of a ball in the
    readings, mean over the places.

    Args:
        weights: of :func:`noise_weights`; None: d′ is None.
    """
    added = torch.zeros(scan.counts.shape)
    powers = []
    for at, projection in _projections(scan, grid, ball, places):
        added[at] += projection
        if weights is not None:
            powers.append(float((weights[at] * projection.square()).sum(dtype=torch.float64)))
    return scan.with_added(added), float(np.mean(np.sqrt(powers))) if powers else None


def _projections(
    scan: Scan, grid: VolumeGrid, ball: InsertedBall, places: Floats
) -> Iterator[tuple[int | EllipsisType, Tensor]]:
    """What a ball at each of the places adds to the line integrals, and of which slice."""
    fine = min(*finite_cells(scan.geometry), 0.5 * ball.diameter_mm) / _FINE
    size = math.ceil(ball.diameter_mm / fine) + 2
    axes = 3 if scan.geometry.has_rows else 2
    for place in places:
        middle = tuple(float(v) for v in place[-axes:])
        patch = VolumeGrid((size,) * axes, fine, middle)
        fractions = ball.volume_fractions(patch, np.asarray([middle]))
        mu = torch.from_numpy(fractions * _attenuation(scan, ball.contrast_hu)).float()
        at = _slice_of(grid, place) if _is_stack(scan) else ...
        yield at, Projector(scan.geometry, patch, scan.window)(mu)


def insertion_places(
    scan: Scan,
    grid: VolumeGrid,
    ball: InsertedBall,
    image: Tensor,
    *,
    n: int = 8,
    seed: int = 0,
) -> Floats:
    """Places for a ball in the object, spread as far from each other as they can, ``(n, axes)`` mm.

    Args:
        scan: whose unit ``image`` has.
        grid: of ``image``.
        ball: all of it lies in voxels of the object (above -500 HU; in another unit above half of
            the 99th percentile).
        image: a reconstruction of the scan without it.
        n: at most so many.
        seed: of the first place.

    Raises:
        ValueError: no room for one.
    """
    from scipy.ndimage import binary_erosion  # a slow import

    values = image.detach().cpu().double().numpy()
    level = _OBJECT_HU if scan.unit == "HU" else 0.5 * float(np.quantile(values, 0.99))
    space = np.asarray(grid.spacing)
    reach = 0.5 * ball.diameter_mm + _MARGIN_VOXELS * space
    if _is_stack(scan):
        reach, space = reach[1:], space[1:]
    steps = [
        np.arange(-math.ceil(r / s), math.ceil(r / s) + 1) * s
        for r, s in zip(reach, space, strict=True)
    ]
    around = sum(
        np.square(v / r)
        for v, r in zip(np.meshgrid(*steps, indexing="ij", sparse=True), reach, strict=True)
    )
    near = np.asarray(around) <= 1.0
    room = binary_erosion(values > level, near[None] if _is_stack(scan) else near)
    free = np.argwhere(room)
    if not len(free):
        raise ValueError(
            f"a ball of {ball} fits nowhere into the object on this grid: give a larger grid, a "
            "smaller ball, or places="
        )
    random = np.random.default_rng(seed)
    if len(free) > _CANDIDATES:
        free = free[random.choice(len(free), _CANDIDATES, replace=False)]
    points = np.stack([axis[i] for axis, i in zip(grid.axes, free.T, strict=True)], axis=1)
    least = _least_distance(grid, ball)
    chosen = [points[random.integers(len(points))]]
    distance = np.full(len(points), math.inf)
    while len(chosen) < n:
        distance = np.minimum(distance, np.linalg.norm(points - chosen[-1], axis=1))
        farthest = int(distance.argmax())
        if distance[farthest] < least:
            break
        chosen.append(points[farthest])
    return np.asarray(chosen)


def _is_stack(scan: Scan) -> bool:
    """Whether slices are reconstructed one by one: a ball is a disc in one of them."""
    return not scan.geometry.has_rows


def _slice_of(grid: VolumeGrid, place: Floats) -> int:
    """The slice in which a place lies."""
    return int(np.abs(grid.axes[0] - place[0]).argmin())


def _least_distance(grid: VolumeGrid, ball: InsertedBall) -> float:
    return max(APART * ball.diameter_mm, APART_VOXELS * max(grid.spacing))


def _checked_places(
    places: Sequence[Sequence[float]], axes: int, scan: Scan, grid: VolumeGrid, ball: InsertedBall
) -> Floats:
    """``(n, 3)`` mm (ValueError: outside of the grid, or too close)."""
    at = np.asarray(places, dtype=np.float64)
    if at.ndim != 2 or at.shape[1] != axes or not len(at) or not np.isfinite(at).all():
        raise ValueError(
            f"places must be rows of {axes} numbers in mm, "
            f"{'(z, y, x)' if axes == 3 else '(y, x)'}, got {places!r}"
        )
    at = np.concatenate([np.zeros((len(at), 3 - axes)), at], axis=1)
    half = 0.5 * np.asarray(grid.extent) - 0.5 * ball.diameter_mm
    if _is_stack(scan):
        half[0] = 0.5 * grid.extent[0]
    low, high = np.asarray(grid.center) - half, np.asarray(grid.center) + half
    for place in at:
        if (place < low).any() or (place > high).any():
            raise ValueError(
                f"a ball of {ball} at {tuple(map(float, place[-axes:]))} mm reaches beyond the "
                f"grid: its middle must lie between {tuple(map(float, low[-axes:].round(3)))} and "
                f"{tuple(map(float, high[-axes:].round(3)))} mm"
            )
    apart = np.linalg.norm(at[:, None] - at[None], axis=-1)
    apart[np.diag_indices(len(at))] = math.inf
    if apart.min() < 0.999 * (least := _least_distance(grid, ball)):
        raise ValueError(
            f"two places are {apart.min():.3g} mm apart, balls of {ball} need {least:.3g} mm: "
            "measure them one after the other"
        )
    return at


def _attenuation(scan: Scan, contrast_hu: float) -> float:
    """A contrast in 1/length."""
    mu = scan.linearisation.mu_ref
    return float(from_hu(torch.tensor(contrast_hu, dtype=torch.float64), mu)) - mu


def _truth(scan: Scan, grid: VolumeGrid, ball: InsertedBall, places: Floats) -> Tensor:
    """What the balls add to a volume, in its unit."""
    if _is_stack(scan):
        plane = VolumeGrid(grid.shape[1:], grid.spacing[1:], grid.center[1:])
        found = np.zeros(grid.shape)
        for place in places:
            of_slice = found[_slice_of(grid, place)]
            np.maximum(of_slice, ball.volume_fractions(plane, place[None, 1:]), out=of_slice)
    else:
        found = ball.volume_fractions(grid, places)
    fractions = torch.from_numpy(found).float()
    contrast = ball.contrast_hu if scan.unit == "HU" else _attenuation(scan, ball.contrast_hu)
    return fractions * contrast


def _territories(grid: VolumeGrid, places: Floats) -> list[tuple[slice, ...]]:
    """Voxels around each place, nearer to it along an axis than half of the way to the next."""
    found = []
    for k, place in enumerate(places):
        others = np.delete(places, k, axis=0)
        reach = 0.5 * np.abs(others - place).max(axis=1).min() if len(others) else math.inf
        near = [
            np.flatnonzero(np.abs(axis - at) <= reach)
            for axis, at in zip(grid.axes, place, strict=True)
        ]
        found.append(tuple(slice(int(i[0]), int(i[-1]) + 1) for i in near))
    return found
