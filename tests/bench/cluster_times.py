"""Times of jobs on two workers: ``python tests/bench/cluster_times.py [overhead|speedup]``, one minute or ten.

``overhead``: jobs that sleep for 1 s on two processes, and on two workers of Dask. They take no processor, so that the
machine need not be idle. Overhead: what each worker's jobs took beyond their sleep, by the wall, from the first job's
start (everything loaded) to the last one's end.

``speedup`` needs two idle cores: ``torchpcct evaluate`` of a small task with one process of one thread, with one of two
threads, and with two of one each, kernels compiled and loaded before the clock starts.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from cluster_kills import TASK
from results import write_results

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "helpers"))
METHODS = ["fbp:soft", "tv@fbp:soft", "pwls", "mbir"]
JOBS = 20


def _on_two(jobs: Any, executor: Any) -> float:
    from recon.evaluate.execute import run

    with tempfile.TemporaryDirectory() as folder:
        run(jobs(2, 0.5), Path(folder), executor)  # both workers have loaded what jobs need
        start = time.perf_counter()
        run(jobs(JOBS, 1.0), Path(folder), executor)
        return time.perf_counter() - start


def overhead() -> dict[str, Any]:
    """Of a job of 1 s, in per cent."""
    import distributed
    from some_jobs import waits

    from recon.evaluate.execute import Cluster, Job, Processes

    def jobs(number: int, seconds: float) -> list[Any]:
        return [Job(f"{k}", waits, (seconds,)) for k in range(number)]

    found = {}
    with Processes(2, 1) as executor:
        found["processes"] = _on_two(jobs, executor)
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as workers:
        cluster = Cluster(workers.scheduler_address)
        found["dask"] = _on_two(jobs, cluster)
        cluster.shutdown()
    return {f"{name}, %": round(100 * (seconds / (JOBS / 2) - 1), 2) for name, seconds in found.items()}


def speedup() -> dict[str, Any]:
    """Seconds of the same evaluation, and how many times faster two workers of one thread are."""
    from recon.evaluate.execute import Processes
    from recon.evaluate.experiment import evaluate

    found = {}
    with tempfile.TemporaryDirectory() as top:
        task = Path(top) / "insert.yaml"
        # On the voxels that MBIR's network is for.
        task.write_text(TASK.replace("voxel_mm: 0.4", "voxel_mm: 0.2"), encoding="utf-8")
        for workers, threads in ((1, 1), (1, 2), (2, 1)):
            with Processes(workers, threads) as executor:
                for n, part in ((8 * workers, "warm"), (24, "timed")):
                    start = time.perf_counter()
                    evaluate(task, METHODS, exposures_s=[10.0, 20.0], n=n, seed=1000 * (part == "warm"),
                             folder=f"{top}/{workers}x{threads}/{part}", executor=executor)  # fmt: skip
                found[f"{workers} x {threads}"] = round(time.perf_counter() - start, 2)
    one, threads_, two = found.values()
    return {"seconds": found, "times faster than 1 x 1": round(one / two, 2), "than 1 x 2": round(threads_ / two, 2)}


_LOAD = [round(x, 2) for x in os.getloadavg()]

if __name__ == "__main__":
    what = sys.argv[1] if sys.argv[1:] else "overhead"
    path = HERE / "cluster_times.json"
    kept = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    made = {
        "command": " ".join(sys.argv),
        "date": time.strftime("%Y-%m-%d"),
        "cores": os.cpu_count(),
        "load before": _LOAD,
    }
    kept[what] = {"overhead": overhead, "speedup": speedup}[what]() | made
    print(json.dumps(kept[what], indent=1))
    write_results(HERE, "cluster_times", kept, f"{json.dumps(kept)}\n")
