"""What every study is made of: its settings, what it measured, and what it tells whoever waits.

A study is a module (or a package that exports the same names) of :mod:`recon.study`, listed in
:mod:`recon.study.registry`, which runs it by its name. It has

* ``SomeNameSettings(StudySettings)`` of the module ``some_name``, a frozen dataclass that validates
  itself;
* ``measure(settings, progress=silent, folder=None) -> Measured``, which simulates, reconstructs and
  measures. It prints nothing and writes nothing, but the results of finished parts into the cache
  of ``folder`` (:mod:`recon.jobs.store`), so that an interrupted study goes on;
* ``plan(settings, folder)``, where parts of it are jobs
  (:meth:`recon.jobs.store.StudyCache.ahead`): lists those that are left, for a dry run, and
  computes nothing (:meth:`recon.jobs.store.StudyCache.plan`);
* ``figures(measured)``: file name → picture of the report;
* ``checks(data)``, where there is something to check: the report's figures beside the paper's;
* ``templates/NAME.md.j2``: the report's text, a template that :mod:`recon.study.report` fills in
  from the JSON values of the report and from nothing else. So the text of a committed report can be
  rendered again from its values.

Noise has one rule in all studies: realisation i draws with the seed ``settings.seed + i``, the same
at every dose, in every scene and for every method, so that their results can be paired.
"""

from __future__ import annotations

import os
import platform
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, ClassVar, Self, cast

import numpy as np

import torchpcct
from torchpcct.validate import whole

if TYPE_CHECKING:
    from torchpcct.typing import JsonObject

Progress = Callable[[str, float], None]
"""Called with the name of a step (after a bar, ``|``, what changes in the meantime) and its
finished fraction, 0…1."""


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

    Raises:
        TypeError, ValueError: a value of the wrong kind, or out of range.
    """

    QUICK: ClassVar[Mapping[str, object]] = {}

    @classmethod
    def of(cls, values: Mapping[str, object], quick: bool = False) -> Self:
        """Settings from the values of a report or a command, whose lists are tuples here; what is
        no field is left out.

        Args:
            values: by field.
            quick: those of a first look in under a minute where ``values`` has none.
        """
        given = {
            k: tuple(v) if isinstance(v, list) else v for k, v in values.items() if k in cls.names()
        }
        return cls(**{**(cls.QUICK if quick else {}), **given})

    @classmethod
    def names(cls) -> set[str]:
        """Of the fields."""
        return {f.name for f in fields(cast(Any, cls)) if f.init}

    def check_whole(self, **least: int) -> None:
        """Check fields that count something: field → the least value.

        Raises:
            TypeError: no whole number.
            ValueError: a value below the least.
        """
        for name, low in least.items():
            whole(name, getattr(self, name), low)


class Timed:
    """Progress that counts the seconds of every step, by the wall: each time until the next
    step is named.

    Attributes:
        seconds: step, up to a colon in its name, → seconds, in the order in which the steps came
            first.
    """

    def __init__(self, progress: Progress) -> None:
        self.seconds: dict[str, float] = {}
        self._progress, self._last = progress, time.perf_counter()

    def __call__(self, step: str, fraction: float) -> None:
        name, now = re.split("[:|]", step)[0], time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now
        self._progress(step, fraction)


@dataclass
class Measured:
    """What a study found.

    Attributes:
        settings: of the study.
        data: JSON values by part (NumPy arrays and scalars among them), of which the report is
            made.
        seen: what its pictures show besides, the study's own.
        seconds: step → seconds.
    """

    settings: Any
    data: JsonObject
    seen: Any = None
    seconds: dict[str, float] = field(default_factory=dict)


def environment() -> dict[str, str | int | None]:
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
