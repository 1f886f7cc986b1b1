"""The small noise-free scan that several tests reconstruct."""

import pytest
from small_scan import GRID, SCENE, scanner

from recon.pwls.inset_problem import InsetProblem
from torchpcct import acquire


@pytest.fixture(scope="session")
def clean():
    return acquire(SCENE, scanner(), region=GRID, duty=0.06, sub_rays=16)


@pytest.fixture(scope="session")
def problem(clean):
    return InsetProblem(clean, GRID)
