"""Two channels mixed into two of equal, uncorrelated noise."""

import numpy as np
import pytest
import torch

from recon.least_squares.basis_problem import Whitening


def test_whitening_makes_noise_equal_and_uncorrelated():
    f = np.array([0.011, 0.31, 11.2])
    gain = np.array([900.0, 4000.0])
    w = Whitening.of(f, gain)
    covariance = np.linalg.inv([[f[0], f[1]], [f[1], f[2]]])
    mixed = w.forward @ covariance @ w.forward.T
    np.testing.assert_allclose(mixed, np.eye(2) * (gain @ covariance @ gain), rtol=1e-9, atol=1e-6 * mixed[0, 0])
    np.testing.assert_allclose(w.forward[0], gain)
    x = torch.rand(4, 2, 2, 3, 5, dtype=torch.float64)
    torch.testing.assert_close(w.undo(w.apply(x)), x)
    # Information follows the congruence, here of a tensor of rays.
    packed = torch.from_numpy(f).reshape(3, 1, 1).expand(3, 4, 5)
    white = w.information(packed)
    np.testing.assert_allclose(white[:, 0, 0], np.array([1, 0, 1]) / (gain @ covariance @ gain), atol=1e-12)


def test_whitening_refuses():
    with pytest.raises(ValueError, match="positive definite"):
        Whitening.of((1.0, 2.0, 1.0), (1.0, 0.0))
    with pytest.raises(ValueError, match="gain"):
        Whitening.of((1.0, 0.0, 1.0), (0.0, 0.0))
    with pytest.raises(ValueError, match="two channels"):
        Whitening.of((1.0, 0.0, 1.0), (1.0, 0.0)).apply(torch.zeros(3, 2, 2, 2))
