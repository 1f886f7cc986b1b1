"""Study ``bowtie``: noise model and corrections of its slices, intervals, and a run at the
smallest scale."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_studies import assert_report_is_whole

from recon.study.bowtie import (
    dose_maps,
    polynomial_linearisation,
    radial_profile,
    ratios,
    region_ratio,
    slice_image,
    slice_scans,
    transmission,
    wide_scanners,
)
from torchpcct.dose import CtdiDose
from torchpcct.geometry import VolumeGrid
from torchpcct.scene import SinusoidalMotion
from torchpcct.scene.materials import material
from torchpcct.scene.phantoms.quality import water_cylinder

EXPOSURE_S = 0.35


@pytest.fixture(scope="module")
def scanners():
    return wide_scanners(120)


@pytest.fixture(scope="module")
def water(scanners):
    return slice_scans(water_cylinder(200.0), scanners)


def test_the_polynomial_meets_its_calibration(scanners):
    scanner = scanners["large+roi"]
    line = polynomial_linearisation(scanner)
    assert line.coefficients.shape == (scanner.geometry.columns, 5)
    for t in (10.0, 200.0, 380.0):
        p = -np.log(
            scanner.behind({material("water"): t})[0].sum(-1) / scanner.weights()[1][0].sum(-1)
        )
        reached = line.apply(torch.from_numpy(p)).numpy() / line.mu_ref
        np.testing.assert_allclose(reached, t, atol=0.15)
    assert line.mu_ref == pytest.approx(scanner.water_linearisation().mu_ref, rel=1e-12)


def test_water_reads_zero_with_both_bowties(water):
    grid = VolumeGrid((150, 150), 1.5)
    for scan in water.values():
        profile = radial_profile(slice_image(scan, grid, "soft"), grid, 90.0)
        assert np.abs(profile[:, 1]).max() < 3.0
        assert profile[0, 0] == 2.5


def test_expected_readings_are_those_of_the_scanner(scanners, water):
    """The central ray crosses 200 mm of water."""
    for bowtie, scanner in scanners.items():
        middle = scanner.geometry.columns // 2
        half = math.sin(float(scanner.geometry.fan_angles[middle])) * 626.0
        chord = 2.0 * math.sqrt(100.0**2 - half**2)
        expected = scanner.behind({material("water"): chord})[
            0, middle
        ].sum() * scanner.mas_per_view(1.0)
        assert float(water[bowtie].counts[0, 0, middle]) == pytest.approx(expected, rel=2e-5)


def test_noise_has_the_detector_s_variance_and_is_paired(water):
    large, roi = water.values()
    middle = slice(large.counts.shape[-1] // 2 - 5, large.counts.shape[-1] // 2 + 5)

    def lines(scan, seed):
        return scan.with_noise(EXPOSURE_S, seed).line_integrals()[..., middle]

    def spread(scan):
        return torch.stack([lines(scan, k) for k in range(60)]).double()

    p = torch.log(large.air) - torch.log(large.counts)
    slope = large.linearisation.slope(p)[..., middle].double()
    expected = slope.square() * large.relative_variance(EXPOSURE_S)[..., middle]
    assert float((spread(large).var(0) / expected).mean()) == pytest.approx(1.0, abs=0.02)
    # At a dozen quanta a reading, the logarithm without the half quantum would be off by 0.04.
    few = 12.0 / (EXPOSURE_S * float((large.counts / large.quantum).min()))
    dark = replace(large, counts=large.counts * few, air=large.air * few)
    bias = float((spread(dark) - dark.line_integrals()[..., middle].double()).mean())
    assert abs(bias) < 0.01
    # Inside the region of interest both bowties give the same readings, and the same noise.
    torch.testing.assert_close(lines(roi, 3), lines(large, 3))
    middle = slice(0, 40)
    assert not torch.allclose(lines(roi, 3), lines(large, 3))


def test_what_slices_cannot_be_is_refused(scanners):
    with pytest.raises(ValueError, match="the scene moves"):
        slice_scans(water_cylinder().with_motion(SinusoidalMotion("cylinder", 1.0)), scanners)
    with pytest.raises(ValueError, match="detector"):
        wide_scanners(8, "film")


def test_silicon_cells_are_the_pcct_s():
    scanner = wide_scanners(8, "silicon")["large"]
    assert scanner.geometry.pitch == (0.5, 0.35)
    assert not scanner.detector.energy_integrating


def test_transmission_is_equal_inside_the_region():
    t = transmission(wide_scanners(8))
    inside = t["offset_at_isocentre_mm"] <= 50.0
    np.testing.assert_allclose(t["large+roi"][inside], t["large"][inside], rtol=1e-12)
    assert (t["large+roi"][t["offset_at_isocentre_mm"] > 80.0] < 0.15 * t["large"].max()).all()


def test_ratios_and_regions():
    doses = {"large": CtdiDose(1.0, 4.0), "large+roi": CtdiDose(1.0, 2.0)}
    assert ratios(doses) == pytest.approx(
        {"peripheral": 0.5, "central": 1.0, "weighted": 5.0 / 9.0}
    )
    scene, scanners = water_cylinder(200.0), wide_scanners(8)
    maps = dose_maps(scene, scanners, VolumeGrid((22, 22), 10.0), EXPOSURE_S, 0, 0)
    large, roi = maps.doses["unscattered"]
    assert region_ratio(maps, scene, ("cylinder",)) == {
        "unscattered": pytest.approx(np.nansum(roi) / np.nansum(large))
    }
    assert np.nanmin(roi[large > 0] / large[large > 0]) > 0.3
    with pytest.raises(ValueError, match="voxels"):
        region_ratio(maps, scene, ("bone",))


@pytest.mark.slow
def test_report(tiny, tmp_path):
    sections = (
        "## CTDI phantom",
        "## Thorax",
        "## Noise",
        "## MBIR and ROI bowtie",
        "## What was modelled",
    )
    study = tiny("bowtie")
    data = assert_report_is_whole(study, tmp_path, {"bowtie.png"}, sections)
    assert len({step for step, _ in study.steps}) >= 5
    assert "was fitted to" in study.report.text
    outcome = {c["name"]: c for c in data["checks"]}
    for name in (
        "central dose, with / without",
        "peripheral dose, with / without",
        "noise inside the ROI",
    ):
        assert next(c for n, c in outcome.items() if name in n)["ok"]
    combined = data["combined"][0]
    factor, product = (
        combined["contrast_variance"]["mbir_factor_roi_bowtie"],
        combined["contrast_variance"],
    )
    assert product["fbp_ratio_roi_to_large"] == pytest.approx(1.0, abs=5e-3)
    assert factor == pytest.approx(product["mbir_factor_large_bowtie"], rel=0.05)
    saved = 1.0 / data["ctdi_ratios"]["plane"]["weighted"]
    assert product["product_plane"] == pytest.approx([saved * f for f in factor])
    assert "nan" not in study.report.text.lower().replace("dominan", "")
