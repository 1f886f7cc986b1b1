"""Detector windows: union, margins, cropping."""

import numpy as np
import pytest
import torch

from torchpcct import ConeBeam, FanBeam
from torchpcct.detector_window import DetectorWindow


def test_union_is_the_smallest_window_that_holds_all():
    a = DetectorWindow(np.array([3, 5]), 4, 1, 2)
    b = DetectorWindow(np.array([6, 1]), 2, 2, 3)
    both = DetectorWindow.union([a, b], 12)
    assert (both.columns, both.first_row, both.rows) == (8, 1, 4)
    for w in (a, b):
        assert bool((both.first_column <= w.first_column).all())
        assert bool((both.first_column + both.columns >= w.first_column + w.columns).all())
    assert bool((both.first_column + both.columns <= 12).all())


def test_a_margin_stops_at_the_outer_window():
    outer = DetectorWindow(np.array([2, 2]), 10, 0, 6)
    wide = DetectorWindow(np.array([3, 9]), 3, 2, 1).widened(2, outer)
    assert (wide.columns, wide.first_row, wide.rows) == (7, 0, 6)
    assert wide.first_column.tolist() == [2, 5]


def test_cropping_keeps_each_reading_at_its_cell():
    outer, inner = (
        DetectorWindow(np.array([2, 4]), 6, 1, 3),
        DetectorWindow(np.array([4, 5]), 3, 2, 1),
    )
    cells = torch.arange(5 * 12.0).reshape(5, 12)
    assert torch.equal(outer.crop(outer.take(cells), inner), inner.take(cells))


@pytest.mark.parametrize("bins", [(), (2,)])
def test_what_is_taken_off_every_view_is_that_of_its_cells(bins):
    window = DetectorWindow(np.array([2, 4]), 6, 1, 3)
    cells = torch.rand(*bins, 5, 12, dtype=torch.float64)
    values = torch.rand(*bins, *window.shape)
    left = values - window.take(cells)
    assert torch.equal(window.less(values, cells), left)
    assert window.less(values, cells).dtype == left.dtype
    # Several scans at once share the cells.
    both = torch.stack([values, 2 * values])
    assert torch.equal(window.less(both, cells)[1], 2 * values - window.take(cells))
    own = left.clone()
    assert window.less(own, cells, out=own) is own
    tracked = values.clone().requires_grad_(True)
    window.less(tracked, cells).sum().backward()
    assert torch.equal(tracked.grad, torch.ones_like(values))
    assert torch.equal(own, left - window.take(cells))


def test_the_full_window_is_the_whole_detector():
    for geometry in (
        FanBeam([0.0, 1.0], 50.0, 90.0, 7, 1.0),
        ConeBeam([0.0, 1.0, 2.0], 50.0, 90.0, 7, 4, 1.0),
    ):
        full = DetectorWindow.full(geometry)
        cells = torch.arange(28.0).reshape(4, 7)[: full.rows]
        assert torch.equal(full.take(cells), cells.expand(geometry.views, -1, -1))


def test_a_window_is_moved_and_cut_into_another():
    outer = DetectorWindow([2, 2, 2], 10, 1, 3)
    part = DetectorWindow([0, 5, 11], 3, 0, 2).within(outer)
    assert part == DetectorWindow([2, 5, 9], 3, 1, 1)
    assert outer.holds(part)
    assert DetectorWindow([0, 0, 0], 20, 0, 9).within(outer) == outer
    with pytest.raises(ValueError, match="no detector row"):
        DetectorWindow([3, 3, 3], 3, 4, 1).within(outer)


def test_a_window_of_other_rows_or_views():
    window = DetectorWindow([2, 4, 6], 5, 1, 3)
    assert window.with_rows(0, 2) == DetectorWindow([2, 4, 6], 5, 0, 2)
    assert window.select(slice(None, None, 2)) == DetectorWindow([2, 6], 5, 1, 3)
    assert window.select([2, 0]) == DetectorWindow([6, 2], 5, 1, 3)


@pytest.mark.parametrize(
    "inner",
    [
        DetectorWindow([1, 4], 3, 1, 1),
        DetectorWindow([2, 8], 3, 1, 1),
        DetectorWindow([2, 4], 3, 0, 2),
        DetectorWindow([2, 4], 3, 3, 2),
    ],
    ids=["left", "right", "below", "above"],
)
def test_cropping_refuses_what_it_does_not_hold(inner):
    outer = DetectorWindow([2, 4], 6, 1, 3)
    assert outer.holds(outer)
    assert not outer.holds(inner)
    with pytest.raises(ValueError, match="reaches beyond"):
        outer.crop(torch.zeros(2, 3, 6), inner)
