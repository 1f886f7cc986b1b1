"""Checks, effects and the study registry."""

from __future__ import annotations

import math

import pytest

from recon.study import registry
from recon.study.checks import Check, around, checks_section, effects_section
from torchpcct.acquisition.plan import Effect


def test_a_check_is_inside_its_closed_range_only():
    assert around("x", 1.25, 1.0, 0.25).ok
    assert not around("x", 1.2501, 1.0, 0.25).ok
    assert Check("open", 1e9, "any", low=0.0).ok
    assert not Check("undetermined", math.nan, 1.0).ok


def test_checks_as_json_values_and_as_text():
    checks = [around("size, mm", 1.97, 1.97, 0.02), Check("dice", 0.2, "visible", low=0.5, note="noise")]
    assert checks[1].as_dict() == {
        "name": "dice", "ours": 0.2, "paper": "visible", "low": 0.5, "high": None, "note": "noise", "ok": False,
    }  # fmt: skip
    text = checks_section(checks)
    assert "1 of 2 checks" in text
    assert "size, mm" in text
    assert "≥ 0.5" in text
    assert "size, mm" not in checks_section(checks, every=False)


def test_effects_say_what_is_modelled():
    text = effects_section([Effect("focal spot", True, 3.14159), Effect("scatter", False, None, "grid")], 0.5)
    assert "3.14" in text
    assert "not estimated" in text
    assert "less than 0.5 HU" in text


def test_an_unknown_study_is_refused():
    with pytest.raises(ValueError, match="unknown study 'x'"):
        registry.build_settings("x")
