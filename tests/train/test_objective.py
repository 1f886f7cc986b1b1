"""The loss and the validation, on models whose errors are known."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from recon.mbir.unrolled import start
from train.config import DataConfig, ObjectiveConfig, Situation
from train.data import Data
from train.objective import Objective, _edges

CONFIG = DataConfig(shape=(24, 20, 20), voxel_mm=0.4, views=120, pool=10, situations=(Situation(42.0, 0.0),))


class Given(nn.Module):
    """A model that returns what it was given; counts its steps."""

    def __init__(self, volumes=None):
        super().__init__()
        self.volumes, self.steps, self.fidelities = volumes, [], []

    def forward(self, problem, fidelity, steps=None):
        self.steps.append(steps)
        self.fidelities.append(fidelity)
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
    batch = next(b for step in range(40) if (b := data.batch(0, step, range(4))).contrast[:, -1].any())
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
    fidelity = model.fidelities[0]
    assert torch.equal(fidelity[:2], fidelity[2:])
    assert 0 <= float(fidelity.min()) <= float(fidelity.max()) <= 1


class Linear(nn.Module):
    """The linear start itself, times a gain."""

    def __init__(self, gain=1.0):
        super().__init__()
        self.gain = gain

    def forward(self, problem, fidelity):
        return self.gain * start(problem, problem.spectrum())


@pytest.mark.extended
def test_validation_of_the_linear_start():
    """The start against itself: a lesion factor of 1 (but for slopes that differ from scene to scene), at any gain."""
    data = Data(replace(CONFIG, shape=(28, 24, 24), voxel_mm=0.3))
    objective = Objective(ObjectiveConfig(validation_exposures_s=(1.0,), validation_draws=4))
    found = objective.validate(Linear(), data, 0)
    f = found.figures
    assert 0.4 < f["slope_1s"] < 1.2
    assert f["lesion_1s"] == pytest.approx(1.0, abs=0.05)
    assert f["sd_hu_1s"] > 0
    assert f["rmse_hu_1s"] > f["fat_hu_1s"] > 0
    assert found.pictures["1s_0"].shape == (24, 48)
    again = objective.validate(Linear(), data, 0)
    assert again.figures == f
    assert again.score == found.score
    half = objective.validate(Linear(0.5), data, 0).figures
    assert half["slope_1s"] == pytest.approx(0.5 * f["slope_1s"], rel=1e-4)
    assert half["fat_hu_1s"] == pytest.approx(0.5 * f["fat_hu_1s"], rel=1e-4)
    for same in ("sd_hu_1s", "lesion_1s"):
        assert half[same] == pytest.approx(f[same], rel=1e-3)


def test_bias_weighs_more_where_one_measures(data):
    batch = next(b for step in range(40) if (b := data.batch(0, step, range(4))).contrast[:, -1].any())
    roi = batch.contrast[:, -1]
    push = roi / roi.square().sum((1, 2, 3), keepdim=True).clamp_min(1e-6)
    given = Given(truth_of(batch) + 0.01 * torch.cat([push, push]))
    totals = [
        float(Objective(ObjectiveConfig(bias=(0.0, 4.0), fidelities=(fidelity, fidelity)))(given, batch).total)
        for fidelity in (0, 1)
    ]
    even = float(Objective(ObjectiveConfig(bias=(0.0, 0.0), fidelities=(1, 1)))(given, batch).total)
    assert totals[0] == pytest.approx(even)
    assert totals[1] > totals[0]


def test_the_scene_without_noise_counts_with_its_weight(data):
    """Half of the scenes, each for two; there the model sees it behind the two draws, in one call."""

    class Constant(nn.Module):
        def __init__(self):
            super().__init__()
            self.calls = []

        def forward(self, problem, fidelity, steps=None):
            self.calls.append(len(problem.beta))
            scene = torch.tensor([0, 1, 0, 1, *free])[: len(problem.beta)]
            return batch.truth[scene] / problem.scale_hu.reshape(-1, 1, 1, 1) + 0.3

    batch = data.batch(0, 0, range(2))
    three = batch.with_noise_free
    assert torch.equal(three.beta[: 2 * batch.size], batch.problem.beta)
    signal = three.apply(batch.truth.repeat(3, 1, 1, 1) / three.scale_hu.reshape(-1, 1, 1, 1))
    torch.testing.assert_close(three.beta[2 * batch.size :], signal[2 * batch.size :])
    free, model = [], Constant()
    without = Objective(ObjectiveConfig(contrast=0.0))(model, batch)
    assert "noise_free" not in without.parts
    added = {}
    for lots in ((0.9, 0.9), (0.1, 0.9), (0.9, 0.1), (0.1, 0.1)):
        free = [k for k, lot in enumerate(lots) if lot < 0.5]
        drawn = replace(batch, lots=torch.tensor([[0.5, lot] for lot in lots]), kept={})
        total = Objective(ObjectiveConfig(contrast=0.0, noise_free=0.5))(model, drawn).total
        added[tuple(free)] = float(total) - float(without.total)
        assert model.calls[-1] == 4 + len(free)
    # Two draws and the scene have the same error: with a weight of a half and half of the scenes, once more.
    assert added[()] == pytest.approx(0.0, abs=1e-4)
    assert added[0, 1] == pytest.approx(float(without.total), rel=1e-4)
    assert added[0,] + added[1,] == pytest.approx(added[0, 1], rel=1e-4)
    lots = torch.cat([data.batch(0, step, range(4)).lots for step in range(20)])
    assert 0.3 < float((lots[:, 1] < 0.5).float().mean()) < 0.7


def test_edges_reach_two_voxels_to_either_side():
    truth = torch.zeros(1, 9, 9, 12)
    truth[..., 6:] = 100.0
    truth[..., 9:] += 10.0  # no more than texture
    found = _edges(truth)
    assert found[0, 4, 4].tolist() == [0.0] * 4 + [1.0] * 4 + [0.0] * 4
    assert torch.equal(_edges(truth + 50.0), found)
