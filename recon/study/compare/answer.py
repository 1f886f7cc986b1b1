"""The answer in one sentence: what MBIR saves at the paper's plaque, and whether it is what the paper assumes."""

from __future__ import annotations

import math
from typing import Any

from recon.study.paper.facts import ASSUMED_FACTOR, DOSES

__all__ = ["answer", "claim", "interval"]

_LOW_S, _HIGH_S = DOSES["1x"], DOSES["5.7x"]
_METHOD = "mbir"
FULL_VIEWS, FEW_DRAWS = 1968, 16


def _found(records: list[dict[str, Any]], method: str, exposure_s: float, figure: str, where: str) -> Any:
    """The record, or None."""
    wanted = {"method": method, "exposure_s": exposure_s, "figure": figure, "where": where}
    return next((r for r in records if wanted.items() <= r.items()), None)


def interval(record: dict[str, Any]) -> str:
    """A value with its interval, where it has one."""
    low, high = record["low"], record["high"]
    if low is None or not math.isfinite(low):
        return f"{record['value']:.2f}"
    return f"{record['value']:.2f} [{low:.2f}, {high:.2f}]"


def claim(records: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The paper's claim made testable: MBIR at 0.35 s has the CNR of FBP at 2 s.

    Args:
        records: of :func:`recon.evaluate.evaluate`.

    Returns:
        Both CNRs, the dose factor at 0.35 s, the one that is needed, and whether it is as large: ``"yes"`` or ``"no"``
        where the whole interval is, else ``"open"``; None where one of the two was not measured.
    """
    ours = _found(records, _METHOD, _LOW_S, "CNR", "small")
    factor = _found(records, _METHOD, _LOW_S, "dose factor: CNR", "small")
    fbp = _found(records, "fbp:soft", _HIGH_S, "CNR", "small")
    if ours is None or factor is None or fbp is None:
        return None
    needed = _HIGH_S / _LOW_S
    met = "yes" if factor["low"] >= needed else "no" if factor["high"] < needed else "open"
    return {"mbir_s": _LOW_S, "fbp_s": _HIGH_S, "needed": needed, "mbir": ours, "fbp": fbp, "factor": factor,
            "met": met}  # fmt: skip


def answer(data: dict[str, Any]) -> str:
    """The result in one sentence, from the report's values; empty without MBIR."""
    records, tested = data["records"], data["claim"]
    text = ""
    if tested is not None:
        verdict, reaches = {
            "yes": ("Yes", "reaches"), "no": ("No", "does not reach"), "open": ("Open", "may or may not reach"),
        }[tested["met"]]  # fmt: skip
        against = "not" if tested["met"] == "no" else "against"
        text = (
            f"{verdict}: at {tested['mbir_s']:.2f} s MBIR's CNR of {interval(tested['mbir'])} {reaches} the "
            f"{tested['fbp']['value']:.2f} of FBP (soft kernel) at {tested['fbp_s']:.2f} s: FBP needs "
            f"{interval(tested['factor'])} times its dose for that CNR, {against} the {ASSUMED_FACTOR:g} times "
            "that the paper assumes"
        )
    exposures = sorted({r["exposure_s"] for r in records if r["method"] == _METHOD}, reverse=True)
    if not exposures:
        return ""
    best = exposures[0]
    parts = [
        (_found(records, _METHOD, best, f"dose factor: {figure}", where), what)
        for figure, where, what in (
            ("CNR", "small", "for the paper's CNR"),
            ("contrast at slope 1", "lesion", "for the contrast of the lesion"),
            ("d'", "volume", "for the detectability"),
            ("noise", "patient", "for the noise of a voxel in fat"),
        )
    ]  # fmt: skip
    summary = ", ".join(f"{interval(r)} {what}" for r, what in parts if r is not None)
    text += f"{'; at' if text else 'At'} {best:.2f} s FBP needs, in doses of MBIR, {summary}"
    s = data["settings"]
    if s["views"] < FULL_VIEWS or s["n"] < FEW_DRAWS:
        text += (f" (WARNING: {s['views']} views, {s['n']} realisations: a test of the program, which says "
                 "nothing about the question)")  # fmt: skip
    return f"**{text}.**"
