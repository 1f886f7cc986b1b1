"""The linear response: dense matrices, drawn noise, and figures that it controls."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from inset_operators import HU, problem, term_of, tissue

from recon.evaluate.response import response, right_hand_side_covariance
from recon.gram.gram import Gram
from recon.mbir.mbir import Mbir
from recon.mbir.network import NetworkConfig
from recon.mbir.unrolled import Unrolled

SHAPE = (6, 8, 8)
DOSE = 0.5


@pytest.fixture(scope="module")
def inset():
    """A small inset in double precision, with the attributes of an InsetProblem that methods ask
    for."""
    A, w = problem(shape=SHAPE, rows=10, dtype=torch.float64)
    gram = Gram(A, w, nodes=1)
    p = SimpleNamespace(
        gram=gram, grid=A.grid, mu_ref=1000 * HU, level=-0.1 * 1000 * HU, projector=A, weights=w
    )
    return p, gram.apply(tissue(A.grid).double()) * DOSE


@pytest.fixture(scope="module")
def weights():
    """A small ball, a voxel, a plane's worth of the rest."""
    found = torch.zeros(3, *SHAPE, dtype=torch.float64)
    found[0, 2:4, 3:5, 3:5] = 1 / 8
    found[1, 3, 1, 6] = 1.0
    found[2, 1] = 1 / 64
    return found


def method(**parts):
    """Random weights; without its steps it is linear."""
    torch.manual_seed(1)
    model = Unrolled(NetworkConfig((6, 8, 8), 0.4), 2)
    torch.nn.init.normal_(model.network.leave.weight, std=0.02)
    network = Mbir(model.double(), **parts)
    return network


def test_of_a_linear_method_is_its_matrix(inset, weights):
    p, b = inset
    run = method(steps=0)
    n, size = math.prod(SHAPE), 1e-2 / HU
    eye = size * torch.eye(n, dtype=torch.float64).reshape(n, *SHAPE)
    zero = run(term_of(p, torch.zeros_like(eye[:1]), DOSE))
    dense = (
        (torch.cat([run(term_of(p, part, DOSE)) for part in eye.split(128)]) - zero).reshape(n, n)
        / size
    ).T
    found = response(run, p, weights, term_of(p, b[None], DOSE), DOSE).reshape(3, -1)
    expected = weights.reshape(3, -1) @ dense
    assert float((found - expected).norm() / expected.norm()) < 2e-4


def test_follows_a_network(inset, weights):
    """g·b of draws that it was not averaged over is correlated with the method's own means, and
    of equal size."""
    p, b = inset
    run = method()
    g = response(run, p, weights, term_of(p, b[None], DOSE), DOSE)
    noise = p.gram.noise((200,), generator=torch.Generator().manual_seed(5)).to(b) * DOSE**0.5
    drawn = torch.einsum(
        "nzyx,rzyx->nr", run(term_of(p, b + noise, DOSE)).detach(), weights
    ).numpy()
    linear = torch.einsum("nzyx,rzyx->nr", b + noise, g).numpy()
    for k in range(3):
        assert np.corrcoef(drawn[:, k], linear[:, k])[0, 1] > 0.9
        assert linear[:, k].std() == pytest.approx(drawn[:, k].std(), rel=0.25)


def test_covariance_is_that_of_projections(inset, weights, monkeypatch):
    """gᵀ AᵀW V W A g by explicit projections."""
    p, _ = inset
    variance = (
        torch.rand(p.weights.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
        + 0.5
    )
    clean = SimpleNamespace(window="w", geometry="g", crop=lambda window: "cropped")
    monkeypatch.setattr(
        "recon.evaluate.response.line_integral_variance", lambda scan, exposure: variance / exposure
    )
    inner = SimpleNamespace(
        weights=p.weights, projector=p.projector, outer="w", geometry="g", window="w"
    )
    found = right_hand_side_covariance(inner, weights, DOSE, clean)
    rows = [p.projector(w) * p.weights * DOSE for w in weights]
    expected = [[float((a * b * variance / DOSE).sum()) for b in rows] for a in rows]
    np.testing.assert_allclose(found, expected, rtol=1e-10)
    with pytest.raises(ValueError, match="another geometry or window"):
        right_hand_side_covariance(inner, weights, DOSE, SimpleNamespace(window="x", geometry="g"))
