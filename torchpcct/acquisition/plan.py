"""What a scan needs to be simulated faithfully, decided by measuring on a few of its own views.

Every effect of the finite beam and of the spectrum can be switched off; a scene that does not need
it should not pay for it. :func:`make_plan` computes a sparse sample of the scan with everything on
and densely sampled, then without each effect in turn, and keeps the effects whose omission would
cost more than the stated tolerance. What the detector makes of the readings is its own choice (dead
time, charge sharing): the plan says so.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from torchpcct.acquisition.bodies import Bodies
from torchpcct.acquisition.spectra import Nodes, energy_nodes, signal_spectra
from torchpcct.acquisition.transmission import SUB_RAY_COUNTS, Beam, expected_readings, sub_rays
from torchpcct.detector_window import NOISE_MARGIN_COLUMNS, DetectorWindow, footprint
from torchpcct.geometry import ConeBeam, VolumeGrid
from torchpcct.scanner.scanner import Scanner
from torchpcct.validate import number

if TYPE_CHECKING:
    from torchpcct.typing import Floats


__all__ = ["Plan", "make_plan"]

_PROBE_VIEWS = 6
"""Views of the scans that a plan is made by."""
_PROBE_ROWS = 3
"""Their rows, those in the middle of what is read."""
_EFFECT_SUB_RAYS = 32
"""Sub-rays of the runs that weigh the effects."""
_TARGET_SUB_RAYS = 256
"""Sub-rays of the run that a smaller number of them must reproduce."""
_PEAK_ERROR = 1e-3
"""Rms error of the line integrals by the finite number of sub-rays, relative to the inset's highest
one."""

_LEFT_OUT = (
    (
        "scatter",
        "no scatter model: an anti-scatter grid and correction are assumed, as in the paper",
    ),
    (
        "focal spot intensity, heel effect",
        "the focal spot is a uniform rectangle, the spectrum the same over the field",
    ),
)
"""Effects that no scan has, and why."""


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
        effects: every effect with its cost in HU (rms over the footprint of the inset, per its mean
            chord).
        nodes: energies that stand for the spectrum.
        points: ``(sub-rays, 5)`` beam samples of
            :func:`torchpcct.acquisition.transmission.sub_rays`.
        active: the readings that see the varying bodies; None: no view differs from another.
        kept: the readings that the scan will hold; None: the whole detector.
        sampling_error: rms error of a line integral by the finite number of sub-rays, relative to
            the inset's peak.
        readings, seconds, bytes: size, estimated time and memory.
        tolerance_hu: the tolerance that decided.
    """

    effects: tuple[Effect, ...]
    nodes: Nodes
    points: Floats
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
            lines.append(
                (
                    f"  {'modelled ' if e.modelled else 'left out '} {e.name:<34} {cost:<22} "
                    f"{e.note}"
                ).rstrip()
            )
        lines.append(
            f"  {len(self.points)} sub-rays a reading, rms sampling error "
            f"{self.sampling_error:.1e} of the peak; {self.readings / 1e6:.2f} M readings, about "
            f"{self.seconds:.0f} s, {self.bytes / 2**30:.2f} GiB"
        )
        return "\n".join(lines)

    def as_dict(self) -> dict[str, object]:
        """JSON values of the plan."""
        return {
            "tolerance_hu": self.tolerance_hu,
            "effects": [vars(e) for e in self.effects],
            "energies": len(self.nodes.indices),
            "sub_rays": len(self.points),
            "sampling_error_of_peak": self.sampling_error,
            "readings": self.readings,
            "estimated_seconds": round(self.seconds, 2),
            "estimated_bytes": self.bytes,
        }


def active_window(geometry: ConeBeam, bodies: Bodies) -> DetectorWindow:
    """The readings that see the bodies that vary; the whole detector if they are too large."""
    extent = np.maximum(bodies.high - bodies.low, 1e-3)[::-1]
    box = VolumeGrid((1, 1, 1), tuple(extent), tuple(((bodies.low + bodies.high) / 2)[::-1]))
    try:
        # Four columns more for the beam's width: a focal spot and a cell are wider than a ray.
        return footprint(geometry, box, margin=4)
    except ValueError:
        return DetectorWindow.full(geometry)


def _kept_window(geometry: ConeBeam, region: VolumeGrid, bodies: Bodies) -> DetectorWindow:
    """The readings around the footprint of ``region``, every row; it must hold all bodies that
    vary."""
    if region.ndim != 3:
        raise ValueError(
            f"region must be a (z, y, x) grid of three numbers each, got the shape {region.shape}"
        )
    kept = footprint(geometry, region, margin=NOISE_MARGIN_COLUMNS).with_rows(0, geometry.rows)
    if bodies.varying:
        # Without the four columns for the beam's width.
        seen = active_window(geometry, bodies)
        inside = (seen.first_column + 4 >= kept.first_column) & (
            seen.first_column + seen.columns - 4 <= kept.first_column + kept.columns
        )
        if not inside.all():
            raise ValueError(
                "region does not hold all bodies that differ between views (box "
                f"{np.round(bodies.low, 1)} … {np.round(bodies.high, 1)} mm): enlarge it, or "
                "acquire without region"
            )
    return kept


class _Probe:
    """A sparse sample of the scan: a few views and rows, all columns that see the varying
    bodies."""

    def __init__(self, bodies: Bodies, scanner: Scanner) -> None:
        g = scanner.geometry
        views = np.unique(np.linspace(0, g.views - 1, min(_PROBE_VIEWS, g.views)).astype(int))
        self.geometry = g.select(views)
        seen = active_window(self.geometry, bodies)
        rows = min(_PROBE_ROWS, seen.rows)
        self.window = seen.with_rows(seen.first_row + (seen.rows - rows) // 2, rows)
        self.bodies, self.scanner = bodies, scanner
        self.energies, self.spectra, _ = signal_spectra(scanner)
        self.seconds = 0.0

    def run(
        self,
        active: Sequence[bool],
        count: int,
        *,
        background: bool = False,
        mono: bool = False,
        still: bool = False,
        nodes: Nodes | None = None,
    ) -> Floats:
        """Line integrals of the probe, ``(views, rows, columns)``.

        Args:
            active, count: of :func:`~torchpcct.acquisition.transmission.sub_rays`.
            background: without the bodies that vary. mono: at the mean energy. still: as if nothing
                moved.
            nodes: energies that stand for the spectrum; None: all of them.
        """
        energies, bins = self.energies, self.scanner.detector.bins
        spectra = self.spectra[:bins].sum(0, keepdims=True)
        air = np.einsum("bce,r->rc", spectra, self.scanner.row_factor)
        if nodes is not None:
            energies = energies[nodes.indices]
            spectra = nodes.spectra[:bins].sum(0, keepdims=True)
        if mono:
            mean = np.einsum("bce,e->bc", spectra, energies) / spectra.sum(-1)
            energies = np.array([float(mean.mean())])
            spectra = spectra.sum(-1, keepdims=True)
        g, w = self.geometry, self.window
        bodies = (
            self.bodies.symmetric(energies, g)
            if background
            else self.bodies.at(energies, g, still=still)
        )
        beam = Beam(
            spectra,
            self.scanner.row_factor,
            self.scanner.source.focal_spot,
            sub_rays(count, active),
        )
        start = time.perf_counter()
        readings = expected_readings(
            g, w, bodies, beam, np.full(g.views, self.bodies.view_step)
        ).numpy()
        self.seconds = time.perf_counter() - start
        air = air[w.first_row : w.first_row + w.rows][:, w.column_indices].transpose(1, 0, 2)
        return np.log(air) - np.log(readings[0])


def _afterglow(scanner: Scanner) -> Effect:
    reason = (
        "every signal is read in its own view and cell"
        if scanner.detector.energy_integrating
        else "counting silicon has no afterglow; tungsten foils part the columns"
    )
    return Effect("afterglow, readout cross-talk", False, None, reason)


def _pulse_effects(scanner: Scanner) -> list[Effect]:
    """Pile-up and charge sharing, as the scanner's detector has them."""
    if scanner.detector.energy_integrating:
        return [Effect("pile-up, charge sharing", False, None, "the detector counts no pulses")]
    dead_ns, merge_ns, shared = (
        float(getattr(scanner.detector, name, 0.0))
        for name in ("dead_time_ns", "merge_ns", "charge_sharing")
    )
    far = "behind the body the count rate is far below the detector's limit"
    if not (dead_ns or shared):
        return [Effect("pile-up, charge sharing", False, None, far)]
    lost = (
        f"dead time {dead_ns:g} ns, merging time {merge_ns:g} ns at "
        f"{scanner.source.current_ma:g} mA"
    )
    split = f"{100 * shared:g} % of the interactions" if shared else "switched off"
    return [
        Effect("pile-up", dead_ns > 0, None, lost if dead_ns else far),
        Effect("charge sharing", shared > 0, None, split),
    ]


def make_plan(
    bodies: Bodies,
    scanner: Scanner,
    region: VolumeGrid | None,
    tolerance_hu: float,
    sub_ray_count: int | None = None,
) -> Plan:
    """Decide what to model; see :class:`Plan`. Called by :func:`torchpcct.acquire`.

    Args:
        bodies: the scene, prepared for the scanner's geometry.
        scanner: what scans it.
        region: grid around whose footprint readings are kept; None: the whole detector.
        tolerance_hu: effects of the beam that would change less are left out.
        sub_ray_count: force a number of sub-rays instead of choosing it.

    Raises:
        ValueError: bodies that vary outside ``region``, a region outside the field of view or of
            two dimensions; a tolerance below 0 or NaN.
        TypeError: a tolerance that is no number.
    """
    number("tolerance_hu", tolerance_hu, low=0.0, unit="HU")
    g = scanner.geometry
    kept = None if region is None else _kept_window(g, region, bodies)
    probe = _Probe(bodies, scanner)
    everything = (True,) * 5
    probe.run(everything, 16)  # compile, so that the time measured below is run time
    reference = probe.run(everything, _EFFECT_SUB_RAYS)
    inset = reference - probe.run(everything, 16, background=True)
    peak = float(np.abs(inset).max())
    mask = np.abs(inset) > 1e-3 * peak
    mu_water = scanner.water_linearisation().mu_ref
    # The rms error is spread over half the diagonal of the bodies' box: a chord typical of the
    # inset.
    chord = max(float(np.linalg.norm((bodies.high - bodies.low)[:2])) / 2, 1.0)

    def cost(difference: Floats) -> float:
        """Error of the line integrals as a CT number: rms over the footprint, spread over the
        bodies' chord."""
        if not mask.any():
            return 0.0
        rms = math.sqrt(float(np.mean(difference[mask] ** 2)))
        return 1000.0 * rms / (mu_water * chord)

    mono = probe.run(everything, _EFFECT_SUB_RAYS, mono=True) - probe.run(
        everything, 16, background=True, mono=True
    )
    scale = float((inset * mono).sum() / max(float((mono * mono).sum()), 1e-300))
    hardening = "after the best single scale factor"
    effects = [Effect("polychromatic spectrum", True, cost(inset - scale * mono), hardening)]
    active = list(everything)
    for axes, name, note in (
        ((0, 1), "focal spot", "mm: " + " × ".join(f"{s:g}" for s in scanner.source.focal_spot)),
        ((2, 3), "cell aperture", "averaged over the cell"),
        ((4,), "gantry turn during a view", f"{math.degrees(bodies.view_step):.3f}°"),
    ):
        without = tuple(i not in axes for i in range(5))
        omitted = cost(probe.run(without, _EFFECT_SUB_RAYS) - reference)
        effects.append(Effect(name, omitted > tolerance_hu, omitted, note))
        for axis in axes:
            active[axis] = omitted > tolerance_hu
    if bodies.scene.is_static:
        effects.append(Effect("motion", False, 0.0, "nothing moves"))
    else:
        omitted = cost(probe.run(everything, _EFFECT_SUB_RAYS, still=True) - reference)
        effects.append(Effect("motion", True, omitted, "exact in every view"))
    scatter, *beam = (Effect(name, False, None, note) for name, note in _LEFT_OUT)
    effects += [scatter, *_pulse_effects(scanner), *beam, _afterglow(scanner)]

    # Full-sampled reference with only the chosen effects: what the number of sub-rays must
    # reproduce.
    chosen = tuple(active)
    target = probe.run(chosen, _TARGET_SUB_RAYS)
    count, error = 1, 0.0
    for count in SUB_RAY_COUNTS if sub_ray_count is None else (sub_ray_count,):
        error = math.sqrt(float(np.mean((probe.run(chosen, count) - target) ** 2))) / max(
            peak, 1e-300
        )
        if error <= _PEAK_ERROR:
            break
    points = sub_rays(count, chosen)
    nodes = energy_nodes(*bodies.attenuation(probe.energies, g), probe.spectra)
    fewer = probe.run(chosen, count, nodes=nodes)
    per_reading = probe.seconds / fewer.size
    omitted = cost(fewer - probe.run(chosen, count))
    if omitted > tolerance_hu:
        nodes = Nodes.all_of(probe.spectra)
    number_of = f"{len(nodes.indices)} of {len(probe.energies)} energies"
    effects.insert(1, Effect("every energy", omitted > tolerance_hu, omitted, number_of))
    window = active_window(g, bodies) if bodies.varying else None
    busy = g.rows * g.columns if window is None else math.prod(window.shape)
    held = math.prod(g.shape if kept is None else kept.shape)
    return Plan(
        effects=tuple(effects),
        nodes=nodes,
        points=points,
        active=window,
        kept=kept,
        sampling_error=error,
        readings=held,
        seconds=busy * per_reading + held * 8e-9,
        bytes=held * 4 * 2 + busy * 8,
        tolerance_hu=tolerance_hu,
    )
