"""The same bits on one thread and on two: a result must not depend on how busy, or how large, the machine is."""

import numba
import pytest
import torch
from small_scan import GRID

from recon import reconstruct
from recon.fbp.fbp import fbp
from torchpcct import Projector

METHODS = ("fbp", "pwls", "mbir")


def _on(threads, compute):
    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(threads)
    torch.set_num_threads(threads)
    try:
        return compute()
    finally:
        numba.set_num_threads(before[0])
        torch.set_num_threads(before[1])


def _both(compute):
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("numba was started on one thread")
    return _on(1, compute), _on(2, compute)


def test_projector_and_its_adjoint(clean):
    A = Projector(clean.geometry, GRID)
    x = torch.rand(GRID.shape, generator=torch.Generator().manual_seed(0))
    forward = _both(lambda: A(x))
    assert torch.equal(*forward)
    assert torch.equal(*_both(lambda: A.T(forward[0])))


def test_fbp_of_line_integrals(clean):
    g = clean.geometry.central_fan
    lines = torch.rand(g.shape, generator=torch.Generator().manual_seed(0))
    assert torch.equal(*_both(lambda: fbp(lines, g, GRID.slice, outside=0.0)))


@pytest.mark.parametrize("method", METHODS)
def test_reconstructions(clean, method):
    noisy = clean.with_noise(2.0, 0)
    one, two = _both(lambda: reconstruct(noisy, GRID, method).data)
    difference = float((one - two).abs().max())
    print(f"{method}: {difference:.3g} HU between one thread and two")
    assert torch.equal(one, two)
