"""The skeleton of every study: its settings, its clock, and what it says to whoever waits.

A study is a folder of this package with four modules, listed in :mod:`recon.study.registry`, which runs it by its name:

* ``settings.py``: ``Settings(StudySettings)``, a frozen dataclass that validates itself;
* ``measure.py``: ``measure(settings, progress=silent, folder=None) -> Measured``, which simulates, reconstructs and
  measures. It prints nothing and writes nothing, but finished pieces into ``folder`` (:mod:`recon.evaluate.store`), so
  that an interrupted study goes on;
* ``report.py``: ``build_report(measured) -> Report``: JSON values, Markdown and the figures; it measures nothing;
* ``figures.py``: the pictures of the report.

``Measured`` is the study's own: a dataclass with ``settings``, ``seconds`` (of a :class:`Clock`) and what was found. So
data walks one way, settings → measure → report, and no module looks back.

Noise has one rule in all studies: realisation i draws with the seed ``settings.seed + i``, the same at every dose, in
every scene and for every method, so that their results can be paired.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar, Self

import numpy as np

import torchpcct
from torchpcct.validate import whole

__all__ = ["Clock", "Progress", "ProgressBars", "StudySettings", "environment", "silent", "time_line"]

Progress = Callable[[str, float], None]
"""Called with the name of a step (after a bar, ``|``, what changes in the meantime) and its finished fraction, 0…1."""


def silent(step: str, fraction: float) -> None:
    """The progress of whom nobody watches."""


class ProgressBars:
    """Progress on the terminal's error stream, a bar per step.

    Args:
        enabled: False: nothing is shown.
    """

    def __init__(self, enabled: bool) -> None:
        self.enabled = enabled
        self._step: str | None = None
        self._bar: Any = None

    def __call__(self, step: str, fraction: float) -> None:
        if not self.enabled:
            return
        step, _, more = step.partition("|")
        if step != self._step:
            from tqdm import tqdm

            self.close()
            self._step = step
            form = "{desc:<28} {bar:30} {percentage:3.0f}% {elapsed}<{remaining}{postfix}"
            self._bar = tqdm(total=100, desc=step, unit="%", leave=True, bar_format=form)
        if more:
            self._bar.set_postfix_str(more, refresh=False)
        self._bar.update(100 * fraction - self._bar.n)

    def of(self, step: str) -> Callable[[float], None]:
        """The progress of one step."""
        return lambda fraction: self(step, fraction)

    def close(self) -> None:
        """End the bar of the last step."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class StudySettings:
    """What the settings of all studies share; each derives a frozen dataclass from it.

    Attributes:
        QUICK: the values of a first look, by field; a comment beside says what is left out.
    """

    QUICK: ClassVar[Mapping[str, Any]] = {}

    @classmethod
    def quick(cls, **changes: Any) -> Self:
        """Settings of a first look in under a minute, with ``changes`` on top."""
        return cls(**{**cls.QUICK, **changes})

    def estimated_seconds(self) -> dict[str, float]:
        """Rough time of each part in s on two idle cores, nothing finished yet; empty: not known."""
        return {}

    def check_whole(self, **least: int) -> None:
        """Check fields that count something: field → the least value.

        Raises:
            TypeError: no whole number.
            ValueError: a value below the least.
        """
        for name, low in least.items():
            whole(name, getattr(self, name), low)


class Clock:
    """Seconds of every step, by the wall.

    Attributes:
        seconds: step → seconds, in the order in which the steps came first.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, step: str) -> None:
        """Count the time since the last lap (or the start) to ``step``."""
        now = time.perf_counter()
        self.seconds[step] = self.seconds.get(step, 0.0) + now - self._last
        self._last = now

    @contextmanager
    def step(self, step: str) -> Iterator[None]:
        """Count the time of a block, and only that, to ``step``."""
        self._last = time.perf_counter()
        yield
        self.lap(step)


def environment() -> dict[str, Any]:
    """Versions and machine that made a result."""
    import numba
    import scipy
    import torch

    return {
        "torchpcct": torchpcct.__version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "numba": numba.__version__,
        "machine": platform.machine(),
        "cores": os.cpu_count(),
    }


def time_line(seconds: Mapping[str, float], note: str = "") -> str:
    """The last line of a report: what took how long."""
    parts = ", ".join(f"{step} {value:.0f} s" for step, value in seconds.items())
    return f"Time: {parts}{'; ' if note else ''}{note}."
