"""Sound scans drawn at random: how many are told that something is wrong with them?

    python tests/bench/false_alarms.py [--n 500] [--first 0] [--kind cone] [--method fbp] [--readings 600000]

Without ``--method`` only the checks run that :func:`recon.reconstruct` runs for every method; with it the whole
reconstruction, and every warning of its report counts. Each alarm is printed with the seed of its scan; ``--seed N``
looks at one. The exit status is 1 if there is any.
"""

import argparse
import logging
import sys
from collections import Counter
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parent.parent / "helpers"))  # where pytest finds them, too

from sound_scans import KINDS, Drawn, draw

import recon
from recon.analytic.coverage import consistency_warnings
from torchpcct.checks.defects import repair_defects
from torchpcct.checks.readings import reading_warnings


def alarms(drawn: Drawn, method: str | None = None) -> list[str]:
    """What a sound scan is wrongly told."""
    scan = drawn.scan()
    if method is None:
        repaired, texts = repair_defects(scan)
        texts = [*texts, *reading_warnings(repaired), *consistency_warnings(repaired, drawn.grid)]
    else:
        texts = recon.reconstruct(scan, drawn.grid, method).report.get("warnings", [])
    return drawn.wrongly(texts)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--n", type=int, default=500, help="scans (500)")
    parser.add_argument("--first", type=int, default=0, help="the first one's seed (0)")
    parser.add_argument("--seed", type=int, help="only this one")
    parser.add_argument("--kind", choices=KINDS, help="only such scans")
    parser.add_argument("--method", choices=("fbp", "pwls", "mbir"), help="reconstruct with it")
    parser.add_argument("--readings", type=int, default=600_000, help="the most of a scan")
    options = parser.parse_args()
    logging.getLogger("recon").setLevel(logging.ERROR)
    torch.set_num_threads(1)
    seeds = [options.seed] if options.seed is not None else range(options.first, options.first + options.n)
    drawn_of, alarmed, texts = Counter[str](), Counter[str](), Counter[str]()
    for seed in seeds:
        drawn = draw(seed, kind=options.kind, readings=options.readings)
        drawn_of[drawn.kind] += 1
        found = alarms(drawn, options.method)
        if found:
            alarmed[drawn.kind] += 1
            texts.update(text.split(":")[0][:60] for text in found)
            print(f"{seed} | {drawn.text}", *(f"      {text[:170]}" for text in found), sep="\n", flush=True)
    print(f"\n{'kind':10}{'scans':>8}{'alarms':>8}")
    for kind in KINDS:
        print(f"{kind:10}{drawn_of[kind]:8}{alarmed[kind]:8}")
    print(f"{'all':10}{drawn_of.total():8}{alarmed.total():8}")
    for text, count in texts.most_common():
        print(f"{count:6}  {text}")
    return int(alarmed.total() > 0)


if __name__ == "__main__":
    sys.exit(main())
