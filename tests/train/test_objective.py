"""The loss and the validation, on models whose errors are known."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from recon.mbir.network import NetworkConfig
from recon.mbir.unrolled import Unrolled
from train.config import DataConfig, ObjectiveConfig, Situation
from train.data import Data
from train.objective import Objective

CONFIG = DataConfig(shape=(24, 20, 20), voxel_mm=0.4, views=120, pool=10, situations=(Situation(42.0, 0.0),))


class Given(nn.Module):
    """A model that returns what it was given; counts its steps."""

    def __init__(self, volumes=None):
        super().__init__()
        self.volumes, self.steps, self.looks = volumes, [], []

    def forward(self, problem, look, steps=None):
        self.steps.append(steps)
        self.looks.append(look)
        return torch.zeros_like(problem.beta) if self.volumes is None else self.volumes


@pytest.fixture(scope="module")
def data():
    return Data(CONFIG)


def truth_of(batch):
    return torch.cat([batch.truth, batch.truth]) / batch.problem.scale_hu.reshape(-1, 1, 1, 1)


def test_the_truth_has_no_loss(data):
    batch = data.batch(0, 0, range(3))
    loss = Objective()(Given(truth_of(batch)), batch)
    assert float(loss.total) == pytest.approx(0.0, abs=1e-6)


def test_terms_by_their_definitions(data):
    """A constant error c everywhere: no contrast error, c² (1 + edge in bodies), c² times the mean of H 1."""
    batch = data.batch(0, 0, range(2))
    error = 0.3 * torch.ones_like(batch.problem.beta)
    config = ObjectiveConfig(edge=0.0)
    parts = Objective(config)(Given(truth_of(batch) + error), batch).parts
    assert parts["white"] == pytest.approx(2 * 0.09, rel=1e-4)
    assert parts["data"] == pytest.approx(
        float((error * batch.problem.apply(error)).mean((1, 2, 3)).sum()) / 2, rel=1e-4
    )
    assert parts["contrast"] == pytest.approx(0.0, abs=1e-4)
    more = Objective(ObjectiveConfig(edge=2.0))(Given(truth_of(batch) + error), batch).parts
    assert parts["white"] < more["white"] < 3 * parts["white"]


def test_noise_costs_once_and_bias_with_its_weight(data):
    """Contrast errors that are opposite in both draws are noise: κ d₁ d₂ gives back; equal ones are bias: it adds."""
    batch = data.batch(0, 2, range(3))
    roi = batch.contrast[:, -1]
    push = roi / roi.square().sum((1, 2, 3), keepdim=True).clamp_min(1e-6)
    for signs, expected in (((1.0, -1.0), -1.0), ((1.0, 1.0), 1.0)):
        error = 0.01 * torch.cat([s * push for s in signs])
        parts = Objective()(Given(truth_of(batch) + error), batch).parts
        assert parts["contrast"] > 0
        assert parts["bias"] == pytest.approx(expected * parts["contrast"], rel=1e-3)


def test_steps_follow_the_training(data):
    batch, model, objective = data.batch(0, 0, range(2)), Given(), Objective(single=0.5)
    for progress in (0.0, 0.49, 0.5, 1.0):
        objective(model, batch, progress)
    assert model.steps == [1, 1, None, None]
    look = model.looks[0]
    assert torch.equal(look[:2], look[2:])
    assert 0 <= float(look.min()) <= float(look.max()) <= 1


def test_validation_of_the_linear_start():
    """An untrained network adds nothing: the lesion's variance is about that of the start, contrast shrinks."""
    data = Data(replace(CONFIG, shape=(28, 24, 24), voxel_mm=0.3))
    model = Unrolled(NetworkConfig((4, 4, 4), 0.3), 1).eval().requires_grad_(False)
    config = ObjectiveConfig(validation_exposures_s=(1.0,), validation_draws=4)
    found = Objective(config).validate(model, data, 0)
    f = found.figures
    assert 0.4 < f["slope_1s"] < 1.2
    assert f["lesion_1s"] == pytest.approx(1.0, abs=0.25)
    assert f["sd_hu_1s"] > 0
    assert f["rmse_hu_1s"] > f["fat_hu_1s"] > 0
    assert found.pictures["1s_0"].shape == (24, 48)
    again = Objective(config).validate(model, data, 0)
    assert again.figures == f
    assert again.score == found.score
