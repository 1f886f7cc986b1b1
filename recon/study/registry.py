"""The studies by name: what ``torchpcct study NAME`` runs, loaded when they are asked for.

What a study must be is described in :mod:`recon.study.study`.
"""

from __future__ import annotations

import ast
import importlib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from recon.study.names import check_setting, setting_names, settings_name
from torchpcct.validate import choice

if TYPE_CHECKING:
    from types import ModuleType

    from recon.study.report import Report
    from recon.study.study import Measured, Progress, StudySettings

STUDIES: dict[str, str] = {
    "compare": (
        "what dose MBIR saves at the paper's plaque, beside FBP, PWLS and the best simple filter"
    ),
    "phantom": (
        "the plaque itself: densities, mass fractions, CT numbers and lengths beside the paper's"
    ),
    "detector": (
        "the silicon detector: counts, DQE beside the published one, pile-up, charge sharing"
    ),
    "bowtie": (
        "ROI bowtie: CTDI and thorax dose, noise inside and outside, dose saved together with MBIR"
    ),
    "motion": (
        "residual motion in PCCT and EID-CT, and reconstruction with the motion known, "
        "exactly or not"
    ),
    "paths": (
        "the path of a moving inset, found from its own scan: errors and warnings on vessels drawn "
        "at random"
    ),
    "noise": (
        "FBP with every kernel, voxel size and dose: CNR tables, and which rankings they establish"
    ),
    "resolution": (
        "PCCT and EID-CT without noise, blurred step by step: lumen, cap and core by thresholds"
    ),
    "hardcases": (
        "scans with too few photons, faults, missing data or a wrong description: which "
        "results are wrong"
    ),
    "recovery": (
        "what each method shows of small and faint bodies that are inserted into the paper's scan"
    ),
    "spectral": (
        "energy bins as polyethylene and PVC: monochromatic images, best energy, tissue maps, by "
        "FBP and joint MBIR (no network)"
    ),
}
"""Name → one line of help. The study ``some-name`` is the module ``recon.study.some_name``."""

_FORMER = {"dose": "bowtie"}
"""The study "bowtie" was first published as "dose"; whoever calls it so still gets it."""


def folder(name: str) -> str:
    """Name of a study's module, of its template, and of the folder of its committed result.

    Raises:
        ValueError: an unknown study.
    """
    return choice("study", _FORMER.get(name, name), STUDIES).replace("-", "_")


def part(name: str) -> ModuleType:
    """The module of a study, with the names that :mod:`recon.study.study` lists.

    Raises:
        ValueError: an unknown study.
    """
    return importlib.import_module(f"recon.study.{folder(name)}")


def settings_class(name: str) -> type[StudySettings]:
    """What the settings of a study are: the class that is named after its module.

    Raises:
        ValueError: an unknown study.
    """
    kind: type[StudySettings] = getattr(part(name), settings_name(folder(name)))
    return kind


def build_settings(
    name: str, *, quick: bool = False, seed: int | None = None, changes: Sequence[str] = ()
) -> StudySettings:
    """Settings of a study from command-line values.

    Args:
        name: of the study.
        quick: start from the reduced settings.
        seed: first seed of the noise, where the study draws noise.
        changes: ``"field=value"`` pairs, the value a Python literal (or a bare word, taken as
            text).

    Raises:
        ValueError: an unknown study or field, a change without ``=``, a value that the settings
            refuse.
        TypeError: a value of a wrong type.
    """
    known = setting_names(folder(name))
    values: dict[str, object] = {} if seed is None or "seed" not in known else {"seed": seed}
    for change in changes:
        key, text = check_setting(folder(name), change)
        try:
            values[key] = ast.literal_eval(text)
        except (SyntaxError, ValueError):
            values[key] = text
    return settings_class(name).of(values, quick)


def run(
    name: str,
    settings: StudySettings,
    progress: Progress | None = None,
    cache: str | Path | None = None,
) -> Report:
    """Measure a study and build its report, which is not saved; see :func:`measured`."""
    return report_of(name, measured(name, settings, progress, cache))


def measured(
    name: str,
    settings: StudySettings,
    progress: Progress | None = None,
    cache: str | Path | None = None,
) -> Measured:
    """Measure a study.

    Args:
        name: of the study.
        settings: of that study.
        progress: called with the name of the step and its finished fraction.
        cache: folder of the results, in which finished parts are cached; the next run of the same
            settings uses them again. None: nothing is cached.

    Raises:
        ValueError: an unknown study; what the study itself refuses.
        TypeError: settings of another study.
        recon.jobs.execute.Planned: a dry run: the jobs that are left. Nothing is computed.
    """
    from recon.jobs import execute
    from recon.study.study import Timed, silent  # loads torch

    study, kind = part(name), settings_class(name)
    if not isinstance(settings, kind):
        raise TypeError(
            f"settings must be {kind.__module__}.{kind.__name__}, got {type(settings).__name__}"
        )
    timed = Timed(progress or silent)
    if isinstance(execute.current(), execute.Planner):
        if hasattr(study, "plan"):
            study.plan(settings, cache)
        raise execute.Planned(
            f"nothing was run: the rest of the study {name} has no jobs, one process computes it"
        )
    found: Measured = study.measure(settings, timed, cache)
    found.seconds = timed.seconds
    return found


def report_of(name: str, measured: Measured) -> Report:
    """The report of what a study measured: settings, values, checks, pictures.

    Raises:
        ValueError: an unknown study.
    """
    from recon.study.report import Report
    from recon.study.study import environment

    study = part(name)
    data = {"study": folder(name), "settings": asdict(measured.settings), **measured.data}
    if hasattr(study, "checks"):
        data["checks"] = [check.as_dict() for check in study.checks(data)]
    data |= {"seconds": measured.seconds, "environment": environment()}
    return Report(folder(name), data, study.figures(measured), getattr(study, "SCREEN", ""))
