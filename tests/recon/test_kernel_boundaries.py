"""Compiled kernels check no index: what hands arrays to them refuses those that do not belong
together."""

import numpy as np
import pytest
import torch

from recon.gram.gram import cholesky, make_definite
from recon.least_squares.qggmrf import DEFAULT_PRIOR
from recon.mbir.bilateral import joint_bilateral
from recon.vessel.local_gram import LocalGram
from torchpcct.acquisition.bodies import BodySet
from torchpcct.acquisition.transmission import Beam, expected_readings
from torchpcct.checks.defects import cell_sums
from torchpcct.counting_noise import compound_poisson, poisson, thinned
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam, VolumeGrid, full_turn
from torchpcct.spectral import SpectralModel

PRIOR = DEFAULT_PRIOR.bind(1.0, (1.0, 1.0), 2e-5)
X = torch.zeros(2, 6, 5)


@pytest.mark.parametrize("shape", [(2, 6, 4), (2, 5, 5), (1, 6, 5), (6, 5), (3, 6, 5), (2, 6, 500)])
def test_the_prior_compares_its_volumes(shape):
    other = torch.zeros(shape)
    for call in (
        lambda: PRIOR.majorizer(X, other),
        lambda: PRIOR.majorizer(other, X),
        lambda: PRIOR.along(X, other, X),
        lambda: PRIOR.along(X, X, other),
    ):
        with pytest.raises(ValueError, match="must have the shape of x"):
            call()


def test_the_prior_compares_dtypes():
    for call in (lambda: PRIOR.majorizer(X, X.double()), lambda: PRIOR.along(X, X, X.double())):
        with pytest.raises(TypeError, match="like x"):
            call()
    with pytest.raises(TypeError, match="float32 or float64"):
        PRIOR.gradient(X.long())
    with pytest.raises(ValueError, match="2 axes"):
        PRIOR.gradient(X[0, 0])


def test_the_bilateral_filter_compares_its_arguments():
    u, t = torch.zeros(1, 4, 5, 6), torch.ones(1)
    for arguments in (
        (u, u[..., :5], t),
        (u, u, torch.ones(2)),
        (u[0], u[0], t),
        (u, u, t, 0.0),
        (u, u, t, 2.5, 0),
    ):
        with pytest.raises(ValueError, match=r"must have the shape|greater than 0|at least 1"):
            joint_bilateral(*arguments)


def test_the_inset_model_compares_its_bands():
    band = torch.ones(1, 3, 2, 4, 4, dtype=torch.complex64)
    for spectra in (
        band,
        torch.ones(7, 2, 2, 4, 4, dtype=torch.complex64),
        torch.ones(3, 4, dtype=torch.complex64),
    ):
        with pytest.raises(ValueError, match="got the shape"):
            make_definite(spectra)
    with pytest.raises(ValueError, match="got the shape"):
        cholesky(torch.ones(3, 2, 4, dtype=torch.complex64))


def test_voxels_beyond_the_grid_are_refused():
    class Model:
        grid = VolumeGrid((2, 4, 4), 1.0)

    for index in ([[0, 0, 4]], [[-1, 0, 0]], [[0, 0]]):
        with pytest.raises(ValueError, match=r"index must (lie|have)"):
            LocalGram.of(Model(), np.array(index), 1.0)


def test_a_simulation_compares_its_arrays():
    g = ConeBeam(full_turn(3), 50.0, 80.0, 4, 2, 1.0)
    bodies = BodySet(
        np.zeros(0, np.int64),
        np.zeros((0, 24)),
        np.zeros((0, 2)),
        np.zeros((0, 3, 3)),
        np.zeros((0, 3, 3)),
        (0.0, 0.0, np.inf),
    )
    beam = Beam(np.ones((1, 4, 2)), np.ones(2), (0.0, 0.0), np.zeros((1, 5)))
    whole, step = DetectorWindow.full(g), np.zeros(3)
    assert expected_readings(g, whole, bodies, beam, step).shape == (1, 3, 2, 4)
    for wrong in (
        (bodies, beam._replace(spectra=np.ones((1, 3, 2))), step, None),
        (bodies, beam._replace(row_factor=np.ones(1)), step, None),
        (bodies, beam._replace(points=np.zeros((1, 3))), step, None),
        (bodies, beam, np.zeros(2), None),
        (bodies, beam, step, np.ones((1, 2, 3))),
        (bodies._replace(drift=np.zeros((0, 2, 3))), beam, step, None),
        (bodies._replace(kinds=np.zeros(1, np.int64)), beam, step, None),
    ):
        with pytest.raises(ValueError, match="must have the shape"):
            expected_readings(g, whole, *wrong)
    with pytest.raises(ValueError, match="beyond the detector"):
        expected_readings(g, DetectorWindow([0, 1, 0], 4, 0, 2), bodies, beam, step)


def test_sums_over_cells_stay_on_the_detector():
    n, air, lost = np.ones((3, 2, 4), np.float32), torch.ones(2, 6), np.zeros(3, bool)
    assert cell_sums(n, air, np.array([0, 2, 1]), lost, 10.0).shape == (5, 2, 6)
    for first in ([0, 3, 0], [-1, 0, 0], [0, 0]):
        with pytest.raises(ValueError, match="first must"):
            cell_sums(n, air, np.array(first), lost, 10.0)


def test_rows_of_a_spectral_model_are_a_list():
    spectra = np.random.default_rng(0).random((2, 2, 5))
    for factor in (np.ones((1, 2)), np.array([1.0, np.nan]), np.array([0.0])):
        with pytest.raises(ValueError, match="row_factor must"):
            SpectralModel(np.linspace(40, 80, 5), spectra, factor)


def test_counts_compare_their_arguments():
    mean = torch.ones(2, 3)
    for call, error in (
        (lambda: thinned(mean, [0, 3], 1, 0.5, torch.ones(3)), ValueError),
        (lambda: thinned(mean, [0, 3], 1, 0.5, torch.ones(2, 2, 3)), ValueError),
        (lambda: compound_poisson(mean, mean.double(), [0, 3], 1), ValueError),
        (lambda: poisson(torch.ones(2, 3, dtype=torch.int32), [0, 3], 1), TypeError),
        (lambda: poisson(torch.tensor(1.0), [0], 1), ValueError),
        (lambda: poisson(mean, [0.5, 3.0], 1), TypeError),
        (lambda: poisson(mean, [0, 3], 1, scale=float("nan")), ValueError),
        (lambda: thinned(mean, [0, 3], 1, float("nan")), ValueError),
        (lambda: thinned(mean, [0, 3], 1, 1.5), ValueError),
        (lambda: thinned(mean, [0, 3], 1, 0.5, electronic=-1.0), ValueError),
    ):
        with pytest.raises(error):
            call()
