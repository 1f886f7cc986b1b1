"""Batches of the training: reproducible, of the right noise and signal, with contrasts that are contrasts."""

import math
from collections import Counter
from dataclasses import replace

import pytest
import torch

from train.config import DataConfig, Situation
from train.data import ROIS, Data

CONFIG = DataConfig(
    shape=(16, 12, 12), voxel_mm=0.4, views=120, pool=30, situations=(Situation(42.0, 0.0), Situation(-20.0, 38.0)),
    exposure_s=(0.5, 2.0),
)  # fmt: skip


@pytest.fixture(scope="module")
def data():
    return Data(CONFIG)


def test_pure_function_of_seed_step_and_index(data):
    whole = data.batch(3, 7, range(4))
    part = Data(CONFIG).batch(3, 7, [2, 0])
    assert whole.size == 4
    assert whole.problem.beta.shape == (8, *CONFIG.shape)
    for name in ("truth", "contrast", "voxels"):
        assert torch.equal(getattr(whole, name)[[2, 0]], getattr(part, name)), name
    torch.testing.assert_close(whole.problem.beta[[2, 0, 6, 4]], part.problem.beta)
    assert not torch.equal(whole.truth, data.batch(3, 8, range(4)).truth)


def test_scenes_of_a_batch_differ(data):
    """In what they show, whichever way they are mirrored, in their exposure and in their noise."""
    for step in range(3):
        batch = data.batch(2, step, range(4))
        sorted_values = batch.truth.flatten(1).sort(1).values
        exposures = batch.problem.scale_hu[:4]
        noise = (batch.problem.beta[:4] - batch.with_noise_free.beta[8:]).flatten(1)
        assert torch.pdist(sorted_values).min() > 1.0
        assert torch.pdist(exposures.reshape(4, 1)).min() > 0.0
        assert torch.corrcoef(noise).fill_diagonal_(0.0).abs().max() < 0.5


def test_statistic_is_signal_and_two_draws_of_noise(data):
    """What is not H u has the covariance H, whose quadratic forms are known, and is independent in both draws."""
    batch = data.batch(0, 1, range(6))
    p = batch.problem
    u = torch.cat([batch.truth, batch.truth]) / p.scale_hu.reshape(-1, 1, 1, 1)
    noise = p.beta - p.apply(u)
    first, second = noise[:6], noise[6:]
    probe = torch.zeros(CONFIG.shape)
    probe[4:12, 3:9, 3:9] = 1.0
    expected = float((probe * p.apply(probe.expand(12, -1, -1, -1))).sum((1, 2, 3))[0])
    found = torch.cat([(first * probe).sum((1, 2, 3)), (second * probe).sum((1, 2, 3))])
    assert float(found.square().mean()) == pytest.approx(expected, rel=1.2)
    assert abs(float((found[:6] * found[6:]).mean())) < 1.5 * expected


def test_contrasts_are_differences_of_means(data):
    """Weights of a core add up to 1, of its surround to -1, or all are 0; the number of voxels is the smaller one's."""
    seen = 0
    for step in range(12):
        batch = data.batch(1, step, range(4))
        assert batch.contrast.shape == (4, ROIS, *CONFIG.shape)
        for contrast, voxels in zip(batch.contrast.flatten(0, 1), batch.voxels.flatten(), strict=True):
            if not float(voxels):
                assert not contrast.any()
                continue
            seen += 1
            assert float(contrast.clamp_min(0).sum()) == pytest.approx(1.0, abs=1e-4)
            assert float(contrast.clamp_max(0).sum()) == pytest.approx(-1.0, abs=1e-4)
            assert float(voxels) == min(int((contrast > 0).sum()), int((contrast < 0).sum()))
    assert seen >= 6


def test_vessels_run_about_every_axis():
    """By the share of scenes whose vessel is longest along an axis: a vessel along x covers more of x than of z."""
    config = DataConfig(shape=(16, 16, 16), voxel_mm=0.4, views=120, along_z=0.0, pool=40,
                        scenes={"free_probability": 0.0, "tilt": 5.0, "texture_probability": 0.0})  # fmt: skip
    made = Data(config)
    longest = []
    for number in range(20):
        bodies = made._scene(0, number)[0].float().abs() > 60
        if bodies.any():
            longest.append(max(range(3), key=lambda a: int(bodies.amax(tuple(k for k in range(3) if k != a)).sum())))
    assert longest.count(0) < longest.count(1) + longest.count(2)
    assert longest.count(1) > 0
    assert longest.count(2) > 0


def test_exposures_lie_in_their_range(data):
    scales = torch.cat([data.batch(5, step, range(4)).problem.scale_hu for step in range(3)])
    ratio = float(scales.max() / scales.min())
    assert 1.1 < ratio < 1.3 * math.sqrt(4.0)  # two situations: their information differs


@pytest.mark.extended
def test_scenes_are_painted_beforehand_as_when_they_are_used():
    made = Data(CONFIG)
    ahead = Data(replace(CONFIG, pool=3))
    ahead.paint(4, 1)
    for number in range(3):
        assert torch.equal(ahead._pool[4, number], made._scene(4, number))


@pytest.mark.extended
def test_draws_are_used_several_times():
    """About as often as asked for, and a resumed run finds the same."""
    config = replace(CONFIG, reuse=3, situations=CONFIG.situations[:1])
    made, seen = Data(config), Counter()
    for step in range(40):
        for batch in made.batches(1, step, [0, 1]):
            assert batch.size == 1
            seen[id(batch)] += 1
    assert len(made.batches(1, 0, range(3))) == 3
    assert len(Data(CONFIG).batches(1, 0, range(3))) == 1
    assert max(seen.values()) > 1
    later = Data(config).batches(1, 39, [0, 1])
    for one, other in zip(made.batches(1, 39, [0, 1]), later, strict=True):
        assert torch.equal(one.truth, other.truth)
        assert torch.equal(one.problem.beta, other.problem.beta)
