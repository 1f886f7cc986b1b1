"""Execute notebooks and store them with their outputs: ``python notebooks/execute.py
[--quick | --full] [notebook …]``.

Without an option each is executed at the scale that it is stored at: that is what renews all of
them after a change.

The metadata keep the hash of the weights that MBIR ran with and the digest of the sources that made
what is shown (:func:`sources_digest`): tests compare both with what there is now."""

from __future__ import annotations

import argparse
import ast
import hashlib
import re
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

from recon.mbir.mbir import Mbir

HERE = Path(__file__).parent
ROOT = HERE.parent
_PLAQUE = ("torchpcct/scene/plaque", "torchpcct/scanner/presets.py", "torchpcct/counting_noise.py")
_MBIR = ("recon/mbir", "recon/gram", "recon/least_squares/inset_problem.py")
_FBP = ("recon/analytic/fbp.py", "recon/analytic/inset.py", "recon/analytic/ramp.py")
MADE_BY: dict[str, tuple[str, ...]] = {
    "first_scan.ipynb": (*_PLAQUE, *_FBP, *_MBIR),
    "fbp_vs_mbir.ipynb": (
        *_PLAQUE,
        *_FBP,
        *_MBIR,
        "recon/evaluate/measure.py",
        "recon/evaluate/estimates.py",
    ),
    "reading_a_plaque.ipynb": (*_PLAQUE, *_FBP, "recon/vessel"),
    "train_your_own_prior.ipynb": (
        *_PLAQUE,
        *_FBP,
        *_MBIR,
        "train/loop.py",
        "train/objective.py",
        "train/configs/quick.yaml",
    ),
    "your_own_data.ipynb": (
        *_FBP,
        "recon/least_squares/pwls.py",
        "torchpcct/formats/preprocess.py",
        "torchpcct/metrics/half_split.py",
    ),
}
"""Files and folders whose change may change what a notebook shows, no more than these: the method
that it shows and the scan that it shows it on."""
PARAMETER = re.compile(r"^QUICK = (True|False)$", re.MULTILINE)


def sources_digest(name: str) -> str:
    """SHA-256 of the sources of :data:`MADE_BY`, without their comments and docstrings, which show
    nowhere.

    Args:
        name: of the notebook.
    """
    total = hashlib.sha256()
    for entry in MADE_BY[name]:
        path = ROOT / entry
        found = (
            [path]
            if path.is_file()
            else sorted(f for e in ("*.py", "*.yaml") for f in path.rglob(e))
        )
        for file in found:
            text = file.read_text(encoding="utf-8")
            shown = ast.dump(_bare(ast.parse(text))) if file.suffix == ".py" else text
            total.update(f"{file.relative_to(ROOT).as_posix()}\n{shown}\n".encode())
    return total.hexdigest()


def _bare(tree: ast.Module) -> ast.Module:
    """Without the texts that stand alone: docstrings of modules, classes, functions and
    attributes."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [
                n
                for n in body
                if not (isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant))
            ]
    return tree


def execute(path: Path, quick: bool | None = None, timeout: int = 7200) -> float:
    """Run one notebook in its own folder and write it back whole; returns the time in s.

    Args:
        path: of the notebook.
        quick: what its switch ``QUICK`` is set to; None: it stays.
        timeout: for a cell, s.

    Raises:
        ValueError: a full run of a notebook that has no switch ``QUICK``.
        nbclient.exceptions.CellExecutionError: a cell failed; the file is left as it was.
    """
    start = time.perf_counter()
    notebook = nbformat.read(path, as_version=4)
    found = 0
    for cell in notebook.cells:
        if cell.cell_type == "code" and quick is not None:
            cell.source, count = PARAMETER.subn(f"QUICK = {quick}", cell.source)
            found += count
    if quick is False and not found:
        raise ValueError(
            f"{path} has no line QUICK = True in a code cell, so there is no full run of it"
        )
    folder = {"metadata": {"path": str(path.resolve().parent)}}
    NotebookClient(
        notebook, timeout=timeout, kernel_name="python3", resources=folder, record_timing=False
    ).execute()
    # What depends on the machine says nothing to the reader and would change with every run.
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
        "torchpcct": {
            "weights_sha256": Mbir.load().weights_sha256,
            **({"sources_sha256": sources_digest(path.name)} if path.name in MADE_BY else {}),
        },
    }
    part = path.with_suffix(".part")
    nbformat.write(notebook, part)
    part.replace(path)
    return time.perf_counter() - start


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description="Execute notebooks in place and keep their outputs."
    )
    parser.add_argument(
        "notebooks", nargs="*", type=Path, help="files (default: all beside this script)"
    )
    scale = parser.add_mutually_exclusive_group()
    scale.add_argument(
        "--quick", action="store_true", default=None, help="few views and draws: QUICK = True"
    )
    scale.add_argument(
        "--full",
        action="store_false",
        dest="quick",
        default=None,
        help="all views and more draws: QUICK = False",
    )
    options = parser.parse_args()
    for path in options.notebooks or sorted(HERE.glob("*.ipynb")):
        seconds = execute(path, options.quick)
        sys.stderr.write(f"{path}: {seconds:.0f} s, {path.stat().st_size / 1e3:.0f} kB\n")


if __name__ == "__main__":
    main()
