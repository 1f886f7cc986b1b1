"""Sound scans drawn at random: how many are told that something is wrong with them? Wrong ones: are
sizes right?

    python tests/bench/false_alarms.py [--n 500] [--first 0] [--kind cone] [--method fbp]
    [--readings 600000]
    python tests/bench/false_alarms.py --method pwls --n 100 --readings 20000
    python tests/bench/false_alarms.py --photons 3 1000 [--n 500] [--readings 100000]
    python tests/bench/false_alarms.py --errors [--n 500] [--first 0] [--kind cone]

Without ``--method`` only the checks run that :func:`recon.reconstruct` runs for every method; with
it the whole reconstruction, and every warning of its report counts that accuses the scan; of PWLS
and MBIR only scans whose object their grid can hold. Each alarm is printed with the
seed of its scan; ``--seed N`` looks at one. The exit status is 1 if there is any.

``--photons LOW HIGH`` draws the photons of a reading in air anew, of objects that stay as dense: of
those the rays that leave none are rightly named.

``--errors`` describes each scan wrongly by a size drawn at random (the centre, the fan angles, the
steps between views, a roll of the detector) and counts how often the error is found, is named, and
lies within what is said after ±, of which 95 % should.
"""

import argparse
import logging
import math
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent.parent / "helpers"))  # where pytest finds them, too

from sound_scans import KINDS, Drawn, draw, transmissions

import recon
from recon.analytic.coverage import consistency_warnings
from torchpcct.checks.conjugate_rays import geometry_test
from torchpcct.checks.defects import repair_defects
from torchpcct.checks.readings import reading_warnings
from torchpcct.geometry import ConeBeam, VolumeGrid
from torchpcct.readings import fewest


def alarms(drawn: Drawn, method: str | None = None) -> list[str]:
    """What a sound scan is wrongly told."""
    scan = drawn.scan()
    if method is None:
        repaired, texts = repair_defects(scan)
        try:
            found = consistency_warnings(repaired, drawn.grid)
        except ValueError as error:  # a refusal is an alarm, too
            found = [str(error)]
        texts = [*texts, *reading_warnings(repaired), *found]
    else:
        grid = drawn.grid if method == "fbp" else as_fine_as_cells(drawn)
        try:
            texts = recon.reconstruct(scan, grid, method).report.get("warnings", [])
        except ValueError as error:  # a refusal is an alarm, too
            texts = [str(error)]
        if method != "fbp":
            texts = of_the_scan(texts)
    return drawn.wrongly(texts)


def held_by_a_grid(drawn: Drawn) -> bool:
    """Whether an iterative method can explain a scan: a counting detector, rows that end neither
    inside the object nor below its top, since no volume on a grid within the rows holds what lies
    beyond them, and no offset detector of a cone beam."""
    if drawn.electronic_noise or "cut off" in drawn.text:
        return False
    if drawn.kind != "cone":
        return True
    return "offset detector" not in drawn.text and height_of(drawn) < math.inf


def height_of(drawn: Drawn) -> float:
    """Half of the height of the object about z = 0, mm; infinite if rows end within it."""
    g = drawn.geometry
    rows = min(-g.row_positions[0], g.row_positions[-1]) + g.pitch[0] / 2
    height = 0.0
    for s in drawn.solids:
        if s.value:
            reach = s.radii[2] + max(s.radii[:2]) * abs(math.sin(s.tilt))
            height = max(height, abs(float(s.center[2])) + float(reach))
    return height if height <= rows / g.magnification else math.inf


def as_fine_as_cells(drawn: Drawn) -> VolumeGrid:
    """The whole field in voxels as large as cells at the axis, and all slices of the object, of a
    row each: others cannot hold what the readings say."""
    g = drawn.geometry
    if drawn.kind == "parallel":
        cell, radius = g.pitch, float(np.abs(g.column_positions).max()) + g.pitch / 2
    else:
        cell = (g.pitch[1] if drawn.kind == "cone" else g.pitch) / g.magnification
        radius = g.fov_radius
    side = max(2, math.ceil(2.0 * radius / cell))
    if drawn.kind != "cone":
        return VolumeGrid((side, side), cell)
    row, height = g.pitch[0] / g.magnification, height_of(drawn)
    lowest = float(g.row_positions[0]) / g.magnification - row / 2
    first = math.floor((-height - lowest) / row + 1e-9)
    last = max(math.ceil((height - lowest) / row - 1e-9), first + 1)
    middle = lowest + row * (first + last) / 2
    return VolumeGrid((last - first, side, side), (row, cell, cell), (middle, 0.0, 0.0))


def of_the_scan(texts: list[str]) -> list[str]:
    """Warnings that accuse the scan, not the voxels or the work of an iterative method: cells are
    too large for edges in clear data, and corners of the grid lie beyond the field of view."""
    own = ("the voxels are too coarse", "are missed by some views", "PWLS stopped", "not trained")
    return [text for text in texts if not any(part in text for part in own)]


def dimmed(drawn: Drawn, photons: tuple[float, float]) -> Drawn:
    """The same scan with photons a reading in air drawn anew, between two numbers."""
    low, high = (math.log(bound) for bound in photons)
    rng = np.random.default_rng([drawn.seed, 4])
    dim = replace(drawn, photons=math.exp(rng.uniform(low, high)))
    rightly = [*drawn.rightly, "photons a reading: how dark"]
    shone = transmissions(dim.geometry, dim.solids, **dim.options)
    if float((dim.photons * dim.profile * shone).min()) < 2.0 * fewest(dim.electronic_noise):
        # Cells that read nothing in any view are dead.
        rightly += ["that their number is not known", "% can be interpolated"]
    return replace(dim, rightly=tuple(rightly))


CAUSES = ("centre", "scale", "step", "roll")


def misdescribed(drawn: Drawn, cause: str, size: float) -> tuple[Any, Any]:
    """Line integrals of a scan and a geometry that is wrong by a size of one cause, as
    ``geometry_test`` counts it."""
    g, shone = drawn.geometry, None
    if cause == "roll":  # each row beside its place
        rows = []
        for height in g.row_positions:
            moved = g.offset[1] - size * float(height)
            row = replace(g, rows=1, offset=(float(height), moved))
            rows.append(transmissions(row, drawn.solids, **drawn.options))
        shone = np.concatenate(rows, 1)
    wrong = g
    if cause == "step":
        wrong = replace(g, angles=g.angles / (1.0 + size))
    elif cause in ("centre", "scale"):
        cone = isinstance(g, ConeBeam)
        pitch, offset = (g.pitch[1], g.offset[1]) if cone else (g.pitch, g.offset)
        factor, shift = (1.0, size * pitch) if cause == "centre" else (1.0 / (1.0 + size), 0.0)
        pitch, offset = factor * pitch, factor * offset + shift
        wrong = replace(
            g,
            pitch=(g.pitch[0], pitch) if cone else pitch,
            offset=(g.offset[0], offset) if cone else offset,
        )
    scan = repair_defects(drawn.scan(wrong, shone))[0]
    return scan.line_integrals(), wrong


def measured(options: argparse.Namespace) -> int:
    """The table of errors that are found, named and covered; 1 if less than nine of ten sizes
    lie within their ±."""
    table = {cause: np.zeros(4, int) for cause in CAUSES}
    for seed in range(options.first, options.first + options.n):
        drawn = draw(seed, kind=options.kind, readings=options.readings)
        rng = np.random.default_rng([seed, 2])
        causes = [
            c
            for c in CAUSES
            if (c != "roll" or drawn.kind == "cone") and (c != "scale" or drawn.kind != "parallel")
        ]
        cause = str(rng.choice(causes))
        low, high = {
            "centre": (0.2, 2.0),
            "scale": (0.01, 0.06),
            "step": (0.003, 0.02),
            "roll": (0.01, 0.06),
        }[cause]
        size = float(rng.choice((-1, 1)) * rng.uniform(low, high))
        lines, wrong = misdescribed(drawn, cause, size)
        test = geometry_test(lines, wrong)
        words = {
            "centre": "rotation centre",
            "scale": "fan angles",
            "step": "steps between",
            "roll": "rolled",
        }
        named = any(words[cause] in text for text in test.findings)
        covered = named and abs(test.sizes[cause] - size) <= 2.0 * test.errors[cause]
        table[cause] += (1, bool(test.findings), named, covered)
        if named and not covered:
            said = f"{test.sizes[cause]:.4g} ± {2 * test.errors[cause]:.2g}"
            print(f"{seed} | {drawn.text}\n      {cause} {size:.4g}, said {said}")
    print(f"\n{'cause':10}{'scans':>8}{'found':>8}{'named':>8}{'within ±':>10}")
    for cause, (count, found, named, covered) in table.items():
        print(f"{cause:10}{count:8}{found:8}{named:8}{covered:10}")
    named, covered = (sum(int(row[k]) for row in table.values()) for k in (2, 3))
    return int(covered < 0.9 * named)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--n", type=int, default=500, help="scans (500)")
    parser.add_argument("--first", type=int, default=0, help="the first one's seed (0)")
    parser.add_argument("--seed", type=int, help="only this one")
    parser.add_argument("--kind", choices=KINDS, help="only such scans")
    parser.add_argument("--method", choices=("fbp", "pwls", "mbir"), help="reconstruct with it")
    parser.add_argument(
        "--photons", type=float, nargs=2, help="a reading in air, between two numbers"
    )
    parser.add_argument("--readings", type=int, default=600_000, help="the most of a scan")
    parser.add_argument(
        "--errors",
        action="store_true",
        help="wrong descriptions instead: are they found and measured?",
    )
    options = parser.parse_args()
    logging.getLogger("recon").setLevel(logging.ERROR)
    torch.set_num_threads(1)
    if options.errors:
        return measured(options)
    seeds = (
        [options.seed]
        if options.seed is not None
        else range(options.first, options.first + options.n)
    )
    drawn_of, alarmed, texts = Counter[str](), Counter[str](), Counter[str]()
    left_out = 0
    for seed in seeds:
        drawn = draw(seed, kind=options.kind, readings=options.readings)
        if options.photons:
            drawn = dimmed(drawn, tuple(options.photons))
        if options.method in ("pwls", "mbir") and not held_by_a_grid(drawn):
            left_out += 1
            continue
        drawn_of[drawn.kind] += 1
        found = alarms(drawn, options.method)
        if found:
            alarmed[drawn.kind] += 1
            texts.update(text.split(":")[0][:60] for text in found)
            print(
                f"{seed} | {drawn.text}; {drawn.photons:.0f} photons",
                *(f"      {text[:170]}" for text in found),
                sep="\n",
                flush=True,
            )
    print(f"\n{'kind':10}{'scans':>8}{'alarms':>8}")
    for kind in KINDS:
        print(f"{kind:10}{drawn_of[kind]:8}{alarmed[kind]:8}")
    print(f"{'all':10}{drawn_of.total():8}{alarmed.total():8}")
    if left_out:
        print(f"left out: {left_out} scans of objects that no grid within the rows holds")
    for text, count in texts.most_common():
        print(f"{count:6}  {text}")
    return int(alarmed.total() > 0)


if __name__ == "__main__":
    sys.exit(main())
