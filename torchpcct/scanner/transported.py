"""A silicon detector whose response follows photons through all their interactions, as an option for scans.

:class:`~torchpcct.scanner.detector.SiliconDetector` lets a photon interact once. Here its expected counts get what
:func:`~torchpcct.scanner.silicon_transport.follow` finds beyond that: scattered photons that interact again and count a
second time, in lower bins, or add to the first pulse where they meet the same strip and depth segment.

The first interaction stays analytic; only the *difference* that further interactions make comes from followed photons,
each compared with its own first deposit. So the Monte Carlo error is that of a small correction.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from torchpcct.scanner.detector import SiliconDetector
from torchpcct.scanner.silicon_transport import Stack, follow
from torchpcct.validate import whole

__all__ = ["TransportedSilicon"]

Floats = NDArray[np.float64]

_NODES_KEV = np.arange(10.0, 151.0, 2.0)
"""Photon energies that are followed; the difference is smooth between them."""

_HEIGHT_KEV = 0.1
_HEIGHTS = np.arange(0.5 * _HEIGHT_KEV, _NODES_KEV[-1] + 1.0, _HEIGHT_KEV)


@dataclass(frozen=True)
class TransportedSilicon(SiliconDetector):
    """Edge-on silicon whose photons are followed through all interactions.

    What a photon leaves in other cells is counted as if in its own: right where neighbouring cells see the same
    intensity; the blur and the correlation between neighbours are not modelled. Counts stay Poisson here; the noise
    that counting a photon twice adds is in :func:`torchpcct.scanner.silicon_transport.efficiency`.

    Args:
        photons: number of photons followed, evenly over energies of 10…150 keV.
        transport_seed: of them.
        stack: sheets and foils; ``fill_factor`` must be the share of the pitch that the foils leave.

    Raises:
        ValueError: ``fill_factor`` that contradicts the foils; charge sharing or pile-up, which are not followed.
    """

    photons: int = 1_000_000
    transport_seed: int = 0
    stack: Stack = field(default_factory=Stack)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.stack, Stack):
            raise TypeError(f"stack must be a Stack, got {type(self.stack).__name__}")
        whole("photons", self.photons, 1000)
        whole("transport_seed", self.transport_seed, 0)
        share = 1.0 - self.stack.foil_mm / self.stack.sheet_pitch_mm
        if abs(share - self.fill_factor) > 1e-6:
            raise ValueError(f"fill_factor must be {share:g}, what the stack's foils leave, got {self.fill_factor:g}")
        if self.charge_sharing or self.dead_time_ns:
            raise ValueError("followed photons know neither charge sharing nor pile-up: leave both at 0")

    def above(self, energies_kev: ArrayLike, thresholds_kev: ArrayLike) -> Floats:
        """Expected counts above thresholds per incident photon, ``(thresholds, E)``, with all interactions."""
        thresholds = np.atleast_1d(np.asarray(thresholds_kev, dtype=np.float64))
        energies = np.atleast_1d(np.asarray(energies_kev, dtype=np.float64))
        # Bins, blur and mode do not change what is followed: they share the cache.
        more = _further(replace(self, mode="counting", thresholds_kev=(5.0,), sigma_kev=1.0))
        counted = more @ ndtr((_HEIGHTS[:, None] - thresholds) / self.sigma_kev)
        return super().above(energies, thresholds) + np.stack([np.interp(energies, _NODES_KEV, c) for c in counted.T])


@functools.lru_cache(maxsize=4)
def _further(detector: TransportedSilicon) -> Floats:
    """Pulses per photon of all interactions less those of the first alone, ``(nodes, heights)``."""
    rng = np.random.default_rng(detector.transport_seed)
    d = follow(detector, _NODES_KEV, np.ones(_NODES_KEV.size), detector.photons, rng, detector.stack)
    node = np.searchsorted(_NODES_KEV, d.incident_kev)
    keys = np.stack([d.photon, d.sheet, d.strip, d.segment], axis=1)
    pulses, index = np.unique(keys, axis=0, return_inverse=True)
    heights: Floats = np.bincount(index.reshape(-1), d.energy_kev).astype(np.float64)
    first = d.order == 0
    shape = (_NODES_KEV.size, _HEIGHTS.size)

    def histogram(photon: NDArray[Any], height: NDArray[Any]) -> Floats:
        place = np.minimum((height / _HEIGHT_KEV).astype(np.int64), _HEIGHTS.size - 1)
        flat = np.bincount(node[photon] * _HEIGHTS.size + place, minlength=shape[0] * shape[1])
        return flat.reshape(shape).astype(np.float64)

    difference = histogram(pulses[:, 0], heights) - histogram(d.photon[first], d.energy_kev[first])
    return np.asarray(difference / np.bincount(node, minlength=shape[0])[:, None])
