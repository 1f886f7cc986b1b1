"""What could make noise and muscle dose the paper's, as tables of the report."""

from __future__ import annotations

import math
from typing import Any

from recon.study.bowtie.absolute_noise import FIT, REGIONS
from recon.study.bowtie.muscle_dose import READINGS
from recon.study.paper import facts as paper
from recon.study.report import by_sign, markdown_table

__all__ = ["muscle_section", "noise_section"]

_POINTS = 3.0
"""Difference to the paper's 55 % that counts as reproduced, in points."""

_PERIPHERY = (46.0, 58.0)
"""Accepted reduction of the CTDI phantom's peripheral dose in %: the paper's 52 ± 6."""


def noise_section(causes: dict[str, Any]) -> str:
    """Markdown: noise of every change beside the paper's, and which reproduce it."""
    rows = [
        [r["change"], *[f"{r['sd_hu'][k]:.1f} ({r['over_paper'][k]:.2f})" for k in REGIONS], "yes" if r["fits"] else ""]
        for r in causes["rows"]
    ]
    rows.append(["paper", *[f"{paper.BOWTIE[f'{k}_sd_hu'][0]:.1f}" for k in REGIONS], ""])
    single = [r["change"] for r in causes["rows"] if r["fits"] and not r["change"].startswith("both")]
    both = [r["change"].removeprefix("both: ") for r in causes["rows"] if r["fits"] and r["change"].startswith("both")]
    head = ["change", "CTDI, inside", "CTDI, outside", "heart", f"all within {100 * FIT:.0f} %"]
    needed, scale = causes["needed"], causes["thorax_scale"]
    text = (
        "### Why the SDs are not the paper's\n\nSD in HU with the large bowtie, in brackets over the paper's, with one "
        f"thing changed that the paper leaves open; {causes['views']} views with the whole tube load.\n\n"
        f"{markdown_table(head, rows)}\n\n"
        f"The paper's SDs are {needed['inside']:.2f}, {needed['outside']:.2f} and {needed['heart']:.2f} times ours. "
    )
    if single:
        text += f"One change reproduces all three: {', '.join(single)}."
    else:
        share = [r["sd_hu"]["heart"] / r["sd_hu"]["inside"] for r in causes["rows"] if "thorax" not in r["change"]]
        theirs = paper.BOWTIE["heart_sd_hu"][0] / paper.BOWTIE["inside_sd_hu"][0]
        text += (
            f"No single change reproduces all three: heart over CTDI phantom is {theirs:.2f} in the paper and "
            f"{min(share):.2f} to {max(share):.2f} here, whatever is changed but the thorax."
        )
    if not math.isnan(scale):
        size = f"{100 * abs(scale - 1):.0f} % {by_sign(scale, 'larger', 'smaller', 1.0)}"
        text += f" A thorax {size} than ours would need the same factor as the CTDI phantom."
    if both:
        text += f" Two changes that do: {'; '.join(both)}. Which it was the paper does not let one tell."
    return text


def muscle_section(causes: list[dict[str, Any]]) -> str:
    """Markdown: reductions of every change and reading, and which come to the paper's."""
    target = paper.BOWTIE["skin_reduction_percent"]
    rows = [
        [r["change"], *[f"{r['readings'][k]:.1f}" for k in READINGS], f"{r['side ribs']:.1f}", f"{r['skin']:.1f}",
         f"{r['periphery']:.1f}"]
        for r in causes
    ]  # fmt: skip
    rows.append(["paper", *[f"{target:g}" for _ in READINGS], "> 45", f"{target:g}", "52"])
    near = [
        f"{r['change']}, {READINGS[k]} ({r['readings'][k]:.1f})"
        for r in causes
        for k in READINGS
        if abs(r["readings"][k] - target) <= _POINTS and _PERIPHERY[0] <= r["periphery"] <= _PERIPHERY[1]
    ]
    plain = [f"{r['change']} ({r['readings']['means']:.1f})" for r in causes
             if abs(r["readings"]["means"] - target) <= _POINTS
             and _PERIPHERY[0] <= r["periphery"] <= _PERIPHERY[1]]  # fmt: skip
    first = causes[0]["periphery"]
    beam, chest = ([r["readings"]["means"] for r in causes if (r["periphery"] != first) == b] for b in (True, False))

    def span(values: list[float]) -> str:
        return f"{min(values):.1f} and {max(values):.1f} %"

    readings = "; ".join(f"*{k}*: {v}" for k, v in READINGS.items())
    head = ["change", *[f"muscle, {k}" for k in READINGS], "side ribs", "skin", "CTDI, periphery"]
    return (
        f"### Why the muscle is not at {target:g} %\n\n% less unscattered dose, with one thing changed; five readings "
        f"of the muscle of the chest wall ({readings}).\n\n{markdown_table(head, rows)}\n\n"
        f"Within {_POINTS:g} points of {target:g} with the CTDI phantom's periphery at 52 ± 6 % less: "
        + (
            f"by the ratio of mean doses {', '.join(plain) or 'none'}; by any reading {'; '.join(near)}. "
            if near
            else "none. "
        )
        + f"By the ratio of mean doses changes of the beam move the muscle between {span(beam)}, changes of the chest "
        f"between {span(chest)}."
    )
