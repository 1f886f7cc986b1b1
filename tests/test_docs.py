"""The site's examples run, everything public is in its reference, and its gallery keeps to its
word."""

import ast
import doctest
import importlib.util
import inspect
import json
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
import torch
from fresh_python import run_python

import recon
from torchpcct import ConeBeam, Projector, VolumeGrid
from torchpcct.scanner import SiliconDetector, presets
from torchpcct.spectral import contrast_information, weighting_gain
from torchpcct.vector_geometry import VectorGeometry

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "notebooks" / "docs"
GALLERY = sorted((ROOT / "notebooks" / "gallery").glob("[0-9]*.py"))
sys.path.insert(0, str(DOCS))


def test_the_conversions_run():
    """Every line of the conventions page that a reader may copy."""
    found = doctest.testfile(str(DOCS / "explanation" / "conventions.md"), module_relative=False)
    assert found.attempted > 25
    assert not found.failed


@cache
def _functions_of_the_page():
    page = (DOCS / "explanation" / "conventions.md").read_text(encoding="utf-8")
    names = {}
    for example in doctest.DocTestParser().get_examples(page):
        exec(compile(example.source, "conventions.md", "exec"), names)
    return names


def _flat(points, source, first, row, column):
    """Cells of a flat detector, from the source, the centre of cell (0, 0) and the steps to the
    next row and column."""
    return np.array(
        [np.linalg.solve(np.c_[row, column, source - p], source - first)[:2] for p in points]
    ).T


def _turned(angle):
    return np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )


def _astra(points, angle):
    """The vectors of its circular cone beam: 500 and 300 mm, 64 × 128 cells of 1.4 × 1.2 mm."""
    s, c = np.sin(angle), np.cos(angle)
    u, v = 1.2 * np.array([c, s, 0]), np.array([0, 0, 1.4])
    return _flat(
        points, 500 * np.array([s, -c, 0]), 300 * np.array([-s, c, 0]) - 63.5 * u - 31.5 * v, v, u
    )


def _rtk(points, angle):
    """Its projection matrix, then origin and spacing of its projection images; its x, y, z are
    our y, z, x."""
    s, c = np.sin(angle), np.cos(angle)
    x, y, z = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ points[:, [1, 2, 0]].T
    return np.array(
        [-1536 * y / (z - 1000) + 5 + 127.5, (-1536 * x / (z - 1000) - 10 + 204.4) / 0.8]
    )


def _tigre(points, angle):
    """Source on +x, the first row at the lowest z, all turned by the angle; offsets 3 and 12 mm."""
    first = [-536, 0.8 * (0.5 - 512 / 2) + 12, 0.5 - 256 / 2 + 3]
    turn = _turned(angle)
    return _flat(
        points, turn @ [1000.0, 0, 0], turn @ first, np.array([0, 0, 1.0]), turn @ [0, 0.8, 0]
    )


def _catsim(points, angle):
    """Source on +y, modules of one column at angles that grow towards +x, all turned by the
    angle."""
    x, y, z = (points @ _turned(angle) - [0, 541, 0]).T
    column = (np.arctan2(x, -y) + np.arctan(1.25 * 1.0239 / 949)) / (
        2 * np.arctan(1.0239 / 2 / 949)
    ) + 443.5
    # its columns turned over
    return np.array([(z * 949 / np.hypot(x, y) - 0.5 * 1.0988) / 1.0988 + 7.5, 887 - column])


def _dicom_ct_pd(points, angle):
    """Focal spot at (−ρ sin φ, ρ cos φ); element i, counted from 1, at the angle (i − i₀) Δ / d
    counter-clockwise."""
    focus = 595 * np.array([-np.sin(angle), np.cos(angle), 0])
    x, y, z = (points - focus).T
    middle = np.arctan2(-focus[1], -focus[0])
    seen = (np.arctan2(y, x) - middle + np.pi) % (2 * np.pi) - np.pi
    element = 369.625 + seen * 1085.6 / 1.2858
    # its elements turned over
    return np.array([32.5 + z * 1085.6 / np.hypot(x, y) / 1.0947 - 1, 736 - element])


def _ours(points, g):
    """Cells of the first view by the definitions of the conventions page."""
    b = g.angles[0]
    radial, tangential = np.array([np.cos(b), np.sin(b), 0]), np.array([-np.sin(b), np.cos(b), 0])
    back, u, z = -((points - g.sod * radial) @ radial), points @ tangential, points[:, 2]
    mm = np.array([z / back, u / back]) * g.sdd
    if g.detector == "curved":
        mm = np.array([z / np.hypot(back, u), np.arctan2(u, back)]) * g.sdd
    middle = np.array([[g.rows - 1], [g.columns - 1]]) / 2
    return (mm - np.reshape(g.offset, (2, 1))) / np.reshape(g.pitch, (2, 1)) + middle


@pytest.mark.parametrize("name", ["astra", "rtk", "tigre", "catsim", "dicom_ct_pd"])
def test_a_point_is_seen_where_the_other_program_sees_it(name):
    """The conversions against formulas that each program publishes, written here once more, with
    nothing of ours."""
    names = _functions_of_the_page()
    points = np.random.default_rng(1).uniform(-60, 60, (50, 3))
    theirs = {
        "astra": _astra,
        "rtk": _rtk,
        "tigre": _tigre,
        "catsim": _catsim,
        "dicom_ct_pd": _dicom_ct_pd,
    }[name]
    convert = names[f"from_{name}"]
    for angle in (0.0, 1.1, 4.4):
        ours = {
            "astra": lambda a: ConeBeam(
                convert([a], 500.0, 300.0, 128, 1.2).angles, 500, 800, 128, 64, (1.4, 1.2)
            ),
            "rtk": lambda a: convert(
                [np.rad2deg(a)], 1000.0, 1536.0, (512, 256), (0.8, 1.0), (-204.4, -127.5), (10, -5)
            ),
            "tigre": lambda a: convert([a], 1000.0, 1536.0, (256, 512), (1.0, 0.8), (3.0, 12.0)),
            "catsim": lambda a: convert(
                1, 541.0, 949.0, 888, 16, 1.0239, 1.0988, -1.25, 0.5, np.rad2deg(a)
            ),
            "dicom_ct_pd": lambda a: convert(
                [a], 595.0, 1085.6, 736, 64, 1.2858, 1.0947, (369.625, 32.5)
            ),
        }[name](angle)
        # CatSim's cells are flat, and their middles lie on chords: 1e-5 of a cell.
        np.testing.assert_allclose(
            _ours(points, ours), theirs(points, angle), atol=1e-4 if name == "catsim" else 1e-9
        )


@pytest.mark.extended
def test_every_public_name_is_in_the_reference(tmp_path):
    """What ``__all__`` lists, asked of the imported modules, against the pages that Sphinx gets."""
    from pages import public_modules, write_api

    write_api(tmp_path)
    text = "\n".join(p.read_text(encoding="utf-8") for p in tmp_path.glob("*.rst"))
    entries = set()
    for block in re.split(r"(?=\.\. automodule::)", text):
        module = re.match(r"\.\. automodule:: (\S+)", block)
        names = re.findall(r":members: (.*)", block) + re.findall(r"py:data:: (\S+)", block)
        entries |= (
            {(module[1], n.strip()) for line in names for n in line.split(",")} if module else set()
        )
        entries |= (
            {(module[1], n) for n in re.findall(r"^\* ``(\w+)``: :py:obj:", block, re.M)}
            if module
            else set()
        )
    modules = [m for group in public_modules().values() for m, *_ in group]
    wanted = {(m, n) for m in modules for n in getattr(importlib.import_module(m), "__all__", ())}
    assert 300 < len(wanted) <= 500
    assert entries == wanted


def test_a_public_name_has_one_home():
    """The module that defines it; packages hand on what is public there."""
    from pages import canonical, public_modules

    for package, modules in public_modules().items():
        for module, _, others in modules:
            assert module == package or not others, (module, others)
            for name in others:
                home, own = canonical(module, name)
                found = getattr(importlib.import_module(module), name)
                assert inspect.ismodule(found) or own in importlib.import_module(home).__all__


IMPORT = re.compile(r"from ((?:torchpcct|recon|train)[\w.]*) import (\([^)]*\)|[\w, ]+)")


def test_what_the_documentation_imports_is_public():
    from pages import public_modules

    places = [ROOT / "README.md", *(ROOT / "notebooks").rglob("*")]
    texts = {
        p: p.read_text(encoding="utf-8")
        for p in places
        if p.suffix in (".md", ".ipynb") or (p.parent.name == "gallery" and p.suffix == ".py")
    }
    found = {
        (place.name, module, name)
        for place, text in texts.items()
        for module, names in IMPORT.findall(text)
        for name in re.findall(r"\w+", re.sub(r" as \w+|\\n", "", names))
    }
    modules = {m for group in public_modules().values() for m, *_ in group}
    assert len(found) > 40
    assert not [
        (place, module, name)
        for place, module, name in found
        if name not in getattr(importlib.import_module(module), "__all__", ())
        and f"{module}.{name}" not in modules
    ]


def test_the_page_of_energies_says_what_is_computed():
    """Its tables: the factors of three contrasts, and what resolution and shared charge leave."""
    page = (DOCS / "howto" / "energies.md").read_text(encoding="utf-8")
    rows = {
        cells[0]: cells[1:]
        for line in page.splitlines()
        if line.startswith("| ") and (cells := [c.strip() for c in line.strip("| ").split("|")])
    }
    scanner = presets.pcct(views=1, rows=1, columns=3, mode="spectral")
    fat, lumen = {"adipose": 240.0}, ("blood_iodine", "fibrous_tissue")
    for name, contrast in (
        ("lumen with iodine against fibrous tissue", lumen),
        ("fibrous tissue against fat", ("fibrous_tissue", "adipose")),
        ("core against fibrous tissue", ("necrotic_core", "fibrous_tissue")),
    ):
        found = [weighting_gain(scanner, contrast, fat, kind)[1] for kind in ("bins", "energies")]
        assert rows[name] == [f"{f:.2f}" for f in found]

    def information(kind, **changes):
        detector = SiliconDetector("spectral", **changes)
        return contrast_information(scanner.replace(detector=detector), lumen, fat, kind)[1]

    best = information("bins", sigma_kev=0.1)
    tables = [
        table
        for table in re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE)
        if table.startswith(("| resolution", "| shared charge"))
    ]
    for table, column, changes in (
        (tables[0], 3, {"sigma_kev": 1.6}),
        (tables[0], 5, {"sigma_kev": 4.0}),
        (tables[1], 3, {"charge_sharing": 0.1}),
    ):
        _, _, shown, factor = ([c.strip() for c in t.split("|")] for t in table.splitlines())
        weighted = information("bins", **changes)
        assert shown[column + 1] == f"{weighted / best:.3f}"
        assert factor[column + 1] == f"{weighted / information('sum', **changes):.2f}"


@pytest.mark.parametrize("path", GALLERY, ids=lambda p: p.stem)
def test_a_script_of_the_gallery_asks_and_answers(path):
    question = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    assert "?" in question
    assert "print(" in path.read_text(encoding="utf-8")


def test_the_gallery_is_large_enough():
    assert len(GALLERY) >= 12


def test_links_of_the_repository_lead_somewhere():
    """Files that a reader of the repository meets; pages of the site are checked as they are
    built."""
    listed = subprocess.run(
        ["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    found = 0
    for path in (ROOT / name for name in listed.splitlines()):
        for link in re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8")):
            file, _, anchor = link.partition("#")
            if "://" in link or path.is_relative_to(DOCS):
                continue
            found += 1
            assert (path.parent / file).exists(), f"{path}: {link}"
            assert not anchor, f"{path}: {link}"
    assert found > 40


def test_the_limits_say_what_the_hard_cases_say():
    report = json.loads((ROOT / "notebooks/hardcases/report.json").read_text(encoding="utf-8"))
    text = " ".join((ROOT / "notebooks/docs/limits.md").read_text(encoding="utf-8").split())
    unseen, rows = report["verdicts"].get("unseen", 0), len(report["rows"])
    assert (
        f"* {unseen} of the {rows} results of the hard cases are wrong through an error that "
        "these data cannot reveal" in text
    )
    assert f"; {report['silent']} are wrong without a warning although the data could have" in text


def test_the_readme_has_few_figures():
    """At most 40 numerals, code blocks left out (the whole of it has about 60)."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    assert len(re.findall(r"\d+(?:[.,]\d+)*", prose)) <= 40


@pytest.mark.slow
@pytest.mark.parametrize("path", GALLERY, ids=lambda p: p.stem)
def test_a_script_of_the_gallery_runs(path, tmp_path):
    """Within 20 s of processor time, kernels compiled; it draws one picture, prints an answer,
    writes nothing here."""
    watch = (
        "import sys, time, runpy, matplotlib; matplotlib.use('agg'); runpy.run_path(sys.argv[1]);"
        "import matplotlib.pyplot as plt; print('figures', len(plt.get_fignums()), "
        "time.process_time())"
    )
    threads = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    for _ in (1, 2):  # the first may compile
        done = subprocess.run(
            [sys.executable, "-c", watch, str(path)],
            cwd=tmp_path,
            text=True,
            check=False,
            capture_output=True,
            timeout=600,
            env={**os.environ, **threads},
        )
        assert done.returncode == 0, done.stderr
        *answer, last = done.stdout.strip().splitlines()
        figures, seconds = last.split()[1:]
        if float(seconds) <= 20:
            break
    assert float(seconds) <= 20
    assert answer
    assert figures == "1" or "Skipped" in answer[-1]
    assert not list(tmp_path.iterdir())


@pytest.mark.extended
def test_the_site_builds_without_a_warning_and_without_a_network(tmp_path):
    """No reference leads nowhere, and no page loads anything from elsewhere."""
    pytest.importorskip("sphinx_gallery")
    options = ["-W", "-n", "-q", "-D", "sphinx_gallery_conf.filename_pattern=none", "-b", "html"]
    command = [sys.executable, "-m", "sphinx", *options, str(DOCS), str(tmp_path)]
    done = subprocess.run(command, text=True, check=False, capture_output=True, timeout=1200)
    assert done.returncode == 0, done.stderr[-3000:]
    loads = r"<(?:script|img|iframe)[^>]*src=\"https?://|<link[^>]*rel=\"stylesheet\"[^>]*href=\"https?://"
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) > 60
    anchors = {
        p: set(re.findall(r"\sid=\"([^\"]+)\"", p.read_text(encoding="utf-8"))) for p in pages
    }
    for path in pages:
        for link in re.findall(r"<a\s[^>]*href=\"([^\"]+)\"", path.read_text(encoding="utf-8")):
            file, _, anchor = unquote(link).partition("#")
            if "://" in link or link.startswith("mailto:"):
                continue
            target = (path.parent / file).resolve() if file else path
            assert target.exists(), f"{path.name}: {link}"
            assert not anchor or anchor in anchors.get(target, ()), f"{path.name}: {link}"
    assert not [p.name for p in pages if re.search(loads, p.read_text(encoding="utf-8"))]


@pytest.mark.peers
@pytest.mark.parametrize("kind", ["parallel", "fanflat"])
def test_the_angles_of_astra(kind):
    """What the conventions page does with ASTRA's circular geometries and images, against
    ASTRA's own."""
    astra = pytest.importorskip("astra")
    page = _functions_of_the_page()
    theta, image = np.linspace(0, 2 * np.pi, 7)[:-1] + 0.1, np.zeros((32, 32), np.float32)
    image[4:10, 18:29] = 1.0
    if kind == "parallel":
        ours, theirs = page["from_astra_parallel"](theta, 48, 1.0), (1.0, 48, theta)
    else:
        ours, theirs = (
            page["from_astra"](theta, 100.0, 50.0, 80, 1.0),
            (1.0, 80, theta, 100.0, 50.0),
        )
    circle = astra.create_proj_geom(kind, *theirs)
    vectors = astra.functions.geom_2vec(circle)["Vectors"]
    parts = slice(2, 6) if kind == "parallel" else slice(0, 6)  # the sign of a parallel ray is free
    np.testing.assert_allclose(
        VectorGeometry.of(ours).vectors[:, parts], vectors[:, parts], atol=1e-9
    )
    name = "line" if kind == "parallel" else "line_fanflat"
    projector = astra.create_projector(name, circle, astra.create_vol_geom(32, 32))
    key, sinogram = astra.create_sino(np.ascontiguousarray(image[::-1]), projector)
    astra.data2d.delete(key)
    mine = Projector(ours, VolumeGrid((32, 32), 1.0))(torch.from_numpy(image)).numpy()
    assert np.abs(mine - sinogram).max() < 0.15 * mine.max()
    assert np.linalg.norm(mine - sinogram) < 0.03 * np.linalg.norm(mine)


@pytest.mark.peers
def test_the_matrices_of_rtk():
    """What the conventions page makes of RTK's parameters, against RTK's own matrices."""
    if importlib.util.find_spec("itk") is None:
        pytest.skip("itk-rtk is not installed")
    gantry, offset = (0.0, 63.0, 271.8), (10.0, -5.0)
    # In a process of its own: its libraries do not bear those of others.
    code = (
        "import itk, json\ng = itk.RTK.ThreeDCircularProjectionGeometry.New()\n"
        f"for a in {gantry}: g.AddProjection(1000.0, 1536.0, a, *{offset})\n"
        "print(json.dumps([itk.array_from_matrix(g.GetMatrix(k)).tolist() for k in "
        f"range({len(gantry)})]))"
    )
    matrices = json.loads(run_python(code).stdout)
    points = np.random.default_rng(1).uniform(-60, 60, (50, 3))
    size, spacing, origin = (512, 256), (0.8, 1.0), (-204.4, -127.5)
    for degrees, matrix in zip(gantry, matrices, strict=True):
        # its x, y, z: our y, z, x
        u, v, w = np.array(matrix) @ np.vstack([points[:, [1, 2, 0]].T, np.ones(50)])
        cells = np.array([(v / w - origin[1]) / spacing[1], (u / w - origin[0]) / spacing[0]])
        ours = _functions_of_the_page()["from_rtk"](
            [degrees], 1000.0, 1536.0, size, spacing, origin, offset
        )
        np.testing.assert_allclose(_ours(points, ours), cells, atol=1e-6)


@pytest.mark.parametrize("name", [n for n in recon.__all__ if callable(getattr(recon, n))])
def test_the_example_of_a_public_function_runs(name):
    function = getattr(recon, name)
    (found,) = doctest.DocTestFinder(recurse=False).find(function, name, globs={name: function})
    outcome = doctest.DocTestRunner().run(found)
    assert outcome.attempted > 4
    assert not outcome.failed
