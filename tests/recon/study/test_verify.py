"""Figures of the README against committed results."""

import json
import math

import pytest

from recon.study.verify import Claim, _parsed, differences, load_claims, lookup, rewrite, uncovered, unproven, verify

DATA = {"rows": [{"m": "a", "s": 2.0, "v": 1.234}, {"m": "b", "s": 2.0, "v": [5.0, 6.6]}], "n": {"k": 200}}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "r.json").write_text(json.dumps(DATA), encoding="utf-8")
    return tmp_path


CLAIM = Claim(
    "saves {v:.1f}× (up to {w:.0f}) in {n}",
    {"v": "r.json: rows[m=a]/v", "w": "r.json: rows[m=b,s=2]/v/1", "n": "r.json: n/k"},
)
README = "# T\n\n## Results\n\nIt saves 1.2× (up to\n7) in 200 draws.\nAnd 3 more.\n\n## Other\n\n9 lives.\n"


def test_lookup_by_key_row_and_index():
    assert lookup(DATA, "rows[m=b]/v/0") == 5.0
    assert lookup(DATA, "n/k") == 200
    for path, message in (("n/x", "no /n/x"), ("rows[s=2]/v", "2 rows fit"), ("rows[m=c]/v", "0 rows fit")):
        with pytest.raises(ValueError, match=message):
            lookup(DATA, path)


def test_a_true_and_a_stale_sentence(folder):
    assert verify(README, [CLAIM], folder)[0].ok
    stale = verify(README.replace("1.2×", "1.3×"), [CLAIM], folder)[0]
    assert not stale.ok
    assert stale.found is not None
    assert verify(README.replace("saves", "gives"), [CLAIM], folder)[0].found is None


def test_rewrite_puts_the_committed_figures_in_and_keeps_the_lines(folder):
    old = README.replace("1.2×", "9.99×").replace("200", "12")
    assert rewrite(old, [CLAIM], folder) == README


def test_words_are_chosen_by_the_sign_of_their_figure(folder):
    """A figure may be right in a sentence that says the contrary."""
    values = {"a": "r.json: shift", "b": "r.json: n/k", "w": "worst of r.json: organs"}
    values["o"] = "worst name of r.json: organs"
    values["q"] = "r.json: n/k ÷ r.json: rows[m=a]/s"
    text = "it {a?gains|loses} {a:|.1f} %, {b>a?more|less} than {b}, {b>1?above|below} 1; "
    text += "at most {w:.0f} ({o}), half {q:.0f}"
    claim = Claim(text, values)
    for shift, sentence in ((4.6, "it gains 4.6 %, more than 200"), (-4.6, "it loses 4.6 %, more than 200")):
        data = DATA | {"shift": shift, "organs": {"heart": 2.0, "spine": -8.1}}
        (folder / "r.json").write_text(json.dumps(data), encoding="utf-8")
        _parsed.cache_clear()
        said = claim.said(folder)
        assert said == f"{sentence}, above 1; at most 8 (spine), half 100"
        other = said.replace("gains", "loses") if shift > 0 else said.replace("loses", "gains")
        assert verify(said, [claim], folder)[0].ok
        assert not verify(other, [claim], folder)[0].ok
        assert rewrite(other, [claim], folder) == said


def test_directions_that_no_figure_chooses_are_named():
    values = {"a": "r.json: n/k"}
    assert list(unproven([Claim("it {a?gains|loses} {a:|.1f} %", values), Claim("more than this", {})])) == []
    for text in ("it loses {a:.1f} %", "is {a:.1f} HU too large", "does not reach the {a:.1f}", "{a:.1f} less than"):
        assert len(list(unproven([Claim(text, values)]))) == 1


def test_figures_without_a_claim_are_found():
    assert list(uncovered(README, [CLAIM], ("Results",))) == ["And 3 more."]
    assert list(uncovered(README, [], ("Other",))) == ["9 lives."]


def test_bad_claims_are_refused(folder):
    with pytest.raises(ValueError, match="no value for"):
        Claim("{x}", {}).said(folder)
    with pytest.raises(ValueError, match="cannot read"):
        Claim("{x}", {"x": "none.json: a"}).said(folder)
    with pytest.raises(ValueError, match="cannot show"):
        Claim("{x:.1f}", {"x": "r.json: rows[m=a]/m"}).said(folder)
    (folder / "c.yaml").write_text("- text: a\n", encoding="utf-8")
    with pytest.raises(ValueError, match="must hold text and values"):
        load_claims(folder / "c.yaml")


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
    assert [line.split(":")[0] for line in differences(DATA, again)] == ["/n/k", "/rows/0/v", "/rows/1/m"]
