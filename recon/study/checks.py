"""A study's figures beside the paper's: each row with what is accepted, and whether it is met."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from recon.study.report import markdown_table
from torchpcct.acquisition.plan import Effect

__all__ = ["Check", "around", "checks_section", "effects_section"]


@dataclass(frozen=True)
class Check:
    """One figure that a study must show.

    Args:
        name: what it is, with its unit.
        ours: as measured; NaN where it could not be determined (never inside).
        paper: the published figure as text, or as a number.
        low, high: accepted range, both ends included; infinite where open.
        note: where it is outside: the computed cause.
    """

    name: str
    ours: float
    paper: float | str
    low: float = -math.inf
    high: float = math.inf
    note: str = ""

    @property
    def ok(self) -> bool:
        """Whether the figure lies in the accepted range."""
        return bool(self.low <= self.ours <= self.high)

    def explained(self, cause: str) -> Check:
        """The check with ``cause`` as its note, where it is outside."""
        return self if self.ok or not cause else replace(self, note=cause)

    def as_dict(self) -> dict[str, Any]:
        """JSON values, ``ok`` among them; open ends are None."""
        ends = {k: v if math.isfinite(v) else None for k, v in (("low", self.low), ("high", self.high))}
        return {**vars(self), **ends, "ours": float(self.ours), "ok": self.ok}


def around(name: str, ours: float, paper: float, tolerance: float, note: str = "") -> Check:
    """A check that accepts ``paper`` ± ``tolerance``."""
    return Check(name, ours, paper, paper - tolerance, paper + tolerance, note)


def _range(check: Check) -> str:
    if math.isinf(check.low) and math.isinf(check.high):
        return "any"
    if math.isinf(check.low):
        return f"≤ {check.high:.4g}"
    if math.isinf(check.high):
        return f"≥ {check.low:.4g}"
    return f"{check.low:.4g} … {check.high:.4g}"


def checks_section(checks: Sequence[Check], *, every: bool = True) -> str:
    """Markdown section of the checks: every row, or only those outside (for long lists)."""
    passed = sum(c.ok for c in checks)
    text = f"## Agreement with the paper\n\n{passed} of {len(checks)} checks inside their tolerance."
    shown = [c for c in checks if every or not c.ok]
    if not shown:
        return text
    rows = [
        [
            c.name,
            "not found" if math.isnan(c.ours) else f"{c.ours:.4g}",
            c.paper if isinstance(c.paper, str) else f"{c.paper:.4g}",
            _range(c),
            "yes" if c.ok else "NO",
            c.note,
        ]
        for c in shown
    ]
    table = markdown_table(["check", "ours", "paper", "accepted", "inside", "note"], rows)
    return f"{text}{'' if every else ' Outside:'}\n\n{table}"


def effects_section(effects: Iterable[Effect], tolerance_hu: float | None = None) -> str:
    """Markdown section that states which effects were modelled, which left out, and what leaving them out costs.

    Args:
        effects: from :attr:`torchpcct.acquisition.plan.Plan.effects`, and what the study itself adds to them.
        tolerance_hu: of the plan; None where several plans with several tolerances were joined.
    """
    rows = [
        [
            e.name,
            "modelled" if e.modelled else "left out",
            "not estimated" if e.cost_hu is None else f"{e.cost_hu:.2f}",
            e.note,
        ]
        for e in effects
    ]
    limit = "" if tolerance_hu is None else f" An effect that costs less than {tolerance_hu:g} HU is left out."
    head = f"## What was modelled\n\nCost: error in HU over the footprint of the inset if the effect is omitted.{limit}"
    return f"{head}\n\n{markdown_table(['effect', '', 'cost, HU', 'note'], rows)}"
