"""What a scan needs to be simulated faithfully, decided by measuring on a few of its own views.

Every effect of the finite beam and of the spectrum can be switched off; a scene that does not need it should not pay
for it. :func:`make_plan` computes a sparse sample of the scan with everything on and densely sampled, then without
each effect in turn, and keeps the effects whose omission would cost more than the stated tolerance.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from torchpcct.acquisition.transmission import SUB_RAY_COUNTS, Beam, BodySet, expected_readings, sub_rays
from torchpcct.detector_window import DetectorWindow, shadow
from torchpcct.geometry import ConeBeam, VolumeGrid

if TYPE_CHECKING:
    from torchpcct.scanner import Scanner
    from torchpcct.scene import Scene

__all__ = ["Effect", "Plan", "make_plan"]

_PROBE_VIEWS, _PROBE_ROWS = 6, 3
# Sub-rays of the runs that weigh the effects, and of the one that a smaller number of sub-rays must reproduce.
_EFFECT_SUB_RAYS, _TARGET_SUB_RAYS = 32, 256
# Rms error of the line integrals by the finite number of sub-rays, relative to the inset's highest one.
_PEAK_ERROR = 1e-3

_LEFT_OUT = (
    ("scatter", "no scatter model: an anti-scatter grid and correction are assumed, as in the paper"),
    ("pile-up, charge sharing", "behind the body the count rate is far below the detector's limit"),
    (
        "focal spot intensity, heel effect",
        "the focal spot is a uniform rectangle, the spectrum the same over the field",
    ),
    ("afterglow, readout cross-talk", "counting silicon has no afterglow; tungsten foils part the columns"),
)


@dataclass(frozen=True)
class Effect:
    """One physical effect: whether it is modelled, and what leaving it out would cost."""

    name: str
    modelled: bool
    cost_hu: float | None
    note: str = ""


@dataclass(frozen=True)
class Plan:
    """What :func:`torchpcct.acquire` will compute.

    Attributes:
        effects: every effect with its cost in HU (rms over the shadow of the inset, per its mean chord).
        points: ``(sub-rays, 5)`` beam samples of :func:`torchpcct.acquisition.transmission.sub_rays`.
        active: the readings that see the varying bodies; None: no view differs from another.
        kept: the readings that the scan will hold; None: the whole detector.
        sampling_error: rms error of a line integral by the finite number of sub-rays, relative to the inset's peak.
        readings, seconds, bytes: size, estimated time and memory.
        tolerance_hu: the tolerance that decided.
    """

    effects: tuple[Effect, ...]
    points: Any
    active: DetectorWindow | None
    kept: DetectorWindow | None
    sampling_error: float
    readings: int
    seconds: float
    bytes: int
    tolerance_hu: float

    def table(self) -> str:
        """The plan as text, one line per effect."""
        lines = [f"Plan (tolerance {self.tolerance_hu:g} HU)"]
        for e in self.effects:
            cost = "  not estimated" if e.cost_hu is None else f"{e.cost_hu:9.2f} HU if omitted"
            lines.append(f"  {'modelled ' if e.modelled else 'left out '} {e.name:<34} {cost:<22} {e.note}".rstrip())
        lines.append(
            f"  {len(self.points)} sub-rays a reading, rms sampling error {self.sampling_error:.1e} of the peak; "
            f"{self.readings / 1e6:.2f} M readings, about {self.seconds:.0f} s, {self.bytes / 2**30:.2f} GiB"
        )
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """JSON values of the plan."""
        return {
            "tolerance_hu": self.tolerance_hu,
            "effects": [vars(e) for e in self.effects],
            "sub_rays": len(self.points),
            "sampling_error_of_peak": self.sampling_error,
            "readings": self.readings,
            "estimated_seconds": round(self.seconds, 2),
            "estimated_bytes": self.bytes,
        }


def _hu_cost(difference: Any, mask: Any, chord: Any, mu_water: float) -> float:
    """Error of the line integrals as a CT number: rms over the shadow, spread over the bodies' mean chord."""
    if not mask.any():
        return 0.0
    rms = math.sqrt(float(np.mean(difference[mask] ** 2)))
    return 1000.0 * rms / (mu_water * max(float(chord[mask].mean()), 1e-6))


def active_window(geometry: ConeBeam, low: Any, high: Any) -> DetectorWindow:
    """Window of the readings that see the box ``low … high`` (x, y, z) mm; the whole detector if it is too large."""
    whole = DetectorWindow(np.zeros(geometry.views, np.int64), geometry.columns, 0, geometry.rows)
    extent = np.maximum(high - low, 1e-3)[::-1]
    box = VolumeGrid((1, 1, 1), tuple(extent), tuple(((low + high) / 2)[::-1]))
    try:
        # Four columns more for the beam's width: a focal spot and a cell are wider than a ray.
        return shadow(geometry, box, margin=4)
    except ValueError:
        return whole


class Probe:
    """A sparse sample of the scan: a few views and rows, all columns that see the varying bodies."""

    def __init__(self, scene: Scene, scanner: Scanner, build: Any, low: Any, high: Any, view_step: float) -> None:
        g = scanner.geometry
        views = np.unique(np.linspace(0, g.views - 1, min(_PROBE_VIEWS, g.views)).astype(int))
        self.geometry = g.select(views)
        self.window = active_window(self.geometry, low, high)
        keep = min(_PROBE_ROWS, self.window.rows)
        first = self.window.first_row + (self.window.rows - keep) // 2
        self.window = DetectorWindow(self.window.first_column, self.window.columns, first, keep)
        self.scanner, self.build, self.view_step = scanner, build, view_step
        self.seconds_per_reading_ray = 0.0

    def run(
        self, active: Sequence[bool], count: int, *, empty: bool = False, mono: bool = False, still: bool = False
    ) -> Any:
        """Line integrals of the probe, ``(views, rows, columns)``."""
        energies, spectra = self.scanner.weights()
        spectra = spectra.sum(0, keepdims=True)
        if mono:
            mean = np.einsum("bce,e->bc", spectra, energies) / spectra.sum(-1)
            energies = np.array([float(mean.mean())])
            spectra = spectra.sum(-1, keepdims=True)
        bodies: BodySet = self.build(energies, self.geometry, empty=empty, still=still)
        start = time.perf_counter()
        readings = expected_readings(
            self.geometry,
            self.window,
            bodies,
            Beam(spectra, self.scanner.row_factor, self.scanner.source.focal_spot, sub_rays(count, active)),
            np.full(self.geometry.views, self.view_step),
        ).numpy()
        self.seconds = time.perf_counter() - start
        air = np.einsum("bce,r->rc", spectra, self.scanner.row_factor)
        w = self.window
        air = air[w.first_row : w.first_row + w.rows][:, w.column_indices].transpose(1, 0, 2)
        return np.log(air) - np.log(readings[0])


def make_plan(
    scene: Scene,
    scanner: Scanner,
    build: Any,
    box: tuple[Any, Any],
    kept: DetectorWindow | None,
    view_step: float,
    tolerance_hu: float,
    sub_ray_count: int | None = None,
    moving: bool = False,
    invariant: bool = False,
) -> Plan:
    """Decide what to model for ``scene``; see :class:`Plan`. Called by :func:`torchpcct.acquire`.

    Args:
        build: ``build(energies, geometry, empty=, still=) -> BodySet`` of the scene.
        box: corners (x, y, z) mm of the bodies that differ between views.
        kept: the readings that the scan will hold.
        view_step: angle in rad during which one view is read.
        sub_ray_count: force a number of sub-rays instead of choosing it.
        moving, invariant: whether bodies move; whether no view differs from another.
    """
    probe = Probe(scene, scanner, build, *box, view_step)
    probe.run((True,) * 5, 16)  # compile, so that the time measured below is run time
    everything = (True,) * 5
    reference = probe.run(everything, _EFFECT_SUB_RAYS)
    per_ray = probe.seconds / (reference.size * _EFFECT_SUB_RAYS)
    background = probe.run(everything, 16, empty=True)
    inset = reference - background
    peak = float(np.abs(inset).max())
    mask = np.abs(inset) > 1e-3 * peak
    mu_water = scanner.water_linearisation().mu_ref
    # The rms error is spread over half the diagonal of the bodies' box: a chord typical of the inset.
    span = float(np.linalg.norm((box[1] - box[0])[:2])) / 2
    chord = np.full(reference.shape, max(span, 1.0))

    effects = []
    active = list(everything)
    for axes, name, note in (
        ((0, 1), "focal spot", "mm: " + " × ".join(f"{s:g}" for s in scanner.source.focal_spot)),
        ((2, 3), "cell aperture", "averaged over the cell"),
        ((4,), "gantry turn during a view", f"{math.degrees(view_step):.3f}°"),
    ):
        without = tuple(i not in axes for i in range(5))
        cost = _hu_cost(probe.run(without, _EFFECT_SUB_RAYS) - reference, mask, chord, mu_water)
        on = cost > tolerance_hu
        effects.append(Effect(name, on, cost, note))
        for axis in axes:
            active[axis] = on
    if moving:
        cost = _hu_cost(probe.run(everything, _EFFECT_SUB_RAYS, still=True) - reference, mask, chord, mu_water)
        effects.append(Effect("motion", True, cost, "exact in every view"))
    else:
        effects.append(Effect("motion", False, 0.0, "nothing moves"))
    mono = probe.run(everything, _EFFECT_SUB_RAYS, mono=True) - probe.run(everything, 16, empty=True, mono=True)
    scale = float((inset * mono).sum() / max(float((mono * mono).sum()), 1e-300))
    cost = _hu_cost(inset - scale * mono, mask, chord, mu_water)
    effects.insert(0, Effect("polychromatic spectrum", True, cost, "after the best single scale factor"))
    effects += [Effect(name, False, None, note) for name, note in _LEFT_OUT]

    # Full-sampled reference with only the chosen effects: what the number of sub-rays must reproduce.
    chosen = tuple(active)
    target = probe.run(chosen, _TARGET_SUB_RAYS)
    count, error = 1, 0.0
    for candidate in SUB_RAY_COUNTS if sub_ray_count is None else (sub_ray_count,):
        count = candidate
        difference = probe.run(chosen, count) - target
        error = math.sqrt(float(np.mean(difference**2))) / max(peak, 1e-300)
        if error <= _PEAK_ERROR:
            break
    g = scanner.geometry
    window = None if invariant else active_window(g, *box)
    busy = g.rows * g.columns if window is None else window.views * window.rows * window.columns
    held = math.prod(g.shape) if kept is None else kept.views * kept.rows * kept.columns
    return Plan(
        effects=tuple(effects),
        points=sub_rays(count, chosen),
        active=window,
        kept=kept,
        sampling_error=error,
        readings=held,
        seconds=busy * len(sub_rays(count, chosen)) * per_ray + held * 8e-9,
        bytes=held * 4 * 2 + busy * 8,
        tolerance_hu=tolerance_hu,
    )
