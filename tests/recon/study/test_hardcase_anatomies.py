"""Disease among the hard cases: what is recovered of it, and what a method has to say of it."""

import pytest
import torch

from recon.evaluate.anatomies import ANATOMIES
from recon.study.hardcases.anatomies import METHODS, _painted, anatomy_verdict
from recon.study.hardcases.measure import HardcasesSettings
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.recovery import recovered_contrast

CENTER = (1.0, -30.0, 20.0)


def test_verdicts_of_disease():
    assert anatomy_verdict(0.60, 0.63, []) == "right"  # 0.95 of what soft FBP shows
    assert anatomy_verdict(0.50, 0.63, []) == "SILENT"
    assert anatomy_verdict(0.50, 0.63, ["a vessel model was used"]) == "warned"
    assert anatomy_verdict(None, 0.63, ["refused"]) == "warned"
    assert anatomy_verdict(1.2, 0.63, []) == "right"


def test_recovery_is_the_share_of_the_contrast_where_the_feature_is():
    truth = torch.zeros(4, 6, 6)
    truth[1:3, 2:4, 2:4] = -90.0
    truth[0, 0, 0] = -40.0  # a voxel that it hardly changes
    assert recovered_contrast(truth, truth) == pytest.approx(1.0)
    assert recovered_contrast(0.4 * truth + (truth == 0), truth) == pytest.approx(0.4)
    assert recovered_contrast(torch.zeros_like(truth), truth) == 0.0
    assert recovered_contrast(-truth, truth) == pytest.approx(-1.0)


def test_the_feature_lies_in_the_middle_of_the_inset():
    grid = VolumeGrid((16, 23, 23), 0.4, CENTER)
    with_it, without = (
        _painted(ANATOMIES["thrombus"], grid, grid, feature=feature) for feature in (True, False)
    )
    # Above fat: the lumen 550 HU, thrombus in its place 155 HU; nothing beside the vessel.
    assert with_it.max() == pytest.approx(550.0)
    assert (with_it - without).min() == pytest.approx(65.0 - 460.0, abs=1.0)
    assert with_it[:, 0].max() == without[:, :, -1].max() == 0.0
    z, y, x = (int(k) for k in divmodded((without - with_it).argmax(), grid.shape))
    at = [axis[k] - c for axis, k, c in zip(grid.axes, (z, y, x), CENTER, strict=True)]
    assert abs(at[0] + 0.2) < 0.6
    assert 0.5 < (at[1] ** 2 + at[2] ** 2) ** 0.5 < 1.7


def divmodded(flat, shape):
    plane, x = divmod(int(flat), shape[2])
    return (*divmod(plane, shape[1]), x)


def test_settings_of_disease():
    assert set(HardcasesSettings().anatomy_methods) == set(METHODS)
    for wrong in ({"anatomies": ("unicorn",)}, {"anatomy_methods": ("fbp",)}, {"draws": -1}):
        with pytest.raises(ValueError, match=r"unicorn|fbp|draws"):
            HardcasesSettings(**wrong)


@pytest.mark.extended
def test_disease_stands_in_the_report(tiny_disease):
    rows = tiny_disease.measured.data["anatomies"]
    assert [(r["anatomy"], r["method"], r["draws"]) for r in rows] == [
        ("ulcer", "pwls", 0),
        ("ulcer", "pwls", 1),
    ]
    for row in rows:
        assert 0.3 < row["soft"] < 1.1
        assert row["verdict"] == anatomy_verdict(row["recovered"], row["soft"], row["messages"])
    assert "an ulcer" in tiny_disease.report.text or "a crater" in tiny_disease.report.text


@pytest.fixture(scope="module")
def tiny_disease(tmp_path_factory):
    from tiny_studies import run_tiny

    return run_tiny("hardcases", tmp_path_factory.mktemp("disease"))
