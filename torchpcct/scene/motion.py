"""Motion of a part of the scene: a body and everything inside it, displaced rigidly in the axial
plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchpcct.validate import number

__all__ = ["SinusoidalMotion"]


@dataclass(frozen=True)
class SinusoidalMotion:
    """A rigid in-plane sinusoid, ``amplitude * sin(2 π f t + phase)``: the simplest model of a
    beating heart's vessel.

    With the defaults and a rotation of 0.35 s that starts at t = 0 the displacement covers ``[0,
    amplitude]``.

    Args:
        body: name of the body that moves; the bodies inside it move with it.
        amplitude: largest displacement in mm (≥ 0).
        rate_bpm: beats per minute (> 0); 60 is one period a second.
        phase: phase at t = 0 in rad.
        direction: direction of the displacement in the axial plane, in rad from +x towards +y.

    Raises:
        ValueError, TypeError: a value out of range or of the wrong kind; the message names it.
    """

    body: str
    amplitude: float
    rate_bpm: float = 60.0
    phase: float = 0.0
    direction: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.body, str):
            raise TypeError(
                f"body must be the name of a body, got {self.body!r} ({type(self.body).__name__})"
            )
        # A negative amplitude is another direction: turn that by π instead.
        object.__setattr__(
            self, "amplitude", number("amplitude", self.amplitude, low=0.0, unit="mm")
        )
        for name in ("rate_bpm", "phase", "direction"):
            object.__setattr__(
                self, name, number(name, getattr(self, name), positive=name == "rate_bpm")
            )

    @property
    def _unit(self) -> NDArray[np.float64]:
        return np.array([math.cos(self.direction), math.sin(self.direction), 0.0])

    def displacement(self, times: ArrayLike) -> NDArray[np.float64]:
        """Displacement at the ``times`` ``(...)`` in s: ``(..., 3)`` float64, x, y, z in mm."""
        t = np.asarray(times, dtype=np.float64)
        wave = np.sin(2.0 * math.pi * self.rate_bpm / 60.0 * t + self.phase)
        return self.amplitude * wave[..., None] * self._unit

    def extremes(self) -> NDArray[np.float64]:
        """Both ends of the displacement, ``(2, 3)`` mm."""
        return np.stack([-self.amplitude * self._unit, self.amplitude * self._unit])

    def scaled(self, fraction: ArrayLike) -> SinusoidalMotion:
        """The same motion with another amplitude, such as the residual motion after gating.

        Args:
            fraction: the amplitude is multiplied by this number.

        Raises:
            ValueError, TypeError: a fraction that is not a finite number.
        """
        scaled = self.amplitude * number("fraction", fraction)
        return SinusoidalMotion(self.body, scaled, self.rate_bpm, self.phase, self.direction)
