"""Study ``dose``: noise model and corrections of its slices, intervals, and a run at the smallest scale."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.study import registry
from recon.study.bowtie.combined import _variance_ratio
from recon.study.bowtie.dose_maps import dose_maps, ramp_figures, ratios, region_ratio, transmission
from recon.study.bowtie.measure import Settings, run
from recon.study.bowtie.slice_scan import (
    BOWTIES,
    polynomial_linearisation,
    radial_profile,
    slice_image,
    slice_scans,
    wide_scanner,
)
from torchpcct.dose import CtdiDose
from torchpcct.geometry import VolumeGrid
from torchpcct.scene import SinusoidalMotion
from torchpcct.scene.materials import material
from torchpcct.scene.phantoms.quality import water_cylinder


@pytest.fixture(scope="module")
def scanners():
    return [wide_scanner(b, 120) for b in BOWTIES]


@pytest.fixture(scope="module")
def water(scanners):
    return slice_scans(water_cylinder(200.0), scanners, 0.35)


def test_the_polynomial_meets_its_calibration(scanners):
    scanner = scanners[1]
    line = polynomial_linearisation(scanner)
    assert line.coefficients.shape == (scanner.geometry.columns, 5)
    for t in (10.0, 200.0, 380.0):
        p = -np.log(scanner.behind({material("water"): t})[0].sum(-1) / scanner.weights()[1][0].sum(-1))
        reached = line.apply(torch.from_numpy(p)).numpy() / line.mu_ref
        np.testing.assert_allclose(reached, t, atol=0.15)
    assert line.mu_ref == pytest.approx(scanner.water_linearisation().mu_ref, rel=1e-12)


def test_lower_orders_cup(scanners):
    p = -np.log(scanners[0].behind({material("water"): 200.0})[0].sum(-1) / scanners[0].weights()[1][0].sum(-1))
    errors = []
    for order in (1, 2, 5):
        line = polynomial_linearisation(scanners[0], order=order)
        errors.append(np.abs(line.apply(torch.from_numpy(p)).numpy() / line.mu_ref - 200.0).max())
    assert errors[0] > 10 * errors[1] > 10 * errors[2]
    with pytest.raises(ValueError, match="thicknesses"):
        polynomial_linearisation(scanners[0], step_mm=100.0)


def test_water_reads_zero_with_both_bowties(water):
    grid = VolumeGrid((150, 150), 1.5)
    for scan in water:
        profile = radial_profile(slice_image(scan, grid, "soft"), grid, 90.0)
        assert np.abs(profile[:, 1]).max() < 3.0
        assert profile[0, 0] == 2.5


def test_expected_readings_are_those_of_the_scanner(scanners, water):
    """The central ray crosses 200 mm of water."""
    for scanner, scan in zip(scanners, water, strict=True):
        middle = scanner.geometry.columns // 2
        half = math.sin(float(scanner.geometry.fan_angles[middle])) * 626.0
        chord = 2.0 * math.sqrt(100.0**2 - half**2)
        expected = scanner.behind({material("water"): chord})[0, middle].sum() * scanner.mas_per_view(0.35)
        assert float(scan.mean[0, middle]) == pytest.approx(expected, rel=1e-9)


def test_noise_has_the_detector_s_variance_and_is_paired(water):
    large, roi = water
    middle = slice(large.mean.shape[1] // 2 - 5, large.mean.shape[1] // 2 + 5)
    draws = torch.stack([large.line_integrals(seed=k)[:, middle] for k in range(60)]).double()
    slope = large.linearisation.slope((torch.log(large.air) - torch.log(large.mean)).float())[:, middle].double()
    expected = slope.square() * (large.gain / large.mean)[:, middle]
    assert float((draws.var(0) / expected).mean()) == pytest.approx(1.0, abs=0.02)
    # At a dozen quanta a reading, the logarithm without the half quantum would be off by 0.04.
    dark = replace(large, mean=large.mean * (12.0 / float(large.mean.min() / large.gain.max())), air=large.air)
    dark = replace(dark, air=large.air * (dark.mean[0, 0] / large.mean[0, 0]))
    draws = torch.stack([dark.line_integrals(seed=k)[:, middle] for k in range(60)]).double()
    bias = float((draws - dark.line_integrals()[:, middle].double()).mean())
    assert abs(bias) < 0.01
    # Inside the region of interest both bowties give the same readings, and the same noise.
    torch.testing.assert_close(roi.line_integrals(seed=3)[:, middle], large.line_integrals(seed=3)[:, middle])
    outside = slice(0, 40)
    assert not torch.allclose(roi.line_integrals(seed=3)[:, outside], large.line_integrals(seed=3)[:, outside])


def test_a_moving_scene_or_other_geometries_are_refused(scanners):
    moving = water_cylinder().with_motion(SinusoidalMotion("cylinder", 1.0))
    with pytest.raises(ValueError, match="stand still"):
        slice_scans(moving, scanners, 0.35)
    with pytest.raises(ValueError, match="one geometry"):
        slice_scans(water_cylinder(), [scanners[0], wide_scanner("large+roi", 60)], 0.35)
    with pytest.raises(ValueError, match="detector"):
        wide_scanner("large", 8, "film")


def test_silicon_cells_are_the_pcct_s():
    scanner = wide_scanner("large", 8, "silicon")
    assert scanner.geometry.pitch == (0.5, 0.35)
    assert not scanner.detector.energy_integrating


def test_the_wider_the_ramp_the_smaller_the_saving():
    rows = ramp_figures({b: wide_scanner(b, 8) for b in BOWTIES}, 0.35)
    for key in ("peripheral", "weighted"):
        assert (np.diff([r[key] for r in rows]) > 0).all()
    assert all(r["central"] == pytest.approx(1.0, abs=1e-3) for r in rows)


def test_transmission_is_equal_inside_the_region():
    t = transmission({b: wide_scanner(b, 8) for b in BOWTIES})
    inside = t["offset_at_isocentre_mm"] <= 50.0
    np.testing.assert_allclose(t["large+roi"][inside], t["large"][inside], rtol=1e-12)
    assert (t["large+roi"][t["offset_at_isocentre_mm"] > 80.0] < 0.15 * t["large"].max()).all()


def test_ratios_and_regions():
    doses = {"large": CtdiDose(1.0, 4.0), "large+roi": CtdiDose(1.0, 2.0)}
    assert ratios(doses) == pytest.approx({"peripheral": 0.5, "central": 1.0, "weighted": 5.0 / 9.0})
    scene, scanners = water_cylinder(200.0), {b: wide_scanner(b, 8) for b in BOWTIES}
    maps = dose_maps(scene, scanners, VolumeGrid((22, 22), 10.0), 0.35, 0, 0, lambda fraction: None)
    assert region_ratio(maps, scene, ("cylinder",)) == pytest.approx(
        np.nansum(maps.primary[1]) / np.nansum(maps.primary[0])
    )
    assert np.nanmin(maps.ratio) > 0.3
    with pytest.raises(ValueError, match="histories"):
        region_ratio(maps, scene, ("cylinder",), scatter=True)
    with pytest.raises(ValueError, match="voxels"):
        region_ratio(maps, scene, ("bone",))


def test_variance_ratio_of_paired_samples():
    rng = np.random.default_rng(0)
    x = rng.normal(size=40)
    assert _variance_ratio(3.0 * x, x) == pytest.approx((9.0, 9.0, 9.0), rel=1e-6)
    covered = 0
    for _ in range(400):
        common = rng.normal(size=30)
        a, b = common + 0.5 * rng.normal(size=30), common + 0.5 * rng.normal(size=30)
        _, low, high = _variance_ratio(a, b)
        covered += low <= 1.0 <= high
    assert 0.92 < covered / 400 < 0.98


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"views": 4}, ValueError, "views"),
        ({"views": 2.5}, TypeError, "views"),
        ({"realizations": 1}, ValueError, "realizations"),
        ({"histories": 10}, ValueError, "histories"),
        ({"exposure_s": 0.0}, ValueError, "exposure_s"),
        ({"map_mm": math.nan}, ValueError, "map_mm"),
        ({"plaque_doses": ()}, ValueError, "plaque_doses"),
        ({"plaque_realizations": 3}, ValueError, "plaque_realizations"),
        ({"detector": "film"}, ValueError, "detector"),
    ],
)
def test_bad_settings(change, error, match):
    with pytest.raises(error, match=match):
        Settings(**change)


def test_registered():
    settings = registry.build_settings("bowtie", quick=True, seed=3, changes=["histories=0"])
    assert (settings.seed, settings.histories) == (3, 0)
    assert settings.views < Settings().views


@pytest.mark.slow
def test_the_study_at_the_smallest_scale(tmp_path):
    steps = []
    settings = Settings(
        views=96, realizations=2, map_mm=12.0, histories=20_000, plaque_views=40, plaque_doses=(2.0,),
        plaque_realizations=4,
    )  # fmt: skip
    report = run(settings, lambda step, fraction: steps.append((step, fraction)))
    report.save(tmp_path)
    data = json.loads((tmp_path / "report.json").read_text())
    assert (tmp_path / "dose.png").stat().st_size > 10_000
    assert all(0.0 <= f <= 1.0 for _, f in steps)
    assert len({s for s, _ in steps}) == 4
    outcome = {c["name"]: c for c in data["checks"]}
    for name in ("central dose, with / without", "peripheral dose, with / without", "noise inside the ROI"):
        assert next(c for n, c in outcome.items() if name in n)["ok"]
    combined = data["combined"][0]
    assert combined["fbp_variance_ratio_roi_to_large"][2] == pytest.approx(1.0, abs=1e-3)
    assert combined["mbir_variance_ratio_roi_to_large"][0] == pytest.approx(1.0, abs=0.02)
    factor, product = combined["contrast_variance"]["mbir_factor_roi_bowtie"], combined["contrast_variance"]
    saved = 1.0 / data["ctdi_ratios"]["plane"]["weighted"]
    assert product["product_plane"] == pytest.approx([saved * f for f in factor])
    assert "What was modelled" in report.text
    assert "nan" not in report.text.lower().replace("dominan", "")
