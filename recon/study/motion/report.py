"""Tables and text of the motion study."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from recon.study.checks import Check, checks_section, effects_section
from recon.study.motion.compensation import estimate_name
from recon.study.motion.figures import curves_figure, images_figure
from recon.study.motion.measure import Measured
from recon.study.motion.observed import Observed
from recon.study.motion.settings import METHODS
from recon.study.paper import facts as paper
from recon.study.report import Report, markdown_table, or_dash
from recon.study.study import environment, time_line
from torchpcct.acquisition.plan import Effect

__all__ = ["build_report"]

_TOLERANCE = 20.0
"""Largest error of a measure in per cent that the paper accepts (its resolution study)."""

_DICE = 0.5
"""Overlap with the true core from which a segmented region counts as the core."""


def build_report(m: Measured) -> Report:
    """Report of :func:`recon.study.motion.measure.measure`: ``report.json``, ``report.md`` and two figures."""
    checks = _checks(m)
    data: dict[str, Any] = {
        "study": "motion",
        "settings": asdict(m.settings),
        "range_mm": m.range_mm,
        "step_mm": m.step_mm,
        "at_rest": {name: o.as_dict() for name, o in m.at_rest.items()},
        "residual": [
            {"scanner": name, "fraction": f, "in_place": here.as_dict(), "moved_back": back.as_dict()}
            for (name, f), (here, back) in m.residual.items()
        ],
        "compensated": [
            {"method": method, "error": error, "noisy": noisy, "realizations": [o.as_dict() for o in found]}
            for (method, error, noisy), found in m.compensated.items()
        ],
        "plan": m.plan,
        "checks": [c.as_dict() for c in checks],
        "seconds": m.seconds,
        "environment": environment(),
    }
    sections = [
        "# Motion: residual motion in PCCT and EID-CT, and its compensation",
        _intro(m),
        checks_section(checks),
        _residual_section(m),
        _compensation_section(m),
        effects_section([Effect(**e) for e in m.plan["effects"]], m.plan["tolerance_hu"]),
        _footer(m),
    ]
    figures = {"motion_images.png": images_figure(m), "motion.png": curves_figure(m)}
    return Report("motion", data, "\n\n".join(sections), figures)


def _relative(found: Observed, rest: Observed) -> float:
    """Lumen area in per cent of that at rest."""
    return 100.0 * found.segmentation.lumen_area / rest.segmentation.lumen_area


def _intro(m: Measured) -> str:
    s = m.settings
    thinned = "" if s.thinning == 1 else f" Reduced run: one view in {s.thinning}."
    return (
        f"The vessel moves rigidly in the axial plane, {s.amplitude_mm:g} mm · sin(2π t · {s.rate_bpm:g} / min), "
        f"during one turn of {s.rotation_s:g} s: {m.range_mm[0]:.2f} … {m.range_mm[1]:.2f} mm, at most "
        f"{m.step_mm * 1000:.1f} µm from view to view. Every view sees it where it is then; its way during a view "
        "blurs the reading. FBP with the standard kernel on "
        f"{s.voxel_mm:g} mm voxels, axial image interpolated to 0.035 mm, lumen ≥ 250 HU, core 20–60 HU.{thinned}\n\n"
        f"**{_headline(m)}**"
    )


def _headline(m: Measured) -> str:
    rest, errors = m.at_rest["PCCT"], (0.0, *m.settings.errors)
    mm = m.settings.amplitude_mm * m.settings.worst
    plain = m.residual["PCCT", m.settings.worst][0]
    borne = _borne(m)
    estimates = {method: [m.compensated[method, e, False][0] for e in errors]
                 for method in METHODS if (method, errors[-1], False) in m.compensated}  # fmt: skip
    fixed = estimates["fbp"][0]
    text = (
        f"Uncompensated, {mm:g} mm of motion change the image by "
        f"{100 * plain.nrmse:.0f} % (normalised rms) and leave {'a' if plain.segmentation.core_found else 'no'} core "
        f"to segment; with the motion known, FBP comes back to {100 * fixed.nrmse:.1f} %, the lumen's area to "
        f"{_relative(fixed, rest):.1f} % of that at rest, the core's contrast to {fixed.contrast_hu:.1f} HU "
        f"(at rest {rest.contrast_hu:.1f}). {borne}"
    )
    limit = _up_to(errors, [_contrast_kept(o, rest) for o in estimates["fbp"]])
    if limit is not None:
        text += (
            f" FBP's contrast of the core stays within {_TOLERANCE:.0f} % of that at rest if the assumed amplitude is "
            f"wrong by up to {100 * limit:.0f} %, a residual motion of {limit * mm:.2g} mm"
        )
        text += "." if limit == errors[-1] else "; at the next larger error it does not."
    for method, found in estimates.items():
        kept = _up_to(errors, [_core_right(o) for o in found])
        text += f" {METHODS[method].split(' (')[0]} "
        if kept is None:
            text += "does not segment the core at any."
        elif kept == 0:
            text += "segments the core with the true motion only."
        else:
            text += f"segments the core up to an error of {100 * kept:.0f} % ({kept * mm:.2g} mm)."
    return text


def _borne(m: Measured) -> str:
    """Up to which residual motion the uncompensated core survives, by either measure."""
    rest, series = m.at_rest["PCCT"], {f: here for f, (here, _) in m.residuals("PCCT").items()}

    def limit(good: Sequence[bool]) -> str:
        kept = _up_to(list(series), good)
        if kept is None:
            return f"not even up to {100 * min(series):.0f} % ({min(series) * m.settings.amplitude_mm:.2g} mm)"
        return f"up to {100 * kept:.0f} % ({kept * m.settings.amplitude_mm:.2g} mm)"

    contrast = limit([_contrast_kept(o, rest) for o in series.values()])
    found = limit([_core_right(o) for o in series.values()])
    at_rest = "" if _core_right(rest) else " (nor at rest)"
    return (
        "How much of the motion the core bears uncompensated depends on the measure: its contrast, read where it is at "
        f"rest, stays within {_TOLERANCE:.0f} % of that at rest {contrast}; segmentation finds it {found}{at_rest}."
    )


def _up_to(errors: Sequence[float], good: Sequence[bool]) -> float | None:
    """The last of the errors up to which all are good; None: not even the first."""
    kept = None
    for error, ok in zip(errors, good, strict=True):
        if not ok:
            break
        kept = error
    return kept


def _contrast_kept(found: Observed, rest: Observed) -> bool:
    return 100.0 * abs(found.contrast_hu / rest.contrast_hu - 1.0) <= _TOLERANCE


def _core_right(found: Observed) -> bool:
    """Whether a core was segmented where it is: in noise, closed specks elsewhere must not count."""
    return found.segmentation.core_found and found.core_dice >= _DICE


def _checks(m: Measured) -> list[Check]:
    s, rest = m.settings, m.at_rest["PCCT"]
    series = {f: here for f, (here, _) in m.residuals("PCCT").items()}
    stable, tolerated = paper.MOTION["lumen_stable_below"], paper.MOTION["tolerated"]
    drift = {f: abs(_relative(o, rest) - 100.0) for f, o in series.items()}
    small = [v for f, v in drift.items() if f < stable]
    last = series[s.worst]
    checks = [
        Check("largest displacement over the amplitude", m.range_mm[1] / s.amplitude_mm, "range [0, A]", 0.99, 1.01),
        Check("smallest displacement over the amplitude", m.range_mm[0] / s.amplitude_mm, "range [0, A]", -0.01, 0.01),
    ]
    if small:
        name = f"lumen area's change below {100 * stable:.0f} % of the motion, %"
        checks.append(Check(name, max(small), "stable", high=_TOLERANCE))
    if stable in drift and s.worst > stable:
        name = f"lumen area's change at {100 * s.worst:.0f} % over that at {100 * stable:.0f} % of the motion"
        checks.append(Check(name, drift[s.worst] / max(drift[stable], 1e-9), "suffers beyond", low=1.0))
    if tolerated in series and rest.segmentation.core_found:
        name = f"core area's change at {100 * tolerated:.0f} % (100: lost), %"
        more = f"more than the lumen's {drift[tolerated]:.1f}"
        checks.append(Check(name, _core_change(series[tolerated], rest), more, low=max(drift[tolerated], 1.0)))
    if tolerated in series:
        borne = _up_to(s.fractions, [_contrast_kept(o, rest) for o in series.values()])
        name = "largest residual motion with the core's contrast within 20 %, % of the motion"
        ours, limit = math.nan if borne is None else 100 * borne, 100 * tolerated
        checks.append(Check(name, ours, f"{limit:.0f}", limit / 2, limit))
    if tolerated in series:
        found = f"core segmented at {100 * min(s.fractions):.0f} % of the motion (1: yes)"
        least = series[min(s.fractions)]
        note = f"no such region of 20–60 HU; contrast {least.contrast_hu:.1f} HU, at rest {rest.contrast_hu:.1f}"
        checks.append(Check(found, float(_core_right(least)), "visible up to 20 %", low=1.0).explained(note))
    name = f"core segmented at {100 * s.worst:.0f} % of the motion (1: yes)"
    checks.append(Check(name, float(last.segmentation.core_found), "structures not reconstructed", high=0.0))
    if len(series) > 1:
        rise = min(np.diff([o.nrmse for o in series.values()]))
        checks.append(Check("smallest rise of the NRMSE with the motion", rise, "rises", low=0.0))
    for fraction, (eid, _) in m.residuals("EID-CT").items():
        if fraction in series:
            name = f"NRMSE at {100 * fraction:.0f} %, EID-CT over PCCT"
            checks.append(Check(name, eid.nrmse / series[fraction].nrmse, "EID-CT less sensitive", high=1.0))
    return checks


def _core_change(found: Observed, rest: Observed) -> float:
    """Change of the core's area in per cent; 100 where it is lost."""
    if not found.segmentation.core_found:
        return 100.0
    return 100.0 * abs(found.segmentation.core_area / rest.segmentation.core_area - 1.0)


def _residual_section(m: Measured) -> str:
    rows = []
    for name, rest in m.at_rest.items():
        rows.append([f"{name}, at rest", "–", "–", *_cells(rest, rest)])
        rows += [
            [f"{name}, {100 * f:.0f} %", f"{100 * here.nrmse:.1f}", f"{100 * back.nrmse:.1f}", *_cells(here, rest)]
            for f, (here, back) in m.residuals(name).items()
        ]
    head = ["residual motion", "NRMSE in place, %", "moved back, %", "lumen, % of rest", "lumen Dice", "core, mm²",
            "basin, HU", "contrast, HU"]  # fmt: skip
    return (
        "## Residual motion\n\n"
        f"{markdown_table(head, rows)}\n\n"
        "NRMSE: rms difference to the same scanner's image at rest over that image's rms deviation from fat. Moved "
        "back: reconstructed on a grid displaced by the mean of the motion, which takes the shift out and leaves the "
        "change of shape. The other columns: in place. Basin: depth of the core's basin (0: no contour closes around "
        "it). Dice: with the true lumen at rest."
    )


def _cells(found: Observed, rest: Observed) -> list[str]:
    return [
        f"{_relative(found, rest):.1f}",
        f"{found.lumen_dice:.2f}",
        or_dash(found.segmentation.core_area, 2),
        f"{found.depth:.1f}",
        f"{found.contrast_hu:.1f}",
    ]


def _compensation_section(m: Measured) -> str:
    s = m.settings
    parts = ["## Compensation\n\n" + _compensation_text(m)]
    for noisy in (False, True):
        rows = [
            [f"{METHODS[method]}, {estimate_name(e)}", *_averages(found, m.compensated[method, None, noisy], noisy)]
            for method in METHODS
            for e in (None, 0.0, *s.errors)
            if (found := m.compensated.get((method, e, noisy)))
        ]
        head = ["reconstruction", "residual, NRMSE %", "lumen, % of rest", "lumen Dice", "core found", "core Dice",
                "basin, HU", "contrast, HU", "cap, mm"]  # fmt: skip
        runs = f"means of {s.realizations} realisations" if s.realizations > 1 else "one realisation"
        noise = f"with the noise of {s.exposure_s:g} s, {runs}" if noisy else "without noise"
        parts.append(f"{noise[0].upper()}{noise[1:]}:\n\n{markdown_table(head, rows)}")
    return "\n\n".join(parts)


def _averages(found: Sequence[Observed], rest: Sequence[Observed], noisy: bool) -> list[str]:
    def mean(values: Iterable[float], digits: int) -> str:
        finite = [v for v in values if math.isfinite(v)]
        return f"{np.mean(finite):.{digits}f}" if finite else "–"

    return [
        mean((100 * o.nrmse for o in found), 1),
        mean((_relative(o, r) for o, r in zip(found, rest, strict=True)), 1),
        mean((o.lumen_dice for o in found), 2),
        f"{sum(_core_right(o) for o in found)} of {len(found)}",
        mean((o.core_dice for o in found), 2),
        "–" if noisy else mean((o.depth for o in found), 1),
        mean((o.contrast_hu for o in found), 1),
        mean((o.cap_line for o in found), 3),
    ]


def _compensation_text(m: Measured) -> str:
    s = m.settings
    mm = s.worst * s.amplitude_mm
    return (
        f"The scan with {100 * s.worst:.0f} % of the motion ({mm:g} mm), reconstructed with the "
        "motion given. The fat around the vessel stands still: its known readings are taken off and reconstructed at "
        "rest; what the vessel adds is filtered and backprojected along the rays that met the vessel where it was "
        "(FBP), or projected with the grid displaced in every view (PWLS and MBIR). Wrong by e: the estimate is "
        f"(1 − e) times the true motion, a residual motion of e · {mm:g} mm. NRMSE: against the "
        "same method's noise-free image at rest; with noise it is mostly noise. Core found: a region segmented with a "
        f"Dice of at least {_DICE:g} with the true core. PWLS was run to its certified minimum, at rest and with the "
        "true motion."
    )


def _footer(m: Measured) -> str:
    s = m.settings
    thinned = "" if s.thinning == 1 else f" --set thinning={s.thinning}"
    seeds = f"seeds of the noise: {s.seed} … {s.seed + s.realizations - 1}; versions: report.json"
    return (
        f"Repeat: `torchpcct study motion{thinned} --set realizations={s.realizations}`. {time_line(m.seconds, seeds)}"
    )
