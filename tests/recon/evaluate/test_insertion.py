"""Balls inserted into a scan: they are what a scan of the object with the balls holds, and what a
method shows of them is told from what it erases."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from sound_scans import BALL, CYLINDER, Solid, transmissions

from recon.evaluate import InsertedBall, contrast_recovery
from recon.evaluate.insertion import noise_weights, recovery_table, with_balls
from recon.evaluate.without_truth import as_slices
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Scan, VolumeGrid, full_turn

MU = 0.02
PHOTONS = 2e5
DISC = Solid(CYLINDER, (0.0, 0.0, 0.0), (20.0, 17.0, 1e5), MU)
GRID = VolumeGrid((64, 64), 0.75)
SUBS = (16, 12, 1)
"""Rays a cell: the edges of a ball are sharp."""


def _scan(geometry, solids, noise=None, mu_water=MU, linearisation=None):
    through = transmissions(geometry, solids, subs=SUBS)
    readings = PHOTONS * through
    if noise is not None:
        readings = np.random.default_rng(noise).poisson(readings).astype(float)
    return Scan.from_counts(
        readings, geometry, air=PHOTONS, mu_water=mu_water, linearisation=linearisation
    )


@pytest.fixture(scope="module")
def fan():
    return FanBeam(full_turn(180), 400.0, 800.0, 110, 1.0)


@pytest.mark.parametrize("kind", ["parallel", "fan", "cone"])
@pytest.mark.parametrize("linearisation", [None, (1.0, 0.15)])
def test_an_inserted_ball_reads_like_a_ball_that_was_scanned(kind, linearisation, fan):
    geometry = {
        "parallel": ParallelBeam(np.arange(90) * np.pi / 90, 64, 0.75),
        "fan": fan,
        "cone": ConeBeam(full_turn(24), 400.0, 800.0, 48, 12, 2.0),
    }[kind]
    flat = kind != "cone"
    place = (2.0, 5.0, -3.0)
    grid = VolumeGrid((1, 64, 64) if flat else (12, 32, 32), 0.75)
    ball = InsertedBall(4.0, 150.0)
    added = Solid(BALL, place[::-1], (2.0, 2.0, 2.0), 0.15 * MU)
    if flat:
        added = Solid(CYLINDER, (place[2], place[1], 0.0), (2.0, 2.0, 1e5), 0.15 * MU)
    plain = _scan(geometry, [DISC], linearisation=linearisation)
    if linearisation is None:
        real = _scan(geometry, [DISC, added])
    else:
        # A correction c: what reads p + q after it is scanned as c⁻¹(c(p) + q).
        p = -np.log(transmissions(geometry, [DISC], subs=SUBS))
        q = -np.log(transmissions(geometry, [added], subs=SUBS))
        wanted = p + 0.15 * p**2 + q
        raw = (np.sqrt(1.0 + 0.6 * wanted) - 1.0) / 0.3
        real = Scan.from_counts(
            PHOTONS * np.exp(-raw), geometry, air=PHOTONS, mu_water=MU, linearisation=linearisation
        )
    at = np.asarray([place])
    stack = plain
    if flat:
        stack = as_slices(plain, GRID)[0]
    found, _ = with_balls(stack, grid, ball, at)
    shown = (found.line_integrals() - stack.line_integrals()).reshape(real.counts.shape)
    truth = real.line_integrals() - plain.line_integrals()
    assert float(truth.max()) > 0.01
    # Voxels of a quarter of a cell for a round ball: 1 % of its longest chord.
    assert float((shown - truth).abs().max()) < 0.02 * float(truth.max())
    assert float((shown.sum() - truth.sum()).abs()) < 0.003 * float(truth.sum())


def test_linear_methods_recover_the_same_at_any_contrast_and_noise(fan):
    balls = [InsertedBall(3.0, 40.0), InsertedBall(3.0, -200.0)]
    methods = ["fbp:soft", "fbp:ram-lak"]
    rows = [
        contrast_recovery(scan, GRID, methods, balls, n=4)
        for scan in (_scan(fan, [DISC]), _scan(fan, [DISC], noise=1))
    ]
    of = {(r.method, r.ball): r for r in rows[0]}
    for row in [*rows[0], *rows[1]]:
        assert row.mean == pytest.approx(of[row.method, balls[0]].mean, abs=0.02)
        assert len(row.values) == 4
        assert len(row.places[0]) == 2
    assert of["fbp:ram-lak", balls[0]].verdict == "more"
    assert of["fbp:soft", balls[0]].verdict == "as much"
    assert 0.5 < of["fbp:soft", balls[0]].mean < of["fbp:ram-lak", balls[0]].mean < 1.1


def _blind(scan, grid):
    return torch.zeros(grid.shape)


def _halving(scan, grid):
    from recon import reconstruct

    return 0.5 * reconstruct(scan, grid, "fbp", kernel="soft").data


def test_what_a_method_erases_is_seen(fan):
    scan = _scan(fan, [DISC], noise=2)
    blind, halved = contrast_recovery(scan, GRID, [_blind, _halving], [InsertedBall(4.0, 60.0)])
    assert blind.mean == 0.0
    assert blind.verdict == "less"
    assert halved.mean == pytest.approx(0.5 * halved.reference_mean, rel=1e-4)
    assert "less than fbp:soft" in str(halved)
    table = recovery_table([blind, halved]).splitlines()
    shown = (
        f"4 mm, +60 HU {len(blind.values)} {blind.detectability:.1f} _blind 0 ± 0 % "
        f"{100 * blind.reference_mean:.0f} % less"
    )
    assert table[1].split() == shown.split()
    assert halved.as_dict()["recovered"] == halved.mean


@pytest.mark.parametrize("linearisation", [None, (1.0, 0.15)])
def test_the_ideal_observer_has_the_detectability_that_is_stated(linearisation, fan):
    """Over noise realisations, Σ w p (y − y₀) has a standard deviation of d′ if w are the inverse
    variances of the readings y; p is what the ball adds to them, and d′² = Σ w p²."""
    ball, place = InsertedBall(3.0, 60.0), np.asarray([(0.0, 4.0, -2.0)])
    photons = PHOTONS * transmissions(fan, [DISC], subs=SUBS)
    rng = np.random.default_rng(6)

    def scan(readings):
        found = Scan.from_counts(
            readings, fan, air=PHOTONS, mu_water=MU, linearisation=linearisation
        )
        return as_slices(found, GRID)[0]

    clean, noisy, *draws = (
        scan(readings) for readings in (photons, *rng.poisson(photons, (81, *photons.shape)) * 1.0)
    )
    stack = VolumeGrid((1, 64, 64), 0.75)
    _, stated = with_balls(noisy, stack, ball, place, noise_weights(noisy))
    y = clean.line_integrals()
    p = with_balls(clean, stack, ball, place)[0].line_integrals() - y
    weights = noisy.weights()
    sums = [float((weights * p * (d.line_integrals() - y)).sum()) for d in draws]
    # 80 draws: the standard deviation is known to 8 %.
    assert np.std(sums) == pytest.approx(stated, rel=0.25)
    assert float((weights * p.square()).sum().sqrt()) == pytest.approx(stated, rel=0.01)


def test_a_scan_without_noise_has_no_detectability(fan):
    stack, grid = as_slices(_scan(fan, [DISC]), GRID)
    scan = replace(stack, exposure_s=None)
    ball, weights = InsertedBall(3.0, 60.0), noise_weights(scan)
    assert with_balls(scan, grid, ball, np.zeros((1, 3)), weights)[1] is None


def test_filters_know_the_noise_of_the_scan(fan):
    scan = _scan(fan, [DISC], noise=3)
    (row,) = contrast_recovery(scan, GRID, "gaussian@fbp:detail", [InsertedBall(3.0, 100.0)], n=3)
    assert 0.3 < row.mean < 1.0


def test_a_scan_without_hu_is_measured_in_its_own_unit(fan):
    hu, other = (
        contrast_recovery(
            _scan(fan, [DISC], mu_water=mu), GRID, "fbp:standard", [InsertedBall(3.0, 100.0)], n=3
        )[0]
        for mu in (MU, None)
    )
    assert other.mean == pytest.approx(hu.mean, rel=1e-3)


def test_slices_are_measured_one_by_one(fan):
    one = _scan(fan, [DISC], noise=4)
    counts = np.random.default_rng(5).poisson(np.stack([one.counts] * 3)).astype(float)
    scan = Scan.from_counts(counts, fan, air=PHOTONS, mu_water=MU)
    grid = VolumeGrid((3, 64, 64), 0.75)
    (row,) = contrast_recovery(scan, grid, "fbp:soft", [InsertedBall(3.0, 100.0)], n=5)
    assert row.values == pytest.approx(row.reference)
    assert row.mean == pytest.approx(0.8, abs=0.1)
    assert len({place[0] for place in row.places}) > 1


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"balls": [InsertedBall(60.0, 10.0)]}, r"a ball of 60 mm, \+10 HU fits nowhere"),
        ({"places": [[1.0, 2.0, 3.0]]}, r"rows of 2 numbers in mm, \(y, x\)"),
        ({"places": [[30.0, 0.0]]}, "reaches beyond the grid"),
        ({"places": [[0.0, 0.0], [0.0, 5.0]]}, "5 mm apart"),
        ({"methods": []}, "at least one method"),
        ({"methods": ["fbp:soft,energies=iodine"]}, "energies="),
        ({"methods": ["fbp:sofd"]}, "sofd"),
        ({"n": 0}, "n must be"),
    ],
)
def test_bad_input_is_named_before_anything_runs(given, message, fan, monkeypatch):
    def never(*_args, **_options):
        raise AssertionError("a reconstruction was started")

    if "fits nowhere" not in message:
        monkeypatch.setattr("recon.evaluate.insertion.reconstruct", never)
    arguments = {"methods": "fbp:soft", "balls": [InsertedBall(3.0, 50.0)], **given}
    with pytest.raises(ValueError, match=message):
        contrast_recovery(_scan(fan, [DISC]), GRID, **arguments)


@pytest.mark.parametrize("values", [(0.0, 10.0), (-1.0, 10.0), (1.0, 0.0), (1.0, float("nan"))])
def test_a_ball_needs_size_and_contrast(values):
    with pytest.raises(ValueError, match=r"diameter_mm|contrast_hu"):
        InsertedBall(*values)


def test_lines_of_another_shape_are_not_added(fan):
    with pytest.raises(ValueError, match="lines have shape"):
        _scan(fan, [DISC]).with_added(torch.zeros(3, 4))


def test_the_command_prints_the_table_or_json(fan, tmp_path, capsys):
    import json

    from recon.cli import main

    path = tmp_path / "scan.h5"
    _scan(fan, [DISC], noise=6).save(path)
    common = ["recovery", str(path), "--method", "fbp:standard", "--ball", "3", "100"]
    assert main([*common, "--voxel", "0.75", "--n", "2"]) in (0, None)
    assert "3 mm, +100 HU" in capsys.readouterr().out
    assert main([*common, "--at", "2", "-3", "--json"]) in (0, None)
    (row,) = json.loads(capsys.readouterr().out)
    assert row["places_mm"] == [[2.0, -3.0]]
    assert row["standard_error"] is None
