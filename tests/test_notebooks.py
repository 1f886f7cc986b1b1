"""The notebooks run at quick scale, and what is stored of them is whole."""

import ast
import os
import re
import subprocess
import sys
from importlib import util
from pathlib import Path

import nbformat
import pytest

FOLDER = Path(__file__).parents[1] / "notebooks"
NAMES = sorted(p.name for p in FOLDER.glob("*.ipynb"))


def outputs(notebook):
    return [
        output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs
    ]


def pictures(notebook):
    return [o for o in outputs(notebook) if "image/png" in o.get("data", {})]


def code_lines(notebook):
    sources = (cell.source for cell in notebook.cells if cell.cell_type == "code")
    return [line for source in sources for line in source.splitlines() if line.strip()]


def run(name, folder, timeout, smaller=()):
    """The notebook executed by the build tool in ``folder``, away from the repository.

    ``smaller``: pairs of what stands in its code and what stands there instead, so that it computes
    less. Every line runs all the same.
    """
    path = folder / name
    notebook = nbformat.read(FOLDER / name, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for old, new in smaller:
        assert any(old in cell.source for cell in cells), f"{name} has no {old}"
        for cell in cells:
            cell.source = cell.source.replace(old, new)
    nbformat.write(notebook, path)
    done = subprocess.run(
        [sys.executable, FOLDER / "execute.py", "--quick", path],
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    notebook = nbformat.read(path, as_version=4)
    assert not [o for o in outputs(notebook) if o.output_type == "error"]
    return notebook


@pytest.mark.parametrize("name", NAMES)
def test_stored_notebook_is_whole(name):
    path = FOLDER / name
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert path.stat().st_size < 1_000_000
    cells = [c for c in notebook.cells if c.cell_type == "code" and c.source.strip()]
    assert [c.execution_count for c in cells] == list(range(1, len(cells) + 1))
    assert pictures(notebook)
    assert not [o for o in outputs(notebook) if o.output_type in ("error", "stream")]
    shown = "".join(str(o) for o in outputs(notebook) if "image/png" not in o.get("data", {}))
    for place in ("/home/", "/tmp/", "/work/", os.sep + "Users" + os.sep):
        assert place not in shown


DELETING = {"unlink", "remove", "rmtree", "rmdir", "removedirs", "rename", "replace", "move"}
WRITING = {"save", "File", "write_text", "write_bytes", "savefig", "imwrite", "open"}


def harms(source):
    """Calls of an example that delete or move a file, or write one whose name a user may have
    given to theirs."""
    found = []
    for call in (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)):
        name = getattr(call.func, "attr", getattr(call.func, "id", ""))
        owner = getattr(getattr(call.func, "value", None), "id", "")
        modes = [
            a.value
            for a in call.args[1:]
            if isinstance(a, ast.Constant) and isinstance(a.value, str)
        ]
        reads = name in ("File", "open") and not any(set(mode) & set("wax+") for mode in modes)
        # A name by itself lies in the folder where the notebook runs, which is the user's.
        bare = call.args and isinstance(call.args[0], ast.Constant | ast.Name | ast.JoinedStr)
        deletes = (
            name in DELETING
            and owner in ("os", "shutil", "Path", "")
            and bool(owner or not call.args)
        )
        if deletes or name in ("unlink", "rmtree") or (name in WRITING and not reads and bare):
            found.append(ast.unparse(call))
    return found


def test_a_harmful_example_is_found():
    """What the scan below looks for: ``your_own_data.ipynb`` once overwrote and deleted the
    user's ``tooth.h5``."""
    source = """
with h5py.File("tooth.h5", "w") as file: pass
for name in ("tooth.h5", "tooth.mha"): Path(name).unlink()
shutil.rmtree("tooth_dicom")
volume.save(name)
volume.save(work / name)
h5py.File("theirs.h5", "r")
text.replace("a", "b")
"""
    assert len(harms(source)) == 4


@pytest.mark.parametrize("name", NAMES)
def test_no_notebook_writes_or_deletes_what_it_has_not_made(name):
    notebook = nbformat.read(FOLDER / name, as_version=4)
    code = [c.source for c in notebook.cells if c.cell_type == "code"]
    plain = "\n".join(
        line for source in code for line in source.splitlines() if not line.startswith("%")
    )
    assert not harms(plain)


def test_no_example_of_the_readme_writes_onto_its_input():
    text = (FOLDER.parent / "README.md").read_text(encoding="utf-8")
    for block in re.findall(r"```python\n(.*?)```", text, re.S):
        assert not [call for call in harms(block) if ".save(" not in call]
        read = set(re.findall(r"open_scan\(\"(.*?)\"", block))
        assert not read & set(re.findall(r"save\(\"(.*?)\"", block))


@pytest.mark.parametrize("name", NAMES)
def test_stored_notebook_is_of_the_shipped_weights(name):
    """A picture of old weights once stood there, in which MBIR was noisier than FBP."""
    from recon.mbir.mbir import Mbir

    notebook = nbformat.read(FOLDER / name, as_version=4)
    if "mbir" in "".join(c.source for c in notebook.cells if c.cell_type == "code"):
        stored = notebook.metadata.get("torchpcct", {}).get("weights_sha256")
        assert stored == Mbir.load().weights_sha256, (
            f"execute it again: python notebooks/execute.py notebooks/{name}"
        )


@pytest.mark.parametrize("name", NAMES)
def test_stored_notebook_is_of_the_sources_as_they_are(name):
    """A picture of an older program, 47 of 255 grey levels off, once stood there under weights
    that were right."""
    stored = (
        nbformat.read(FOLDER / name, as_version=4)
        .metadata.get("torchpcct", {})
        .get("sources_sha256")
    )
    again = f"execute it again: python notebooks/execute.py notebooks/{name}"
    if stored is None:
        pytest.skip(f"stored before digests of sources were kept; {again}")
    assert stored == _execute().sources_digest(name), again


def test_the_digest_of_a_notebook_sees_code_alone(tmp_path, monkeypatch):
    script = _execute()
    assert set(script.MADE_BY) == set(NAMES)
    assert all(
        (script.ROOT / entry).exists() for entries in script.MADE_BY.values() for entry in entries
    )
    monkeypatch.setattr(script, "ROOT", tmp_path)
    monkeypatch.setattr(script, "MADE_BY", {"n": ("a.py", "folder")})
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "b.yaml").write_text("x: 1", encoding="utf-8")

    def digest(text):
        (tmp_path / "a.py").write_text(text, encoding="utf-8")
        return script.sources_digest("n")

    first = digest('"""Doc."""\ndef f(x):\n    """What."""\n    return x + 1\n')
    assert (
        digest('"""Other."""\n# a comment\ndef f(x):\n    """Else."""\n    return (x + 1)\n')
        == first
    )
    assert digest('"""Doc."""\ndef f(x):\n    """What."""\n    return x + 2\n') != first
    last = digest("x = 1")
    (tmp_path / "folder" / "b.yaml").write_text("x: 2", encoding="utf-8")
    assert script.sources_digest("n") != last


def _execute():
    spec = util.spec_from_file_location("execute", FOLDER / "execute.py")
    script = util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


def test_first_scan_is_short():
    assert len(code_lines(nbformat.read(FOLDER / "first_scan.ipynb", as_version=4))) < 25


@pytest.mark.extended
def test_first_scan_runs(tmp_path):
    smaller = (("492", "123"), ("(51, 45, 45)", "(27, 31, 31)"))
    assert len(pictures(run("first_scan.ipynb", tmp_path, 600, smaller))) == 1


@pytest.mark.extended
def test_your_own_data_runs(tmp_path):
    pytest.importorskip("algotom")
    (tmp_path / "tooth.h5").write_bytes(b"the user's own")
    smaller = (("axis = 301", "axis = 151"), ('"FBP, soft": 8, "PWLS, 0.3": 3', '"FBP, soft": 2'))
    notebook = run("your_own_data.ipynb", tmp_path, 1800, smaller)
    assert len(pictures(notebook)) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["tooth.h5", "your_own_data.ipynb"]
    assert (tmp_path / "tooth.h5").read_bytes() == b"the user's own"
    texts = [
        o.data["text/markdown"] for o in outputs(notebook) if "text/markdown" in o.get("data", {})
    ]
    quieter = {
        row.split(" | ")[0]: float(row.split(" | ")[-1].rstrip(" |"))
        for row in texts[2].splitlines()[2:]
    }
    assert quieter["| FBP, ram-lak"] == 1.0
    assert abs(quieter["| FBP, soft"] - 1.0) < 0.1  # a blur of the reference
    assert quieter["| PWLS, 0.03"] > 1.5


@pytest.mark.extended
def test_benchmark_runs(tmp_path):
    inset = "rois={}, grid=type(task.grid)((27, 31, 31), 0.2, task.grid.center)"
    smaller = (("presets.pcct(views=246)", f"presets.pcct(views=123), {inset}"),)
    notebook = run("fbp_vs_mbir.ipynb", tmp_path, 3600, smaller)
    assert len(pictures(notebook)) == 3
    text = "\n".join(o.data.get("text/markdown", "") for o in outputs(notebook) if "data" in o)
    assert "The Cramér–Rao bound" in text


@pytest.mark.extended
def test_reading_a_plaque_runs(tmp_path):
    smaller = (("(51, 45, 45)", "(31, 41, 41)"), ("4.5), 25", "4.5), 15"))
    notebook = run("reading_a_plaque.ipynb", tmp_path, 1800, smaller)
    (text,) = (
        o.data["text/markdown"] for o in outputs(notebook) if "text/markdown" in o.get("data", {})
    )
    assert float(text.split("core: ")[1].split(".\n")[0]) > 0.9  # the scan holds a core


@pytest.mark.extended
def test_train_your_own_prior_runs(tmp_path):
    smaller = (
        ("STEPS = 20", "STEPS = 2"),
        ("views=492", "views=123"),
        ("duty=1 / 4", "duty=1 / 16"),
        ("(51, 45, 45)", "(27, 31, 31)"),
    )
    notebook = run("train_your_own_prior.ipynb", tmp_path, 3600, smaller)
    texts = [
        o.data["text/markdown"] for o in outputs(notebook) if "text/markdown" in o.get("data", {})
    ]
    assert "weights.safetensors" in texts[0]
    noise = [float(row.split(" | ")[-1].rstrip(" |")) for row in texts[1].splitlines()[2:]]
    assert len(noise) == 3
    assert noise[2] < noise[0]  # the weights that ship, FBP
    assert [path.name for path in tmp_path.iterdir()] == ["train_your_own_prior.ipynb"]


@pytest.mark.extended
def test_a_full_run_is_a_full_run(tmp_path):
    """The switch is found in the cell itself: a tag once was lost, and ``--full`` ran the quick
    version. Without an option it stays."""
    written = {}
    for name, source in (
        ("switch", "QUICK = True\nassert not QUICK"),
        ("none", "quick = True"),
        ("stored", "QUICK = False\nassert not QUICK"),
    ):
        written[name] = tmp_path / f"{name}.ipynb"
        notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source)])
        nbformat.write(notebook, written[name])
    for words, status, said in (
        (["--full", written["switch"], written["none"]], 1, "no line QUICK = True"),
        ([written["stored"]], 0, "stored.ipynb: "),
    ):
        command = [sys.executable, FOLDER / "execute.py", *words]
        done = subprocess.run(command, capture_output=True, text=True, timeout=1200, check=False)
        assert done.returncode == status, done.stderr
        assert said in done.stderr
        assert "switch.ipynb: " in done.stderr or status == 0
