"""What a fibrous layer holds: against dense matrices in float64, and its change with the data."""

from dataclasses import replace

import drawn_vessel
import numpy as np
import pytest
import torch

from recon.vessel import layer
from recon.vessel.data import grid_of, pilot
from recon.vessel.layer import LENGTHS_MM, LayerEstimate, LayerField
from recon.vessel.model import VesselModel
from recon.vessel.start import find_vessel


def fitted(data):
    vessel = VesselModel(data, find_vessel(pilot(data), grid_of(data), None))
    return vessel.fit(vessel.first_guess(), expected=True, tolerance=1e-3)


@pytest.fixture(scope="module")
def data():
    gram = drawn_vessel.operator((16, 24, 24))
    return drawn_vessel.data(gram, drawn_vessel.image(gram.finer, 100.0, samples=3), 1)


@pytest.fixture(scope="module")
def fit(data):
    return fitted(data)


@pytest.fixture(scope="module")
def dense(fit):
    """Of parameters and white field: the joint matrix of the normal equations, its right side,
    and B = L σ S."""
    vessel, p, field = fit.vessel, len(fit.parameters), LayerField(fit.vessel, fit.layer)
    n = field.size
    B = layer.SD_HU * fit.layer[:, None] * np.stack([field.of(w) for w in np.eye(n)], 1)
    joint = np.empty((p + n, p + n))
    joint[:p, :p] = fit.hessian
    joint[p:, :p] = B.T @ fit.curved
    joint[:p, p:] = joint[p:, :p].T
    joint[p:, p:] = np.eye(n) + B.T @ vessel.gram.apply(B.astype(np.float32))
    return joint, np.append(fit.gradient, B.T @ fit.residual), B


def test_field_has_unit_variance_and_correlations_along_around_and_across(fit):
    vessel, field = fit.vessel, LayerField(fit.vessel, fit.layer)
    F = np.stack([field.of(w) for w in np.eye(field.size)], 1)
    values = np.random.default_rng(0).normal(size=F.shape[0])
    assert np.allclose(field.adjoint(values), F.T @ values)
    inside = np.flatnonzero(fit.layer > 0.1)[::5]
    c, K = vessel.outer_at, F[inside] @ F[inside].T
    assert np.abs(np.diag(K) - 1.0).max() < 0.01  # a circle's correlation is not quite a Gaussian
    s, rho = c.s[inside], c.rho[inside]
    radius = np.average(c.rho[fit.layer > 1e-3], weights=fit.layer[fit.layer > 1e-3])
    turn = (c.theta[inside, None] - c.theta[inside] + np.pi) % (2 * np.pi) - np.pi
    squares = [
        ((x / length) ** 2)
        for x, length in zip(
            (s[:, None] - s, turn * radius, rho[:, None] - rho), LENGTHS_MM, strict=True
        )
    ]
    # Interpolation between nodes half a length apart.
    assert np.abs(K - np.exp(-0.5 * sum(squares))).max() < 0.05


def test_a_vessel_without_a_layer_holds_nothing(fit):
    field = LayerField(fit.vessel, np.zeros(len(fit.layer)))
    assert np.isfinite(field.of(np.ones(field.size))).all()


@pytest.mark.extended
def test_contents_and_step_are_those_of_the_joint_mode(fit, dense):
    joint, right, B = dense
    exact = np.linalg.solve(joint, right)
    p = len(fit.parameters)
    found = LayerEstimate(fit)
    contents = B @ exact[p:]
    assert contents.std() > 10.0
    inside = found.image[tuple(fit.vessel.index.T)] - found.fit.image[tuple(fit.vessel.index.T)]
    assert np.abs(inside - contents).max() < 0.5
    assert (
        np.abs(
            found.fit.drawing.soft - fit.vessel.draw(fit.parameters + exact[:p], fit.bodies).soft
        ).max()
        < 2.0
    )


@pytest.mark.extended
def test_a_step_that_leads_up_is_not_taken(fit, dense, monkeypatch):
    joint, right, B = dense
    p = len(fit.parameters)
    monkeypatch.setattr(VesselModel, "energy", lambda *a: (np.inf, None))
    found = LayerEstimate(fit)
    assert np.array_equal(found.fit.parameters, fit.parameters)
    contents = B @ np.linalg.solve(joint[p:, p:], right[p:])
    assert np.allclose(found.image - fit.image, fit.vessel.on_grid(contents), atol=0.5)


def test_change_is_symmetric_and_that_of_a_new_fit(data, fit):
    estimate = LayerEstimate(fit)
    noise = [
        data.operator.noise(generator=torch.Generator().manual_seed(s)).double()
        * 0.05
        * float(data.scale) ** 0.5
        for s in (2, 3)
    ]
    changes = [estimate.change(v.numpy()) for v in noise]
    cross = [float((changes[k] * noise[1 - k].numpy()).sum()) for k in (0, 1)]
    assert cross[0] == pytest.approx(
        cross[1], abs=0.02 * float((changes[0] * noise[0].numpy()).sum())
    )
    others = [replace(data, b=data.b + s * noise[0].to(data.b)[None]) for s in (1, -1)]
    there = [LayerEstimate(fitted(other)).image for other in others]
    real = 0.5 * (there[0] - there[1])
    # The outlines bend differently about a core than without it, and the map is that without.
    assert np.linalg.norm(real - changes[0]) < 0.25 * np.linalg.norm(real)
