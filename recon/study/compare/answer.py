"""The answer in one sentence, and the dose factors as tables."""

from __future__ import annotations

from typing import Any

from recon.study.paper.facts import ASSUMED_FACTOR, DOSES
from recon.study.report import markdown_table

__all__ = ["answer", "claim", "claim_section", "dose_section"]

_LOW_S, _HIGH_S = DOSES["1x"], DOSES["5.7x"]

_CONTRASTS = {"roi": "ROI contrast", "whole": "lesion contrast"}
_ROWS = {
    "sd_hu": ("SD, HU", 1), "slope": ("slope", 2), "bias_hu": ("bias, HU", 1),
    "false_contrast_hu": ("without the core, HU", 1),
}  # fmt: skip


def _at(rows: list[dict[str, Any]], exposure_s: float) -> dict[str, Any] | None:
    return next((e for e in rows if e["exposure_s"] == exposure_s), None)


def _interval(e: dict[str, float], digits: int) -> str:
    return f"{e['value']:.{digits}f} [{e['low']:.{digits}f}, {e['high']:.{digits}f}]"


def claim(factors: list[dict[str, Any]], references: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The paper's claim made testable: MBIR at 0.35 s against the reference FBP at 2 s, figure by figure.

    Args:
        factors: of :func:`recon.study.compare.factors.dose_factors`; references: of
            :func:`recon.study.compare.factors.reference_entry`.

    Returns:
        ``needed``, the ratio of both doses, and for every figure FBP's value, MBIR's and the dose factor, with whether
        it is as large as needed: ``"yes"`` or ``"no"`` where the whole interval is, else ``"open"``; None where one of
        the two was not measured.
    """
    low, fbp = _at(factors, _LOW_S), _at(references, _HIGH_S)
    if low is None or fbp is None:
        return None
    needed = _HIGH_S / _LOW_S

    def row(figure: str, of_fbp: float, of_mbir: dict[str, float], factor: dict[str, float]) -> dict[str, Any]:
        met = "yes" if factor["low"] >= needed else "no" if factor["high"] < needed else "open"
        return {"figure": figure, "fbp": of_fbp, "mbir": of_mbir, "factor": factor, "met": met}

    rows = [
        row("SD of a voxel in plain fat, HU", fbp["fat_sd_hu"], low["fat_sd_hu"], low["fat_factor"]),
        row("the paper's CNR", fbp["paper_cnr"], low["paper_cnr"], low["paper_cnr_factor"]),
    ]
    for name, text in _CONTRASTS.items():
        ours, theirs = low["contrast"][name], fbp["contrast"][name]
        # Both SDs as they would be at slope 1: what the factor compares.
        corrected = {k: v / ours["slope"]["value"] for k, v in ours["sd_hu"].items()}
        of_fbp = theirs["sd_hu"] / theirs["slope"]
        rows.append(row(f"{text}: SD / slope, HU", of_fbp, corrected, ours["factor"]))
    return {"mbir_s": _LOW_S, "fbp_s": _HIGH_S, "needed": needed, "rows": rows}


def answer(data: dict[str, Any]) -> str:
    """The result in one sentence, from the report's values; empty without MBIR."""
    factors, tested = data["dose_factors"], data["claim"]
    best = _at(factors, _HIGH_S) or (factors[-1] if factors else None)
    if best is None:
        return ""
    text = ""
    if tested is not None:
        cnr = tested["rows"][1]
        verdict, reaches = {
            "yes": ("Yes", "reaches"), "no": ("No", "does not reach"), "open": ("Open", "may or may not reach"),
        }[cnr["met"]]  # fmt: skip
        controlled = "controlled " if data["settings"]["control"] else ""
        against = "and not" if cnr["met"] == "no" else "against"
        text = (
            f"{verdict}: at {tested['mbir_s']:.2f} s MBIR's {controlled}CNR of {_interval(cnr['mbir'], 2)} {reaches} "
            "the "
            f"{cnr['fbp']:.2f} of FBP (soft kernel, 0.25 mm) at {tested['fbp_s']:.2f} s, as it is worth "
            f"{_interval(cnr['factor'], 2)} times the dose {against} the {ASSUMED_FACTOR:g} times that the paper "
            "assumes; "
        )
    text += (
        f"at {best['exposure_s']:.2f} s MBIR is worth {_interval(best['paper_cnr_factor'], 2)} times the dose of FBP "
        "by the paper's CNR"
    )
    for name, label in (("roi", "in the paper's ROIs"), ("whole", "over the whole lesion")):
        e = best["contrast"][name]
        text += (
            f", {_interval(e['factor'], 2)} times by the variance of the contrast {label} (slope "
            f"{e['slope']['value']:.2f}, bias {e['bias_hu']['value']:+.0f} HU)"
        )
    text += f" and {_interval(best['fat_factor'], 2)} times by the noise of a voxel in plain fat, the tissue it is told"
    text = text[0].upper() + text[1:]
    s = data["settings"]
    reduced = s["views"] < 1968 or not s["control"]
    warning = (
        f" (WARNING: {s['views']} views, {s['realizations']} realisations{'' if s['control'] else ', no control'}: a "
        "test of the program, which says nothing about the question)"
    )
    return f"**{text}{warning if reduced else ''}.**"


def dose_section(data: dict[str, Any]) -> str:
    """Dose factors with what they are made of, per exposure, and the paper's claim."""
    if not data["dose_factors"]:
        return ""
    truth = data["true_values"]
    first = data["dose_factors"][0]
    counts = " / ".join(str(e["realizations"]) for e in data["dose_factors"])
    parts = [
        "## Dose factors of MBIR against FBP soft 0.25 mm",
        "How many times the dose FBP needs for the same figure; square brackets: 95 %. FBP: exact. "
        + (
            f"MBIR: {counts} paired draws with a linear control whose moments are exact (correlation of "
            "the contrasts, paper's ROIs / whole lesion: "
            + ", ".join(
                f"{e['exposure_s']:.2f} s {e['contrast']['roi']['correlation']:.3f} / "
                f"{e['contrast']['whole']['correlation']:.3f}"
                for e in data["dose_factors"]
            )
            + "). "
            if first["controlled"]
            else f"MBIR: {counts} paired draws. "
        )
        + f"True contrast {truth['contrast_hu']:.1f} HU (rods of each tissue at the plaque's place). Slope: change of "
        "the contrast with the core put in, over the true one, from a twin without core and with the same noise; "
        "“without the core”: the contrast read in that twin, where there is none. ROI contrast: between the paper's "
        "two ROIs; lesion contrast: between all core and all fibrous tissue of the core's slices. The factor of a "
        "contrast is that of its variance at slope 1: never read it without slope and bias. Noise in fat is that of "
        f"single voxels (FBP 0.25 mm, MBIR {data['mbir_voxel_mm']:.2f} mm), in the tissue that "
        "MBIR is told as the surround: it says how smooth the image is there, not what can be seen.",
    ]
    for e in data["dose_factors"]:
        fbp = _at(data["reference"], e["exposure_s"])
        assert fbp is not None
        rows = [
            ["noise in plain fat: SD, HU", f"{fbp['fat_sd_hu']:.1f}", _interval(e["fat_sd_hu"], 1),
             _interval(e["fat_factor"], 2)],
            ["the paper's CNR", f"{fbp['paper_cnr']:.2f}", _interval(e["paper_cnr"], 2),
             _interval(e["paper_cnr_factor"], 2)],
        ]  # fmt: skip
        for name, text in _CONTRASTS.items():
            ours, theirs = e["contrast"][name], fbp["contrast"][name]
            for key, (label, digits) in _ROWS.items():
                factor = _interval(ours["factor"], 2) if key == "sd_hu" else ""
                rows.append([f"{text}: {label}", f"{theirs[key]:.{digits}f}", _interval(ours[key], digits), factor])
        parts.append(markdown_table([f"{e['exposure_s']:.2f} s", "FBP, exact", "MBIR", "dose factor"], rows))
    return "\n\n".join([*parts, *claim_section(data)])


def claim_section(data: dict[str, Any]) -> list[str]:
    """The paper's claim, tested: a sentence and a table; nothing where no dose factors were measured."""
    tested = data["claim"]
    if tested is None:
        return []
    head = [
        "figure", f"FBP {tested['fbp_s']:.2f} s", f"MBIR {tested['mbir_s']:.2f} s", "dose factor",
        f"≥ {tested['needed']:.1f}",
    ]  # fmt: skip
    table = [
        [r["figure"], f"{r['fbp']:.{d}f}", _interval(r["mbir"], d), _interval(r["factor"], 2), r["met"]]
        for r, d in zip(tested["rows"], (1, 2, 1, 1), strict=True)
    ]
    return [
        f"The paper's claim: MBIR at {tested['mbir_s']:.2f} s as good as FBP at {tested['fbp_s']:.2f} s, which "
        f"needs a dose factor of {tested['needed']:.1f}.",
        markdown_table(head, table),
    ]
