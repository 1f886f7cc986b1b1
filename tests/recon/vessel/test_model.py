"""The vessel's model: its drawing and derivatives, and the fit to noise-free data of known
tissues."""

from types import SimpleNamespace

import drawn_vessel
import numpy as np
import pytest
import torch
from drawn_vessel import INNER_MM, LUMEN_MM, VALUES, WALL_MM

from recon.vessel.core import CorePrior, CoreSpace
from recon.vessel.data import grid_of, in_hu, pilot
from recon.vessel.model import FAT, FIBROUS, LUMEN, THICKNESS, VesselModel
from recon.vessel.start import find_vessel


@pytest.fixture(scope="module")
def vessel(gram):
    data = drawn_vessel.data(gram, drawn_vessel.image(gram.finer, 0.0))
    return VesselModel(data, find_vessel(pilot(data), grid_of(data), None))


@pytest.fixture(scope="module")
def fit(vessel):
    return vessel.fit(vessel.first_guess())


def test_jacobian(vessel):
    rng = np.random.default_rng(0)
    theta = np.append(vessel.first_guess(), -40.0)
    bodies = rng.random((1, len(vessel.index)))
    found = vessel.draw(theta, bodies).jacobian
    for group in [*([k] for k in range(6)), vessel.lumen_part, vessel.outer_part, [vessel.size]]:
        columns = np.arange(len(theta))[group]
        numeric = np.empty((len(vessel.index), len(columns)))
        for k, column in zip(columns, numeric.T, strict=True):
            step = np.zeros_like(theta)
            step[k] = 1e-3 if len(columns) == 1 else 1e-4
            ahead, behind = (
                vessel.draw(theta + s * step, bodies, jacobian=False).image for s in (1, -1)
            )
            column[:] = (ahead - behind) / (2 * step[k])
        # What the normal's turn changes is left out of the derivative: second order in the
        # outline's slope, and most for splines that reach little of the vessel, so the measure is
        # the outline's largest column.
        error, size = (np.linalg.norm(v, axis=0) for v in (found[:, columns] - numeric, numeric))
        assert error.max() <= 0.06 * size.max() + 1e-6


def test_fit_finds_tissues_and_outlines(vessel, fit):
    p = fit.parameters
    assert p[FAT] == pytest.approx(VALUES["fat"], abs=1)
    assert p[LUMEN] == pytest.approx(VALUES["lumen"], abs=4)
    assert p[FIBROUS] == pytest.approx(VALUES["fibrous"], abs=8)
    truth = drawn_vessel.image(vessel.grid, 0.0).numpy()[tuple(vessel.index.T)]
    assert np.sqrt(np.mean((p[FAT] + vessel.voxel_means(fit.drawing.soft) - truth) ** 2)) < 8
    assert fit.drawing.fractions[2].sum() * 0.027 == pytest.approx(
        np.pi * LUMEN_MM**2 * np.hypot(1, drawn_vessel.TILT) * 7.8, rel=0.02
    )
    outer = np.pi * (INNER_MM + WALL_MM) ** 2 * np.hypot(1, drawn_vessel.TILT) * 7.8
    assert fit.drawing.fractions[0].sum() * 0.027 == pytest.approx(outer, rel=0.03)
    assert np.exp(p[THICKNESS]) == pytest.approx(WALL_MM, abs=0.08)


@pytest.mark.extended
@pytest.mark.parametrize("seed", [2, 3, 5])
def test_fit_goes_to_the_mode_from_afar(gram, seed):
    """It stopped where a shortened step gained little: for seed 5 at 63 in the log posterior
    short of the mode."""
    data = drawn_vessel.data(gram, drawn_vessel.image(gram.finer, 0.0, samples=2), seed)
    vessel = VesselModel(data, find_vessel(pilot(data), grid_of(data), None))
    afar = vessel.first_guess()
    afar[vessel.lumen_part] *= 1.3
    afar[vessel.outer_part] *= 0.8
    found, mode = (
        vessel.fit(afar, expected=True),
        vessel.fit(afar, expected=True, steps=60, tolerance=1e-5),
    )
    assert found.energy - mode.energy < 0.6


class Scripted(VesselModel):
    """A model of one direction: its energy is a function of how far a step went."""

    def __init__(self, energy):
        self.index, self.ones, self.b = np.zeros(1), np.ones(1), np.zeros(1)
        self.along, self.tried = energy, []

    def _prior_with(self, bodies, expected):
        return np.eye(FAT + 1)

    def draw(self, theta, bodies, **_):
        return SimpleNamespace(image=np.zeros(1), jacobian=np.ones((1, FAT + 1)))

    def energy(self, theta, image, precision):
        self.tried.append(float(theta[0]))
        return self.along(theta[0]), np.zeros(1)

    def hessian(self, drawing, precision, seen=None):
        return np.eye(FAT + 1)

    def _gradient(self, *_):
        return np.eye(FAT + 1)[0]


def test_a_step_that_leads_up_is_shortened_to_a_tenth_at_most():
    """The parabola through a wall of energy has its top next to where the step began: nothing is
    gained there."""
    model = Scripted(lambda x: 1e9 if x > 0.02 else -x)
    model.fit(np.zeros(FAT + 1), steps=1)
    assert model.tried == pytest.approx([0.0, 1.0, 0.1, 0.01])


def test_fit_is_a_mode(vessel, fit):
    """A Newton step from the mode promises nothing, and the residual is b − Gx of the whole
    volume."""
    assert 0.5 * fit.gradient @ fit.covariance @ fit.gradient < 0.2
    volume = torch.full(vessel.grid.shape, fit.parameters[FAT])
    volume[tuple(vessel.index.T)] += torch.from_numpy(fit.drawing.image).float()
    exact = vessel.data.left(volume[None])[0].numpy()[tuple(vessel.index.T)]
    assert np.allclose(fit.residual, exact, atol=2e-5 * float(vessel.data.b.abs().max()))


def test_evidence_of_a_body_is_the_ratio_of_two_gaussian_integrals(vessel, fit):
    """Against the joint Hessian of vessel and body, in float64."""
    space = CoreSpace(vessel, fit, CorePrior())
    shapes = space.draw_prior(5, np.random.default_rng(0))
    shares = space.fractions(shapes)
    seen = space.evidence(shares)
    p = len(fit.parameters)
    for k in range(5):
        c = np.zeros((len(vessel.index), 1), np.float32)
        c[space.chosen, 0] = shares[k]
        c = vessel.as_projected(c)
        curved = vessel.gram.apply(c)[:, 0].astype(float)
        joint = np.zeros((p + 1, p + 1))
        joint[:p, :p] = fit.hessian
        joint[p, :p] = joint[:p, p] = fit.curved.T.astype(float) @ c[:, 0]
        joint[p, p] = curved @ c[:, 0] + 100.0**-2
        pull = np.append(fit.gradient, c[:, 0] @ fit.residual)

        def log(hessian, gradient):
            return (
                0.5 * gradient @ np.linalg.solve(hessian, gradient)
                - 0.5 * np.linalg.slogdet(hessian)[1]
            )

        exact = log(joint, pull) - log(fit.hessian, fit.gradient) - np.log(100.0)
        assert seen.log[k] == pytest.approx(exact, rel=1e-3, abs=2e-3)
        assert seen.mean[k] == pytest.approx(np.linalg.solve(joint, pull)[p], rel=2e-3, abs=2e-2)
        assert seen.variance[k] == pytest.approx(np.linalg.inv(joint)[p, p], rel=5e-3)


def test_data_of_a_scan_in_hu(problem, clean):
    """b and G in HU: the likelihood's mode is the least-squares volume, whatever unit it is
    written in."""
    found = in_hu(problem.term(clean))
    volume = 30.0 * torch.randn(problem.grid.shape, generator=torch.Generator().manual_seed(0))
    hu = problem.mu_ref / 1000
    attenuation = (volume / 1000 + 1) * problem.mu_ref - problem.level
    exact = (problem.term(clean).b[0] - problem.gram.apply(attenuation)) * hu
    assert torch.allclose(found.left(volume[None])[0], exact, atol=1e-4 * float(exact.abs().max()))


def test_no_vessel():
    gram = drawn_vessel.operator((8, 12, 12))
    data = drawn_vessel.data(gram, torch.full(gram.finer.shape, -90.0))
    with pytest.raises(ValueError, match="nothing stands out"):
        find_vessel(pilot(data), grid_of(data), None)
    with pytest.raises(ValueError, match="outside of the volume"):
        find_vessel(
            drawn_vessel.image(gram.grid, 0.0).numpy(), gram.grid, np.array([50.0, -30.0, -30.0])
        )
