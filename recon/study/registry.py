"""The studies that ``torchpcct study NAME`` runs.

Each study is a module of this package with

* ``Settings``: a frozen dataclass that validates itself, with ``Settings.quick(**changes)`` for a first look (≤ 60 s);
* ``run(settings, progress=None) -> Report``: computes everything and returns the report, writing nothing;
  ``progress(step, fraction)`` is called with the name of the step and its finished fraction.
"""

from __future__ import annotations

import ast
import importlib
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any

from recon.study.report import Report

__all__ = ["STUDIES", "build_settings", "run"]

STUDIES: dict[str, str] = {
    "detector": "the silicon detector: counts, DQE beside the published one, pile-up, charge sharing",
    "bowtie": "ROI bowtie: CTDI and thorax dose, noise inside and outside, and its product with MBIR",
    "motion": "residual motion in PCCT and EID-CT, and reconstruction with the motion known, exactly or not",
    "noise": "FBP with every kernel, voxel size and dose: CNR tables, and which rankings they establish",
    "resolution": "PCCT and EID-CT without noise, blurred step by step: lumen, cap and core by thresholds",
    "spectral": "energy bins into PE and PVC: monochromatic images, best energy, tissue maps, by FBP and joint MBIR",
}
"""Name → one line of help. The module is ``recon.study.<name>.measure``."""


def _module(name: str) -> Any:
    if name not in STUDIES:
        raise ValueError(f"unknown study {name!r}: use one of {', '.join(STUDIES)}")
    return importlib.import_module(f"recon.study.{name}.measure")


def build_settings(name: str, *, quick: bool = False, seed: int | None = None, changes: Sequence[str] = ()) -> Any:
    """Settings of a study from command-line values.

    Args:
        name: of the study.
        quick: start from the reduced settings.
        seed: first seed of the noise, where the study draws noise.
        changes: ``"field=value"`` pairs, the value a Python literal (or a bare word, taken as text).

    Raises:
        ValueError: an unknown study or field, a change without ``=``, a value that the settings refuse.
    """
    kind = _module(name).Settings
    known = {f.name for f in fields(kind) if f.init}
    values: dict[str, Any] = {} if seed is None or "seed" not in known else {"seed": seed}
    for change in changes:
        key, equals, text = change.partition("=")
        if not equals or key not in known:
            raise ValueError(f"--set {change}: give field=value with one of the fields {', '.join(sorted(known))}")
        try:
            values[key] = ast.literal_eval(text)
        except (SyntaxError, ValueError):
            values[key] = text
        if isinstance(values[key], list):
            values[key] = tuple(values[key])
    return kind.quick(**values) if quick else kind(**values)


def run(name: str, settings: Any, progress: Callable[[str, float], None] | None = None) -> Report:
    """Run a study; see the module's docstring.

    Raises:
        ValueError: an unknown study.
        TypeError: settings of another study.
    """
    module = _module(name)
    if not isinstance(settings, module.Settings):
        raise TypeError(f"settings must be {module.__name__}.Settings, got {type(settings).__name__}")
    report = module.run(settings, progress)
    assert isinstance(report, Report)
    return report
