"""A campaign beyond one machine, computed before it is paid for: ``python
notebooks/campaign/plan.py`` writes plan.md.

Times of jobs, bytes and what the machinery takes per job are measured and stand in
``measured.json``; the schedule of the campaign is simulated from them, with workers that die and
nodes that are slow.
"""

from __future__ import annotations

import heapq
import json
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
DRAWS = 10_000
TASKS = 1000
METHODS = 10
BLOCKS = (8, 40, 200, 1000)
WORKERS = (64, 256, 1024, 4096)
SLOW_SHARE = 0.02
SLOW = 3.0
DEATHS_PER_HOUR = 1e-3
"""Nodes that are slow and how much; deaths of a worker per hour (of spot instances some 5 %:
0.05)."""
EUROS_PER_CORE_HOUR = 0.04
PARTS = 5
"""Runs that the campaign is cut into."""


def makespan(
    jobs: int, seconds: float, spread: float, per_job_s: float, workers: int, start_s: float
) -> float:
    """Seconds until the last job is done: workers take the next one when they are free, one client
    hands them out.

    Args:
        jobs: number; seconds, spread: of one, log-normal.
        per_job_s: the client's and scheduler's own time for a job, one after another.
        workers: number; start_s: until each has loaded and compiled.
    """
    rng = np.random.default_rng(0)
    pace = np.where(rng.random(workers) < SLOW_SHARE, SLOW, 1.0)
    free = [(start_s * pace[w], w) for w in range(workers)]
    heapq.heapify(free)
    handed, end = 0.0, 0.0
    for length in seconds * rng.lognormal(-(spread**2) / 2, spread, jobs):
        at, w = heapq.heappop(free)
        handed = max(handed + per_job_s, at)
        done = handed + length * pace[w]
        if rng.random() < DEATHS_PER_HOUR * length / 3600.0:  # half of it is done again
            done += 0.5 * length * pace[w] + start_s
        end = max(end, done)
        heapq.heappush(free, (done, w))
    return end


def main() -> None:
    """Write the page."""
    m = json.loads((HERE / "measured.json").read_text(encoding="utf-8"))
    draw, volume = m["seconds_draw"], float(np.mean(list(m["seconds_volume"].values())))
    realisation = draw + 2 * METHODS * volume
    scan, known = m["seconds_scan"], m["seconds_known"] * METHODS
    total = TASKS * (DRAWS * realisation + scan + known)
    lines = [
        "# A campaign of 10 000 draws × 1000 tasks × 10 methods",
        "",
        f"Computed by `plan.py` from `measured.json` ({m['how']}).",
        "",
        "| | |",
        "|---|---|",
        f"| a realisation, all methods, one core | {realisation:.1f} s (draws {draw:.1f} s, a "
        f"volume {volume:.2f} s on average) |",
        f"| all of it | {total / 3600:,.0f} core hours, {total / 3600 * EUROS_PER_CORE_HOUR:,.0f} "
        f"€ at {EUROS_PER_CORE_HOUR} € a core hour |",
        f"| kept | {TASKS * METHODS * DRAWS * m['bytes_realisation'] / 1e12:.2f} TB of cached "
        f"results, and {TASKS * m['bytes_scans'] / 1e12:.2f} TB of noise-free scans |",
        f"| network, disk not shared | the results once, and {m['bytes_job'] / 1e3:.0f} kB of "
        "arguments a job |",
        f"| memory | {m['mib_worker']:.0f} MiB a worker |",
        "",
        "## Block size and workers",
        "",
        "Realisations of a block are computed by one job for all methods. Share of the workers' "
        f"time that computes, simulated; {100 * SLOW_SHARE:g} % of the nodes are {SLOW:g} times "
        f"slower, {DEATHS_PER_HOUR:g} deaths a worker and hour:",
        "",
        "| block | jobs | a job | files | " + " | ".join(f"{w} workers" for w in WORKERS) + " |",
        "|---|" + "---|" * (3 + len(WORKERS)),
    ]
    best: dict[int, tuple[float, int]] = {}
    for block in BLOCKS:
        jobs, seconds = TASKS * DRAWS // block, block * realisation
        row = [f"{block}", f"{jobs:,}", f"{seconds / 60:.0f} min", f"{jobs * METHODS:,}"]
        for workers in WORKERS:
            n = jobs // PARTS
            end = makespan(
                n, seconds, m["spread"], m["seconds_per_job"], workers, m["seconds_start"]
            )
            share = n * seconds / (workers * end)
            best[workers] = max(best.get(workers, (0.0, 0)), (round(share, 2), block))
            row.append(f"{100 * share:.0f} %, {end * PARTS / 86400:.1f} d")
        lines.append("| " + " | ".join(row) + " |")
    rate, files = 1.0 / m["seconds_per_job"], DRAWS // 8 * TASKS * METHODS
    chosen = ", ".join(
        f"{b} with {w} workers ({100 * share:.0f} %)" for w, (share, b) in best.items()
    )
    lines += [
        "",
        f"Each cell: one of {PARTS} runs of {TASKS // PARTS} tasks, and the days for all. Best: "
        f"{chosen}.",
        "",
        "## What breaks first",
        "",
        "1. Stragglers: a run ends with the last job of a slow node, so jobs must be short beside "
        "a run's share of a worker. This is what the table shows, and it forbids large blocks "
        "long before anything asks for them.",
        f"2. The result store: blocks of 8 make {files:,} files, where parallel file systems allow "
        "some 10⁶ to 10⁷ a user; to see which are there takes a repeated command "
        f"{files * m['seconds_has'] / 3600:.1f} h. Hence runs of {TASKS // PARTS} tasks, each "
        "folder packed or cleared when its report stands; blocks of 40 where stragglers allow.",
        f"3. The client's memory: about {m['client_bytes_job'] / 1e3:.1f} kB a job, "
        f"{m['client_bytes_job'] * TASKS * DRAWS / 8 / 1e9:.1f} GB for all tasks at once in "
        "blocks of 8.",
        f"4. The scheduler, last: {1e3 * m['seconds_per_job']:.1f} ms of client a job, {rate:.0f} "
        f"jobs a second, feed {rate * 8 * realisation:,.0f} workers with blocks of 8.",
        "",
        "So the block of `recon/evaluate/measure.py` stays at 8; what a campaign of this size "
        "lacks is a store that packs the results of a task into few files.",
        "",
    ]
    (HERE / "plan.md").write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
