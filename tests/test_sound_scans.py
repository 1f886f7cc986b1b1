"""Sound scans are told nothing wrong: some that ``tests/bench/false_alarms.py`` draws; and how
they are made."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from analytic import Ellipsoid, line_integrals
from sound_scans import BALL, BOX, CYLINDER, Solid, draw, possible, transmissions

from torchpcct import ConeBeam, FanBeam, ParallelBeam, full_turn
from torchpcct.checks.conjugate_rays import geometry_test

_SPEC = importlib.util.spec_from_file_location(
    "false_alarms", Path(__file__).parent / "bench/false_alarms.py"
)
false_alarms = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(false_alarms)


# Coarse cells and a wide spot, which blur; opaque faces that rays pass along; thin bodies between
# two rows; a hollow body; faces that end within a row; a face along the rays, in few columns.
ONCE_ALARMED = [
    (50_439, 25_000),
    (50_447, 60_000),
    (58_211, 60_000),
    (56_446, 60_000),
    (56_459, 60_000),
    (59_079, 60_000),
    (70_246, 60_000),
    (70_447, 60_000),
    (79_127, 60_000),
    (150_230, 50_000),
    (900_185, 50_000),
]


@pytest.mark.parametrize(
    ("seed", "readings"), [*((seed, 25_000) for seed in range(20)), *ONCE_ALARMED]
)
def test_sound_scans_raise_no_alarm(seed, readings):
    drawn = draw(seed, readings=readings)
    assert false_alarms.alarms(drawn) == [], drawn.text


@pytest.mark.parametrize(
    ("kind", "seed", "cause", "size"),
    [
        ("fan", 1, "centre", -0.7),
        ("fan", 22, "scale", 0.03),
        ("fan", 1, "step", -0.012),
        ("cone", 5, "centre", 1.3),
    ],
)
def test_wrong_descriptions_are_measured(kind, seed, cause, size):
    drawn = draw(seed, kind=kind, readings=25_000)
    found = geometry_test(*false_alarms.misdescribed(drawn, cause, size))
    assert found.findings, drawn.text
    # ± is two of them
    assert abs(found.sizes[cause] - size) < 3.0 * found.errors[cause] < abs(size)


def test_a_hole_takes_away_no_more_than_is_there():
    """What attenuates less than air would rightly be named."""
    outer = Solid(BALL, (1.0, 2.0, 0.0), (20.0, 18.0, 15.0), 0.02)
    hole = Solid(CYLINDER, (3.0, 0.0, 0.0), (5.0, 4.0, 6.0), -0.015, 0.3)
    again = Solid(BOX, (5.0, 0.0, 0.0), (3.0, 4.0, 2.0), -0.012)
    beyond = Solid(BALL, (20.0, 2.0, 0.0), (5.0, 5.0, 5.0), -0.01)
    more = Solid(BALL, (20.0, 2.0, 0.0), (5.0, 5.0, 5.0), 0.01)
    solids = [outer, hole, again, beyond, more]
    values = [s.value for s in possible(solids, np.random.default_rng(0))]
    assert values == pytest.approx([0.02, -0.015, -0.005, 0.0, 0.01])
    for seed in (130_195, 140_040):
        drawn = draw(seed, readings=25_000)
        shone = transmissions(drawn.geometry, drawn.solids, **drawn.options)
        assert shone.max() <= 1.0 + 1e-12


def test_all_parts_of_a_focal_spot_shine():
    """A spot to one side would be a centre in another place."""
    g = ConeBeam(full_turn(4), 300.0, 500.0, 40, 3, (2.0, 2.0))
    for subs in ((3, 2, 1), (3, 2, 3), (3, 7, 1)):
        shone = transmissions(
            g, [Solid(BALL, (0.0, 0.0, 0.0), (20.0, 20.0, 50.0), 0.02)], subs=subs, spot=6.0
        )
        middle = ((1.0 - shone) * (np.arange(40) - 19.5)).sum(2) / (1.0 - shone).sum(2)
        assert np.abs(middle).max() < 0.002


@pytest.mark.parametrize(
    "geometry",
    [
        ParallelBeam([0.3, 2.0], 24, 4.0, 1.0),
        FanBeam([0.3, -2.0], 150.0, 260.0, 24, 8.0, 1.0),
        ConeBeam([0.3, 2.0], 150.0, 260.0, 24, 5, (6.0, 8.0), (1.0, 2.0), "curved"),
    ],
)
def test_transmissions_are_those_of_exact_chords(geometry):
    cone = geometry.has_rows
    place, radii = (2.0, 10.0, -15.0), (5.0, 20.0, 28.0)
    bodies = [Ellipsoid(place if cone else place[1:], radii if cone else radii[1:], 0.4, 0.02)]
    solids = [
        Solid(
            BALL if cone else CYLINDER,
            (-15.0, 10.0, 2.0),
            (28.0, 20.0, 5.0 if cone else 1e5),
            0.02,
            0.4,
        )
    ]
    expected = np.exp(-line_integrals(geometry, bodies, sub=1))
    np.testing.assert_allclose(
        transmissions(geometry, solids, subs=(1, 1, 1)), expected, rtol=1e-12
    )


def test_chords_of_tilted_boxes_and_cylinders():
    along = ParallelBeam([0.0], 1, 1.0)
    box = [Solid(BOX, (3.0, 0.0, 0.0), (4.0, 2.0, 1.0), 0.1)]
    rod = [Solid(CYLINDER, (3.0, 0.0, 0.0), (4.0, 4.0, 1.0), 0.1, 0.0, 0.3)]
    upright = [Solid(CYLINDER, (0.0, 3.0, 0.0), (4.0, 4.0, 1.0), 0.1, 0.0, np.pi / 4)]
    across = ParallelBeam([np.pi / 2], 1, 1.0)
    one = {"subs": (1, 1, 1)}
    assert -np.log(transmissions(along, box, **one)).item() == pytest.approx(0.8)
    assert -np.log(transmissions(along, rod, **one)).item() == pytest.approx(0.8)
    # Along y through a disc 2 mm thick that is tilted by 45° about x: 2 mm · √2.
    assert -np.log(transmissions(across, upright, **one)).item() == pytest.approx(
        0.2 * np.sqrt(2.0)
    )
