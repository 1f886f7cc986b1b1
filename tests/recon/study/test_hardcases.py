"""The hard cases: verdicts, what is said of each case, and the report."""

import logging
import math

import numpy as np
import pytest
from tiny_studies import run_tiny

from recon.study.hardcases.cases import CASES, untouched
from recon.study.hardcases.measure import verdict
from torchpcct.geometry import VolumeGrid
from torchpcct.scene.plaque import plaque_scene


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return run_tiny("hardcases", tmp_path_factory.mktemp("hardcases"))


def test_verdicts():
    assert verdict(4.0, 10.0, True, []) == "right"
    assert verdict(6.0, 10.0, True, []) == "SILENT"
    assert verdict(6.0, 10.0, True, ["wrong centre"]) == "warned"
    assert verdict(1.0, 10.0, False, []) == "SILENT"
    assert verdict(np.nan, 10.0, False, ["starved"]) == "warned"
    assert verdict(None, 10.0, True, ["refused"]) == "warned"
    assert verdict(6.0, 10.0, True, [], unseen="turned") == "unseen"
    assert verdict(4.0, 10.0, True, [], worse=1.1) == "SILENT"
    assert verdict(4.0, 10.0, True, ["metal"], worse=1.1) == "warned"
    assert verdict(4.0, 10.0, True, [], worse=1.04) == "right"


@pytest.mark.extended
def test_a_mended_case_is_right_and_a_refused_one_said(tiny):
    rows = {r["case"]: r for r in tiny.measured.data["rows"]}
    assert len(CASES) >= 100
    assert rows["sound"]["error_hu"] == 0.0
    assert rows["dead-column"]["verdict"] == "right"
    assert any("dead detector cells" in text for text in rows["dead-column"]["messages"])
    assert rows["three-views"]["refused"]
    assert rows["centre-2"]["error_hu"] > rows["centre-2"]["noise_hu"]
    assert any("conjugate rays disagree" in text for text in rows["centre-2"]["messages"])


@pytest.mark.extended
def test_a_whole_body(tiny):
    rows = {r["case"]: r for r in tiny.measured.data["rows"]}
    assert rows["body-sod"]["verdict"] == "unseen"
    assert rows["body-sod"]["error_hu"] > rows["body-sod"]["noise_hu"] > 20
    assert rows["body-reversed"]["verdict"] == "warned"
    assert "columns counted the other way" in rows["body-reversed"]["messages"][0]
    assert rows["body-not-square"]["refused"]
    assert "unseen 1" in tiny.report.text


@pytest.mark.extended
def test_metal_is_named_and_its_own_voxels_do_not_count(tiny):
    rows = {r["case"]: r for r in tiny.measured.data["rows"]}
    assert any("metal" in text for text in rows["metal"]["messages"])
    # The rod reads 16 000 HU: counted, it would be an error of more than a thousand.
    assert rows["metal"]["error_hu"] < 2 * rows["sound"]["noise_hu"]
    assert (
        rows["sound"]["soft_hu"] < rows["sound"]["truth_hu"] < 1.2 * rows["sound"]["noise_hu"] + 20
    )
    assert rows["three-views"]["truth_hu"] is rows["three-views"]["soft_hu"] is None


def test_only_what_a_case_adds_is_left_out():
    scene, plaque = plaque_scene(vessel_length=6.2)
    grid = VolumeGrid((4, 23, 23), 0.4, plaque.position[::-1])
    assert untouched(scene, scene, grid).all()
    for name, volume in (
        ("metal", math.pi * 0.6**2 * 1.6),
        ("dynamic-range", math.pi * 0.6**2 * 1.6),
    ):
        with_rod = CASES[name].scene(plaque)
        seen = untouched(with_rod, scene, grid)
        share = with_rod.volume_fractions(grid)[with_rod.index("implant")]
        assert share[seen].max() == 0
        assert share.sum() * 0.4**3 == pytest.approx(volume, rel=0.02)
        assert 0.8 < seen.mean() < 0.97
    assert untouched(CASES["large-body"].scene(plaque), scene, grid).all()


@pytest.mark.extended
def test_the_report_counts_silent_errors(tiny):
    assert (
        tiny.report.data["silent"]
        == 0
        == sum(r["verdict"] == "SILENT" for r in tiny.measured.data["rows"])
    )
    assert f"**Silent errors: {tiny.report.data['silent']}** of 8" in tiny.report.text
    assert "a dead column" in tiny.report.text


@pytest.mark.extended
def test_listening_ends_with_the_study(tiny):
    assert all(logging.getLogger(name).propagate for name in ("recon", "torchpcct"))
    assert not any(type(h).__name__ == "Listener" for h in logging.getLogger("recon").handlers)
