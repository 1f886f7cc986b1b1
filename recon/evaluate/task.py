"""A task: a thing to see or to measure, what it lies in, and the scanner that looks at it.

A task is data. It has a scene, a *signal* (one body of it, or several) and a *background* (the body
around). The scene without signal has the background's material in its place. From these follows
what is read of every volume:

* ``lesion``: mean over the whole signal less mean over the background around it; ``slice``: the
  same in the axial slice that holds most of the signal; ``small``: of some voxels in the signal's
  middle and the nearest of the background;
* the root mean square error near the bodies and beside the signal, and the noise in every tissue
  that fills a part of the inset;
* contrast invented where nothing is, and contours that are not there;
* whether the signal is there, by an observer who knows where (:mod:`recon.evaluate.estimates`).

Ready ones are in :mod:`recon.evaluate.tasks`; ``torchpcct show-task NAME`` prints one as YAML to
start from.
"""

from __future__ import annotations

import hashlib
import logging
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from recon.analytic.exact_noise import line_integral_variance
from recon.evaluate.names import check_method
from recon.jobs.sources import source_digest
from recon.jobs.store import Store
from recon.least_squares.beyond_grid import beyond_grid
from recon.names import split_energies
from torchpcct.acquisition.acquire import acquire
from torchpcct.acquisition.path_lengths import tissue_path_lengths
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.cramer_rao import cramer_rao_bound, information_matrix
from torchpcct.scan import NOISE_FREE_EXPOSURE_S, Scan
from torchpcct.scanner.scanner import Scanner
from torchpcct.scene.scene import Scene
from torchpcct.validate import numbers

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from torchpcct.typing import Bools


__all__ = ["Task"]

Floats = NDArray[np.float64]
Pair = tuple[Tensor, Tensor]

ROIS = ("small", "slice", "lesion")
"""Names of the regions in which contrast is read."""
_PURE = 0.99
"""Volume fraction of a tissue in the voxels that are read."""
_MOSTLY = 0.8
"""The same where there are too few of those."""
_FEW = 4
"""Voxels that are too few."""
_LONGEST_S = 1e6
"""Exposures at most, eleven days."""
_AROUND_MM = 1.5
"""The background is read as far from the signal, mm."""
_SMALL_MM2 = 0.25
"""Area of the small ROIs, about that of the paper's."""
_NEAR_MM = 0.4
"""The error is that of bodies and of what lies so close to them, mm."""
_RIM_MM = 0.8
"""A rim is looked for so far from bodies, mm."""
BESIDE_MM = 0.6
"""So far the blur of an edge reaches; what is so close to the signal is beside it."""
_ABOUT_MM = 1.5
"""What lies so close to a body is about it, mm."""
_SHELL_MM = 0.2
"""Width of the shells around a body, mm."""
_INSET_RIM_MM = 0.8
"""Width of the inset's rim, where little is measured, mm."""
_FLAT_MM = 1.0
"""Noise is that of voxels so far from any edge, mm."""
_FLAT_VOXELS = 150
"""Voxels of a tissue whose noise is read, at least."""
_KEPT_VOXELS = 2000
"""Voxels of a tissue whose noise is read, at most."""
_LINES = 32
"""Lines per voxel edge of the true shares: to 0.1 HU rms, 9 HU beside metal of 110 000."""
_VIEWS = 246
"""Views that values and limit are summed over: path lengths change slowly from view to view."""
_SUB_RAYS = 16
"""Beam samples of those views."""


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class GroundTruth:
    """What holds of a task without noise.

    Attributes:
        tissues: names, the signal first, then the background.
        values_hu: what each reads on this scanner at this place, by least squares on the noise-free
            readings.
        bound_hu: smallest SD at 1 s of any unbiased estimate of background less signal, all
            outlines known.
    """

    tissues: tuple[str, ...]
    values_hu: tuple[float, ...]
    bound_hu: float

    @property
    def contrast_hu(self) -> float:
        """Background less signal."""
        return self.values_hu[1] - self.values_hu[0]


@dataclass(frozen=True, eq=False)
class Task:
    """See the module.

    Args:
        name: for tables and files: letters, digits, ``._-``, at most 64, not beginning with a dot.
        title: one line on what is asked.
        scene: with the signal, standing still.
        signal: name of its body, or names.
        background: name of the body around; None: the parent of the signal.
        scanner: counting, cone beam.
        grid: ``(z, y, x)`` cubic voxels about the signal, small against the field of view.
        exposures_s: at which it is usually looked at.
        reference: FBP that factors are quoted against (:func:`recon.evaluate.methods.method_of`).
        rois: name → weights of signal and background ``grid.shape`` that add up to 1 each; None:
            see the module.
        tolerance_hu: effects of the scan below it are left out (:func:`torchpcct.acquire`).

    Raises:
        ValueError: no such bodies, a signal that does not touch the inset, voxels too large for it,
            ROIs of another grid, a reference that is not FBP, an exposure that is given twice.
        TypeError: a title or reference that is no text.
    """

    name: str
    scene: Scene
    signal: tuple[str, ...]
    scanner: Scanner
    grid: VolumeGrid
    background: str = ""
    title: str = ""
    exposures_s: tuple[float, ...] = (0.35, 2.0)
    reference: str = "fbp:soft"
    rois: Mapping[str, Pair] = field(default_factory=dict)
    tolerance_hu: float = 0.5

    has_energies: ClassVar[bool] = True
    """Whether the scene can be scanned in energy bins: all its tissues are materials."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}", str(self.name)):
            raise ValueError(
                "the name of a task is that of its files: letters, digits, '.', '_' and '-', at "
                f"most 64, no '.' at the start; got {str(self.name)[:80]!r}"
            )
        signal = (self.signal,) if isinstance(self.signal, str) else tuple(self.signal)
        if not signal:
            raise ValueError(f"task {self.name}: signal names no body of the scene")
        for name in (*signal, *([self.background] if self.background else [])):
            if name not in self.names:
                raise ValueError(
                    f"task {self.name}: no body {name!r} in the scene, which has "
                    f"{', '.join(self.names)}"
                )
        background = self.background or self.scene[signal[0]].parent
        if background is None:
            raise ValueError(
                f"task {self.name}: {signal[0]!r} lies in no other body: name the background"
            )
        if background in signal:
            raise ValueError(f"task {self.name}: {background!r} is both signal and background")
        if (
            self.grid.ndim != 3
            or max(abs(s / self.grid.spacing[0] - 1.0) for s in self.grid.spacing) > 0.01
        ):
            raise ValueError(
                f"task {self.name}: the inset must have cubic voxels (z, y, x), got {self.grid}"
            )
        for roi, pair in self.rois.items():
            for weights in pair:
                if tuple(weights.shape) != tuple(self.grid.shape):
                    raise ValueError(
                        f"task {self.name}: the weights of ROI {roi!r} have the shape "
                        f"{tuple(weights.shape)}, the inset {tuple(self.grid.shape)}: weights on "
                        "another grid come with it, rois={} takes those that follow from the scene"
                    )
        for field_name in ("title", "reference"):
            value = getattr(self, field_name)
            if not isinstance(value, str):
                raise TypeError(
                    f"task {self.name}: {field_name} must be a text, got {value!r:.200}"
                )
        check_method(self.reference)
        if split_energies(self.reference)[0].partition(":")[0] != "fbp" or "@" in self.reference:
            raise ValueError(
                f"task {self.name}: reference must be FBP, fbp:KERNEL, that factors are quoted "
                f"against, got {self.reference!r}"
            )
        exposures = exposures_of(self.exposures_s)
        for name, value in (
            ("signal", signal),
            ("background", background),
            ("exposures_s", exposures),
        ):
            object.__setattr__(self, name, value)

    @property
    def names(self) -> tuple[str, ...]:
        """What signal and background can be."""
        return self.scene.names

    @cached_property
    def absent(self) -> Scene:
        """The scene without the signal."""
        scene = self.scene
        for name in self.signal:
            scene = scene.replace_material(name, self.scene[self.background].material)
        return scene

    @cached_property
    def fingerprint(self) -> str:
        """Of all that a task's results depend on: itself, and the sources that compute them."""
        digest = source_digest("recon.evaluate.measure", type(self).__module__)
        plain = [
            _plain(getattr(self, f.name))
            for f in fields(self)
            if f.name not in ("title", "exposures_s")
        ]
        return hashlib.sha256(f"{plain} {digest}".encode()).hexdigest()[:16]

    def __getstate__(self) -> dict[str, object]:
        """Without what it has kept of its own computations, to be sent."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    # --- noise-free scans and what they say -------------------------------------------------------

    def scans(self, store: Store) -> tuple[Scan, Scan]:
        """Noise-free scans with and without the signal, kept in ``store``."""
        return self.scan(store, "present"), self.scan(store, "absent")

    def scan(self, store: Store, signal: str) -> Scan:
        """Noise-free scan of the scene with the signal ``"present"`` or ``"absent"``, kept in
        ``store``."""
        path = self.scan_file(store, signal)
        if not path.exists():
            scene = self.scene if signal == "present" else self.absent
            try:
                made = acquire(
                    scene, self.scanner, region=self.grid, tolerance_hu=self.tolerance_hu
                )
            except ValueError as error:
                raise ValueError(
                    f"task {self.name}: {error} (outside of the inset a task's scene must be "
                    "round about the axis)"
                ) from error
            for text in _beyond(made, self.grid):
                log.warning("task %s: %s", self.name, text)
            store.keep_scan(made, path)
        return Scan.load(path)

    def prepare(self, store: Store, signal: str) -> None:
        """Simulate and keep what the scan with the signal ``"present"`` or ``"absent"`` is made
        of: a job of its own."""
        self.scan(store, signal)

    def scan_file(self, store: Store, name: str) -> Path:
        """Where a noise-free scan is kept; those of the task before it was changed are removed."""
        path = store.path(f"{name}-{self.fingerprint}.h5")
        for old in path.parent.glob(f"{name}-*.h5"):
            if old != path:
                store.remove(old)
        return path

    def ground_truth(self, store: Store) -> GroundTruth:
        """Values of the tissues and the Cramér–Rao bound; bodies of one material count as one
        tissue."""
        return self.ground_truth_of(*self.scans(store))

    def ground_truth_of(self, present: Scan, absent: Scan) -> GroundTruth:
        """The same of noise-free scans with and without the signal."""
        seen = SomeViews(present)
        maps = seen.path_lengths(self, list(self._groups.values()))
        information = seen.information(maps)
        values = seen.values(maps, information)
        # The signal by what it changes: whatever else the readings hold drops out.
        change = seen.lines - absent.line_integrals()[seen.views]
        differs = (
            _inner(maps[0], seen.weight * change) * seen.scale * seen.share / information[0, 0]
        )
        values[0] = values[1] + differs
        return GroundTruth(
            tuple(self._groups), tuple(float(v) for v in values), contrast_bound(information)
        )

    @cached_property
    def _groups(self) -> dict[str, list[str]]:
        """Tissue → bodies."""
        found = {"signal": list(self.signal), self.background: [self.background]}
        tissue = {self.scene.materials[self.scene.index(self.background)].name: self.background}
        for body, material in zip(self.scene.bodies, self.scene.materials, strict=True):
            if body.name not in (*self.signal, self.background):
                found.setdefault(tissue.setdefault(material.name, body.name), []).append(body.name)
        return found

    # --- where is what ----------------------------------------------------------------------------

    @cached_property
    def volume_fractions(self) -> dict[str, Floats]:
        """Tissue → its share of every voxel, ``grid.shape``; the signal's under ``signal``."""
        fractions = self._fractions
        return {
            tissue: np.sum([fractions[n] for n in names], axis=0)
            for tissue, names in self._groups.items()
        }

    @cached_property
    def _fractions(self) -> dict[str, Floats]:
        """Body → its share of every voxel."""
        return dict(
            zip(self.scene.names, self.scene.volume_fractions(self.grid, _LINES), strict=True)
        )

    @property
    def _beside(self) -> Floats:
        """Share of the background's own body, without others of its material."""
        return self._fractions[self.background]

    def truth(self, ground_truth: GroundTruth) -> tuple[Tensor, Tensor]:
        """HU of every voxel with and without the signal, ``grid.shape`` float32; outside of all
        bodies air."""
        values = dict(zip(ground_truth.tissues, ground_truth.values_hu, strict=True))
        outside = 1.0 - np.sum(list(self.volume_fractions.values()), axis=0)
        absent = np.sum(
            [
                share * values[self.background if t == "signal" else t]
                for t, share in self.volume_fractions.items()
            ],
            axis=0,
        )
        absent = absent - 1000.0 * outside
        present = absent - ground_truth.contrast_hu * self.volume_fractions["signal"]
        return torch.from_numpy(present).float(), torch.from_numpy(absent).float()

    @cached_property
    def regions(self) -> dict[str, Pair]:
        """ROI → weights of signal and background, float64, each of sum 1."""
        signal, around = self._signal_voxels, self._around
        rows = np.asarray(signal.any((1, 2)))
        fullest = int(signal.sum((1, 2)).argmax())
        one = np.zeros_like(signal)
        one[fullest] = True
        small = self._small(signal, around, one)
        found = {
            "small": small,
            "slice": (signal & one, around & one),
            "lesion": (signal, around & rows[:, None, None]),
        }
        for name, (_, outer) in found.items():
            if not outer.any():
                raise ValueError(
                    f"task {self.name}: no voxel beside the signal lies wholly in "
                    f"{self.background!r} (ROI {name}): take smaller voxels, or name another "
                    "background"
                )
        pairs = {n: (_mean(a), _mean(b)) for n, (a, b) in found.items()}
        return {**pairs, **self.rois}

    @cached_property
    def _signal_voxels(self) -> NDArray[np.bool_]:
        """Voxels that are read as the signal."""
        return self._pure("signal", self.volume_fractions["signal"])

    @property
    def _around(self) -> NDArray[np.bool_]:
        """Voxels that are read as the background around it."""
        away = ndimage.distance_transform_edt(~self._signal_voxels, sampling=self.grid.spacing)
        return self._pure(self.background, self._beside) & (away <= _AROUND_MM)

    def _pure(self, name: str, share: Floats) -> NDArray[np.bool_]:
        for least in (_PURE, _MOSTLY):
            if (share > least).sum() >= _FEW:
                return np.asarray(share > least)
        raise ValueError(
            f"task {self.name}: {int((share > _MOSTLY).sum())} voxels of the inset lie in "
            f"{name!r}, {_FEW} are needed: take smaller voxels, or an inset that contains it"
        )

    def _small(self, signal: Bools, around: Bools, here: Bools) -> tuple[Bools, Bools]:
        """Voxels of one slice in the middle of the signal, and near to them where the background
        is not thin."""
        step = self.grid.spacing
        count = max(_FEW, round(_SMALL_MM2 / (step[1] * step[2])))
        depth = np.where(signal & here, _depth(signal, step), -1.0)
        inner = _nearest(signal & here, np.unravel_index(int(depth.argmax()), depth.shape), count)
        beside = np.where(around & here, _depth(around, step), -1.0)
        return inner, _nearest(beside >= 0.5 * beside.max(), ndimage.center_of_mass(inner), count)

    @property
    def _largest(self) -> str:
        """The tissue that fills most of the inset."""
        return max(self.volume_fractions, key=lambda t: float(self.volume_fractions[t].sum()))

    @property
    def _rest(self) -> Floats:
        """Share of what the bodies lie in."""
        return self.volume_fractions[self._largest]

    @cached_property
    def near(self) -> Tensor:
        """Mask ``grid.shape`` in which the error counts: all but what the bodies lie in, and
        what is close to it."""
        bodies = self._rest < 0.5
        bodies |= self.volume_fractions["signal"] > 0.5
        away = ndimage.distance_transform_edt(~bodies, sampling=self.grid.spacing)
        return torch.from_numpy(away <= _NEAR_MM)

    @cached_property
    def beside(self) -> Tensor:
        """Mask ``grid.shape`` of the signal and what is beside it."""
        signal = self._signal_voxels | (self.volume_fractions["signal"] > 0.5)
        return torch.from_numpy(
            ndimage.distance_transform_edt(~signal, sampling=self.grid.spacing) <= BESIDE_MM
        )

    @cached_property
    def empty(self) -> Tensor:
        """Mask ``grid.shape`` of tissue so far from all edges that their blur does not reach there:
        whatever contrast a volume shows within it is invented."""
        tissue = np.argmax(self._constant, axis=0)
        mixed = np.max(self._constant, axis=0) < 1.0 - 1e-6
        edges = mixed | (ndimage.maximum_filter(tissue, 3) != ndimage.minimum_filter(tissue, 3))
        away = ndimage.distance_transform_edt(~edges, sampling=self.grid.spacing)
        return torch.from_numpy((away > BESIDE_MM) & self._inner)

    @cached_property
    def quiet(self) -> Tensor:
        """Mask ``grid.shape`` of what of :attr:`empty` is about the bodies."""
        away = ndimage.distance_transform_edt(self._rest > 0.5, sampling=self.grid.spacing)
        return self.empty & torch.from_numpy(away <= _ABOUT_MM)

    @property
    def _constant(self) -> list[Floats]:
        """Share of every voxel of what has one value."""
        return list(self.volume_fractions.values())

    @cached_property
    def _inner(self) -> NDArray[np.bool_]:
        """All but the rim of the inset."""
        width = math.ceil(_INSET_RIM_MM / self.grid.spacing[0])
        inner = np.zeros(self.grid.shape, bool)
        inner[(slice(width, -width),) * 3] = True
        return inner

    @cached_property
    def shells(self) -> tuple[Tensor, ...]:
        """Masks ``grid.shape`` about the bodies, the signal none of them if there are others,
        from near to far."""
        signal = self.volume_fractions["signal"]
        others = np.sum(list(self.volume_fractions.values()), axis=0) - self._rest - signal > 0.5
        bodies = others if others.any() else signal > 0.5
        away = ndimage.distance_transform_edt(~bodies, sampling=self.grid.spacing)
        ends = np.arange(BESIDE_MM, _ABOUT_MM + BESIDE_MM, _SHELL_MM)
        return tuple(
            torch.from_numpy((away > end) & (away <= end + _SHELL_MM) & self._inner) for end in ends
        )

    @cached_property
    def rim(self) -> Tensor:
        """Mask ``grid.shape`` of the largest tissue's pure voxels beside bodies, where
        sharpening undershoots."""
        pure = self.volume_fractions[self._largest] > 1.0 - 1e-6
        return torch.from_numpy(pure & (_depth(pure, self.grid.spacing) <= _RIM_MM))

    @cached_property
    def flat(self) -> dict[str, Tensor]:
        """Tissue → indices (of the flat volume) of voxels away from its edges and the rim of the
        inset."""
        found = {}
        for tissue, share in self.volume_fractions.items():
            deep = _depth(share > 1.0 - 1e-6, self.grid.spacing) > _FLAT_MM
            at = np.flatnonzero(deep & self._inner)
            if len(at) >= _FLAT_VOXELS:
                found[tissue] = torch.from_numpy(at[:: -(-len(at) // _KEPT_VOXELS)])
        return found

    @cached_property
    def middle_mm(self) -> tuple[float, float, float]:
        """``(z, y, x)`` of the signal's centre of mass."""
        at = ndimage.center_of_mass(self.volume_fractions["signal"])
        z, y, x = (
            float(np.interp(p, np.arange(len(a)), a))
            for p, a in zip(at, self.grid.axes, strict=True)
        )
        return z, y, x


class SomeViews:
    """So many views of a noise-free scan as values and limits need.

    Args:
        scan: within a detector window.
    """

    def __init__(self, scan: Scan) -> None:
        g, w = scan.geometry, scan.window
        assert w is not None
        self.views = list(range(0, g.views, max(1, g.views // _VIEWS)))
        self.geometry = g.select(self.views)
        self.window = DetectorWindow(w.first_column[self.views], w.columns, w.first_row, w.rows)
        self.weight = 1.0 / line_integral_variance(scan, NOISE_FREE_EXPOSURE_S)[self.views]
        self.lines = scan.line_integrals()[self.views]
        self.scale, self.share = scan.linearisation.mu_ref / 1000.0, g.views / len(self.views)

    def path_lengths(self, task: Task, groups: list[list[str]]) -> list[Tensor]:
        """Of groups of the scene's bodies, mm."""
        maps = tissue_path_lengths(
            task.scene,
            groups,
            self.geometry,
            self.window,
            sub_rays=_SUB_RAYS,
            focal_spot=task.scanner.source.focal_spot,
        )
        return list(maps)

    def information(self, maps: list[Tensor]) -> Floats:
        """Of all views on the values of tissues with these path lengths, HU⁻², at 1 s."""
        return information_matrix(maps, self.weight, scale=self.scale) * self.share

    def values(self, maps: list[Tensor], information: Floats) -> Floats:
        """Least squares for the values of tissues with these path lengths and their information,
        HU."""
        right = (
            self.scale * self.share * np.array([_inner(m, self.weight * self.lines) for m in maps])
        )
        return np.asarray(np.linalg.solve(information, right) - 1000.0)


def exposures_of(value: object) -> tuple[float, ...]:
    """Exposures in s, each once.

    Raises:
        TypeError, ValueError: no numbers, none, out of range, one that is given twice.
    """
    found = tuple(numbers("exposures_s", value, positive=True, high=_LONGEST_S, unit="s"))
    twice = next((e for k, e in enumerate(found) if e in found[:k]), None)
    if twice is not None:
        raise ValueError(f"exposures_s has {twice:g} s twice: leave one out")
    return found


def contrast_bound(information: Floats) -> float:
    """Smallest SD of an unbiased estimate of the second tissue's value less the first one's, HU."""
    first, second = np.eye(len(information))[:2]
    return math.sqrt(cramer_rao_bound(information, second - first).item())


def _plain(value: object) -> object:
    """What a value is made of, without what it has kept of its own computations."""
    if isinstance(value, np.ndarray | Tensor):
        array = np.ascontiguousarray(value)
        return str(array.dtype), array.shape, hashlib.sha256(array.tobytes()).hexdigest()
    if is_dataclass(value) and not isinstance(value, type):
        return type(value).__name__, [
            (f.name, _plain(getattr(value, f.name))) for f in fields(value)
        ]
    if isinstance(value, Scene):
        return [_plain(b) for b in value.bodies], [_plain(m) for m in value.motion]
    if isinstance(value, Mapping):
        return [(str(k), _plain(v)) for k, v in value.items()]
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return repr(value)


def _inner(a: Tensor, b: Tensor) -> float:
    return float((a * b).sum((-1, -2), dtype=torch.float64).sum())


def _mean(mask: ArrayLike) -> Tensor:
    weights = torch.from_numpy(np.asarray(mask, dtype=np.float64))
    return weights / weights.sum()


def _depth(mask: Bools, step: Sequence[float]) -> Floats:
    """Distance in mm to where the mask ends."""
    return np.asarray(ndimage.distance_transform_edt(np.pad(mask, 1, mode="edge"), sampling=step))[
        1:-1, 1:-1, 1:-1
    ]


def _nearest(mask: Bools, point: Sequence[float | np.integer], count: int) -> NDArray[np.bool_]:
    """The ``count`` voxels of a mask that are nearest to a point (in voxels)."""
    at = np.argwhere(mask)
    order = np.square(at - np.asarray(point)).sum(1).argsort(kind="stable")[:count]
    out = np.zeros(mask.shape, bool)
    out[tuple(at[order].T)] = True
    return out


def _beyond(scan: Scan, grid: VolumeGrid) -> list[str]:
    """What of a scan lies beyond its inset (:mod:`recon.least_squares.beyond_grid`)."""
    if scan.counts.ndim != 3 or scan.electronic_noise:  # the iterative methods take no such scan
        return []
    seen = footprint(scan.geometry, grid, margin=1)
    return beyond_grid(scan, grid, seen, scan.exterior_line_integrals())
