"""The package as a whole: what it exports, what imports what, how fast it loads."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def imports(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (a.name.split(".")[0] for a in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield (node.module or "").split(".")[0]


@pytest.mark.parametrize(("package", "forbidden"), [("torchpcct", {"recon", "train"}), ("recon", {"train"})])
def test_data_flows_one_way(package, forbidden):
    """torchpcct ← recon ← train; only the command line, which joins them, may look ahead."""
    for path in (ROOT / package).rglob("*.py"):
        if path.name != "cli.py":
            assert not forbidden & set(imports(path)), path


def test_public_names():
    import recon
    import torchpcct

    for name in torchpcct.__all__:
        assert getattr(torchpcct, name) is not None
    assert callable(torchpcct.acquire)
    assert callable(recon.fbp)
    assert callable(recon.reconstruct)
    with pytest.raises(AttributeError, match="no attribute"):
        _ = torchpcct.nonsense


def test_import_time_beyond_torch():
    code = (
        "import torch, numpy, time; t = time.process_time(); import torchpcct, recon; "
        "from torchpcct import Projector, acquire; print(time.process_time() - t)"
    )
    times = [float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
             for _ in range(2)]  # fmt: skip
    assert min(times) < 1.5


def test_continuous_integration_runs_the_readme():
    commands = [
        line
        for line in (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
        if line.startswith("python3 -m venv")
    ]
    assert len(commands) == 2
    assert commands[1] in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_library_does_not_print():
    for package in ("torchpcct", "recon"):
        for path in (ROOT / package).rglob("*.py"):
            if path.name in ("cli.py", "__main__.py"):
                continue
            calls = [n for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.Call)]
            assert not [c for c in calls if isinstance(c.func, ast.Name) and c.func.id == "print"], path
