"""The data term against dense matrices: its value, units, what is taken off, and what is left."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from recon.data_term import NormalOperator, Projected, Quadratic

SHAPE = (2, 3, 4)
VOXELS = 24
RAYS = 40
MU = 0.02
LEVEL = 0.018


class Dense:
    """A matrix in the place of a projector."""

    def __init__(self, matrix):
        self.matrix, self.domain_shape, self.range_shape = matrix, SHAPE, (len(matrix),)

    def __call__(self, x):
        return x.flatten(-3) @ self.matrix.T

    def T(self, y):
        return (y @ self.matrix).unflatten(-1, SHAPE)


class Flat:
    """A model of AᵀWA: a multiple of 1."""

    def apply(self, x):
        return 3.0 * x

    def periodic_spectrum(self):
        return torch.full((2, 3, 3), 3.0)

    def information(self, mu_per_hu, frequency=0.5):
        return 7.0 * mu_per_hu**2


class Case:
    """Two scans, of other exposures, of the same A and W."""

    def __init__(self, seed=0):
        generator = torch.Generator().manual_seed(seed)

        def drawn(*shape):
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        self.A, self.w = Dense(drawn(RAYS, VOXELS)), drawn(RAYS).abs()
        self.y, self.exposure = drawn(2, RAYS), torch.tensor([0.5, 4.0], dtype=torch.float64)
        self.x = drawn(2, *SHAPE)
        weighed = self.exposure[:, None] * self.w * self.y
        self.term = Quadratic(
            Projected(self.A, lambda y: self.w * y, Flat()),
            self.A.T(weighed),
            self.exposure,
            (0.5,) * 3,
            MU,
            LEVEL,
            energy=(weighed * self.y).sum(1),
            readings=RAYS,
        )

    def misfit(self, x):
        """‖y − A x‖²_W of both."""
        return (self.exposure[:, None] * self.w * (self.y - self.A(x)).square()).sum(1)


@pytest.fixture(scope="module")
def case():
    return Case()


def chi2(term, u):
    return term.chi2(u, term.left(u))


def test_what_is_left_is_minus_the_gradient_of_half_the_misfit(case):
    x = case.x.clone().requires_grad_()
    (0.5 * case.misfit(x)).sum().backward()
    torch.testing.assert_close(case.term.left(case.x), -x.grad)
    torch.testing.assert_close(chi2(case.term, case.x) * RAYS, case.misfit(case.x))


@given(st.lists(st.floats(0.01, 1000.0), min_size=2, max_size=2))
def test_another_unit_is_the_same_misfit(units):
    case = Case(1)
    u = case.term.in_units(torch.tensor(units, dtype=torch.float64))
    at = case.x / (torch.tensor(units, dtype=torch.float64) * MU / 1000).reshape(2, 1, 1, 1)
    torch.testing.assert_close(u.mm(at), case.x)
    torch.testing.assert_close(u.hu(at), case.term.hu(case.x))
    torch.testing.assert_close(u.of_hu(u.hu(at)), at)
    torch.testing.assert_close(chi2(u, at), chi2(case.term, case.x))
    with pytest.raises(ValueError, match="in units of HU already"):
        u.in_noise_units()


def test_noise_units_follow_the_information(case):
    """c = (I V)^(−1/2) with the information of the exposure; H is about 1 where I is."""
    noise = case.term.in_noise_units()
    information = 7.0 * (MU / 1000) ** 2 * case.exposure
    torch.testing.assert_close(noise.unit_hu, (information * 0.5**3).rsqrt())
    torch.testing.assert_close(
        noise.spectrum()[:, 0, 0, 0], torch.full((2,), 3.0 / 7.0 * 8).double()
    )
    with pytest.raises(ValueError, match="is in mm⁻¹"):
        _ = case.term.unit_hu


def test_what_is_taken_off_is_added_again(case):
    """The term of the rest, at the rest, is that of all at all; so are parts and several scans."""
    rest = case.term.less(0.25 * case.x)
    torch.testing.assert_close(rest.left(0.75 * case.x), case.term.left(case.x))
    torch.testing.assert_close(chi2(rest, 0.75 * case.x), chi2(case.term, case.x))
    both = Quadratic.joined([case.term.part([1]), case.term.part([0])])
    torch.testing.assert_close(chi2(both, case.x.flip(0)), chi2(case.term, case.x).flip(0))
    several = case.term.times(3.0)
    torch.testing.assert_close(several.left(case.x), 3.0 * case.term.left(case.x))
    torch.testing.assert_close(chi2(several, case.x), 3.0 * chi2(case.term, case.x))


def test_hu_of_nothing_is_the_surroundings(case):
    zero = torch.zeros(2, *SHAPE, dtype=torch.float64)
    torch.testing.assert_close(case.term.hu(zero), torch.full_like(zero, -100.0))
    assert case.term.zero_hu == pytest.approx(-100.0)
    water = Quadratic(Flat(), zero, case.exposure, (0.5,) * 3, MU)
    assert (water.zero_hu, float(water.hu(zero).abs().max())) == (0.0, 0.0)
    with pytest.raises(ValueError, match="does not know"):
        chi2(water, zero)


def test_operators_are_what_solvers_ask_for(case):
    assert isinstance(case.term.operator, NormalOperator)
    assert isinstance(Flat(), NormalOperator)
    # An operator by projections is asked of its model what it does not know itself.
    assert case.term.operator.information(2.0) == Flat().information(2.0)
