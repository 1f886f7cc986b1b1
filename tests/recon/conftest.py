"""The small noise-free scans that several tests reconstruct."""

import pytest
from small_scan import GRID, SCENE, SPECTRAL_GRID, scanner

from recon.least_squares.inset_problem import InsetProblem
from torchpcct import acquire
from torchpcct.spectral import SpectralModel, decompose_scan, decompose_surround


@pytest.fixture(scope="session")
def clean():
    return acquire(SCENE, scanner(), region=GRID, duty=0.06, sub_rays=16)


@pytest.fixture(scope="session")
def problem(clean):
    return InsetProblem(clean, GRID)


@pytest.fixture(scope="session")
def spectral():
    """A noise-free spectral scan of the ball, its model, line integrals and those of the surround."""
    s = scanner("spectral", rows=10)
    clean, model = acquire(SCENE, s, region=SPECTRAL_GRID, duty=0.06, sub_rays=16), SpectralModel.of(s, 1.0)
    return clean, model, decompose_scan(clean, model).line_integrals, decompose_surround(clean, model)
