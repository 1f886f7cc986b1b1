"""The resolution study: its measures against closed forms, its limits, and a whole run at small
scale."""

import math

import numpy as np
import pytest
import torch
from plaque_image import tissue_volume
from tiny_studies import assert_report_is_whole

from recon.study.paper.plaque_scan import Truth, measure_plaque
from recon.study.resolution import FWHM_PER_SIGMA, blur, blur_series, crossing, limits, point_width
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.roi import axial_grid
from torchpcct.scene.plaque import plaque_scene


@pytest.fixture(scope="module")
def plaque():
    scene, shape = plaque_scene()
    return scene, shape, Truth.of(scene, shape)


def test_blur_is_gaussian_and_keeps_the_mean():
    image = torch.zeros(101, 101, dtype=torch.float64)
    image[50, 50] = 1.0
    out = blur(image, 3.75)
    x = torch.arange(101, dtype=torch.float64) - 50
    assert float(out.sum()) == pytest.approx(1.0, abs=1e-12)
    assert float((out.sum(0) * x**2).sum()) == pytest.approx(3.75**2, rel=0.01)  # cut at 4 σ
    assert torch.equal(blur(image, 0.0), image)
    torch.testing.assert_close(blur(torch.ones(20, 20), 10.0), torch.ones(20, 20))


@pytest.mark.parametrize(("radial", "tangential"), [(0.2, 0.2), (0.25, 0.4)])
def test_width_of_a_known_point(radial, tangential):
    """A Gaussian turned along the direction to the isocentre; the wire's own width is taken off
    in quadrature."""
    grid = VolumeGrid((121, 121), 0.02, (30.0, 40.0))
    y, x = np.meshgrid(grid.axes[0] - 30.0, grid.axes[1] - 40.0, indexing="ij")
    r, t = 0.6 * y + 0.8 * x, 0.8 * y - 0.6 * x
    s = [w / FWHM_PER_SIGMA for w in (radial, tangential)]
    own = 0.03 / 2.0
    image = 7.0 + 3.0 * np.exp(-0.5 * (r**2 / (s[0] ** 2 + own**2) + t**2 / (s[1] ** 2 + own**2)))
    found = point_width(image, grid)
    assert found["radial"] == pytest.approx(radial, rel=0.01)
    assert found["tangential"] == pytest.approx(tangential, rel=0.01)
    assert found["area"] == pytest.approx(math.sqrt(radial * tangential), rel=0.02)
    assert found["undershoot"] == pytest.approx(0.0, abs=1e-6)


def test_crossing():
    assert crossing([0, 1, 2], [0.0, 0.1, 0.3], 0.2) == pytest.approx(1.5)
    assert crossing([0, 1, 2], [0.0, 0.1, math.nan], 0.2) == 2.0
    assert crossing([0, 1, 2], [0.0, 0.1, 0.15], 0.2) == 2.0
    assert crossing([0, 1], [0.5, 0.6], 0.2) == 0.0


def test_where_the_plaque_is(plaque):
    _, shape, truth = plaque
    for point, name in zip(truth.line, ("lumen", "core"), strict=True):
        mask = truth.masks[name]
        assert mask.sum() * 0.035**2 == pytest.approx(float(shape.area(name)), rel=0.01)
        index = [
            round((p - a[0]) / 0.035) for p, a in zip(point, truth.image.axes[1:], strict=True)
        ]
        assert mask[tuple(index)]


def test_a_disc_is_found_where_it_is():
    grid = axial_grid((0.0, 0.0, 0.0))
    y, x = np.meshgrid(*grid.slice.axes, indexing="ij")
    disc = np.hypot(y - 0.1, x - 0.2) < 1.0
    image = torch.from_numpy(np.where(disc, 500.0, -100.0))
    found = measure_plaque(
        image, Truth(grid, {"lumen": disc, "core": disc}, ((0.1, 0.2), (0.1, 2.2)))
    )
    assert found["lumen_dice"] == 1.0
    assert found["core_dice"] == 0.0
    assert found["lumen_mm2"] == pytest.approx(math.pi, rel=0.01)


def _ideal(plaque, sigma_px):
    """The plaque's axial image with ideal edges, blurred by a system of ``sigma_px``."""
    scene, _, truth = plaque
    return blur(tissue_volume(scene, truth.image)[0], sigma_px)


@pytest.fixture(scope="module")
def series(plaque):
    return blur_series(_ideal(plaque, 4.0), plaque[2], (0.0, 1.25, 2.5, 3.75, 5.0, 7.5, 10.0))


def test_blur_takes_cap_core_and_lumen(series):
    areas = [b["lumen_mm2"] for b in series]
    caps = [b["cap_line_mm"] for b in series]
    depths = [b["basin_depth_hu"] for b in series]
    assert areas == sorted(areas, reverse=True)
    assert caps == sorted(caps)
    assert depths == sorted(depths, reverse=True)
    assert series[0]["core_found"]
    assert not series[-1]["core_found"]
    assert depths[-1] < 1.0
    found = limits(series, 0.2)
    assert 1.25 < found["cap"] < 5.0
    assert found["core_lost"] in {b["sigma_px"] for b in series if not b["core_found"]}
    assert found["basin"] < 7.5
    assert limits(series[:1], 0.2)["core_lost"] is None


def test_a_thicker_blur_before_is_a_thinner_blur_after(plaque, series):
    """Gaussians add in quadrature: the sharper system bears a wider blur before it shows the
    same."""
    direct = measure_plaque(_ideal(plaque, math.hypot(4.0, 5.0)), plaque[2])
    twice = next(b for b in series if b["sigma_px"] == 5.0)
    assert twice["cap_line_mm"] == pytest.approx(direct["cap_line_mm"], abs=0.002)
    assert twice["lumen_mm2"] == pytest.approx(direct["lumen_mm2"], rel=2e-3)


@pytest.mark.extended
def test_the_scanners(tiny):
    """The EID-CT is the blunter one; the core's part of the contrast goes first."""
    measured = tiny("resolution").measured
    pcct, eid = (measured.data["scanners"][name] for name in ("PCCT", "EID-CT"))
    assert 0.2 < pcct["fwhm_mm"]["area"] < 0.5 * eid["fwhm_mm"]["area"]
    contrast, empty = (pcct[key][1] - pcct[key][0] for key in ("roi_hu", "empty_hu"))
    assert pcct["own_contrast_hu"] == pytest.approx(contrast - empty)
    assert eid["own_contrast_hu"] < 0.5 * pcct["own_contrast_hu"]
    assert eid["contrast_sd_hu"] < pcct["contrast_sd_hu"]
    assert eid["exposure_s"] == pytest.approx(measured.settings.exposure_s * (541 / 626) ** 2)
    assert [b["sigma_px"] for b in pcct["blurred"]] == list(measured.settings.sigmas_px)
    assert len(eid["blurred"]) == 1


@pytest.mark.extended
def test_report(tiny, tmp_path):
    """Every row of the list is there; a core that is lost early names its cause."""
    study = tiny("resolution")
    sections = (
        "## The two scanners",
        "## PCCT under blur",
        "## Agreement with the paper",
        "## What was modelled",
    )
    data = assert_report_is_whole(
        study, tmp_path, {"resolution.png", "resolution_images.png"}, sections
    )
    assert len(data["checks"]) == 13
    assert all(
        c["note"]
        for c in data["checks"]
        if not c["ok"] and ("rim" in c["name"] or "CNR" in c["name"])
    )
    width = data["scanners"]["PCCT"]["fwhm_mm"]["area"]
    assert data["final_fwhm_mm"] == pytest.approx(math.hypot(width, data["margin_fwhm_mm"]))
    # The report says what the criterion starts from, in a word of the figure's sign.
    excess = data["scanners"]["PCCT"]["blurred"][0]["cap_line_mm"] / data["truth"]["cap_mm"] - 1.0
    assert data["cap_excess"] == pytest.approx(excess)
    assert f"{100 * abs(excess):.0f} % too {'thick' if excess > 0 else 'thin'}" in study.report.text
