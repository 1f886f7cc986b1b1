"""One thread and two: our kernels give the same bits; torch's matrix products and convolutions
stay within a bound."""

import pytest
import torch
from small_scan import GRID

from recon import reconstruct
from recon.analytic.fbp import fbp
from torchpcct.threads import get_num_threads, set_num_threads

TOLERANCE_HU = {"fbp": 0.0, "pwls": 0.0, "mbir": 0.01}
"""As the docstring of :func:`recon.reconstruct` says; measured for MBIR: 8e-5 … 2.4e-4 HU."""


def _on(threads, compute):
    before = get_num_threads(), torch.get_num_threads()
    set_num_threads(threads)
    torch.set_num_threads(threads)
    try:
        return compute()
    finally:
        set_num_threads(before[0])
        torch.set_num_threads(before[1])


def _both(compute):
    return _on(1, compute), _on(2, compute)


def test_fbp_of_line_integrals(clean):
    g = clean.geometry.central_fan
    lines = torch.rand(g.shape, generator=torch.Generator().manual_seed(0))
    one, two = _both(lambda: fbp(lines, g, GRID.slice, outside=0.0))
    # Whole rows are filtered by matrix products of 1500 terms, whose order BLAS chooses by the
    # number of threads.
    assert float((one - two).abs().max()) <= 1e-5 * float(one.abs().max())


@pytest.mark.extended
@pytest.mark.parametrize("method", TOLERANCE_HU)
def test_reconstructions(clean, method):
    noisy = clean.with_noise(2.0, 0)
    one, two = _both(lambda: reconstruct(noisy, GRID, method).data)
    assert float((one - two).abs().max()) <= TOLERANCE_HU[method]
