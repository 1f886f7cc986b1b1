"""The two basis images of an inset from a spectral scan."""

import pytest
from small_scan import SPECTRAL_GRID as GRID

from recon.analytic.inset import InsetFbp
from recon.least_squares.basis_problem import BasisProblem
from recon.least_squares.qggmrf import QGGMRF


def test_basis_images_of_a_ball(spectral):
    clean, model, lines, around = spectral
    problem = BasisProblem(clean, model, GRID)
    assert problem.anisotropy < 0.1
    images, report = problem.solve(lines, clean.window, QGGMRF(1e-3, 300.0), dose=2.0, tolerance=0.2)
    assert report["converged"]
    assert images.shape == (2, *GRID.shape)
    reference = InsetFbp(clean, [GRID], ["soft"], surround=around).images(lines)[0][0]
    white, fbp_white = (problem.whitening.apply(v) for v in (images, reference))
    for place in ((slice(2, 4), slice(5, 7), slice(5, 7)), (slice(2, 4), slice(0, 2), slice(0, 2))):
        middle = (slice(None), *place)
        # HU at 52 keV, and the second channel in units of equal noise
        assert float((white[middle] - fbp_white[middle]).mean((1, 2, 3)).abs().max()) < 8
    with pytest.raises(ValueError, match="dose"):
        problem.solve(lines, clean.window, dose=0.0)
