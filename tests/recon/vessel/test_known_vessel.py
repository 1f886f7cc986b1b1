"""MBIR around the outlines of a vessel: sharper where they fit, the plain reconstruction where
they do not."""

from dataclasses import replace

import drawn_vessel
import numpy as np
import pytest
import torch

from recon.data_term import Quadratic
from recon.vessel import VesselPrior, known
from recon.vessel.known import KnownVessel

EXPOSURE_S = 0.25


def right_hand_side(drawn, image, seed):
    return drawn_vessel.right_hand_side(drawn, image, seed, EXPOSURE_S)


@pytest.fixture(scope="module")
def vessel(drawn):
    """The data term of a vessel with a core of 100 HU of contrast, drawn on finer voxels."""
    return right_hand_side(drawn, drawn_vessel.image(drawn.gram.finer, 100.0, samples=3), 1)


def test_outlines_are_sharper_and_the_layer_keeps_what_the_data_show(drawn, network):
    truth = drawn_vessel.image(drawn.grid, 100.0)
    vessel = right_hand_side(drawn, drawn_vessel.image(drawn.gram.finer, 100.0, samples=3), None)
    (found,) = network.with_known(KnownVessel()).solve(vessel)
    assert found.report["vessel"]["used"]
    plain, around = network(vessel)[0], found.volume
    inside = truth > -80
    error = [float((v - truth)[inside].square().mean().sqrt()) for v in (plain, around)]
    assert error[1] < 0.6 * error[0]
    core = drawn_vessel.image(drawn.grid, 1000.0) < -880
    # The model has no core: it stands there because the data have it.
    assert float(around[core].mean()) < float(around[inside & ~core & (truth < 150)].mean()) - 30


def test_without_a_vessel_it_is_the_plain_reconstruction(drawn, network):
    b = right_hand_side(drawn, torch.full(drawn.gram.finer.shape, -90.0), 2)
    (found,) = network.with_known(KnownVessel()).solve(b)
    assert torch.equal(found.volume, network(b)[0])
    assert "nothing stands out" in found.report["vessel"]["why"]
    assert found.warnings == [f"no vessel model was used: {found.report['vessel']['why']}"]


def test_outlines_that_leave_something_unexplained_are_not_drawn(drawn, network):
    """A second bright thing at the vessel's wall."""
    image = drawn_vessel.image(drawn.gram.finer, 100.0, samples=3)
    bright = torch.nonzero(image > image.max() - 50.0).double().mean(0)
    z, y, x = (
        torch.arange(n)[(slice(None),) + (None,) * (2 - k)] for k, n in enumerate(image.shape)
    )
    near = (z - bright[0]) ** 2 + (y - bright[1] - 12) ** 2 + (x - bright[2]) ** 2 < 36
    b = right_hand_side(drawn, torch.where(near, torch.tensor(900.0), image), 3)
    (found,) = network.with_known(KnownVessel()).solve(b)
    assert not found.report["vessel"]["used"]
    assert torch.equal(found.volume, network(b)[0])


def test_what_lies_apart_from_a_vessel_does_not_speak_against_it(drawn, network):
    """Muscle 1.2 mm from the wall: the network reconstructs it, the vessel is drawn all the
    same."""
    image = drawn_vessel.image(drawn.gram.finer, 100.0, samples=3)
    z, y = (torch.from_numpy(drawn.gram.finer.axes[k] - drawn.gram.finer.center[k]) for k in (0, 1))
    wall = drawn_vessel.INNER_MM + drawn_vessel.WALL_MM
    muscle = y - drawn_vessel.TILT * z[:, None] < -(wall + 1.2)
    beside = torch.where(muscle[:, :, None], torch.tensor(0.0), image)
    b = right_hand_side(drawn, beside, 3)
    (found,) = network.with_known(KnownVessel()).solve(b)
    assert found.report["vessel"]["used"], found.report
    volumes = found.volume, network(b)[0]
    assert float((volumes[0] - volumes[1])[:, 0].mean()) == pytest.approx(0.0, abs=5.0)


@pytest.mark.parametrize(
    ("values", "tissue"), [({"wall": -65.0, "fibrous": -60.0}, "wall"), ({"fibrous": 330.0}, "fib")]
)
def test_a_vessel_of_what_is_no_tissue_is_not_drawn(drawn, network, values, tissue):
    """Inflamed fat about a lumen, contrast agent beside a flap: both are fitted, and explain the
    data."""
    b = right_hand_side(drawn, drawn_vessel.image(drawn.gram.finer, 0.0, samples=3, **values), 4)
    (found,) = network.with_known(KnownVessel()).solve(b)
    assert f"its {tissue}" in found.report["vessel"]["why"]
    assert torch.equal(found.volume, network(b)[0])


def test_scenes_of_a_batch_are_what_they_are_alone(drawn, network, vessel):
    empty = right_hand_side(drawn, torch.full(drawn.gram.finer.shape, -90.0), 2)
    method = network.with_known(KnownVessel())
    both = method.solve(Quadratic.joined([empty, vessel]))
    for k, alone in enumerate((empty, vessel)):
        assert torch.allclose(both[k].volume, method(alone)[0], atol=0.5)
    assert [found.report["vessel"]["used"] for found in both] == [False, True]
    assert ["no vessel" in found.warnings[0] for found in both] == [True, False]
    assert "may be missing: compare" in both[1].warnings[0]
    (plain,) = method.with_known(None).solve(vessel)
    assert torch.equal(plain.volume, network(vessel)[0])
    assert "vessel" not in plain.report


def test_it_is_differentiable_with_the_fit(drawn, network, vessel):
    """Against a finite difference of the whole method, fitted anew on both sides."""
    method = network.with_known(KnownVessel()).with_fidelity(1.0)
    b = vessel.b.clone().requires_grad_()
    weights = torch.from_numpy(np.random.default_rng(0).standard_normal(b.shape)).float()
    direction = right_hand_side(drawn, torch.full(drawn.gram.finer.shape, -910.0), 5).b * 0.02

    def weighed(b):
        return (method(replace(vessel, b=b)) * weights).sum(dtype=torch.float64)

    weighed(b).backward()
    with torch.no_grad():
        there = [weighed(vessel.b + s * direction) for s in (0.5, -0.5)]
    assert float((b.grad * direction).sum()) == pytest.approx(float(there[0] - there[1]), rel=0.06)


def test_more_fidelity_leaves_more_of_the_contrast_and_of_the_noise(drawn, network):
    images = [drawn_vessel.image(drawn.gram.finer, c, samples=3) for c in (100.0, 0.0)]
    core = drawn_vessel.image(drawn.grid, 1000.0) < -880
    contrast, noise = [], []
    for fidelity in (0.0, 1.0):
        clean, without, noisy = (
            KnownVessel().image_of(right_hand_side(drawn, image, seed), fidelity).image
            for image, seed in ((images[0], None), (images[1], None), (images[1], 7))
        )
        contrast.append(float((without - clean)[core].mean()))
        noise.append(float((noisy - without)[core].std()))
    assert contrast[1] > contrast[0] + 10.0
    assert noise[1] > 1.2 * noise[0]


def test_what_is_believed_of_the_vessel_reaches_the_fit(drawn, network, vessel, monkeypatch):
    seen = []

    def refused(data, start, prior):
        seen.append(prior)
        raise ValueError("seen")

    monkeypatch.setattr(known, "VesselModel", refused)
    network.with_known(KnownVessel("a prior")).solve(vessel)
    assert seen == ["a prior"]


def test_all_values_moved_move_the_volume(drawn, network, vessel):
    """The zero of the scanner is 150 HU off: so is the volume, whose outlines do not ask where
    it lies."""
    moved = vessel.less(torch.full_like(vessel.b, -150.0 * drawn.mu_ref / 1000.0))
    changes = []
    for believed in (None, VesselPrior()):
        found = [network.with_known(KnownVessel(believed)).solve(b)[0] for b in (vessel, moved)]
        assert all(f.report["vessel"]["used"] for f in found)
        still, other = (f.volume for f in found)
        changes.append(float((other - still - 150.0)[still > -40].square().mean().sqrt()))
    assert changes[0] < min(5.0, 0.5 * changes[1]), changes
