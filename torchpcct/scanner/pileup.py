"""Pile-up in the depth segments of a photon-counting detector: lost counts, and pulses that merge.

Model, per depth segment (Taguchi and Iwanczyk, Med. Phys. 40, 100901, 2013, with rectangular
pulses): a pulse above the lowest threshold triggers and blocks the segment for the dead time τ
(non-paralysable), so that a true trigger rate a is recorded as a / (1 + a τ). Pulses that follow
within the merging time add their charge to the triggering one: its recorded height is its own plus
that of a Poisson number (mean: interaction rate × merging time) of others. The count rate does not
depend on the exposure time, only on the tube current, so a scan's expected readings are mapped one
by one.

The variance of a dead-time-limited count is below its mean by 1 / (1 + a τ)² or so; scans draw
Poisson noise of the recorded mean, which overstates the noise of rays in air and is right within 2
a τ behind a body.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from torch import Tensor

from torchpcct.scanner.detector import SiliconDetector
from torchpcct.scene.materials import MATERIALS
from torchpcct.validate import checked

if TYPE_CHECKING:
    from torchpcct.typing import Ints


__all__ = ["PileUpMap", "pulse_heights", "recorded_rates"]

Floats = NDArray[np.float64]

_STEP_KEV = 1.0
"""Width of the bins of deposited energy, keV."""
_COLUMN_NODES = 64
"""Columns at which the map is computed; between them it is interpolated."""
_THICKNESS_MM = 600.0
"""Thickest water of the map, mm."""
_THICKNESS_NODES = 80
"""Thicknesses at which it is computed."""
_SAMPLES = 2048
"""Samples of the map along the line integral."""


@checked
def pulse_heights(detector: SiliconDetector, energies_kev: ArrayLike, size: int) -> Floats:
    """Pulses per incident photon by recorded height, ``(E, size)``.

    Charge sharing and energy resolution included; entry k holds the heights of k … k + 1 keV, the
    first one all below, the last one all above.
    """
    edges = np.concatenate([[-np.inf], _STEP_KEV * np.arange(1, size)])
    cumulative = detector.above(energies_kev, edges)
    return np.asarray(
        np.maximum(cumulative - np.append(cumulative[1:], 0 * cumulative[:1], axis=0), 0.0).T
    )


@checked
def recorded_rates(
    detector: SiliconDetector, energies_kev: ArrayLike, quanta_per_s: ArrayLike
) -> Floats:
    """Recorded counts per second and bin.

    Args:
        detector: with its ``dead_time_ns`` and ``merge_ns``.
        energies_kev: ``(E,)`` keV.
        quanta_per_s: ``(..., E)`` photons per second that reach the cell, by energy.

    Returns:
        ``(bins, ...)`` counts per second; without dead time quanta × response (to the step of 1 keV
        in height).
    """
    energies = np.atleast_1d(np.asarray(energies_kev, dtype=np.float64))
    quanta = np.asarray(quanta_per_s, dtype=np.float64)
    batch = quanta.shape[:-1]
    quanta = quanta.reshape(-1, energies.size)
    dead, merge = detector.dead_time_ns * 1e-9, detector.merge_ns * 1e-9
    response = detector.response(energies)
    total = detector.above(energies, detector.thresholds_kev[:1])[0]
    # Room for the sum of several pulses; heights beyond it fold into the open last bin.
    size = 4 * int(2 ** np.ceil(np.log2(energies[-1] / _STEP_KEV + 1)))
    heights = (
        pulse_heights(detector, energies, size) if merge > 0 and response.shape[0] > 1 else None
    )
    shares = detector.segment_shares(energies)
    out = np.zeros((response.shape[0], quanta.shape[0]))
    for share in shares:
        rates = quanta * share
        triggers = rates @ total
        live = 1.0 / (1.0 + dead * triggers)
        if heights is None:
            out += live * (rates @ response.T).T
        else:
            out += live * _merged(detector, rates @ heights, merge)
    return out.reshape(-1, *batch)


def _merged(detector: SiliconDetector, heights: Floats, merge_s: float) -> Floats:
    """Triggers per second by bin when later pulses add to the first, ``(bins, M)``; ``heights``
    ``(M, size)`` per s."""
    size = heights.shape[1]
    all_rates = heights.sum(1, keepdims=True)
    # (bins, size): share of each height step above a threshold
    above = _share_above(detector.thresholds_kev, size)
    triggering = heights * above[0]
    # A height of entry k lies anywhere in its step: an added pulse shifts by k or k + 1.
    spectrum = np.fft.rfft((heights + np.roll(heights, 1, axis=1)) / 2, axis=1)
    merged = np.fft.irfft(
        np.fft.rfft(triggering, axis=1) * np.exp(merge_s * (spectrum - all_rates)), n=size, axis=1
    )
    # What wraps around at the far end is far above all thresholds: put the lost norm there.
    merged = np.maximum(merged, 0.0)
    cumulative = np.concatenate([merged @ above[1:].T, np.zeros((len(merged), 1))], axis=1)
    top = np.concatenate([triggering.sum(1, keepdims=True), cumulative], axis=1)
    return np.maximum(top[:, :-1] - top[:, 1:], 0.0).T


def _share_above(thresholds: tuple[float, ...], size: int) -> Floats:
    lower = _STEP_KEV * np.arange(size)
    return np.clip((lower + _STEP_KEV - np.asarray(thresholds)[:, None]) / _STEP_KEV, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class PileUpMap:
    """What pile-up makes of the expected readings of a scanner.

    The spectrum behind an object is taken as that behind the water of equal attenuation: what the
    loss depends on is the rate. Rates are those of the central plane (the outer rows get 0.03 %
    less).

    Attributes:
        log_ratio: ``(bins + 1, nodes, samples)`` ln(recorded / true counts) at equidistant line
            integrals, for every bin and, last, for the sum of all bins.
        scale: line integral (of the sum of all bins) of the last sample.
        node: ``(columns,)`` position of every detector column among the nodes, between which the
            map is interpolated.
    """

    log_ratio: Floats
    scale: float
    node: Floats

    @classmethod
    def calibrate(
        cls, detector: SiliconDetector, energies_kev: Floats, quanta_per_s: Floats
    ) -> PileUpMap:
        """Fit behind water.

        Args:
            detector: with its dead time.
            energies_kev: ``(E,)`` keV.
            quanta_per_s: ``(columns, E)`` photons per second that reach the cells in air, by
                energy.
        """
        columns = quanta_per_s.shape[0]
        nodes = np.unique(np.linspace(0, columns - 1, _COLUMN_NODES).astype(int))
        # Dense where the rate is high.
        thickness = _THICKNESS_MM * np.linspace(0.0, 1.0, _THICKNESS_NODES) ** 1.5
        transmitted = np.exp(-np.outer(thickness, MATERIALS["water"].attenuation(energies_kev)))
        rates = quanta_per_s[nodes, None, :] * transmitted
        free = np.einsum("be,nte->bnt", detector.response(energies_kev), rates)
        recorded = recorded_rates(detector, energies_kev, rates)
        ratio = np.log(
            np.concatenate(
                [recorded / free, recorded.sum(0, keepdims=True) / free.sum(0, keepdims=True)]
            )
        )
        p = np.log(free.sum(0)[:, :1] / free.sum(0))  # (nodes, thickness)
        scale = float(p[:, -1].min())
        grid = np.linspace(0.0, scale, _SAMPLES)
        # Cubic: a piecewise linear map would put steps into the slope of the water correction.
        resampled = np.stack(
            [[CubicSpline(p[i], r[i])(grid) for i in range(nodes.size)] for r in ratio]
        )
        resampled.setflags(write=False)
        return cls(resampled, scale, np.interp(np.arange(columns), nodes, np.arange(nodes.size)))

    def at(self, line_integrals: ArrayLike, columns: Ints | slice) -> Floats:
        """ln(recorded / true) of every bin, ``(bins, ...)``, for true line integrals and
        detector columns."""
        return self._look_up(self.log_ratio[:-1], line_integrals, columns)

    def _look_up(self, table: Floats, line_integrals: ArrayLike, columns: Ints | slice) -> Floats:
        p, node = np.broadcast_arrays(
            np.asarray(line_integrals, dtype=np.float64), self.node[columns]
        )
        position = np.clip(p / self.scale, 0.0, 1.0) * (table.shape[-1] - 1)
        low = np.minimum(position.astype(np.int64), table.shape[-1] - 2)
        part = position - low
        left = np.minimum(node.astype(np.int64), max(table.shape[1] - 2, 0))
        right, share = np.minimum(left + 1, table.shape[1] - 1), node - left
        near = table[:, left, low] * (1 - part) + table[:, left, low + 1] * part
        far = table[:, right, low] * (1 - part) + table[:, right, low + 1] * part
        return np.asarray(near * (1 - share) + far * share)

    def apply(self, readings: Tensor, air: Tensor, columns: Ints | slice) -> Tensor:
        """Recorded for true expected readings.

        Args:
            readings: ``(bins, ..., columns)`` expected counts.
            air: of the same cells without the object, broadcastable to ``readings``.
            columns: ``(..., columns)`` detector column of each reading (broadcastable to one bin's
                readings).

        Returns:
            Tensor like ``readings``; cells that count nothing stay 0.
        """
        p = air.sum(0).double().log() - readings.sum(0).double().log()
        ratio = torch.from_numpy(self.at(torch.nan_to_num(p, posinf=self.scale).numpy(), columns))
        return readings * ratio.exp().to(readings.dtype)

    def shift(self, line_integrals: ArrayLike) -> Floats:
        """What pile-up adds to the line integrals of the summed counts in a calibration,
        ``(columns, samples)``."""
        columns, total = np.arange(self.node.size)[:, None], self.log_ratio[-1:]
        return np.asarray(
            self._look_up(total, 0.0, columns)[0] - self._look_up(total, line_integrals, columns)[0]
        )
