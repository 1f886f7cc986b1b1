"""The comparison at small scale, and the answer that it gives."""

import json
import math
import re
from dataclasses import replace
from types import SimpleNamespace

import pytest
from tiny_studies import INSERT, assert_report_is_whole

from recon.evaluate.report import page
from recon.evaluate.tasks import read_task
from recon.study.compare import claim, dose_chart
from recon.study.energies import energy_rows
from recon.study.report import TEMPLATES, aligned, render


@pytest.mark.extended
def test_report(tiny, tmp_path):
    study = tiny("compare")
    data = assert_report_is_whole(
        study, tmp_path, {"compare.png", "dose_factors.png"}, ("## plaque", "gaussian@fbp:soft")
    )
    assert data["study"] == "compare"
    assert {r["method"] for r in data["records"]} == {"fbp:soft", "gaussian@fbp:soft"}
    assert data["claim"] is None  # without MBIR
    assert "MBIR's CNR" not in study.report.text
    screen = study.report.screen.splitlines()
    assert len(screen) <= 40
    assert max(map(len, screen)) <= 110
    assert re.search(r"^\| gaussian@fbp:soft, \S+ s +\| +\d", study.report.screen, re.MULTILINE)


def test_a_page_has_its_tables_and_pictures_in_it():
    table = "| a | b |\n|--|--|\n| 1 < 2 | c`d` |"
    text = f"# T\n\n<script>x</script> a | b\n\n![s](second.svg)\n\n{aligned(table)}\n"
    whole = page("a & b", text, {"first.png": b"\x89PNG", "second.svg": b"<svg/>"})
    assert "<title>a &amp; b</title>" in whole
    assert "<script>" not in whole
    assert "<td>1 &lt; 2</td>" in whole.replace(' style="text-align:left"', "")
    assert "c<code>d</code></td>" in whole
    first, second = (whole.index(f"data:image/{kind};base64,") for kind in ("png", "svg+xml"))
    assert second < whole.index("<table>") < first  # where the text names it, or at the end
    assert "http" not in whole


def test_tables_are_aligned():
    text = aligned(
        "text | no table\n\n| a | bb |\n|--|--|\n| long name | 1 |\n| x | |\n| a \\| b | 22 "
        "|\n\nend"
    )
    assert text.startswith("text | no table\n\n| a ")
    lines = text.splitlines()[2:-2]
    assert len({len(line) for line in lines}) == 1
    assert lines[1] == "|:----------|---:|"


def record(method, exposure, figure, where, value, low=math.nan, high=math.nan):
    return {
        "task": "plaque",
        "method": method,
        "exposure_s": exposure,
        "figure": figure,
        "where": where,
        "value": value,
        "low": low,
        "high": high,
    }


def report_values(low, high, exposures=(0.35, 2.0)):
    records = [record("fbp:soft", e, "CNR", "small", 1.91 * math.sqrt(e / 2.0)) for e in exposures]
    for e in exposures:
        records += [
            record("mbir", e, "CNR", "small", 1.0, 0.9, 1.1),
            record("mbir", e, "dose factor: CNR", "small", 5.55, low, high),
            record("mbir", e, "dose factor: contrast at slope 1", "lesion", 0.85, 0.8, 0.9),
        ]
    settings = {
        "views": 1968,
        "n": 16,
        "methods": ["fbp:soft", "mbir"],
        "exposures_s": list(exposures),
    }
    return {
        "settings": settings,
        "records": records,
        "claim": claim(records),
        "reference": "fbp:soft",
    }


def answer(data):
    """The first paragraph of what a terminal shows."""
    first = render("compare_screen", data).split("\n\n")[0]
    return "" if first.startswith("|") else " ".join(first.split())


@pytest.mark.parametrize(
    ("low", "high", "expected_text"),
    [(5.8, 9.0, " reaches "), (2.0, 5.6, " does not reach "), (5.0, 6.0, " may or may not ")],
)
def test_the_answer_is_one_sentence_made_of_the_results(low, high, expected_text):
    data = report_values(low, high)
    text = answer(data)
    assert expected_text in text
    assert len(re.findall(r"[.!?](?=\s|$)", text)) == 1
    assert "has a CNR of 1.00 [0.90, 1.10], which" in text
    assert "that of FBP (soft kernel) of a scan of 2.00 s, 1.91;" in text
    assert "0.85 [0.80, 0.90] for the contrast of the lesion" in text
    assert "detectability" not in text  # was not measured
    assert "WARNING" not in text
    data["settings"]["views"] = 246
    assert "says nothing about the question" in answer(data)
    assert data["claim"]["needed"] == pytest.approx(2.0 / 0.35)


def test_the_page_begins_with_the_answer_in_three_sentences():
    """Then the pictures and one table, which is narrow; what follows is for those who ask for
    more."""
    data = report_values(2.0, 5.6)
    data["records"].append(
        record("pwls", 2.0, "dose factor: contrast at slope 1", "lesion", 1.06, 1.01, 1.11)
    )
    data |= {"tables": "THE REST", "seconds": {}, "peak_memory_gib": 1.0}
    top, rest = render("compare", data).split("\n---\n")
    assert "THE REST" in rest
    question, told, first, second, table, meaning = top.strip().split("\n\n")
    assert question.endswith("?")
    sentences = re.split(r"(?<=[a-z0-9]\.)(?:\*\*)?\s+", told)
    assert len(sentences) == 3
    assert "5.55 [2.00, 5.60] times the dose of MBIR in a scan of 2 s" in sentences[0]
    assert "where the paper assumes 5.7" in sentences[0]
    assert "0.85 [0.80, 0.90] times the dose: there MBIR costs dose." in sentences[1]
    assert "(PWLS) in the place of MBIR it is 1.06 [1.01, 1.11] times" in sentences[2]
    assert (first.count(".png"), second.count(".png")) == (1, 1)
    assert len(table.splitlines()) == 2 + len(data["settings"]["methods"])
    assert max(map(len, table.splitlines())) < 110
    assert "95 %" in meaning
    data["settings"]["n"] = 8
    assert "WARNING: 1968 views, 8 realisations" in render("compare", data).split("\n---\n")[0]
    for low, high, verdict in (
        (1.1, 2.0, "saves dose."),
        (0.9, 1.1, "neither saves nor costs"),
        (0.1, 0.9, "costs dose."),
    ):
        for r in data["records"]:
            if r["figure"].startswith("dose factor: contrast"):
                r |= {"low": low, "high": high}
        assert f"there MBIR {verdict}" in render("compare", data)


def test_the_chart_draws_every_factor_that_was_measured():
    data = report_values(2.0, 5.6)
    settings = SimpleNamespace(**data["settings"])
    axes = dose_chart(data["records"], settings).axes
    points = [
        [
            line.get_xdata()[0]
            for line in a.lines
            if line.get_marker() == "o" and len(line.get_xdata())
        ]
        for a in axes
    ]
    assert points == [[5.55, 5.55], [0.85, 0.85], []]


def test_no_claim_without_both_exposures():
    data = report_values(4.0, 6.0, exposures=(2.0,))
    assert data["claim"] is None
    assert "5.7" not in answer(data)
    assert answer({**data, "records": []}) == ""


def test_what_the_weights_of_energy_bins_bring(tmp_path):
    """Exact, 97 % of the limit or more; no image at one energy, and no mix of the two basis images,
    is better than the weights where the contrast is one that the basis holds."""
    (tmp_path / "insert.yaml").write_text(INSERT, encoding="utf-8")
    task = read_task(tmp_path / "insert.yaml")
    scene = task.scene.replace_material("insert", "adipose")
    (row,) = energy_rows(replace(task, scene=scene), [("insert", "patient")], views=16)
    assert 1.02 < row["limit"] < row["energies"]
    assert 0.97 * row["limit"] < row["weights"] < 1.005 * row["limit"]
    assert row["vmi"] <= row["vmi_limit"] < 1.005 * row["weights"]
    assert 40 < row["vmi_kev"] < 80


def test_the_committed_rows_are_told_with_their_sign():
    """The factors of the committed report, in its text and in the README."""
    root = TEMPLATES.parents[2]
    report = json.loads((root / "notebooks/compare/report.json").read_text(encoding="utf-8"))
    rows = {row["contrast"][0]: row for row in report["energies"]}
    assert set(rows) == {"lumen", "fibrous", "core"}
    for row in rows.values():
        assert row["weights"] > 0.97 * row["limit"]
    text = render("compare", report)
    assert re.search(r"lumen against fibrous +\| +1\.49 \|", text)
    readme = " ".join((root / "README.md").read_text(encoding="utf-8").split())
    assert f"{rows['lumen']['weights']:.2f} times the dose for the lumen" in readme
