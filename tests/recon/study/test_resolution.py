"""The resolution study: its measures against closed forms, its limits, and a whole run at small scale."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.study import registry
from recon.study.resolution.blur import (
    FWHM_PER_SIGMA,
    blur,
    centers,
    crossing,
    measure,
    point_width,
    truth,
)
from recon.study.resolution.measure import Imaged, Measured, Settings
from recon.study.resolution.report import build_report, limits
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.resolution import ellipsoid_distance
from torchpcct.metrics.roi import axial_grid
from torchpcct.scene.plaque import plaque_scene


@pytest.fixture(scope="module")
def plaque():
    return plaque_scene()


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
    """A Gaussian turned along the direction to the isocentre; the wire's own width is taken off in quadrature."""
    grid = VolumeGrid((121, 121), 0.02, (30.0, 40.0))
    y, x = np.meshgrid(grid.axes[0] - 30.0, grid.axes[1] - 40.0, indexing="ij")
    r, t = 0.6 * y + 0.8 * x, 0.8 * y - 0.6 * x
    s = [w / FWHM_PER_SIGMA for w in (radial, tangential)]
    own = 0.03 / 2.0
    image = 7.0 + 3.0 * np.exp(-0.5 * (r**2 / (s[0] ** 2 + own**2) + t**2 / (s[1] ** 2 + own**2)))
    found = point_width(image, grid)
    assert found.radial == pytest.approx(radial, rel=0.01)
    assert found.tangential == pytest.approx(tangential, rel=0.01)
    assert found.area == pytest.approx(math.sqrt(radial * tangential), rel=0.02)
    assert found.undershoot == pytest.approx(0.0, abs=1e-6)


def test_crossing():
    assert crossing([0, 1, 2], [0.0, 0.1, 0.3], 0.2) == pytest.approx(1.5)
    assert crossing([0, 1, 2], [0.0, 0.1, math.nan], 0.2) == 2.0
    assert crossing([0, 1, 2], [0.0, 0.1, 0.15], 0.2) == 2.0
    assert crossing([0, 1], [0.5, 0.6], 0.2) == 0.0


def test_where_the_plaque_is(plaque):
    scene, shape = plaque
    image = axial_grid(shape.position[::-1])
    masks = truth(scene, image)
    for name in ("lumen", "core"):
        assert masks[name].sum() * 0.035**2 == pytest.approx(float(shape.area(name)), rel=0.01)
    lumen, core = centers(shape)
    for point, name in ((lumen, "lumen"), (core, "core")):
        index = [round((p - a[0]) / 0.035) for p, a in zip(point, image.axes[1:], strict=True)]
        assert masks[name][tuple(index)]


def _ideal(plaque, sigma_px=6.0):
    """The plaque's axial image with ideal edges, blurred by a system of 0.49 mm, its tissues at their target values."""
    scene, shape = plaque
    image = axial_grid(shape.position[::-1])
    values = {"patient": -100.0, "wall": 60.0, "fibrous": 100.0, "lumen": 470.0, "core": 40.0}
    labels = scene.labels(image)[0]
    ideal = torch.zeros(labels.shape, dtype=torch.float64)
    for name, value in values.items():
        ideal[torch.from_numpy(labels == scene.index(name))] = value
    return image, blur(ideal, sigma_px)


@pytest.fixture(scope="module")
def series(plaque):
    image, sharp = _ideal(plaque, 4.0)
    masks, line = truth(plaque[0], image), centers(plaque[1])
    return [measure(sharp, image, s, masks, line) for s in (0.0, 1.25, 2.5, 3.75, 5.0, 7.5, 10.0)]


def test_blur_takes_cap_core_and_lumen(series):
    areas = [b.segmentation.lumen_area for b in series]
    caps = [b.cap_line for b in series]
    depths = [b.depth for b in series]
    assert areas == sorted(areas, reverse=True)
    assert caps == sorted(caps)
    assert depths == sorted(depths, reverse=True)
    assert series[0].segmentation.core_found
    assert not series[-1].segmentation.core_found
    assert depths[-1] < 1.0
    found = limits(series, 0.2)
    assert 1.25 < found["cap"] < 5.0
    assert found["core_lost"] in {b.sigma_px for b in series}
    assert found["basin"] < 7.5


def test_a_thicker_blur_before_is_a_thinner_blur_after(plaque, series):
    """Gaussians add in quadrature: the sharper system bears a wider blur before it shows the same."""
    image, _ = _ideal(plaque)
    masks, line = truth(plaque[0], image), centers(plaque[1])
    direct = measure(_ideal(plaque, math.hypot(4.0, 5.0))[1], image, 0.0, masks, line)
    twice = next(b for b in series if b.sigma_px == 5.0)
    assert twice.cap_line == pytest.approx(direct.cap_line, abs=0.002)
    assert twice.segmentation.lumen_area == pytest.approx(direct.segmentation.lumen_area, rel=2e-3)


def test_a_disc_is_found_where_it_is():
    grid = axial_grid((0.0, 0.0, 0.0))
    distance = ellipsoid_distance(grid.slice, (0.1, 0.2), (1.0, 1.0))
    image = torch.from_numpy(np.where(distance < 0, 500.0, -100.0))
    masks = {"lumen": distance < 0, "core": distance < 0}
    found = measure(image, grid, 0.0, masks, ((0.1, 0.2), (0.1, 2.2)))
    assert found.lumen_dice == 1.0
    assert found.core_dice == 0.0
    assert found.as_dict()["lumen_mm2"] == pytest.approx(math.pi, rel=0.01)


def test_report(plaque, series):
    """Every row of the list is there; a core that is lost early names its cause."""
    image, sharp = _ideal(plaque)
    from recon.study.resolution.blur import SystemWidth

    plan = {"effects": [{"name": "focal spot", "modelled": True, "cost_hu": 3.0, "note": ""}], "tolerance_hu": 0.5}
    tall = torch.zeros(200, 256, dtype=torch.float64)
    width = SystemWidth(0.3, 0.3, 0.3, -0.01)
    pcct = Imaged(sharp, tall, (41.0, 92.0), (95.0, 96.0), 25.0, 2.0, width, list(series), plan)
    eid = replace(pcct, roi_hu=(66.0, 76.0), blurred=[series[-1]])
    settings = Settings(sigmas_px=tuple(b.sigma_px for b in series))
    measured = Measured(
        settings, plaque[1], image, {"PCCT": pcct, "EID-CT": eid}, {0.45: (0.22, list(series))},
        {"lumen": 4.1, "core": 1.9},
    )  # fmt: skip
    report = build_report(measured)
    names = [c["name"] for c in report.data["checks"]]
    assert len(names) == 13
    assert report.data["final_fwhm_mm"] == pytest.approx(math.hypot(0.3, report.data["margin_fwhm_mm"]))
    assert set(report.figures) == {"resolution.png", "resolution_images.png"}
    assert "## What was modelled" in report.text
    assert pcct.own_contrast_hu == pytest.approx(50.0)


def test_settings():
    assert registry.build_settings("resolution", quick=True).thinning == 8
    for change, message in (
        ({"thinning": 0}, "thinning"),
        ({"sigmas_px": (1.0, 2.0, 3.0)}, "rise from 0"),
        ({"sigmas_px": (0.0, 2.0, 1.0)}, "rise from 0"),
        ({"tolerance": 1.5}, "tolerance"),
        ({"exposure_s": 0.0}, "exposure_s"),
    ):
        with pytest.raises(ValueError, match=message):
            Settings(**change)
