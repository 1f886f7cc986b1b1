"""MBIR with the tissues of a vessel: sharper than without where they fit, the same where they do
not."""

from dataclasses import replace

import drawn_vessel
import numpy as np
import pytest
import torch
from drawn_vessel import right_hand_side
from refusals import refused
from small_scan import GRID

from recon import reconstruct
from recon.mbir.mbir import Mbir
from recon.mbir.network import NetworkConfig
from recon.mbir.unrolled import Unrolled
from recon.vessel import VesselPrior, known, read_plaque
from recon.vessel.known import KnownTissues, KnownVessel

BALL = np.s_[2:5, 2:5, 2:5]
"""A bright thing in the fat that no tissue of the vessel is."""


@pytest.fixture(scope="module")
def fine(drawn):
    """What is seen, on voxels of half the size."""
    image = drawn_vessel.image(drawn.gram.finer, 100.0, samples=3)
    image[tuple(slice(2 * s.start, 2 * s.stop) for s in BALL)] += 300.0
    return image


@pytest.fixture(scope="module")
def truth(drawn):
    image = drawn_vessel.image(drawn.grid, 100.0)
    image[BALL] += 300.0
    return image


@pytest.fixture(scope="module")
def solved(drawn, network, fine):
    """Without and with tissues, HU, and the notes."""
    b = right_hand_side(drawn, fine, 1)
    method = network.with_known(KnownTissues())
    (found,) = method.solve(b)
    with torch.no_grad():
        return network(b)[0], found.volume, found.report


def test_the_vessel_is_sharper_and_its_core_at_full_contrast(drawn, solved, truth):
    plain, found, notes = solved
    assert notes["tissues"]["used"]
    assert notes["tissues"]["presence"] > 0.95
    vessel = truth > -80
    vessel[BALL] = False
    error = [float((v - truth)[vessel].square().mean().sqrt()) for v in (plain, found)]
    assert error[1] < 0.5 * error[0]
    inside = drawn_vessel.image(drawn.grid, 1000.0) < -880  # voxels wholly in the core
    assert inside.sum() > 5
    # The reading of these data says 136 ± 42 HU of contrast.
    assert float(found[inside].mean()) == pytest.approx(0.0, abs=50)


def test_what_no_tissue_is_comes_from_the_data(solved):
    plain, found, _ = solved
    assert float(found[BALL].mean()) == pytest.approx(float(plain[BALL].mean()), abs=15)
    assert float(plain[BALL].mean()) > drawn_vessel.VALUES["fat"] + 60


def test_the_data_are_kept(drawn, network, solved, fine):
    """The low frequencies of the residual are as small as without tissues, the fit to the data
    is better."""
    b = right_hand_side(drawn, fine, 1)
    normal = network.normal(b)
    rest = []
    for volume in solved[:2]:
        u = (
            volume[None] / normal.unit_hu
            + (drawn.mu_ref - drawn.level) * 1000.0 / drawn.mu_ref / normal.unit_hu
        )
        left = normal.b - normal.apply(u)
        rest.append(-float((u * (left + normal.b)).sum(dtype=torch.float64)))
    assert rest[1] < rest[0]


def test_without_a_vessel_it_is_the_plain_reconstruction(drawn, network):
    b = right_hand_side(drawn, torch.full(drawn.gram.finer.shape, -90.0), 2)
    (found,) = network.with_known(KnownTissues()).solve(b)
    assert torch.equal(found.volume, network(b)[0])
    assert not found.report["tissues"]["used"]
    assert "no tissues were fitted" in found.warnings[0]


@pytest.mark.extended
def test_tissues_that_do_not_explain_the_data_are_not_used(drawn, network, fine, monkeypatch):
    reading = known.read_plaque
    monkeypatch.setattr(known, "read_plaque", lambda *a, **k: replace(reading(*a, **k), chi2=2.0))
    b = right_hand_side(drawn, fine, 1)
    (found,) = network.with_known(KnownTissues()).solve(b)
    assert torch.equal(found.volume, network(b)[0])
    assert "residual is 2.00" in found.warnings[0]


def test_what_is_believed_of_the_vessel_reaches_the_reading(drawn, network, fine, monkeypatch):
    seen = []

    def reading(*arguments, vessel_prior):
        seen.append(vessel_prior)
        raise ValueError("seen")

    monkeypatch.setattr(known, "read_plaque", reading)
    b = right_hand_side(drawn, fine, 1)
    for believed in (None, VesselPrior(wall=(20.0, 5.0))):
        network.with_known(KnownTissues(believed)).with_fidelity(1.0).solve(b)
    assert seen == [None, VesselPrior(wall=(20.0, 5.0))]


@pytest.mark.extended
def test_a_core_is_drawn_as_far_as_it_is_probable(drawn, network, fine, monkeypatch):
    b = right_hand_side(drawn, fine, 1)
    reading = read_plaque(b)
    monkeypatch.setattr(
        known, "read_plaque", lambda *arguments, **settings: replace(reading, presence=0.25)
    )
    around = KnownVessel().image_of(b, network.fidelity).image
    found = KnownTissues().image_of(b, network.fidelity).image
    assert torch.allclose(found, 0.25 * torch.from_numpy(reading.image) + 0.75 * around, atol=1e-3)
    assert float((around - torch.from_numpy(reading.image)).abs().max()) > 20.0


def test_from_a_scan(clean, problem, caplog):
    """No vessel in this scan: the report says so, and so does the log."""
    model = Unrolled(NetworkConfig((6, 8, 8), 0.4), 2)
    model.seen_scale_hu = torch.tensor([1.0, 5000.0])
    scan = clean.with_noise(1.0, 0)
    given = {"network": Mbir(model), "problem": problem}
    volume = reconstruct(scan, GRID, "mbir", tissues=True, **given)
    assert torch.equal(volume.data, reconstruct(scan, GRID, "mbir", **given).data)
    assert not volume.report["tissues"]["used"]
    assert any("no tissues were fitted" in text for text in volume.report["warnings"])
    assert "no tissues were fitted" in caplog.text


def test_another_fidelity_keeps_the_tissues_and_noise_units_are_the_inverse_of_hu(
    drawn, network, truth, fine
):
    method = network.with_known(KnownTissues(point=(0.0, 0.0, 1.0))).with_fidelity(1.0)
    assert isinstance(method.known, KnownTissues)
    assert (method.fidelity, method.known.point) == (1.0, (0.0, 0.0, 1.0))
    assert network.fidelity != 1.0
    normal = network.normal(right_hand_side(drawn, fine, 1))
    back = normal.hu(normal.of_hu(truth[None]))
    assert torch.allclose(back[0], truth, atol=1e-3)


def test_refusals(clean, problem):
    refused(
        ("tissues=True", lambda: reconstruct(clean, GRID, "mbir", point=(0, 0, 0))),
        (
            "vessel_prior says",
            lambda: reconstruct(clean, GRID, "mbir", vessel_prior=VesselPrior(), vessel=False),
        ),
        (
            "known is given as well as vessel or tissues",
            lambda: reconstruct(clean, GRID, "mbir", tissues=True, known=KnownVessel()),
        ),
        (
            "point must be 3 numbers",
            lambda: reconstruct(clean, GRID, "mbir", tissues=True, point=(0, 0)),
        ),
    )
