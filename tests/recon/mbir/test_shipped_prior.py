"""What the shipped weights must be worth: beside FBP of the same readings, beside their own linear
start, part by part.

A tilted vessel with a core (not the paper's), painted on 0.1 mm, projected and drawn at two noise
levels.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import drawn_vessel
import pytest
import torch
from inset_operators import HU, problem, term_of
from scipy import ndimage
from torch import nn

from recon.analytic.backproject import backproject
from recon.analytic.fbp import filter_sinogram
from recon.gram.gram import Gram
from recon.mbir.frequencies import filtered
from recon.mbir.mbir import Mbir
from recon.mbir.network import NetworkConfig
from recon.mbir.residual import significant_residual
from recon.mbir.unrolled import (
    REFERENCE_SCALE_HU,
    Unrolled,
    guide_noise,
    limited,
    low_residual,
    start,
)

FAT = drawn_vessel.VALUES["fat"]
LEVEL = 1.0 + FAT / 1000.0
"""Of what lies about the vessel, in units of water: fat."""
RIM = 3
"""Voxels at the faces that are not compared."""


@pytest.fixture(scope="module")
def drawn():
    """Operators, truth and readings of the vessel above the fat about it."""
    views, rows = 240, 20
    A, w = problem(views, (22, 30, 30), 0.2, rows)
    fine, _ = problem(views, (44, 60, 60), 0.1, rows)
    truth = drawn_vessel.image(A.grid, 80.0, samples=4)
    readings = fine((drawn_vessel.image(fine.grid, 80.0, samples=2) + 1000.0 * (1.0 - LEVEL)) * HU)
    inner = torch.zeros(truth.shape, dtype=torch.bool)
    inner[RIM:-RIM, RIM:-RIM, RIM:-RIM] = True
    vessel = truth > FAT + 10.0
    apart = torch.from_numpy(ndimage.distance_transform_edt(~vessel.numpy(), sampling=0.2)) > 0.6
    scan = SimpleNamespace(
        gram=Gram(A, w, 5), grid=A.grid, mu_ref=1000.0 * HU, level=1000.0 * LEVEL * HU
    )
    return SimpleNamespace(
        A=A,
        w=w,
        truth=truth,
        readings=readings,
        scan=scan,
        places={"vessel": vessel & inner, "fat": apart & inner},
    )


@pytest.fixture(scope="module", params=[40.0, 8.0], ids=["152 HU", "341 HU"])
def found(drawn, request):
    """HU of every method at a noise level, with the problem and the volumes of MBIR's steps."""
    exposure, generator = request.param, torch.Generator().manual_seed(0)
    noise = torch.randn((2, *drawn.readings.shape), generator=generator)
    y = drawn.readings + noise / (drawn.w * exposure).sqrt()
    b, network = drawn.A.T(drawn.w * exposure * y), Mbir.load()
    term = term_of(drawn.scan, b, exposure)
    kernels = filter_sinogram(
        y, drawn.A.geometry, ["soft", "standard"], drawn.A.window, held=drawn.A.window
    )
    soft, standard = backproject(
        kernels, drawn.A.geometry, drawn.A.grid, drawn.A.window
    ) / HU - 1000.0 * (1.0 - LEVEL)
    with torch.no_grad():
        volumes = {
            "soft": soft,
            "standard": standard,
            "mbir": network(term),
            "linear": Mbir(network.model, network.fidelity, steps=0)(term),
        }
        normal = network.normal(term)
        free = network.model(normal, network.fidelity, final_data_consistency=False)
    return SimpleNamespace(
        exposure=exposure,
        volumes=volumes,
        normal=normal,
        fidelity=network.fidelity,
        free=free,
        out=normal.of_hu(volumes["mbir"]),
    )


def error(drawn, found, method, place):
    """Root mean square, HU."""
    return float(
        (found.volumes[method] - drawn.truth)[:, drawn.places[place]].square().mean().sqrt()
    )


def energy(normal, u):
    """½ uᵀHu − βᵀu: the misfit of the data, but for a constant."""
    return float((0.5 * u * normal.apply(u) - normal.b * u).sum(dtype=torch.float64))


@pytest.mark.parametrize(
    ("place", "rival", "at_most"),
    [
        ("vessel", "soft", (0.70, 0.68)),
        ("vessel", "standard", (0.56, 0.48)),
        ("vessel", "linear", (0.79, 0.86)),
        ("fat", "soft", (0.22, 0.18)),
        ("fat", "standard", (0.15, 0.12)),
        ("fat", "linear", (0.30, 0.25)),
    ],
)
def test_the_error_is_that_share_of_the_rivals(drawn, found, place, rival, at_most):
    share = error(drawn, found, "mbir", place) / error(drawn, found, rival, place)
    assert share < at_most[0 if found.exposure == 40.0 else 1]


def test_fat_and_lumen_keep_their_values(drawn, found):
    volume = found.volumes["mbir"]
    assert float(volume[:, drawn.places["fat"]].mean()) == pytest.approx(FAT, abs=2.5)
    lumen = drawn.truth > drawn_vessel.VALUES["lumen"] - 1.0
    assert float(volume[:, lumen].mean()) == pytest.approx(drawn_vessel.VALUES["lumen"], rel=0.06)


def test_final_data_consistency_makes_the_network_s_volume_explain_the_data(found):
    left = [
        low_residual(found.normal, found.normal.b - found.normal.apply(u), found.fidelity).max()
        for u in (found.free, found.out)
    ]
    assert left[1] < 0.5 * left[0]
    assert energy(found.normal, found.out) < energy(found.normal, found.free)


class Listener(nn.Module):
    """In the network's place: keeps what it is given, and moves away from the data."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def forward(self, u, towards, condition, smoothed):
        self.seen.append((u, towards, condition))
        return 0.9 * u


def test_the_network_is_given_a_step_towards_the_data_and_where_it_is(found):
    normal, model = found.normal, Unrolled(NetworkConfig((6, 8, 8), 0.2), 2)
    model.network = Listener()
    with torch.no_grad():
        model(normal, 0.75)
    spectrum = normal.spectrum()
    before = start(normal, spectrum)
    assert len(model.network.seen) == 2
    for k, (u, towards, condition) in enumerate(model.network.seen):
        torch.testing.assert_close(u, before)
        left = normal.b - normal.apply(u)
        torch.testing.assert_close(
            towards - u, filtered(left, 1.0 / (spectrum + 0.1)), rtol=1e-3, atol=1e-3
        )
        assert energy(normal, towards) < energy(normal, u)
        level = torch.log(normal.unit_hu / REFERENCE_SCALE_HU)
        torch.testing.assert_close(
            condition, torch.stack([level, 0.25 + 0 * level, k + 0 * level], 1)
        )
        before = 0.9 * u


@pytest.fixture(scope="module")
def striped(drawn):
    """The shipped network, a problem that holds fine stripes beyond all noise, the volumes of its
    steps, and what the network alone, with the data, without overshoot, and with what the data
    still hold makes of it."""
    network, exposure, generator = Mbir.load(), 40.0, torch.Generator().manual_seed(0)
    noise = torch.randn(drawn.readings.shape, generator=generator)
    y = drawn.readings + noise / (drawn.w * exposure).sqrt()
    b = drawn.A.T(drawn.w * exposure * y)[None]
    normal = network.normal(term_of(drawn.scan, b, exposure))
    stripes = 8.0 * torch.sin(2.0 * math.pi * torch.arange(normal.b.shape[-1]) / 5.0)
    normal = replace(normal, b=normal.b + normal.apply(stripes.expand(normal.b.shape).contiguous()))
    steps = []

    def run(callback=None, **options):
        with torch.no_grad():
            return network.model(normal, network.fidelity, callback, **options)

    plain = {"cut_overshoot": False, "restore": False}
    made = {
        "alone": run(lambda k, v: steps.append(v), final_data_consistency=False, **plain),
        "data": run(**plain),
        "cut": run(restore=False),
        "all": run(),
    }
    return SimpleNamespace(
        model=network.model, normal=normal, steps=steps, run=run, plain=plain, **made
    )


def test_steps_and_prior_are_what_is_asked_for(striped):
    count = striped.model.steps
    assert len(striped.steps) == count + 1
    torch.testing.assert_close(striped.steps[-1], striped.alone)
    for steps in (1, count + 1):
        seen, asked = [], []
        found = striped.run(
            lambda k, v, seen=seen: seen.append(v),
            steps=steps,
            final_data_consistency=False,
            **striped.plain,
        )
        assert len(seen) == steps + 1
        torch.testing.assert_close(seen[1], striped.steps[1])
        torch.testing.assert_close(seen[-1], found)
        kept = striped.run(
            prior=lambda v, *_, asked=asked: asked.append(v) or v,
            steps=steps,
            final_data_consistency=False,
            **striped.plain,
        )
        assert len(asked) == steps
        torch.testing.assert_close(kept, striped.steps[0])
    assert float((striped.alone - striped.steps[0]).abs().max()) > 0.5


def test_every_switch_takes_its_part_out_and_nothing_else(striped):
    """Each part is tested by itself elsewhere: here that it is there, in its place, in what
    ships."""
    normal, spectrum = striped.normal, striped.normal.spectrum()
    assert energy(normal, striped.data) < energy(normal, striped.alone) - 1.0
    given = []

    def listening(*seen):
        given.append(seen)
        return striped.model.network(*seen)

    torch.testing.assert_close(striped.run(prior=listening), striped.all)
    noise = guide_noise(spectrum, normal.b.shape[-3:], normal.voxel_mm)
    torch.testing.assert_close(striped.cut, limited(striped.data, given[-1][3], noise))
    assert float((striped.cut - striped.data).abs().max()) > 0.5
    back = significant_residual(normal, spectrum, striped.cut, 0.1)
    torch.testing.assert_close(striped.all, striped.cut + back)
    assert float(back.abs().max()) > 0.5
