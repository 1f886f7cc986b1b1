"""The FFT model of AᵀWA against the exact operator."""

import math

import pytest
import torch
from inset_operators import CENTER, HU, matrix, problem, tissue
from refusals import refused
from standin import DEVICE, standin

from recon.gram.gram import Gram, make_definite
from torchpcct import FanBeam, Projector, VolumeGrid
from torchpcct.detector_window import footprint
from torchpcct.geometry import full_turn


@pytest.fixture(scope="module")
def inset():
    A, w = problem(shape=(6, 11, 11), rows=8)
    return A, w, Gram(A, w)


def error(gram, A, w, x):
    """‖G x − AᵀWA x‖ / ‖AᵀWA x‖ of each volume."""
    exact = A.T(w * A(x))
    axes = tuple(range(-gram.grid.ndim, 0))
    norm = torch.linalg.vector_norm
    return norm(gram.apply(x) - exact, dim=axes) / norm(exact, dim=axes)


def test_error_on_tissue_and_on_noise(inset):
    A, w, gram = inset
    noise = torch.randn(A.domain_shape, generator=torch.Generator().manual_seed(0))
    found = error(gram, A, w, torch.stack([tissue(A.grid), noise]))
    assert float(found[0]) <= 0.003
    assert float(found[1]) <= 0.04


def test_smooth_tissue_is_exact_at_few_views():
    """The cut-off of lags makes low frequencies of the padded grid indefinite, which is no error
    on the grid."""
    A, w = problem(views=180, shape=(24, 46, 46), voxel=0.2, rows=14)
    gram = Gram(A, w, nodes=5)
    assert float(error(gram, A, w, tissue(A.grid))) <= 0.004
    # Conjugate gradients meet the least eigenvalues first: on the grid the operator is definite
    # still.
    left = torch.randn(A.domain_shape, generator=torch.Generator().manual_seed(1))
    step = left
    for _ in range(60):
        seen = gram.apply(step)
        curvature, energy = (step * seen).sum(), left.square().sum()
        assert float(curvature) > 0.0
        left = left - energy / curvature * seen
        step = left + left.square().sum() / energy * step


def test_more_nodes_are_more_accurate():
    A, w = problem(shape=(6, 25, 25))
    shape = tissue(A.grid)
    errors = [float(error(Gram(A, w, nodes), A, w, shape)) for nodes in (1, 9)]
    assert errors[1] < 0.5 * errors[0]


def test_self_adjoint_and_positive(inset):
    A, _, gram = inset
    m = matrix(gram.apply, A.domain_shape)
    assert float((m - m.T).abs().max()) <= 1e-9 * float(m.abs().max())
    eigenvalues = torch.linalg.eigvalsh(m)
    assert float(eigenvalues[0]) > -1e-6 * float(eigenvalues[-1])


@pytest.mark.parametrize("terms", [1, 6])
def test_spectra_become_definite_whatever_they_are(terms):
    """Frequencies: sound; position-dependent terms too large; indefinite at the centre; negative
    throughout."""
    nz, kinds = 6, 4
    spectra = torch.zeros(terms, 2, nz, 1, kinds, dtype=torch.complex64)
    spectra[0, 0, :, 0] = torch.tensor([1.0, 1.0, 0.5, -1.0])
    spectra[0, 1, :-1, 0] = torch.tensor([0.1, 0.1, 0.6, 0.2])
    spectra[1:, 0, :, 0, 1] = 2.0
    found = make_definite(spectra)
    assert torch.equal(found[..., 0], spectra[..., 0])
    corners = [(1.0, y, x, y * y, y * x, x * x)[:terms] for y in (-1, 0, 1) for x in (-1, 0, 1)]
    for weights in corners:
        band = torch.einsum(
            "c,cbzf->fbz", torch.tensor(weights, dtype=torch.complex64), found[..., 0, :]
        )
        for main, below in band:
            dense = torch.diag(main) + torch.diag(below[:-1], -1) + torch.diag(below[:-1].conj(), 1)
            assert float(torch.linalg.eigvalsh(dense)[0]) > 0


def test_row_phase_is_kept_slice_by_slice():
    """0.2 mm slices under 0.5 mm rows: the response of a slice depends on where it sits under
    the rows."""
    A, w = problem(views=120, shape=(12, 9, 9), voxel=0.2, rows=10)
    spikes = torch.zeros(12, *A.domain_shape)
    spikes[torch.arange(12), torch.arange(12), 4, 4] = 1.0
    exact = A.T(w * A(spikes))[torch.arange(12), torch.arange(12), 4, 4]
    assert float(exact.max() / exact.min()) > 1.2  # the effect is there
    model = Gram(A, w).apply(spikes)[torch.arange(12), torch.arange(12), 4, 4]
    assert torch.allclose(model, exact, rtol=0.08)


def test_without_a_window_and_in_a_plane():
    A, w = problem(views=60, shape=(4, 7, 7), window=False)
    windowed, w2 = problem(views=60, shape=(4, 7, 7))
    x = tissue(A.grid)
    assert torch.allclose(
        Gram(A, w).apply(x), Gram(windowed, w2).apply(x), rtol=1e-3, atol=1e-3 * float(w.max()) * HU
    )
    fan = FanBeam(full_turn(200), 626.0, 1098.0, 700, 0.7, detector="curved")
    grid = VolumeGrid((15, 15), 0.5, CENTER[1:])
    B = Projector(fan, grid, footprint(fan, grid))
    ones = torch.ones(B.range_shape)
    gram = Gram(B, ones)
    y, x2 = (torch.from_numpy(a - c) for a, c in zip(grid.axes, grid.center, strict=True))
    disc = (torch.hypot(y[:, None], x2[None]) < 2).float()
    assert float(error(gram, B, ones, disc)) < 0.02


def test_scaled_batched_and_differentiable(inset):
    A, _, gram = inset
    x = torch.randn(2, 3, *A.domain_shape, generator=torch.Generator().manual_seed(1))
    y = gram.apply(x)
    assert torch.allclose(y[1, 2], gram.apply(x[1, 2]), rtol=1e-4, atol=1e-5 * float(y.abs().max()))
    assert torch.allclose(
        gram.scaled(4.0).apply(x), 4 * y, rtol=1e-5, atol=1e-5 * float(y.abs().max())
    )
    leaf = x[0, 0].clone().requires_grad_()
    probe = x[1, 1]
    (gram.apply(leaf) * probe).sum().backward()
    assert torch.allclose(
        leaf.grad, gram.apply(probe), rtol=1e-4, atol=1e-5 * float(leaf.grad.abs().max())
    )
    assert gram.apply(x.double()).dtype == torch.float64


def test_batches_in_pieces_as_at_once(inset, monkeypatch):
    A, _, gram = inset
    x = torch.randn(5, *A.domain_shape, generator=torch.Generator().manual_seed(2))
    found = []
    for numbers in (1, 2**30):
        monkeypatch.setattr("recon.gram.gram.IN_CACHE", numbers)
        found.append(gram.apply(x))
    torch.testing.assert_close(*found, rtol=1e-5, atol=1e-6 * float(found[0].abs().max()))


def test_an_empty_batch_gives_an_empty_batch(inset):
    A, _, gram = inset
    nothing = torch.zeros(0, 2, *A.domain_shape, requires_grad=True)
    found = gram.apply(nothing)
    assert found.shape == nothing.shape
    found.sum().backward()
    assert nothing.grad.shape == nothing.shape
    empty = gram.noise((0,), generator=torch.Generator())
    assert empty.shape == (0, *A.domain_shape)


def test_information_follows_exposure_not_voxel_size(inset):
    _, _, gram = inset
    assert gram.scaled(2.0).information(HU) == pytest.approx(2 * gram.information(HU))
    fine, w = problem(shape=(12, 33, 33), voxel=0.25)
    coarse, w2 = problem(shape=(8, 21, 21), voxel=0.4)
    assert Gram(fine, w, 1).information(HU) == pytest.approx(
        Gram(coarse, w2, 1).information(HU), rel=0.15
    )


def test_noise_has_the_covariance_of_the_data(inset):
    A, w, gram = inset
    n = 4000
    draws = gram.noise((n,), generator=torch.Generator().manual_seed(3)).reshape(n, -1).double()
    assert torch.equal(
        gram.noise((2,), generator=torch.Generator().manual_seed(5)),
        gram.noise((2,), generator=torch.Generator().manual_seed(5)),
    )
    probes = torch.stack(
        [tissue(A.grid), torch.randn(A.domain_shape, generator=torch.Generator().manual_seed(4))]
    )
    for probe in probes.double():
        variance = float((draws @ probe.flatten()).var())
        expected = float((A(probe).square() * w).sum())
        assert variance == pytest.approx(expected, rel=5 * math.sqrt(2 / n) + 0.03)


def test_noise_grows_as_the_root_of_the_exposure(inset):
    gram = inset[2]
    once, longer = (
        g.noise(generator=torch.Generator().manual_seed(3)) for g in (gram, gram.scaled(4.0))
    )
    torch.testing.assert_close(longer, 2.0 * once)


def test_the_spectrum_is_what_waves_on_the_grid_meet():
    """Periodic ones, of all directions: their quadratic forms."""
    A, w = problem(shape=(6, 12, 13), rows=8)
    gram = Gram(A, w, nodes=1)
    spectrum = gram.periodic_spectrum()
    z, y, x = torch.meshgrid(*map(torch.arange, A.domain_shape), indexing="ij")
    for k in ((0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3), (2, 3, 1), (5, 10, 4)):
        phase = 2.0 * math.pi * (k[0] * z / 6 + k[1] * y / 12 + k[2] * x / 13)
        waves = torch.stack([phase.cos(), phase.sin()])
        met = float((waves * gram.apply(waves)).sum()) / phase.numel()
        assert float(spectrum[k]) == pytest.approx(met, rel=0.02)


def test_information_is_read_off_by_the_law_of_the_ramp(inset):
    """Of a wave that voxels hold, and of finer ones that they do not."""
    gram = inset[2]
    finest = 0.25 / 0.4
    held, beyond = gram.information(HU, finest), gram.information(HU, 4.0 * finest)
    assert beyond == pytest.approx(held / 4.0, rel=1e-6)


def test_all_of_it_moves_to_another_device(inset):
    moved = inset[2].to("meta")
    held = {name: v.device.type for name, v in vars(moved).items() if isinstance(v, torch.Tensor)}
    assert set(held.values()) == {"meta"}, held


def test_on_a_device_it_is_the_same_operator(inset):
    A, _, gram = inset
    x = torch.randn(A.domain_shape, generator=torch.Generator().manual_seed(2))
    expected = gram.apply(x)
    with standin():
        found = gram.to(DEVICE).apply(x.to(DEVICE)).cpu()
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5 * float(expected.abs().max()))


def test_nearly_zero_weights():
    """Weights of 1e-12: the same operator, scaled; single precision does not underflow."""
    A, w = problem(views=60, shape=(4, 9, 9))
    x = tissue(A.grid)
    a, b = Gram(A, w).apply(x), Gram(A, w * 1e-12).apply(x) * 1e12
    assert torch.allclose(a, b, rtol=1e-3, atol=1e-4 * float(a.abs().max()))


def test_refusals():
    A, w = problem(views=12, shape=(2, 5, 5))
    refused(
        ("shape of the projector's range", lambda: Gram(A, w[:-1])),
        ("at least 0", lambda: Gram(A, -w)),
        ("finite", lambda: Gram(A, w / 0)),
        ("all weights are 0", lambda: Gram(A, w * 0)),
        ("float", lambda: Gram(A, w.int())),
        ("nodes", lambda: Gram(A, w, nodes=3)),
    )
    gram = Gram(A, w, nodes=1)
    with pytest.raises(ValueError, match="x must have shape"):
        gram.apply(torch.zeros(2, 5, 4))
    with pytest.raises(ValueError, match="factor"):
        gram.scaled(0.0)
