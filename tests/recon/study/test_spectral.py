"""The spectral study at small scale: its report, its checks, its tissue maps."""

import copy
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_studies import assert_report_is_whole

from recon.study.report import render
from recon.study.spectral import SpectralSettings, calibration, checks
from recon.study.spectral.calibration import (
    SHOWN_KEV,
    CalibrationError,
    calibration_cases,
    calibration_costs,
    decomposed,
)
from recon.study.spectral.scan import BODIES, truth_labels
from torchpcct.geometry import VolumeGrid
from torchpcct.scene.plaque import plaque_scene
from torchpcct.spectral import MMD_TISSUES, vmi


@pytest.mark.extended
def test_report(tiny, tmp_path):
    study = tiny("spectral")
    sections = ("## Agreement with the paper", "## What was modelled", "seed 0", "## Tissue maps")
    assert_report_is_whole(study, tmp_path, {"spectral.png", "tissues.png"}, sections)
    done = {step for step, fraction in study.steps if fraction == 1.0}
    assert done >= {"simulate", "decompose noisy scans", "tissue maps", "joint MBIR"}


@pytest.mark.extended
def test_physics_that_holds_at_any_scale(tiny):
    data = tiny("spectral").measured.data
    standard, low = data["rays"][0], data["rays"][-1]
    assert standard["whitened_ratio"] == pytest.approx(1.0, abs=0.02)
    assert low["whitened_ratio"] == pytest.approx(1.01, abs=0.03)
    assert max(abs(b) for b in standard["bias"]) < 0.01
    assert standard["failed"] == low["failed"] == 0
    v = data["vmi"]
    for key in ("voxel", "roi_means"):
        assert v[key]["optimum_kev"] == pytest.approx(52, abs=5)
        assert v[key]["best_cnr"] <= v[key]["limit"]
    # The exact covariance is that of the noisy images.
    np.testing.assert_allclose(v["sampled_covariance"], v["voxel_covariance"], rtol=0.25)
    assert all(s["converged"] for s in data["mbir"]["solves"])
    assert data["mbir"]["anisotropy"] < 0.05


@pytest.mark.extended
def test_mbir_is_less_noisy_than_fbp(tiny):
    """The gantry turns 6° in each of so few views and smears the vessel: only the fat can be
    judged."""
    data = tiny("spectral").measured.data
    noisy = data["mbir"]["at_best_energy"][-1]
    assert noisy["noise"] == 1.0
    assert noisy["joint MBIR"]["fat_sd_hu"] < 0.9 * noisy["FBP"]["fat_sd_hu"]
    clean = data["mbir"]["at_best_energy"][0]
    assert clean["joint MBIR"]["fat_sd_hu"] < 0.25 * noisy["joint MBIR"]["fat_sd_hu"]
    for method in ("FBP", "joint MBIR"):
        assert data["dice"][method][0]["pericoronary_fat"]["mean"] > 0.9


@pytest.mark.extended
def test_checks_name_what_fails(tiny):
    data = copy.deepcopy(tiny("spectral").measured.data)
    data["rays"][0]["whitened_ratio"] = 1.2
    data["rays"][1]["failed"] = 1
    failed = {c.name for c in checks(data) if not c.ok}
    for part in ("Cramér–Rao bound, 2 s", "without a finite"):
        assert any(part in name for name in failed)


@pytest.mark.extended
def test_no_error_costs_nothing(tiny, monkeypatch):
    """Wrong calibrations of zero size, through the whole chain: every cost is 0 in HU and in
    Dice."""
    # One bin stands for all of them.
    monkeypatch.setattr(
        calibration, "calibration_cases", lambda settings, bins: calibration_cases(settings, 1)
    )
    settings = replace(
        tiny("spectral").measured.settings,
        threshold_error_kev=0.0,
        voltage_error_kv=0.0,
        gain_error=0.0,
        transport_photons=0,
    )
    costs = calibration_costs(
        settings, tiny("spectral").measured.seen.tissues, lambda fraction: None
    )
    assert len(costs["cases"]) == 7
    for case in costs["cases"]:
        assert case["failed"] == 0.0
        for hu in case["cost_hu"].values():
            assert hu == pytest.approx(dict.fromkeys(hu, 0.0), abs=1e-3)
        assert set(case["cost_dice"].values()) == {0.0}


@pytest.mark.extended
def test_wrong_calibrations_cost(tiny):
    """Signs and sizes that follow without the study's own code."""
    found = {c["name"]: c for c in tiny("spectral").measured.data["calibration"]["cases"]}
    assert found["none"]["failed"] == 0.0
    # 1 % more counts: the line integrals fall by 0.01, evenly; of the patient's 240 mm of fat that
    # is 2.3 per mille.
    for energy in SHOWN_KEV:
        more = found["1 % more counts in all bins"]["cost_hu"][f"{energy:g}"]
        assert more["fat"] < 0
        assert more["fat"] == pytest.approx(more["core"], abs=0.3)
    # One bin in eight costs less than all of them, and the air scan takes most of an error of the
    # spectrum.
    level = {name: abs(c["cost_hu"]["70"]["fat"]) for name, c in found.items()}
    assert (
        max(level[f"1 % more counts in bin {k}"] for k in range(1, 9))
        < level["1 % more counts in all bins"]
    )
    assert level["tube voltage 2 kV lower"] < 0.5 * level["tube voltage 2 kV lower, no air scan"]
    assert level["thresholds 2 keV lower"] > 2.0
    # What repeated interactions cost is gone once the decomposition knows their response.
    unknown = found["photons interact repeatedly"]["cost_hu"]["52"]["core"]
    known = found["photons interact repeatedly, known from other photons"]["cost_hu"]["52"]["core"]
    assert abs(known) < 0.3 * abs(unknown)
    assert found["none"]["hu"]["52"]["contrast"] > 20.0


@pytest.mark.extended
def test_twice_the_error_costs_more(tiny):
    """Small errors cost in proportion."""
    scan = tiny("spectral").measured.seen.scan
    lines = [
        decomposed(scan, CalibrationError("x", gain=g), scan.scanner)[0] for g in (0.0, 0.005, 0.01)
    ]
    small, large = (vmi(images - lines[0], scan.basis, [70.0]) for images in lines[1:])
    zero = vmi(torch.zeros_like(lines[0]), scan.basis, [70.0])
    ratio = float((large - zero).mean() / (small - zero).mean())
    assert ratio == pytest.approx(2.0, abs=0.05)
    names = [e.name for e in calibration_cases(SpectralSettings(), 8)]
    assert len(set(names)) == len(names) == 17


def test_truth_is_the_tissue_that_fills_the_voxel():
    scene, plaque = plaque_scene()
    x, y, z = plaque.position
    labels = truth_labels(scene, VolumeGrid((1, 90, 90), 0.1, (z, y, x)))
    area = {t: float((labels == k).sum()) * 0.01 for k, t in enumerate(MMD_TISSUES)}
    assert area["necrotic_core"] == pytest.approx(math.pi * 0.6 * 0.985, rel=0.05)
    lumen = scene[BODIES["blood_iodine"]].shape
    assert area["blood_iodine"] == pytest.approx(math.pi * lumen.section(0.0)[1] ** 2, rel=0.05)
    assert 0 < float((labels < 0).float().mean()) < 0.1


@pytest.mark.extended
def test_what_joint_mbir_does_to_the_contrast_is_said_by_its_sign(tiny):
    data = json.loads(tiny("spectral").report.json)
    clean = data["mbir"]["at_best_energy"][0]
    clean["FBP"] |= {"core_hu": 40.0, "fibrous_hu": 100.0}
    for joint, words in (
        (90.0, ("pays with contrast", "17 % less")),
        (112.0, ("gains contrast", "20 % more")),
    ):
        clean["joint MBIR"] |= {"core_hu": 40.0, "fibrous_hu": joint}
        text = render("spectral", data)
        assert all(word in text for word in words)
