"""Sentences rendered from committed results."""

import json
import math
from pathlib import Path

import pytest

from recon.study.results import README_MARKS, differences, render

DATA = {
    "rows": [{"m": "a", "s": 2.0, "v": 1.234}, {"m": "b", "s": 2.0, "v": [5.0, 6.6]}],
    "n": {"k": 200},
}
RECORD = {
    "task": "plaque",
    "method": "mbir",
    "exposure_s": 2.0,
    "figure": "CNR",
    "where": "small",
    "value": 1.531,
    "low": 1.47,
    "high": 1.594,
}
FIRST, LAST = README_MARKS


@pytest.fixture
def root(tmp_path):
    folder = tmp_path / "notebooks" / "r"
    folder.mkdir(parents=True)
    (folder / "report.json").write_text(
        json.dumps({**DATA, "records": [RECORD], "shift": -4.6}), encoding="utf-8"
    )
    (tmp_path / "README.md").write_text(f"# T\n\n{FIRST}\nold\n{LAST}\n\nend\n", encoding="utf-8")
    return tmp_path


def rendered(root, text):
    path = root / "notebooks" / "results.template.md"
    path.write_text(f"# R\n\n{FIRST}\n{text}\n{LAST}\nmore\n", encoding="utf-8")
    found = render(root)
    assert found["README.md"].startswith(f"# T\n\n{FIRST}\n")
    assert found["README.md"].endswith(f"\n{LAST}\n\nend\n")
    assert found["notebooks/RESULTS.md"].startswith("# R\n\n")
    assert found["notebooks/RESULTS.md"].endswith("\nmore\n")
    rendered_text = found["notebooks/RESULTS.md"].splitlines()[2]
    assert f"\n{rendered_text}\n" in found["README.md"]
    return rendered_text


@pytest.mark.parametrize(
    ("text", "expected_text"),
    [
        ('{{ (r.rows|row(m="a")).v|f(".1f") }}× of {{ r.n.k }}', "1.2× of 200"),
        ('{{ r|record("plaque", "mbir", 2, "CNR", "small")|f(".1f") }}', "1.5"),
        ('{{ r|record("plaque", "mbir", 2, "CNR", "small")|interval }}', "1.53 [1.47, 1.59]"),
        (
            'it {{ "gains" if r.shift > 0 else "loses" }} {{ r.shift|abs|f(".1f") }} %',
            "it loses 4.6 %",
        ),
    ],
)
def test_fields(root, text, expected_text):
    assert rendered(root, text) == expected_text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{{ x.n.k }}", "'x' is undefined"),
        ('{{ r.n.x|f(".1f") }}', "no attribute 'x'"),
        ('{{ r|record("plaque", "mbir", 3, "CNR", "small")|f(".1f") }}', "0 rows have"),
        ("{{ (r.rows|row(s=2)).v }}", "2 rows have"),
        ('{{ (r.rows|row(m="a")).m|f(".1f") }}', "must be real number"),
        (FIRST, "once"),
    ],
)
def test_what_cannot_be_rendered_is_refused(root, text, message):
    with pytest.raises(ValueError, match=message):
        rendered(root, text)


def test_the_repository_is_rendered():
    root = Path(__file__).parents[3]
    for name, text in render(root).items():
        assert (root / name).read_text(encoding="utf-8") == text, (
            f"{name}: torchpcct verify --write"
        )


def test_differences_are_named_and_runs_may_take_another_time():
    again = json.loads(json.dumps(DATA))
    assert not list(differences({**DATA, "seconds": 1}, {**again, "seconds": 2}))
    assert not list(differences({"core_mm2": math.nan}, {"core_mm2": math.nan}))
    assert list(differences({"core_mm2": math.nan}, {"core_mm2": 1.0}))
    again["rows"][0]["v"] *= 1.0005
    assert not list(differences(DATA, again))
    again["rows"][0]["v"] *= 1.01
    again["rows"][1]["m"] = "c"
    del again["n"]["k"]
    assert [line.split(":")[0] for line in differences(DATA, again)] == [
        "/n/k",
        "/rows/0/v",
        "/rows/1/m",
    ]
