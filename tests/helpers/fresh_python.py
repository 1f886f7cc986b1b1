"""A Python process of its own, which finds what this one finds."""

import os
import subprocess
import sys


def run_python(code, *arguments, check=True, cwd=None, **variables):
    """Run ``code``, with changed ``variables`` of the environment: status, standard output and
    error as text."""
    path = os.pathsep.join(p for p in sys.path if p)
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": path, **variables},
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0 or not check, done.stderr[-3000:]
    return done
