"""Execute notebooks and store them with their outputs: ``python notebooks/execute.py [--full] [notebook …]``.

The metadata keep the hash of the weights that MBIR ran with: a test compares it with that of the shipped ones."""

from __future__ import annotations

import argparse
import re
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

from recon.mbir.mbir import Mbir

HERE = Path(__file__).parent
PARAMETER = re.compile(r"^QUICK = (True|False)$", re.MULTILINE)


def execute(path: Path, quick: bool, timeout: int = 7200) -> float:
    """Run one notebook in its own folder and write it back whole; returns the time in s.

    Raises:
        ValueError: a full run of a notebook that has no switch ``QUICK``.
        nbclient.exceptions.CellExecutionError: a cell failed; the file is left as it was.
    """
    start = time.perf_counter()
    notebook = nbformat.read(path, as_version=4)
    found = 0
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.source, count = PARAMETER.subn(f"QUICK = {quick}", cell.source)
            found += count
    if not quick and not found:
        raise ValueError(f"{path} has no line QUICK = True in a code cell, so there is no full run of it")
    folder = {"metadata": {"path": str(path.resolve().parent)}}
    NotebookClient(notebook, timeout=timeout, kernel_name="python3", resources=folder, record_timing=False).execute()
    # What depends on the machine says nothing to the reader and would change with every run.
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
        "torchpcct": {"weights_sha256": Mbir.load().weights_sha256},
    }
    part = path.with_suffix(".part")
    nbformat.write(notebook, part)
    part.replace(path)
    return time.perf_counter() - start


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Execute notebooks in place and keep their outputs.")
    parser.add_argument("notebooks", nargs="*", type=Path, help="files (default: all beside this script)")
    parser.add_argument("--full", action="store_true", help="all views and more realisations: QUICK = False")
    options = parser.parse_args()
    for path in options.notebooks or sorted(HERE.glob("*.ipynb")):
        seconds = execute(path, not options.full)
        sys.stderr.write(f"{path}: {seconds:.0f} s, {path.stat().st_size / 1e3:.0f} kB\n")


if __name__ == "__main__":
    main()
