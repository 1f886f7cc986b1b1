"""Anatomies that break assumptions: each feature is there, in the tissue it belongs to, and the
base is not changed."""

import math
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy import ndimage

from recon.evaluate.anatomies import ANATOMIES, TISSUES_HU, anatomy
from recon.evaluate.names import TASKS
from recon.evaluate.task import GroundTruth
from recon.evaluate.tasks import AnatomyTask, read_task
from recon.jobs.store import Store
from torchpcct import Projector, VolumeGrid
from torchpcct.scene.raster import label_fractions
from torchpcct.scene.scene import voxel_centres

COARSE = VolumeGrid((29, 23, 23), 0.4)
POINTS = voxel_centres(COARSE)
FEW = """
anatomy: calcification
scene:
  kind: bodies
  bodies:
    - {name: patient, shape: cylinder, semi_axes: 60, material: pericoronary_fat}
signal: feature
background: lumen
scanner: {preset: pcct, views: 24, rows: 8, energy_bin_kev: 4}
tolerance_hu: 1000
inset: {size: [2.4, 5.6, 5.6], center: {z: 0.4, y: -8, x: -8}}
exposures_s: 2
"""


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    """A broken anatomy on few views and slices; its middle is that of the vessel but for 0.4 mm."""
    path = tmp_path_factory.mktemp("anatomy") / "few.yaml"
    path.write_text(FEW, encoding="utf-8")
    return read_task(path)


@pytest.mark.parametrize("name", ANATOMIES)
def test_the_feature_is_all_that_differs(name):
    what = ANATOMIES[name]
    names = list(what.values)
    with_, without = what.labels(POINTS)
    changed = {names[k] for k in np.unique(with_[with_ != without])}

    def differs(points):
        return np.not_equal(*what.labels(points)).astype(int)

    assert label_fractions(differs, 2, COARSE)[1].sum() * 0.4**3 > 0.05, (
        "a feature of 0.05 mm³ or more"
    )
    assert changed <= {part.tissue for part in what.feature}
    # The inset holds it: nothing differs at its rim along x and y.
    different = with_ != without
    assert not different[:, [0, -1]].any()
    assert not different[:, :, [0, -1]].any()


def test_features_have_the_sizes_they_are_said_to_have():
    def volume_mm3(name, tissue):
        shares = anatomy(name).volume_fractions(VolumeGrid((12, 12, 12), 0.4))
        return (
            sum(
                float(own.sum())
                for (after, before), own in shares.items()
                if after == tissue != before
            )
            * 0.4**3
        )

    # A ball of 0.5 mm that lies across the wall's two faces, one of 1.1 mm that the lumen's wall
    # cuts.
    assert 0.3 < volume_mm3("calcification", "calcium") / (math.pi / 6 * 0.5**3) < 1.0
    assert 0.7 < volume_mm3("thrombus", "thrombus") / (math.pi / 6 * 1.1**3) < 1.0
    a, b, c = ANATOMIES["core"].feature[0].inside.__closure__[0].cell_contents.semi_axes
    assert volume_mm3("core", "core") == pytest.approx(4 / 3 * math.pi * a * b * c, rel=2e-3)


def test_shares_are_those_of_the_labels_and_painting_is_their_mean():
    what, grid = anatomy("branch"), VolumeGrid((4, 20, 20), 0.4)
    shares = what.volume_fractions(grid)
    np.testing.assert_allclose(np.sum(list(shares.values()), axis=0), 1.0, atol=1e-12)
    assert {pair for pair in shares if pair[0] != pair[1]} == {
        ("wall", "fat"),
        ("lumen", "fat"),
        ("lumen", "wall"),
        ("lumen", "fibrous"),
    }
    names, (with_, without) = list(what.values), what.labels(voxel_centres(grid))
    for pair, share in shares.items():
        # A voxel that a tissue fills has it in its middle.
        full = share > 1.0 - 1e-9
        assert (with_[full] == names.index(pair[0])).all()
        assert (without[full] == names.index(pair[1])).all()
    painted = what.painted(grid, {"lumen": 10.0, "wall": 2.0}, feature=False)
    lumen, wall = (
        sum(own for (_, before), own in shares.items() if before == t) for t in ("lumen", "wall")
    )
    np.testing.assert_allclose(painted, 10.0 * lumen + 2.0 * wall)
    with pytest.raises(ValueError, match="ulcer"):
        anatomy("ulcre")


def test_what_the_task_of_an_anatomy_reads_is_its_truth(few):
    values = {**TISSUES_HU, "patient": -92.0, "signal": TISSUES_HU["calcium"]}
    ground_truth = GroundTruth(
        tuple(few.volume_fractions), tuple(values[t] for t in few.volume_fractions), 1.0
    )
    assert ground_truth.tissues[:2] == ("signal", "lumen")
    np.testing.assert_allclose(np.sum(list(few.volume_fractions.values()), axis=0), 1.0, atol=1e-12)
    present, absent = (t.double().numpy() for t in few.truth(ground_truth))
    change = present - absent
    # What changes is the feature, in proportion to its share: calcium for wall or for fibrous
    # tissue.
    signal = few.volume_fractions["signal"]
    np.testing.assert_array_equal(change == 0.0, signal == 0.0)
    steps = [TISSUES_HU["calcium"] - TISSUES_HU[t] for t in ("fibrous", "wall")]
    at = signal > 0
    assert (change[at] > (steps[0] - 0.1) * signal[at] - 1e-3).all()
    assert (change[at] < (steps[1] + 0.1) * signal[at] + 1e-3).all()
    weights, around = few.regions["lesion"]
    np.testing.assert_array_equal(weights.numpy() > 0, change > 0.5 * change.max())
    # The background is read where the truths agree.
    assert np.abs(change[around.numpy() > 0]).max() == 0.0
    assert (few.volume_fractions["lumen"][around.numpy() > 0] > 0.99).all()


@pytest.mark.extended
def test_the_scan_of_an_anatomy_holds_what_is_painted(few, tmp_path):
    """By the projection of the true volume, whose voxels are twice as large as those that were
    projected."""
    store = Store(tmp_path)
    ground_truth = few.ground_truth(store)
    assert dict(zip(ground_truth.tissues, ground_truth.values_hu, strict=True))[
        "signal"
    ] == pytest.approx(TISSUES_HU["calcium"])
    assert ground_truth.bound_hu > 0
    present, absent = few.scans(store)
    change = present.line_integrals() - absent.line_integrals()
    truth = few.truth(ground_truth)
    mu = (truth[0] - truth[1]) * (present.linearisation.mu_ref / 1000.0)
    expected = Projector(present.geometry, few.grid, present.window)(mu)
    assert float(change.sum() / expected.sum()) == pytest.approx(1.0, abs=0.02)
    assert float((change - expected).norm() / expected.norm()) < 0.25


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"anatomy": "ulcre"}, "did you mean 'ulcer'"),
        ({"signal": "calcium"}, "the signal is 'feature'"),
        ({"background": "core"}, "one of wall, fibrous, lumen, patient"),
        ({"background": ""}, "name the background"),
        ({"vessel": "tilted"}, "different kinds of task"),
        ({"inset": {"size": [2, 6, 6]}}, "needs center"),
        (
            {
                "scene": {
                    "kind": "bodies",
                    "bodies": [
                        {"name": "wall", "shape": "cylinder", "semi_axes": 60, "material": "water"}
                    ],
                }
            },
            "wall is a tissue and a body",
        ),
    ],
)
def test_anatomies_that_make_no_task(change, said, tmp_path):
    path = tmp_path / "other.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(FEW), **change}), encoding="utf-8")
    with pytest.raises(ValueError, match=said):
        read_task(path)


def test_broken_anatomies_are_ready_tasks():
    kinds = {task.anatomy for task in map(read_task, TASKS) if isinstance(task, AnatomyTask)}
    assert kinds >= {
        "ulcer",
        "thrombus",
        "flap",
        "calcification",
        "stent",
        "inflamed_30",
        "branch",
        "healthy",
    }


def test_the_muscle_that_a_vessel_lies_on_is_no_body():
    """So figures of the vessel are those of the same vessel in fat."""
    whole = read_task("plaque_on_muscle")
    beside = replace(
        whole, grid=VolumeGrid((12, *whole.grid.shape[1:]), whole.grid.spacing, whole.grid.center)
    )
    muscle = beside.volume_fractions["muscle"]
    assert (muscle[:, :, :8] == 1.0).all()
    assert not beside.near[:, :, :8].any()
    deep = ndimage.distance_transform_edt(muscle > 0.5, sampling=beside.grid.spacing) > 0.8
    assert not (beside.near.numpy() & deep).any()
    # What is invented within the muscle counts as in fat.
    assert (beside.quiet.numpy() & (muscle == 1.0)).any()
