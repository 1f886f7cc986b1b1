"""Logarithms of few photons: how far the image is off is foretold; counts are not off."""

import re

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, line_integrals
from scipy.ndimage import uniform_filter

from recon.analytic import few_photons
from recon.analytic.few_photons import bias_warnings
from recon.analytic.water_unit import row_image
from torchpcct import ConeBeam, FanBeam, Scan, full_turn

MU = 0.02
G = FanBeam(full_turn(240), 570.0, 1040.0, 128, 3.6, 0.9)
LINES = line_integrals(
    G,
    [
        Ellipsoid((0.0, 0.0), (70.0, 95.0), value=MU),
        Ellipsoid((-42.0, 0.0), (13.0, 13.0), value=MU),
        Ellipsoid((38.0, 9.0), (10.0, 10.0), value=0.3 * MU),
    ],
    sub=1,
)


def read(air, seed=0):
    return np.random.default_rng(seed).poisson(air * np.exp(-LINES)).astype(float)


LOGARITHMS = {
    "zeros as half a photon": (lambda n, air: np.log(air / np.maximum(n, 0.5)), 1),
    "zeros as one photon": (lambda n, air: np.log(air / np.maximum(n, 1.0)), 1),
    "one more": (lambda n, air: np.log((air + 1.0) / (n + 1.0)), -1),
    "half of one more": (lambda n, air: np.log(air / (n + 0.5)), 0),
}


def said(scan):
    texts = bias_warnings(scan, scan.line_integrals(), G)
    return float(re.findall(r"by about ([\d.e+]+) HU", texts[0])[0]) if texts else 0.0, texts


@pytest.mark.parametrize("air", [120.0, 300.0])
@pytest.mark.parametrize("name", LOGARITHMS)
def test_the_error_of_logarithms_is_foretold(name, air):
    make, side = LOGARITHMS[name]
    told = []
    for seed in range(4):
        scan = Scan.from_line_integrals(make(read(air, seed), air), G, mu_water=MU)
        size, texts = said(scan)
        told.append(size)
        if texts and "right where a half was" not in texts[0]:
            assert side
            assert ("too high" if side > 0 else "too low") in texts[0]
    if not side:
        assert max(told) < 60.0
        return
    mean = np.mean([make(read(air, seed), air) for seed in range(40)], 0)
    off, density = (
        uniform_filter(row_image(torch.from_numpy(p), G), 8) for p in (mean - LINES, LINES)
    )
    worst = 1000.0 / MU * float((side * off)[density > 0.4 * density.max()].max())
    assert worst > 30.0
    assert np.array(told) / worst == pytest.approx(1.0, abs=0.35)


def test_counts_and_many_photons_are_not_off():
    for air in (60.0, 300.0, 1e4):
        assert said(Scan.from_counts(read(air), G, air=air, mu_water=MU))[1] == []
    clear = np.log(1e4 / np.maximum(read(1e4), 0.5))
    assert said(Scan.from_line_integrals(clear, G, mu_water=MU))[1] == []
    assert said(Scan.from_line_integrals(LINES, G, mu_water=MU))[1] == []


def test_rays_of_no_photons_are_not_known():
    """Electronic noise leaves less of what the darkest rays say."""
    y = read(20.0) + 4.0 * np.random.default_rng(1).standard_normal(LINES.shape)
    scan = Scan.from_counts(y, G, air=20.0, mu_water=MU, electronic_noise=4.0)
    size, (text,) = said(scan)
    assert "their number is not known" in text
    assert "too low" in text
    assert size > 200.0


@pytest.fixture
def foretold(monkeypatch):
    """Warnings where line integrals are off by a share of them, as is known or not."""

    def texts(share, sure=True, scan=None, geometry=G, of=LINES):
        scan = (
            Scan.from_line_integrals(LINES, G, photons=100.0, mu_water=MU) if scan is None else scan
        )
        error = torch.as_tensor(share * of)
        monkeypatch.setattr(few_photons, "logarithm_error", lambda scan: (error, sure))
        lines = scan.line_integrals()
        return bias_warnings(
            scan, lines if lines.ndim == 2 or geometry.has_rows else lines[1], geometry
        )

    return texts


def test_twice_the_error_is_tolerated_where_it_is_not_known_well(foretold):
    """At the brighter body it is twice its share of the rest."""
    counts = Scan.from_counts(read(100.0), G, air=100.0, mu_water=MU)
    assert "too high" in foretold(0.011)[0]
    assert "too low" in foretold(-0.011)[0]
    assert not foretold(0.005)
    for less in ({"sure": False}, {"scan": counts}):
        assert not foretold(0.011, **less)
        assert foretold(0.022, **less)


def test_the_size_is_in_the_unit_of_the_volume(foretold):
    (text,) = foretold(0.1)
    assert float(re.findall(r"by about ([\d.e+]+) HU", text)[0]) == pytest.approx(200.0, rel=0.2)
    (text,) = foretold(0.1, scan=Scan.from_line_integrals(LINES, G, photons=100.0))
    size = float(re.findall(r"by about ([\d.e-]+) mm\^-1", text)[0])
    assert size == pytest.approx(0.2 * MU, rel=0.2)


def test_the_row_and_the_slice_that_are_shown_are_looked_at(foretold):
    """The row that is off by most, and the middle slice of a stack."""
    cone = ConeBeam(G.angles, G.sod, G.sdd, G.columns, 3, (3.6, G.pitch), (0.0, G.offset))
    rows = np.stack([0.0 * LINES, LINES, 0.0 * LINES], 1)
    scan = Scan.from_line_integrals(np.stack([LINES] * 3, 1), cone, photons=100.0, mu_water=MU)
    assert foretold(0.1, scan=scan, geometry=cone, of=rows)
    stack = Scan.from_line_integrals(np.stack([LINES] * 3), G, photons=100.0, mu_water=MU)
    assert foretold(0.1, scan=stack, of=np.stack([0.0 * LINES, LINES, 0.0 * LINES]))
    assert not foretold(0.1, scan=stack, of=np.stack([LINES, 0.0 * LINES, LINES]))
