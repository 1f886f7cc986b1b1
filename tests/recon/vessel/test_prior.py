"""What is believed of a vessel: refused when it cannot be meant, and felt by the fit."""

import drawn_vessel
import numpy as np
import pytest

from recon.vessel import VesselPrior
from recon.vessel.data import grid_of, pilot
from recon.vessel.model import FIBROUS, WALL, VesselModel
from recon.vessel.start import find_vessel


@pytest.mark.parametrize(
    ("values", "error", "match"),
    [
        ({"wall": (50.0, 0.0)}, ValueError, "wall"),
        ({"wall": (float("nan"), 10.0)}, ValueError, "wall"),
        ({"fibrous": (95.0, -1.0)}, ValueError, "fibrous"),
        ({"fibrous": 95.0}, ValueError, "fibrous"),
        ({"fibrous": ("a", 1.0)}, TypeError, "fibrous"),
        ({"orders": 1}, ValueError, "orders"),
        ({"orders": 5}, ValueError, "orders"),
        ({"orders": 3.0}, TypeError, "orders"),
        ({"shift": -1.0}, ValueError, "shift"),
        ({"shift": "wide"}, TypeError, "shift"),
        ({"freedom": 0.0}, ValueError, "freedom"),
    ],
)
def test_what_cannot_be_believed_is_refused(values, error, match):
    with pytest.raises(error, match=match):
        VesselPrior(**values)


@pytest.fixture(scope="module")
def seen(gram):
    data = drawn_vessel.data(gram, drawn_vessel.image(gram.finer, 0.0))
    return data, find_vessel(pilot(data), grid_of(data), None)


def test_a_firm_belief_holds_and_a_loose_one_gives_way(seen):
    """Values far from the truth: pulled there with 1 HU of doubt, hardly with 100 HU."""
    fits = []
    for sd in (1.0, 100.0):
        vessel = VesselModel(*seen, VesselPrior((0.0, sd), (160.0, sd)))
        fits.append(vessel.fit(vessel.first_guess()).parameters)
    true = [drawn_vessel.VALUES[t] for t in ("wall", "fibrous")]
    off = [np.abs(p[[WALL, FIBROUS]] - true) for p in fits]
    assert off[1][1] < 12
    assert off[0][1] > 3 * off[1][1]
    assert off[0][0] > off[1][0]


def test_a_belief_in_the_difference_alone_gives_way_together(seen):
    """Both means 100 HU off: with a shift the fit finds the values, and what the prior says of
    their difference."""
    off = []
    for shift in (0.0, 200.0):
        means = [drawn_vessel.VALUES[t] + 100.0 for t in ("wall", "fibrous")]
        vessel = VesselModel(*seen, VesselPrior((means[0], 10.0), (means[1], 10.0), shift=shift))
        found = vessel.fit(vessel.first_guess()).parameters[[WALL, FIBROUS]]
        off.append(np.abs(found - means + 100.0))
    assert off[0].max() > 40
    assert off[1].max() < 15


def test_orders_are_those_of_both_outlines(seen):
    for orders in (2, 3, 4):
        vessel = VesselModel(*seen, VesselPrior(orders=orders))
        guess = vessel.first_guess()
        assert (
            vessel.lumen_shape(guess).shape[1]
            == vessel.outer_shape(guess).shape[1]
            == 2 * orders + 1
        )
