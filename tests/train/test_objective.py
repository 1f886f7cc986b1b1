"""The loss and the validation, on models whose errors are known."""

import math
from dataclasses import replace

import pytest
import torch
from torch import nn

from recon.mbir.network import NetworkConfig
from recon.mbir.unrolled import Unrolled
from train.config import DataConfig, ObjectiveConfig, Situation
from train.data import Data, _edges, spread
from train.objective import Objective

CONFIG = DataConfig(
    shape=(20, 16, 16), voxel_mm=0.4, views=120, scenes_kept=40, situations=(Situation(42.0, 0.0),)
)


class Given(nn.Module):
    """A model that returns what it was given; counts its steps."""

    def __init__(self, volumes=None):
        super().__init__()
        self.volumes, self.steps, self.fidelities, self.sizes = volumes, [], [], []

    def forward(self, problem, fidelity, steps=None, views=None, prior=None):
        self.steps.append(steps)
        self.fidelities.append(fidelity)
        self.sizes.append(len(problem.b))
        volumes = self.volumes(problem) if callable(self.volumes) else self.volumes
        return torch.zeros_like(problem.b) if volumes is None else volumes


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return Data(CONFIG, 0, tmp_path_factory.mktemp("views"))


def truth_of(batch):
    return torch.cat([batch.truth, batch.truth]) / batch.problem.unit_hu[: 2 * batch.size].reshape(
        -1, 1, 1, 1
    )


def with_contrast(data):
    return next(
        b for step in range(10) if (b := data.batch(step, 4, range(4))).contrast[:, -1].any()
    )


def test_the_truth_has_no_loss(data):
    batch = data.batch(0, 4, range(3))
    loss = Objective()(Given(truth_of(batch)), batch)
    assert float(loss.total) == pytest.approx(0.0, abs=1e-6)


def test_edges_and_bodies_count_more(data):
    """A constant error c everywhere: no contrast error, and c² (1 + edge and body there) over the
    same of the filtered view, whose error is not constant."""
    batch = data.batch(0, 4, range(2))
    truth, (_, _, smoothed) = truth_of(batch), batch.views
    assert smoothed is not None
    of_view = (smoothed[:4] - truth).square()
    for edge, body in ((0.0, 0.0), (2.0, 0.0), (2.0, 3.0)):
        config = ObjectiveConfig(edge=edge, body=body)
        parts = Objective(config)(Given(truth + 0.3), batch).parts
        counts = (1.0 + edge * batch.edges + body * batch.bodies).repeat(2, 1, 1, 1)
        ratio = 0.09 * counts.mean((1, 2, 3)) / (of_view * counts).mean((1, 2, 3))
        assert parts["image"] == pytest.approx(float(ratio.sum()) / 2, rel=1e-4)
        assert parts["contrast"] == pytest.approx(0.0, abs=1e-4)


def test_constant_tissue_counts_more_in_the_end(data):
    """By ``flat`` in bodies, by ``empty`` elsewhere."""
    batch = data.batch(0, 4, range(2))
    half = torch.zeros_like(batch.truth)
    half[..., : half.shape[-1] // 2] = 1.0
    batch = replace(batch, truth=100.0 * half, bodies=half)
    truth, (_, _, smoothed) = truth_of(batch), batch.views
    assert smoothed is not None
    of_view = (smoothed[:4] - truth).square()
    constant = spread(batch.truth) < 10.0
    places = {"flat": constant * (batch.bodies > 0), "empty": constant * (batch.bodies == 0)}
    assert all(bool(place.any()) for place in places.values())
    for name, place in places.items():
        config = ObjectiveConfig(edge=0.0, end_from=0.5, **{name: 7.0})
        for progress, weight in ((0.4, 0.0), (0.5, 7.0)):
            parts = Objective(config)(Given(truth + 0.3), batch, progress).parts
            counts = (1.0 + weight * place).repeat(2, 1, 1, 1)
            ratio = 0.09 * counts.mean((1, 2, 3)) / (of_view * counts).mean((1, 2, 3))
            assert parts["image"] == pytest.approx(float(ratio.sum()) / 2, rel=1e-4)


def test_scenes_count_alike_by_their_relative_error(data):
    """Twice the error of the filtered view costs four wherever it is, however large that is."""
    batch = data.batch(0, 4, range(2))
    truth, (_, _, smoothed) = truth_of(batch), batch.views
    assert smoothed is not None
    error = 2.0 * (smoothed[:4] - truth)
    config = ObjectiveConfig(image=3.0, contrast=0.0, edge=2.0, body=1.0, flat=1.0)
    loss = Objective(config)(Given(truth + error), batch)
    assert float(loss.total) == pytest.approx(2 * 3.0 * 4.0, rel=1e-4)


def test_bias_of_lesions_is_what_both_draws_share(data):
    """Errors that are opposite in both draws are noise, equal ones are bias, and it counts where a
    lesion is."""
    batch = data.batch(0, 4, range(2))
    batch = replace(batch, lesions=torch.zeros_like(batch.truth))
    batch.lesions[..., 4:9] = 1.0
    truth, (_, _, smoothed) = truth_of(batch), batch.views
    assert smoothed is not None
    error = 0.5 * (smoothed[:2] - truth[:2])
    options = {"image": 3.0, "contrast": 0.0, "edge": 0.0, "end_from": 0.5}

    def total(sign, fidelity, bias, progress=1.0, error=error):
        both = torch.cat([error, sign * error])
        config = ObjectiveConfig(lesion_bias=bias, fidelities=(fidelity, fidelity), **options)
        return float(Objective(config)(Given(truth + both), batch, progress).total)

    measure = (smoothed[:4] - truth).square().mean((1, 2, 3))
    there = (error.square() * batch.lesions).mean((1, 2, 3))
    expected = 3.0 * float((there / (measure[:2] * measure[2:]).sqrt()).sum())
    beside = error * (1.0 - batch.lesions)
    for sign in (1.0, -1.0):
        plain = total(sign, 1.0, (0.0, 0.0))
        shared = total(sign, 1.0, (0.0, 1.0)) - plain
        assert sign * shared == pytest.approx(expected, rel=1e-3)
        assert total(sign, 1.0, (1.0, 4.0)) - plain == pytest.approx(4.0 * shared, rel=1e-4)
        assert total(sign, 0.0, (1.0, 4.0)) - plain == pytest.approx(shared, rel=1e-4)
        assert total(sign, 1.0, (1.0, 4.0), progress=0.4) == pytest.approx(plain)
        alone = [total(sign, 1.0, bias, error=beside) for bias in ((0.0, 0.0), (1.0, 4.0))]
        assert alone[0] == pytest.approx(alone[1])


def test_without_a_filtered_view_the_step_towards_the_data_is_the_measure(data):
    batch = data.batch(0, 4, range(2))
    truth, (first, towards, _) = truth_of(batch), batch.views
    config = ObjectiveConfig(image=3.0, contrast=0.0)
    bare = replace(batch, views=(first, towards, None))
    loss = Objective(config)(Given(towards[:4].clone()), bare)
    assert float(loss.total) == pytest.approx(2 * 3.0, rel=1e-4)
    assert not torch.equal(towards[:4], truth)


def test_noise_costs_once_and_bias_with_its_weight(data):
    """Contrast errors that are opposite in both draws are noise: κ d₁ d₂ gives back; equal ones
    are bias: it adds."""
    batch = with_contrast(data)
    roi = batch.contrast[:, -1]
    push = roi / roi.square().sum((1, 2, 3), keepdim=True).clamp_min(1e-6)
    for signs, expected in (((1.0, -1.0), -1.0), ((1.0, 1.0), 1.0)):
        error = 0.01 * torch.cat([s * push for s in signs])
        parts = Objective()(Given(truth_of(batch) + error), batch).parts
        assert parts["contrast"] > 0
        assert parts["contrast_bias"] == pytest.approx(expected * parts["contrast"], rel=1e-3)


def test_steps_follow_the_training(data):
    batch, model, objective = data.batch(0, 4, range(2)), Given(), Objective(single=0.5)
    for progress in (0.0, 0.49, 0.5, 1.0):
        objective(model, batch, progress)
    assert model.steps == [1, 1, None, None]
    fidelity = model.fidelities[0]
    assert torch.equal(fidelity[:2], fidelity[2:])
    assert 0 <= float(fidelity.min()) <= float(fidelity.max()) <= 1


def test_bias_weighs_more_where_one_measures(data):
    batch = with_contrast(data)
    roi = batch.contrast[:, -1]
    push = roi / roi.square().sum((1, 2, 3), keepdim=True).clamp_min(1e-6)
    given = Given(truth_of(batch) + 0.01 * torch.cat([push, push]))
    totals = [
        float(
            Objective(ObjectiveConfig(contrast_bias=(0.0, 4.0), fidelities=(fidelity, fidelity)))(
                given, batch
            ).total
        )
        for fidelity in (0, 1)
    ]
    even = float(
        Objective(ObjectiveConfig(contrast_bias=(0.0, 0.0), fidelities=(1, 1)))(given, batch).total
    )
    assert totals[0] == pytest.approx(even)
    assert totals[1] > totals[0]


def test_contrasts_may_weigh_more_in_the_end(data):
    batch = with_contrast(data)
    roi = batch.contrast[:, -1]
    push = roi / roi.square().sum((1, 2, 3), keepdim=True).clamp_min(1e-6)
    given = Given(truth_of(batch) + 0.01 * torch.cat([push, push]))

    def total(progress, **options):
        config = ObjectiveConfig(end_from=0.5, **options)
        return float(Objective(config)(given, batch, progress).total)

    plain, without = total(1.0, contrast=0.2), total(1.0, contrast=0.0)
    assert plain > without
    assert total(0.4, contrast=0.2, contrast_end=0.8) == pytest.approx(plain)
    in_the_end = total(0.5, contrast=0.2, contrast_end=0.8)
    assert in_the_end - without == pytest.approx(4.0 * (plain - without), rel=1e-3)
    assert total(0.5, contrast=0.2, contrast_end=0.0) == pytest.approx(without)


def test_the_scene_without_noise_counts_with_its_weight(data):
    """Half of the scenes, each for two; there the model sees it behind the two draws, in one
    call."""
    batch = data.batch(0, 4, range(2))
    free = []

    def off_by_a_constant(problem):
        scene = torch.tensor([0, 1, 0, 1, *free])[: len(problem.b)]
        return batch.truth[scene] / problem.unit_hu.reshape(-1, 1, 1, 1) + 0.3

    model = Given(off_by_a_constant)
    without = Objective(ObjectiveConfig(contrast=0.0))(model, batch)
    assert "noise_free" not in without.parts
    added = {}
    for lots in ((0.9, 0.9), (0.1, 0.9), (0.9, 0.1), (0.1, 0.1)):
        free = [k for k, lot in enumerate(lots) if lot < 0.5]
        drawn = replace(batch, lots=torch.tensor([[0.5, lot] for lot in lots]))
        total = Objective(ObjectiveConfig(contrast=0.0, noise_free=0.5))(model, drawn).total
        added[tuple(free)] = float(total) - float(without.total)
        assert model.sizes[-1] == 4 + len(free)
    # With a weight of a half and half of the scenes each counts once, over the error of its own
    # filtered view.
    assert added[()] == pytest.approx(0.0, abs=1e-4)
    config = ObjectiveConfig(contrast=0.0)
    truth = batch.truth / batch.problem.unit_hu[:2].reshape(-1, 1, 1, 1)
    counts = 1.0 + config.edge * batch.edges + config.body * batch.bodies
    of_view = ((batch.views[2][4:] - truth).square() * counts).mean((1, 2, 3))
    each = config.image * 0.09 * counts.mean((1, 2, 3)) / of_view
    assert [added[0,], added[1,]] == pytest.approx(each.tolist(), rel=1e-3)
    assert added[0, 1] == pytest.approx(float(each.sum()), rel=1e-3)
    lots = torch.cat([data.batch(step, 4, range(4)).lots for step in range(10)])
    assert 0.25 < float((lots[:, 1] < 0.5).float().mean()) < 0.75


def test_the_network_sees_its_views_turned_and_gives_volumes_that_are_not(data):
    """A network that does what it does in every orientation has the same loss in all of them;
    another has not."""
    model = Unrolled(NetworkConfig((4, 4, 4), 0.4, bilateral=True), steps=1).train()
    batch = data.batch(0, 4, range(2))
    assert (
        sum(torch.equal(data.batch(k, 4, [0]).turned(batch.truth), batch.truth) for k in range(10))
        < 5
    )
    loss = float(Objective()(model, batch).total.detach())
    model.network.forward = lambda estimate, towards, condition, smoothed: (
        0.5 * (towards + smoothed)
    )
    still = replace(batch, turned=lambda v: v, unturned=lambda v: v)
    one, other = (float(Objective()(model, b).total) for b in (batch, still))
    assert one == pytest.approx(other, rel=1e-5)
    assert one != pytest.approx(loss)


@pytest.mark.extended
def test_validation_is_relative_to_the_filter(data):
    """The filter in the network's place has ratios of 1; half of its error has half of them,
    whatever the scene."""
    held_out = Data(replace(CONFIG, scenes_kept=8), 9, data.views.folder.parent)
    held_out._terms = data._terms
    assert math.isfinite(
        Objective().validate(Unrolled(NetworkConfig((4, 4, 4), 0.4)).eval(), held_out).score
    )
    model = Unrolled(NetworkConfig((4, 4, 4), 0.4, bilateral=True), steps=1).eval()
    with torch.no_grad():
        model.network.leave.weight.zero_()
        model.network.share.fill_(1.0)  # the network is the filter
    found = Objective().validate(model, held_out)
    for dose in ("low", "high"):
        for name in ("error", "all"):
            assert found.figures[f"{name}_{dose}"] == pytest.approx(1.0, abs=1e-3)
    assert found.score == pytest.approx(0.0, abs=3e-3)
    assert found.pictures["held_out_0"].shape == (16, 48)
    with torch.no_grad():
        model.network.share.fill_(0.0)
    worse = Objective().validate(model, held_out)
    assert worse.score < found.score - 0.5
    again = Objective().validate(model, held_out)
    assert again.figures == worse.figures
    # Scenes without a body leave their figure open, and the score to whole volumes.
    drawn = held_out.batch

    def empty(*given):
        batch = drawn(*given)
        return replace(batch, bodies=torch.zeros_like(batch.bodies))

    held_out.batch = empty
    without = Objective().validate(model, held_out)
    assert math.isnan(without.figures["error_low"])
    assert without.score == pytest.approx(
        -0.5 * math.log(worse.figures["all_low"] * worse.figures["all_high"])
    )


def test_large_contrasts_do_not_hide_how_faint_ones_are_shown(data):
    """Half of the contrast is shown below 150 HU, all of it above."""
    held_out = Data(replace(CONFIG, scenes_kept=40), 11, data.views.folder.parent)
    held_out._terms = data._terms
    drawn, truths = held_out.batch, []

    def of_one_voxel(*given):
        """Contrasts of each scene's first voxel that lies in a body, to the background's 0."""
        batch = drawn(*given)
        truths.append(batch.truth)
        body = (batch.truth.abs() > 20.0).flatten(1).float()
        first = body * (body.cumsum(1) == 1.0)
        return replace(batch, contrast=first.reshape(batch.truth.shape)[:, None])

    def shown(problem):
        truth = truths[-1]
        halved = torch.where(truth.abs() < 150.0, 0.5 * truth, truth)
        return halved / problem.unit_hu.reshape(-1, 1, 1, 1)

    held_out.batch = of_one_voxel
    figures = Objective().validate(Given(shown), held_out).figures
    for dose in ("low", "high"):
        assert figures[f"faint_{dose}"] == pytest.approx(0.5, rel=1e-3)
        assert figures[f"slope_{dose}"] > 0.55


def test_edges_reach_two_voxels_to_either_side():
    truth = torch.zeros(9, 9, 12)
    truth[..., 6:] = 100.0
    truth[..., 9:] += 10.0  # no more than texture
    found = _edges(truth)
    assert found[4, 4].tolist() == [False] * 4 + [True] * 4 + [False] * 4
    assert torch.equal(_edges(truth + 50.0), found)
