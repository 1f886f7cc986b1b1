"""The hard cases: verdicts, what is said of each case, and the report."""

import logging

import numpy as np
import pytest
from tiny_studies import run_tiny

from recon.study.hardcases.cases import CASES
from recon.study.hardcases.measure import verdict
from recon.study.hardcases.settings import Settings


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return run_tiny("hardcases", tmp_path_factory.mktemp("hardcases"))


def test_verdicts():
    assert verdict(4.0, 10.0, True, []) == "right"
    assert verdict(6.0, 10.0, True, []) == "SILENT"
    assert verdict(6.0, 10.0, True, ["wrong centre"]) == "said"
    assert verdict(1.0, 10.0, False, []) == "SILENT"
    assert verdict(np.nan, 10.0, False, ["starved"]) == "said"
    assert verdict(None, 10.0, True, ["refused"]) == "said"


def test_a_mended_case_is_right_and_a_refused_one_said(tiny):
    rows = {r["case"]: r for r in tiny.measured.rows}
    assert rows["sound"]["error_hu"] == 0.0
    assert rows["dead-column"]["verdict"] == "right"
    assert any("dead detector cells" in text for text in rows["dead-column"]["said"])
    assert rows["three-views"]["refused"]
    assert rows["centre-2"]["error_hu"] > rows["centre-2"]["noise_hu"]
    assert any("opposite rays disagree" in text for text in rows["centre-2"]["said"])


def test_the_report_counts_silent_errors(tiny):
    assert tiny.report.data["silent"] == 0 == sum(r["verdict"] == "SILENT" for r in tiny.measured.rows)
    assert f"**Silent errors: {tiny.report.data['silent']}** of 4" in tiny.report.text
    assert "a dead column" in tiny.report.text


def test_listening_ends_with_the_study(tiny):
    assert all(logging.getLogger(name).propagate for name in ("recon", "torchpcct"))
    assert not any(type(h).__name__ == "Listener" for h in logging.getLogger("recon").handlers)


def test_settings_refuse_unknown_cases():
    with pytest.raises(ValueError, match="unknown case 'x'"):
        Settings(cases=("x",))
    with pytest.raises(ValueError, match="methods must be one name or more"):
        Settings(methods="fbp")
    assert len(CASES) >= 31
