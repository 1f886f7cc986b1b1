"""What is read of the volumes: every method at every exposure, block after block of
realisations.

The readings of a block are cached. They are numbers only: ROI means, channels of the observer,
errors, and some flat voxels.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage, signal
from torch import Tensor

from recon.evaluate.methods import Method, Realisation
from recon.evaluate.realisations import Realisations, Simulated
from recon.evaluate.task import BESIDE_MM, Task
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.observer import dog_channels, template_channel
from torchpcct.volume import Volume

if TYPE_CHECKING:
    from torchpcct.typing import Floats32

Floats = NDArray[np.float64]
Block: TypeAlias = dict[str, Any]
"""What is read of a block of realisations: numbers and arrays by the names that
:class:`RoiReadings` has."""

BLOCK = 8
"""Realisations of a block."""
OBSERVERS = ("axial", "volume")
"""Observers by what they look at: the axial slice, or the volume."""
_CHANNELS = 4
"""Difference-of-Gaussians channels of an observer beside the signal's own shape."""
_LOWEST = 0.15
"""Frequency of the first of them, lp/mm."""
_SEEN_MM = 0.3
"""Standard deviation of the blur through which the observer expects the signal."""
_LONGEST = 120
"""Bytes of a folder's name that is a method's."""
_SHIFT_VOXELS = 0.5
"""A volume that lies so much off is on another grid."""
_SMOOTHED_MM = 0.3
"""Standard deviation of the Gaussian that errors are smoothed by before invented contrast is looked
for in them, mm."""
_SOME_VOXELS = 4000
"""Voxels in which it is looked for."""
_BALL_MM = 1.0
"""Diameter of the false bodies that are looked for, mm."""
_AROUND_MM = (0.7, 1.2)
"""Distances from their centres that what is around them has, mm."""
_BORDER_HU = 50.0
"""A border that a reader would take for a wall, HU."""
_FEWEST = 50
"""Voxels of a shell in which a border is looked for, at least."""


@dataclass(frozen=True, eq=False)
class RoiReadings:
    """Of one method at one exposure; the first axis is the realisation, the second says with or
    without the signal.

    Attributes:
        rois: ``(n, 2, rois, 2)`` means of signal and background, HU.
        channels: observer → ``(n, 2, channels)``.
        square: ``(n,)`` mean square error with the signal near the bodies, HU².
        square_beside: ``(n,)`` the same beside the signal.
        invented: ``(n, voxels)`` smoothed error with the signal where nothing is, HU.
        false_body: ``(n,)`` largest contrast with the signal, of either sign, of a ball of 1 mm
            where nothing is, HU; NaN: none fits there.
        shells: ``(n, shells)`` mean error with the signal around the bodies, from near to far, HU.
        flat: tissue → ``(n, voxels)`` HU, with the signal.
        clean_rois: ``(2, rois, 2)`` of noise-free data; clean_square: likewise; clean_rim: least
            error there in the rim of the largest tissue, HU.
        control: ``(n, 2, rois, 2)`` HU: linear functionals of the same realisations that follow
            ``rois``, with their mean ``(2, rois, 2)`` and covariance ``(rois, 2, rois, 2)``; None:
            the reference's ROI means serve.
        first: first volume with the signal, float16, and that of noise-free data.
        seconds: of a volume.
        vessel_used, warned: shares of volumes with and without the signal for which MBIR used a
            vessel model, or warned of something; NaN: the method does not say.
    """

    rois: Floats
    channels: dict[str, Floats]
    square: Floats
    square_beside: Floats
    invented: NDArray[np.float32]
    false_body: Floats
    shells: Floats
    flat: dict[str, NDArray[np.float32]]
    clean_rois: Floats
    clean_square: float
    clean_rim: float
    control: tuple[Floats, Floats, Floats] | None
    first: NDArray[np.float16]
    first_clean: NDArray[np.float16]
    seconds: float
    vessel_used: Floats
    warned: Floats

    @property
    def n(self) -> int:
        """Realisations."""
        return len(self.square)


class Reader:
    """Reads volumes of a task.

    Args:
        task: where its tissues are.
        truth: HU with and without the signal.
    """

    def __init__(self, task: Task, truth: tuple[Tensor, Tensor]) -> None:
        self.task, self.truth = task, truth
        self.rois = tuple(task.regions)
        self.weights = torch.stack([w for pair in task.regions.values() for w in pair])

    @cached_property
    def channels(self) -> dict[str, Tensor]:
        """Observer → ``(channels, z, y, x)``: the signal as it is expected, then differences of
        Gaussians about it."""
        task, grid = self.task, self.task.grid
        expected = ndimage.gaussian_filter(
            (self.truth[0] - self.truth[1]).double().numpy(), [_SEEN_MM / s for s in grid.spacing]
        )
        dogs = dog_channels(grid, task.middle_mm, _CHANNELS, lowest=_LOWEST)
        fullest = int(task.volume_fractions["signal"].sum((1, 2)).argmax())
        one = np.zeros((grid.shape[0], 1, 1))
        one[fullest] = 1.0
        plane = VolumeGrid(
            (1, *grid.shape[1:]), grid.spacing, (float(grid.axes[0][fullest]), *grid.center[1:])
        )
        flat = (
            dog_channels(plane.slice, task.middle_mm[1:], _CHANNELS, lowest=_LOWEST)[:, None] * one
        )
        return {
            "axial": torch.from_numpy(np.concatenate([template_channel(expected * one), flat])),
            "volume": torch.from_numpy(np.concatenate([template_channel(expected), dogs])),
        }

    def pair(self, volume: Tensor) -> Floats:
        """``(rois, 2)`` means."""
        found = torch.einsum("zyx,rzyx->r", volume.double(), self.weights)
        return np.asarray(found.numpy()).reshape(-1, 2)

    def responses(self, volume: Tensor, observer: str) -> Floats:
        """Of an observer's channels."""
        return np.asarray(
            torch.einsum("zyx,czyx->c", volume.double(), self.channels[observer]).numpy()
        )

    def square(self, volume: Tensor, mask: Tensor) -> float:
        """Mean square error with the signal in a mask, HU²."""
        return float((volume - self.truth[0])[mask].double().square().mean())

    def invented(self, volume: Tensor) -> NDArray[np.float32]:
        """Error in some voxels of where nothing is, smoothed within that."""
        mask, sigmas = (
            self.task.quiet.double().numpy(),
            [_SMOOTHED_MM / s for s in self.task.grid.spacing],
        )
        error = ndimage.gaussian_filter((volume - self.truth[0]).double().numpy() * mask, sigmas)
        at, weights = self._quiet
        return np.asarray(error.reshape(-1)[at] / weights, np.float32)

    @cached_property
    def _quiet(self) -> tuple[NDArray[np.int64], Floats]:
        """Indices of some voxels where nothing is, and the weight of their smoothing."""
        mask = self.task.quiet.double().numpy()
        at = np.flatnonzero(mask)
        at = at[:: -(-len(at) // _SOME_VOXELS)] if len(at) else at
        weights = ndimage.gaussian_filter(mask, [_SMOOTHED_MM / s for s in self.task.grid.spacing])
        return at, weights.reshape(-1)[at]

    def false_body(self, volume: Tensor) -> float:
        """Largest contrast, of either sign, of a ball with what is around it, anywhere where
        nothing is, HU; NaN: no ball fits there."""
        (ball, around), weight, fits = self._balls
        if not fits.any():
            return math.nan
        error = (volume - self.truth[0]).double().numpy() * self.task.empty.numpy()
        inside, outside = (signal.oaconvolve(error, k, "same")[fits] for k in (ball, around))
        return float(np.abs(inside - outside / weight[fits]).max())

    @cached_property
    def _balls(self) -> tuple[tuple[Floats, Floats], Floats, NDArray[np.bool_]]:
        """A ball and what is around it, as kernels of sum 1; the share of the latter where nothing
        is, and where the ball and half of what is around it fit in."""
        away = _distances(_AROUND_MM[1], self.task.grid.spacing)
        masks = away <= _BALL_MM / 2, (away >= _AROUND_MM[0]) & (away <= _AROUND_MM[1])
        ball, around = (mask / mask.sum() for mask in masks)
        empty = self.task.empty.double().numpy()
        inside, weight = (signal.oaconvolve(empty, k, "same") for k in (ball, around))
        return (ball, around), weight, (inside > 1.0 - 1e-6) & (weight > 0.5)

    def shells(self, volume: Tensor) -> list[float]:
        """Mean error around the bodies, away from borders that are there."""
        error = (volume - self.truth[0]).double()
        return [float(error[shell].mean()) for shell in self._shells]

    @cached_property
    def _shells(self) -> list[Tensor]:
        ball = _distances(BESIDE_MM, self.task.grid.spacing) <= BESIDE_MM
        borders = np.zeros(self.task.grid.shape, bool)
        for truth in self.truth:
            hu = truth.numpy()
            borders |= (
                ndimage.maximum_filter(hu, footprint=ball)
                - ndimage.minimum_filter(hu, footprint=ball)
                > _BORDER_HU
            )
        free = torch.from_numpy(~borders)
        return [kept for shell in self.task.shells if int((kept := shell & free).sum()) >= _FEWEST]

    def rim(self, volume: Tensor) -> float:
        """Least error beside the bodies, HU; below 0 a dark rim."""
        mask = self.task.rim
        return float((volume - self.truth[0])[mask].min()) if mask.any() else 0.0

    def flat(self, volume: Tensor) -> dict[str, Floats32]:
        """Voxels of every flat tissue."""
        return {t: volume.reshape(-1)[at].float().numpy() for t, at in self.task.flat.items()}


def _distances(reach_mm: float, spacing: Sequence[float]) -> Floats:
    """From the middle of a box of voxels that holds a ball of this radius, mm."""
    reach = [math.ceil(reach_mm / s) for s in spacing]
    at = np.stack(np.meshgrid(*(np.arange(-r, r + 1) for r in reach), indexing="ij"), axis=-1)
    return np.asarray(np.linalg.norm(at * spacing, axis=-1))


def volume_of(method: Method, realisation: Realisation) -> Tensor:
    """A method's volume, checked: HU ``(z, y, x)`` float32.

    Raises:
        TypeError, ValueError: what it gave is no volume on the task's grid in HU: another type,
            shape or grid, NaN.
    """
    given = method.run(realisation)
    if isinstance(given, Volume):
        if given.grid != realisation.grid:
            raise ValueError(
                f"{method.name} gave a volume on {given.grid}, asked was {realisation.grid}"
            )
        if given.unit != "HU":
            raise ValueError(f"{method.name} gave a volume in {given.unit}: HU are needed")
        given = given.data
    if isinstance(given, np.ndarray):
        given = torch.from_numpy(np.ascontiguousarray(given))
    if not isinstance(given, Tensor) or given.is_complex() or given.dtype == torch.bool:
        kind = given.dtype if isinstance(given, Tensor) else type(given).__name__
        raise TypeError(
            f"{method.name} gave {kind}: a real tensor, array or Volume (z, y, x) in HU is needed"
        )
    if tuple(given.shape) != realisation.grid.shape:
        raise ValueError(
            f"{method.name} gave a volume of shape {tuple(given.shape)}, the inset has "
            f"{realisation.grid.shape}"
        )
    bad = int((~torch.isfinite(given)).sum())
    if bad:
        raise ValueError(f"{method.name} gave {bad} voxels that are NaN or infinite")
    return given.detach().float()


def check_volume(volume: Tensor, method: Method, reader: Reader, fbp: Tensor) -> None:
    """A first look at a noise-free volume with the signal, and FBP of the same scan, HU ``(z, y,
    x)``: unit and place.

    Raises:
        ValueError: not in HU, or shifted.
    """
    truth = reader.truth[0]
    a, b = truth - truth.mean(), volume - volume.mean()
    scale = float((a * b).sum() / a.square().sum().clamp_min(1e-9))
    if not 0.2 < scale < 5.0 or float((volume - truth).mean().abs()) > 300.0:
        raise ValueError(
            f"{method.name}: its noise-free volume is {scale:.3g} times the truth, mean "
            f"{float(volume.mean()):.4g} for {float(truth.mean()):.4g} HU: does it give HU (water "
            "0, air -1000)?"
        )
    # Its place by FBP: with few views streaks are larger than edges.
    a = fbp - fbp.mean()
    power = torch.fft.irfftn(torch.fft.rfftn(a).conj() * torch.fft.rfftn(b), s=a.shape)
    at = np.unravel_index(int(power.argmax()), a.shape)
    off = [int(k) if k <= n // 2 else int(k) - n for k, n in zip(at, a.shape, strict=True)]
    if any(abs(k) > _SHIFT_VOXELS for k in off):
        raise ValueError(
            f"{method.name}: its noise-free volume is shifted by {off} voxels (z, y, x): voxel "
            "centres lie at grid.axes, ascending"
        )


def kept_as(method: Method, exposure_s: float, task: Task, seed: int) -> tuple[str, str]:
    """Where what is cached of a method at an exposure lies in the task's store, and its key."""
    name = "".join(c if c.isalnum() or c in "-_." else "_" for c in method.name)
    if name.startswith(".") or len(name.encode()) > _LONGEST:
        name = f"{name.strip('.')[:40]}-{hashlib.sha256(method.name.encode()).hexdigest()[:12]}"
    return f"{name}/{exposure_s:g}s", f"8 {method.name} {method.key} {seed} {task.fingerprint}"


class Measurement:
    """A method at one exposure: what is read of noise-free data, then of block after block of
    realisations.

    Args:
        method: what reconstructs.
        realisations: of the task; reader: of its volumes.
        exposure_s: in s.
    """

    def __init__(
        self, method: Method, realisations: Realisations, reader: Reader, exposure_s: float
    ) -> None:
        self.method, self.reader, self.store = method, reader, realisations.store
        self._place, self._key = kept_as(method, exposure_s, realisations.task, realisations.seed)
        self._blocks: list[Block] = []

        def clean() -> Block:
            pair = [realisations.noise_free(p, exposure_s) for p in (True, False)]
            return _measure_pairs(
                [pair], method, reader, keep=True, fbp=pair[0].fbp(realisations.kernels[0])
            )

        self._clean = self.store.cached(f"{self._place}/clean", self._key, clean)
        self._known: dict[str, Any] | None = None
        self._adjoints: Tensor | None = None
        if method.network is not None:
            respond = partial(realisations.response, method.network, reader, exposure_s)
            self._known = self.store.cached(f"{self._place}/response", self._key, respond)
            self._adjoints = torch.from_numpy(self._known["adjoints"])

    def block(self, k: range, pairs: Callable[[], Sequence[Sequence[Simulated]]]) -> None:
        """Realisations ``k``; ``pairs`` gives them, if they have not been measured before."""

        def compute() -> Block:
            return _measure_pairs(
                pairs(), self.method, self.reader, keep=k.start == 0, adjoints=self._adjoints
            )

        self._blocks.append(
            self.store.cached(f"{self._place}/{k.start}-{k.stop}", self._key, compute)
        )

    def readings(self) -> RoiReadings:
        """Of all blocks."""
        blocks, clean, known = self._blocks, self._clean, self._known
        joined = {
            name: np.concatenate([b[name] for b in blocks])
            for name in blocks[0]
            if name not in ("first", "seconds")
        }
        known_moments = (
            None if known is None else (joined["control"], known["mean"], known["covariance"])
        )
        return RoiReadings(
            rois=joined["rois"],
            channels={o: joined[f"channels_{o}"] for o in OBSERVERS},
            square=joined["square"],
            square_beside=joined["square_beside"],
            invented=joined["invented"],
            false_body=joined["false_body"],
            shells=joined["shells"],
            flat={t: joined[f"flat_{t}"] for t in self.reader.task.flat},
            clean_rois=clean["rois"][0],
            clean_square=float(clean["square"][0]),
            clean_rim=float(clean["rim"][0]),
            control=known_moments,
            first=blocks[0]["first"],
            first_clean=clean["first"],
            seconds=float(np.mean([b["seconds"] for b in blocks])),
            vessel_used=joined["vessel_used"].mean(0),
            warned=joined["warned"].mean(0),
        )


def _measure_pairs(
    pairs: Sequence[Sequence[Simulated]],
    method: Method,
    reader: Reader,
    keep: bool,
    adjoints: Tensor | None = None,
    fbp: Tensor | None = None,
) -> Block:
    """The readings of pairs; with ``fbp``, which then is that of the first realisation, the first
    volume is checked against it."""
    lists: dict[str, list[Any]] = {
        name: []
        for name in (
            "rois",
            "vessel_used",
            "warned",
            "square",
            "square_beside",
            "invented",
            "false_body",
            "shells",
            "rim",
        )
    }
    seconds, control = [], []
    channels: dict[str, list[Any]] = {o: [] for o in OBSERVERS}
    flat: dict[str, list[Any]] = {t: [] for t in reader.task.flat}
    first = None
    for pair in pairs:
        volumes = []
        for realisation in pair:
            began = time.perf_counter()
            volumes.append(volume_of(method, realisation))
            seconds.append(time.perf_counter() - began)
            if fbp is not None and len(seconds) == 1:
                check_volume(volumes[0], method, reader, fbp)
        lists["rois"].append([reader.pair(v) for v in volumes])
        for name in ("vessel_used", "warned"):
            answers = [getattr(realisation, name, None) for realisation in pair]
            lists[name].append([math.nan if a is None else float(a) for a in answers])
        if adjoints is not None:
            control.append([functionals(adjoints, realisation.term.b[0]) for realisation in pair])
        for o in OBSERVERS:
            channels[o].append([reader.responses(v, o) for v in volumes])
        lists["square"].append(reader.square(volumes[0], reader.task.near))
        lists["square_beside"].append(reader.square(volumes[0], reader.task.beside))
        lists["invented"].append(reader.invented(volumes[0]))
        lists["false_body"].append(reader.false_body(volumes[0]))
        lists["shells"].append(reader.shells(volumes[0]))
        lists["rim"].append(reader.rim(volumes[0]))
        for t, values in reader.flat(volumes[0]).items():
            flat[t].append(values)
        if keep and first is None:
            first = volumes[0].numpy().astype(np.float16)
    found = {name: np.array(values) for name, values in lists.items()}
    found["seconds"] = np.array(np.median(seconds))
    found |= {"control": np.array(control)} if control else {}
    found |= {f"channels_{o}": np.array(v) for o, v in channels.items()}
    found |= {f"flat_{t}": np.array(v, dtype=np.float32) for t, v in flat.items()}
    return found if first is None else {**found, "first": first}


def functionals(adjoints: Tensor, right_hand_side: Tensor) -> Floats:
    """Of AᵀWy ``(z, y, x)``: ``(rois, 2)`` HU, of adjoints ``(2 · rois, z, y, x)``."""
    return np.asarray(
        torch.einsum("zyx,rzyx->r", right_hand_side.double(), adjoints).numpy()
    ).reshape(-1, 2)
