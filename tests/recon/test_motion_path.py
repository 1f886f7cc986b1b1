"""The path of an inset as a table and as a picture."""

import csv
import io

import numpy as np
import pytest

from recon.motion import InsetMotion, Jump, path_figure, path_table
from recon.motion.path import TABLE_HEADER


def _motion(**changes):
    path = np.linspace(-0.3, 0.3, 12)[:, None] * [0.5, -1.0, 1.0]
    jump = Jump(5, np.array([0.1, 0.0, -0.2]), np.full(3, 0.01))
    options = {"errors": 0.02 + 0 * path, "held": True, "jump": jump, **changes}
    return InsetMotion(
        path, evidence=30.0, rms_mm=0.2, misfit=(2.0, 1.0), steps=3, **options
    ).report()


def test_the_table_holds_path_and_errors():
    motion = _motion()
    rows = list(csv.reader(io.StringIO(path_table(motion))))
    assert tuple(rows[0]) == TABLE_HEADER
    values = np.array(rows[1:], dtype=float)
    np.testing.assert_array_equal(values[:, 0], np.arange(12))
    np.testing.assert_allclose(values[:, 1:4], motion["path_mm"], rtol=0)
    np.testing.assert_allclose(values[:, 4:], motion["errors_mm"], rtol=0)
    unknown = _motion(errors=np.full((12, 3), np.inf), held=False, jump=None)
    assert path_table(unknown).splitlines()[1].endswith(",,,")


def test_the_picture_shows_path_band_and_jump():
    figure = path_figure(_motion())
    for ax, name, axis in zip(figure.axes, "zyx", range(3), strict=True):
        path, jump = ax.lines
        np.testing.assert_allclose(path.get_ydata(), np.array(_motion()["path_mm"])[:, axis])
        assert list(jump.get_xdata()) == [4.5, 4.5]
        assert ax.get_ylabel() == f"{name}, mm"
        assert len(ax.collections) == 1
    unknown = path_figure(_motion(errors=np.full((12, 3), np.inf), held=False, jump=None))
    assert not unknown.axes[0].collections
    assert "none applied" in unknown.get_suptitle()


def test_a_report_without_a_path_is_refused():
    for make in (path_table, path_figure):
        with pytest.raises(ValueError, match="has no path"):
            make({"method": "fbp"})
