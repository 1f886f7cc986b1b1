"""Detector windows: union, margins, cropping."""

import numpy as np
import torch

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
    outer, inner = DetectorWindow(np.array([2, 4]), 6, 1, 3), DetectorWindow(np.array([4, 5]), 3, 2, 1)
    cells = torch.arange(5 * 12.0).reshape(5, 12)
    assert torch.equal(outer.crop(outer.take(cells), inner), inner.take(cells))
