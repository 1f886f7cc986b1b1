"""What the studies found, in sentences whose figures are read from the committed reports.

``notebooks/results.template.md`` is Markdown with expressions in Jinja's language, as the templates
of the reports are (:func:`recon.evaluate.report.templates`): every committed report is a variable,
``{{ hardcases.silent }}``. :func:`render` gives ``notebooks/RESULTS.md`` and the block of the
README between its two marks; the reports of the studies are rendered from their values, too. So no
sentence can disagree with a result: ``torchpcct verify`` renders again and compares. Of an
evaluation (:mod:`recon.evaluate`) ``NAME|record(TASK, METHOD, EXPOSURE, FIGURE, WHERE)`` is one
record.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from recon.evaluate.report import filled
from recon.mbir.recovery_note import RECOVERY
from recon.study import registry, report

if TYPE_CHECKING:
    from torchpcct.typing import Json


README_MARKS = ("<!-- results: rendered by torchpcct verify --write -->", "<!-- end of results -->")
"""Between them stands in README.md, and in the template, what both share."""

PASSING = (
    "seconds",
    "environment",
    "machine",
    "command",
    "speed",
    "rays_per_second",
    "rays_per_core_second",
    "threads",
    "peak_memory",
    "tables",
)
"""Keys of results that describe the run and not what was found: they differ from run to run.
Tables are Markdown of records that stand beside them, and hold seconds."""


_RECOVERY_FILE = f"recon/mbir/weights/{RECOVERY}"
"""Contrast recovery by MBIR of small and faint bodies, from the study "recovery"."""


def render(root: Path) -> dict[str, str]:
    """File, relative to the repository ``root``, → its text with the committed figures: RESULTS.md,
    README.md, the ``report.md`` of every study that is committed, and how much of small and faint
    bodies MBIR shows (:mod:`recon.mbir.recovery_note`).

    Raises:
        ValueError: a report, key or figure is missing, a format does not fit, a mark is missing.
    """
    from jinja2 import TemplateError

    folder = root / "notebooks"
    found = {
        p.parent.name: json.loads(p.read_text(encoding="utf-8"))
        for p in folder.glob("*/report.json")
    }
    try:
        text = filled(folder / "results.template.md", found)
    except (TemplateError, TypeError) as error:
        raise ValueError(
            f"results.template.md: {error}: mend the template, or run the study again"
        ) from error
    readme = (root / "README.md").read_text(encoding="utf-8")
    first, last = README_MARKS
    if any(part.count(mark) != 1 for part in (text, readme) for mark in README_MARKS):
        raise ValueError(
            f"README.md and results.template.md must hold each of {first} and {last} once"
        )
    block = text[text.index(first) : text.index(last)]
    studies = [study for study in map(registry.folder, registry.STUDIES) if study in found]
    from recon.study.recovery import mbir_recovery  # loads numba

    recovery = {_RECOVERY_FILE: mbir_recovery(found["recovery"])} if "recovery" in found else {}
    return {
        **recovery,
        **{
            f"notebooks/{study}/report.md": report.render(study, found[study]) + "\n"
            for study in studies
        },
        "README.md": readme[: readme.index(first)] + block + readme[readme.index(last) :],
        "notebooks/RESULTS.md": "\n".join(
            line for line in text.splitlines() if line not in README_MARKS
        )
        + "\n",
    }


def differences(
    committed: Json, again: Json, tolerance: float = 1e-3, place: str = ""
) -> Iterator[str]:
    """Where a result that was computed again differs from the committed one.

    Args:
        committed, again: JSON values.
        tolerance: relative, on every figure; other machines round sums otherwise. Figures below
            1e-6 count as 0.
        place: path so far, of the messages.

    Yields:
        A line for each difference: its path, then the committed value and the new one.
    """
    if isinstance(committed, dict) and isinstance(again, dict):
        for key in sorted({*committed, *again}):
            if not any(word in key for word in PASSING):
                yield from differences(
                    committed.get(key), again.get(key), tolerance, f"{place}/{key}"
                )
    elif isinstance(committed, list) and isinstance(again, list) and len(committed) == len(again):
        for k, (a, b) in enumerate(zip(committed, again, strict=True)):
            yield from differences(a, b, tolerance, f"{place}/{k}")
    elif isinstance(committed, int | float) and isinstance(again, int | float):
        both_undetermined = math.isnan(committed) and math.isnan(again)
        if not both_undetermined and not math.isclose(
            committed, again, rel_tol=tolerance, abs_tol=1e-6
        ):
            yield f"{place}: {committed} → {again}"
    elif committed != again:
        yield f"{place}: {committed!r} → {again!r}"
