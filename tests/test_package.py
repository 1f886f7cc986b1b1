"""The package as a whole: what it exports, and what it loads for that (its shape:
test_layout.py)."""

import ast
import importlib.util
import json
import re
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from fresh_python import run_python
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from parsed import import_statements

ROOT = Path(__file__).parent.parent


SLOW = {
    "matplotlib",
    "h5py",
    "xraydb",
    "spekpy",
    "skimage",
    "kornia",
    "nibabel",
    "safetensors",
    "tensorboard",
    "triton",
}


@pytest.mark.parametrize(
    ("package", "more"), [("torchpcct.scene", {"torch", "numba", "scipy"}), ("recon", set())]
)
def test_importing_loads_nothing_that_is_used_later(package, more):
    """Kernels, figures, files and spectra come with their first use: scenes not even need torch."""
    code = f"import sys, {package}; print(*sys.modules)"
    loaded = set(run_python(code).stdout.split())
    assert not loaded & (SLOW | more)
    assert not {
        m for m in loaded if m.startswith(("torchpcct.", "recon.", "train.")) and "kernel" in m
    }


def test_no_method_loads_the_compiler_of_torch():
    """Which takes more than a second of every process."""
    code = "import sys, recon.api, recon.mbir, recon.evaluate.experiment; print(*sys.modules)"
    loaded = set(run_python(code).stdout.split())
    assert "torch" in loaded
    assert not loaded & {"torch._dynamo", "sympy"}


def test_one_version():
    """It stands in torchpcct/files.py; pyproject.toml reads it there, citation and changelog
    follow."""
    import torchpcct

    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert "version" not in pyproject["project"]
    module, _, name = pyproject["tool"]["setuptools"]["dynamic"]["version"]["attr"].rpartition(".")
    assert getattr(importlib.import_module(module), name) == torchpcct.__version__
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == torchpcct.__version__
    headings = re.findall(
        r"^## (.*)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert headings[:2] == ["Unreleased", torchpcct.__version__]


def test_the_addresses_of_the_project_agree():
    """Whoever hosts it elsewhere changes them in three places; links of badges lead to workflows
    that there are."""
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    source = urls["Source"]
    assert citation["repository-code"] == source
    assert citation["url"] == urls["Documentation"]
    assert urls["Issues"].startswith(source)
    assert urls["Changelog"] == f"{source}/blob/main/CHANGELOG.md"
    assert set(re.findall(r"https://github\.com/[\w-]+/[\w-]+", readme)) == {source}
    workflows = ROOT / ".github" / "workflows"
    assert {
        name
        for name in re.findall(r"actions/workflows/([\w.]+)", readme)
        if (workflows / name).exists()
    } == {"ci.yml"}


def test_workflows_run_what_there_is():
    """They cannot be run here; that they are read and name what exists can be seen."""
    ci, release = (
        yaml.safe_load((ROOT / ".github" / "workflows" / f"{name}.yml").read_text(encoding="utf-8"))
        for name in ("ci", "release")
    )
    steps = [step for job in ci["jobs"].values() for step in job["steps"]]
    assert ".ci/run" in [step.get("run") for step in steps]
    # trusted publishing, and nothing else
    assert release["jobs"]["publish"]["permissions"] == {"id-token": "write"}
    assert release["jobs"]["publish"]["needs"] == "build"
    site = yaml.safe_load((ROOT / ".readthedocs.yaml").read_text(encoding="utf-8"))
    assert (ROOT / site["sphinx"]["configuration"]).is_file()
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "optional-dependencies"
    ]
    assert set(site["python"]["install"][0]["extra_requirements"]) <= set(extras)


def test_articles_of_the_bibliography_can_be_found():
    entries = (
        (ROOT / "notebooks" / "docs" / "references.bib")
        .read_text(encoding="utf-8")
        .strip()
        .splitlines()
    )
    assert len(entries) > 15
    for entry in entries:
        found = re.search(r"doi = \{(10\.\d{4,}/[^\s{}]+)\}|url = \{(https://[^\s{}]+)\}", entry)
        assert found, entry


def test_the_cards_are_those_of_the_weights():
    """card.md is written by hand, training.md and card.json by the training: new weights need
    all three."""
    from recon.mbir.mbir import Mbir

    shipped, folder = Mbir.load(), ROOT / "recon" / "mbir" / "weights"
    assert (
        json.loads((folder / "card.json").read_text())["sha256_of_tensors"]
        == shipped.weights_sha256
    )
    low, high = shipped.model.seen_scale_hu.tolist()
    for name, expected_text in (
        ("training.md", ""),
        ("card.md", f"Noise scales of {low:.0f} to {high:.0f} HU"),
    ):
        text = (folder / name).read_text(encoding="utf-8")
        assert f"`{shipped.weights_sha256[:16]}…`" in text, name
        assert expected_text in text


@pytest.mark.slow
def test_the_wheel_holds_what_is_needed_and_no_more(tmp_path):
    """What it does once installed: tests/bench/wheel.py."""
    spec = importlib.util.spec_from_file_location("wheel", ROOT / "tests/bench/wheel.py")
    bench = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(bench)
    with zipfile.ZipFile(bench.build(tmp_path)) as archive:
        found = {name for name in archive.namelist() if ".dist-info/" not in name}
        (metadata,) = (
            archive.read(n).decode() for n in archive.namelist() if n.endswith("/METADATA")
        )
    source = tmp_path / "source"
    files = {path.relative_to(source).as_posix() for path in source.rglob("*") if path.is_file()}
    packages = ("torchpcct/", "recon/", "train/")
    assert found == {
        name for name in files if name.startswith(packages) and name != "train/experiments.md"
    }
    import torchpcct

    assert f"\nVersion: {torchpcct.__version__}\n" in metadata


MODULES = {
    "yaml": "pyyaml",
    "skimage": "scikit-image",
    "PIL": "pillow",
    "llvmlite": "numba",
    "markdown_it": "markdown-it-py",
}
"""Modules whose package has another name, or comes with one that pins it."""


def test_everything_imported_is_declared_with_a_floor_that_the_constraints_keep():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    listed = [
        *project["dependencies"],
        *(r for extra in project["optional-dependencies"].values() for r in extra),
    ]
    requirements = [r for r in map(Requirement, listed) if r.name != "torchpcct"]
    assert [str(r) for r in requirements if {s.operator for s in r.specifier} != {">="}] == []
    declared = {canonicalize_name(r.name) for r in requirements}
    own = {"torchpcct", "recon", "train", "_typeshed"}  # the last has type checkers alone
    for path in (p for package in own for p in (ROOT / package).rglob("*.py")):
        for node in import_statements(path):
            if isinstance(node, ast.Import):
                names = [a.name for a in node.names]
            else:
                names = [] if node.level else [node.module or ""]
            for top in {n.partition(".")[0] for n in names} - own - sys.stdlib_module_names:
                assert canonicalize_name(MODULES.get(top, top)) in declared, (
                    f"{path}: {top} is not declared"
                )
    pins = (
        Requirement(line)
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if line[:1] not in "# "
    )
    tested = {canonicalize_name(r.name): next(iter(r.specifier)).version for r in pins}
    old = [
        str(r)
        for r in requirements
        if not r.specifier.contains(tested.get(canonicalize_name(r.name), "9999"))
    ]
    assert old == []


def test_continuous_integration_runs_the_readme():
    commands = [
        line
        for line in (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
        if line.startswith("python3 -m venv")
    ]
    assert len(commands) == 2
    assert commands[1] in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
