"""Angles that scatter about the described ones, by conjugate rays: found and measured below what
neighbouring views tell, and told from other faults."""

import re
from dataclasses import replace

import numpy as np
import pytest
from analytic import Ellipsoid, line_integrals

from torchpcct import FanBeam, ParallelBeam, Scan, full_turn
from torchpcct.checks.conjugate_rays import geometry_test
from torchpcct.checks.neighbours import neighbour_test

MU = 0.02
BODIES = [
    Ellipsoid((2.0, -3.0), (70.0, 92.0), value=MU),
    *(
        Ellipsoid(
            (55.0 * np.cos(a), 40.0 * np.sin(a)), (5.0 + a, 8.0), a, value=(-0.5 + 0.4 * a) * MU
        )
        for a in np.arange(6.0)
    ),
]
STEP = 2.0 * np.pi / 360
BEAMS = {
    "parallel": ParallelBeam(full_turn(360), 128, 1.7, 0.4),
    "fan": FanBeam(full_turn(360), 600.0, 1100.0, 128, 3.2, 0.8),
}
SHONE = {name: np.exp(-line_integrals(g, BODIES, sub=1)) for name, g in BEAMS.items()}


def _lines(beam, seed=0, photons=3e4, gains=1.0):
    n = np.random.default_rng(seed).poisson(photons * SHONE[beam]) * gains
    return Scan.from_counts(n, BEAMS[beam], air=photons, mu_water=MU).line_integrals()


def _turned(beam, offsets):
    return replace(BEAMS[beam], angles=BEAMS[beam].angles + offsets * STEP)


@pytest.mark.parametrize("beam", BEAMS)
def test_angles_that_scatter_are_found_and_measured(beam):
    for seed in range(3):
        offsets = 0.4 * np.random.default_rng(seed).standard_normal(360)
        found = geometry_test(_lines(beam, seed, photons=3e5), _turned(beam, offsets))
        (text,) = found.findings
        assert re.search(r"views scatter by about 0\.[2345] of a step", text)
        assert abs(found.sizes["view_scatter"] - 0.4) < 0.15


def test_the_size_of_the_scatter_is_as_uncertain_as_is_stated():
    sizes, stated = [], []
    for seed in range(12):
        offsets = 0.4 * np.random.default_rng(seed).standard_normal(360)
        found = geometry_test(_lines("parallel", seed, photons=3e5), _turned("parallel", offsets))
        sizes.append(found.sizes["view_scatter"])
        stated.append(found.errors["view_scatter"])
    assert 0.55 < np.std(sizes) / np.mean(stated) < 1.6


@pytest.mark.parametrize("beam", BEAMS)
def test_nothing_else_is_taken_for_scatter(beam):
    v = np.arange(360)
    described = {
        "sound": _turned(beam, 0.0 * v),
        "uneven": _turned(beam, 2.0 * np.sin(3.0 * v * STEP)),
        "by turns": _turned(beam, 0.4 * (-1.0) ** v),
        "small": _turned(beam, 0.05 * np.random.default_rng(1).standard_normal(360)),
    }
    for name, g in described.items():
        said = geometry_test(_lines(beam), g).findings
        assert not any("scatter" in text for text in said), name
    flicker = 1.0 + 0.02 * np.random.default_rng(2).standard_normal((360, 1))
    said = geometry_test(_lines(beam, gains=flicker), BEAMS[beam]).findings
    assert not any("scatter" in text for text in said)


def test_conjugate_rays_tell_what_neighbours_do_not():
    offsets = 0.4 * np.random.default_rng(4).standard_normal(360)
    lines, g = _lines("fan", 4), _turned("fan", offsets)
    assert not any("scatter" in text for text in neighbour_test(lines, g).findings)
    assert any("scatter" in text for text in geometry_test(lines, g).findings)
