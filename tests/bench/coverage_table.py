"""Lines that the default tests run, per package: reads ``coverage.json``, writes ``tests/coverage.md``.

    python -m pytest -n 0 --cov --cov-report=json && python tests/bench/coverage_table.py

Compiled kernels (numba, Triton) are left out, as ``pyproject.toml`` says: Python never runs their lines. What only runs
in processes that tests start (the command line's last lines, killed trainings) counts as not run.
"""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent.parent
LOW = 85.0


def table(files: dict[str, Any]) -> str:
    """Markdown: each package, then every module of which fewer than :data:`LOW` % of the lines ran."""
    parts: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0])
    low = []
    for name, found in sorted(files.items()):
        lines, run = found["summary"]["num_statements"], found["summary"]["covered_lines"]
        for package in (str(Path(name).parent), "all"):
            parts[package] = [a + b for a, b in zip(parts[package], (1, lines, run), strict=True)]
        if lines and 100 * run < LOW * lines:
            missing = ", ".join(_ranges(found["missing_lines"]))
            low.append(f"| `{name}` | {lines} | {100 * run / lines:.0f} | {missing} |")
    rows = [f"| `{p}` | {n} | {lines} | {100 * run / max(lines, 1):.1f} |" for p, (n, lines, run) in parts.items()]
    rows.sort(key=lambda row: row.startswith("| `all`"))
    return "\n".join([
        "# Lines that the default tests run", "",
        "`python -m pytest -n 0 --cov --cov-report=json && python tests/bench/coverage_table.py`; without compiled",
        "kernels, and without what runs in processes that the tests start.", "",
        "| package | modules | lines | run, % |", "|---|---|---|---|", *rows, "",
        f"Modules below {LOW:.0f} %:" if low else f"No module is below {LOW:.0f} %.", "",
        *(["| module | lines | run, % | not run |", "|---|---|---|---|", *low] if low else []),
    ]) + "\n"  # fmt: skip


def _ranges(lines: list[int]) -> list[str]:
    """Neighbouring numbers as ``first–last``."""
    runs: list[list[int]] = []
    for line in lines:
        if runs and line == runs[-1][1] + 1:
            runs[-1][1] = line
        else:
            runs.append([line, line])
    return [str(a) if a == b else f"{a}–{b}" for a, b in runs]


if __name__ == "__main__":
    read = json.loads((ROOT / "coverage.json").read_text(encoding="utf-8"))
    (ROOT / "tests/coverage.md").write_text(table(read["files"]), encoding="utf-8")
