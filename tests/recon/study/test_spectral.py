"""The spectral study at small scale: its report, its checks, its tissue maps."""

import copy
import math

import numpy as np
import pytest
import torch
from tiny_studies import assert_report_is_whole

from recon.study.spectral.report import checks_of
from recon.study.spectral.settings import Settings
from recon.study.spectral.tissues import BODIES, truth_labels
from torchpcct.geometry import VolumeGrid
from torchpcct.scene.plaque import plaque_scene
from torchpcct.spectral import MMD_TISSUES, pe_pvc, vmi


def test_report(tiny, tmp_path):
    study = tiny("spectral")
    sections = ("## Agreement with the paper", "## What was modelled", "## Environment", "seed 0", "## Tissue maps")
    assert_report_is_whole(study, tmp_path, {"spectral.png", "tissues.png"}, sections)
    done = {step for step, fraction in study.steps if fraction == 1.0}
    assert done >= {"simulate", "decompose noisy scans", "tissue maps", "joint MBIR"}


def test_physics_that_holds_at_any_scale(tiny):
    data = tiny("spectral").measured.data
    standard, low = data["rays"][0], data["rays"][-1]
    assert standard["whitened_ratio"] == pytest.approx(1.0, abs=0.02)
    assert low["whitened_ratio"] == pytest.approx(1.01, abs=0.03)
    assert max(abs(b) for b in standard["bias"]) < 0.01
    assert standard["failed"] == low["failed"] == 0
    starved = data["starved"]
    assert starved["without_counts"] >= 10
    assert starved["not_finite"] == starved["not_converged"] == 0
    assert max(np.abs(v).max() for v in data["water"].values()) < 1.0
    v = data["vmi"]
    for key in ("voxel", "roi_means"):
        assert v[key]["optimum_kev"] == pytest.approx(52, abs=5)
        assert v[key]["best_cnr"] <= v[key]["limit"]
    # The exact covariance is that of the noisy images.
    np.testing.assert_allclose(v["sampled_covariance"], v["voxel_covariance"], rtol=0.25)
    assert all(s["converged"] for s in data["mbir"]["solves"])
    assert data["mbir"]["anisotropy"] < 0.05


def test_mbir_is_less_noisy_than_fbp(tiny):
    """The gantry turns 6° in each of so few views and smears the vessel: only the fat can be judged."""
    data = tiny("spectral").measured.data
    noisy = data["mbir"]["at_best_energy"][-1]
    assert noisy["noise"] == 1.0
    assert noisy["joint MBIR"]["fat_sd_hu"] < 0.9 * noisy["FBP"]["fat_sd_hu"]
    clean = data["mbir"]["at_best_energy"][0]
    assert clean["joint MBIR"]["fat_sd_hu"] < 0.25 * noisy["joint MBIR"]["fat_sd_hu"]
    for method in ("FBP", "joint MBIR"):
        assert data["dice"][method][0]["pericoronary_fat"]["mean"] > 0.9


def test_checks_name_what_fails(tiny):
    data = copy.deepcopy(tiny("spectral").measured.data)
    data["water"] = {"cylinder": [0.0, -1.4]}
    data["rays"][0]["whitened_ratio"] = 1.2
    data["starved"]["not_finite"] = 1
    failed = {c.name for c in checks_of(data) if not c.ok}
    for part in ("water", "Cramér–Rao bound, 2 s", "without a finite"):
        assert any(part in name for name in failed)


def test_truth_is_the_tissue_that_fills_the_voxel():
    scene, plaque = plaque_scene()
    x, y, z = plaque.position
    labels = truth_labels(scene, VolumeGrid((1, 90, 90), 0.1, (z, y, x)))
    area = {t: float((labels == k).sum()) * 0.01 for k, t in enumerate(MMD_TISSUES)}
    assert area["necrotic_core"] == pytest.approx(math.pi * 0.6 * 0.985, rel=0.05)
    lumen = scene[BODIES["blood_iodine"]].shape
    assert area["blood_iodine"] == pytest.approx(math.pi * lumen.section(0.0)[1] ** 2, rel=0.05)
    assert 0 < float((labels < 0).float().mean()) < 0.1


def test_vmi_of_the_corners_is_the_tissue():
    """Coefficients of soft tissue reproduce its HU: the maps start from the right corners."""
    basis = pe_pvc()
    core, fibrous = (torch.from_numpy(basis.coefficients(t)) for t in ("necrotic_core", "fibrous_tissue"))
    contrast = vmi(fibrous, basis, [40.0, 70.0]) - vmi(core, basis, [40.0, 70.0])
    assert contrast.tolist() == pytest.approx([64, 60], abs=2)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"exposure_s": 0.0}, "exposure_s"),
        ({"realizations": 0}, "realizations"),
        ({"mbir_realizations": 9}, "mbir_realizations"),
        ({"noise_levels": (0.25, 1.0)}, "ascend from 0"),
        ({"noise_levels": (0.0, 1.0, 0.5)}, "ascend from 0"),
        ({"views": 10}, "views"),
        ({"starved_rays": 1}, "starved_rays"),
    ],
)
def test_bad_settings(change, match):
    with pytest.raises(ValueError, match=match):
        Settings(**change)
