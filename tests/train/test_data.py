"""Batches of the training: reproducible, with the right noise, signal and contrasts, and kept in
a file."""

import errno
import math
import os
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage

from recon.mbir.unrolled import first_views
from train.config import DataConfig, Situation
from train.data import ROIS, Data, InTurn, Views, painted, turn

CONFIG = DataConfig(
    shape=(16, 12, 12),
    voxel_mm=0.4,
    views=120,
    scenes_kept=24,
    situations=(Situation(42.0, 0.0), Situation(-20.0, 38.0)),
    exposure_s=(0.5, 2.0),
)
BATCH = 4


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return Data(CONFIG, 3, tmp_path_factory.mktemp("views"))


def test_lesions_are_where_the_scene_differs_from_the_healthy_one():
    """Free bodies in plain fat are all that is there; healthy vessels have no lesion."""
    plain = {"beside_probability": 0.0, "texture_probability": 0.0, "blur": (0.0, 0.0)}
    inside = ("core", "ulcer", "thrombus", "flap", "calcification", "occlusion")
    beside = ("halo", "strand", "nodule", "free")
    healthy = {f"{kind}_probability": 0.0 for kind in inside + beside}
    for seed in range(3):
        scenes = plain | {"free_probability": 1.0}
        _, truth, labels = painted(replace(CONFIG, scenes=scenes), seed)
        assert torch.equal(labels & 16 > 0, truth.abs() > 5.0)
        _, truth, labels = painted(replace(CONFIG, scenes=plain | healthy), seed)
        assert truth.abs().max() > 50.0
        assert not (labels & 16).any()


def test_pure_function_of_seed_step_and_index(data, tmp_path):
    """Also where the views come from another file."""
    whole = data.batch(5, BATCH, range(4))
    again, other = Data(CONFIG, 3, tmp_path), Data(CONFIG, 4, tmp_path)
    again._terms = other._terms = data._terms
    part = again.batch(5, BATCH, [2, 0])
    assert whole.size == 4
    assert whole.problem.b.shape == (12, *CONFIG.shape)
    for name in ("truth", "contrast", "voxels", "lots", "edges", "bodies", "lesions"):
        assert torch.equal(getattr(whole, name)[[2, 0]], getattr(part, name)), name
    assert torch.equal(whole.problem.b[[2, 0, 6, 4, 10, 8]], part.problem.b)
    assert not torch.equal(whole.truth, data.batch(4, BATCH, range(4)).truth)
    assert not torch.equal(whole.truth[2], other.batch(5, BATCH, [2]).truth[0])


def test_an_epoch_takes_every_scene_once(data):
    assert data.batches_in_epoch(BATCH) == 6
    epochs = [[data.numbers(6 * epoch + k, BATCH) for k in range(6)] for epoch in range(2)]
    for epoch in epochs:
        assert sorted(n for numbers in epoch for n in numbers) == list(range(24))
        assert all(len({n % 2 for n in numbers}) == 1 for numbers in epoch), (
            "one Gram operator in a step"
        )
    assert epochs[0] != epochs[1]
    assert data.batches_in_epoch(5) == 4


def test_late_scenes_come_after_the_others(data, tmp_path):
    late = Data(replace(CONFIG, scenes={"free_probability": 1.0}), 5, tmp_path)
    late._terms = data._terms
    both = InTurn(data, late, 5)
    for step, of, there in ((4, data, 4), (5, late, 0), (6, late, 1)):
        found, wanted = both.batch(step, BATCH, [1]), of.batch(there, BATCH, [1])
        assert torch.equal(found.truth, wanted.truth)
        assert torch.equal(found.problem.b, wanted.problem.b)


def test_two_draws_of_noise_are_independent_of_each_other_and_of_other_scenes(data):
    """What is not H u has the covariance H, whose quadratic forms are known."""
    for step in range(3):
        batch = data.batch(step, BATCH, range(4))
        p, n = batch.problem, batch.size
        noise = p.b[: 2 * n] - torch.cat([p.b[2 * n :], p.b[2 * n :]])
        assert torch.corrcoef(noise.flatten(1)).fill_diagonal_(0.0).abs().max() < 0.5
        assert torch.pdist(batch.truth.flatten(1).sort(1).values).min() > 1.0
        probe = torch.zeros(CONFIG.shape)
        probe[4:12, 3:9, 3:9] = 1.0
        expected = float((probe * p.apply(probe.expand(3 * n, -1, -1, -1))).sum((1, 2, 3))[0])
        found = (noise * probe).sum((1, 2, 3))
        assert float(found.square().mean()) == pytest.approx(expected, rel=1.6)


def test_views_are_those_of_the_method(data):
    """To the rounding of half precision; the last third is the scene itself, blurred as a scan
    is."""
    batch = data.batch(1, BATCH, range(4))
    found = first_views(batch.problem, bilateral=True)
    for kept, made in zip(batch.views, found, strict=True):
        assert kept is not None
        assert float((kept - made).abs().max()) < 0.02 * float(made.std())
    scale = batch.problem.unit_hu[8:].reshape(-1, 1, 1, 1)
    signal = batch.problem.part(range(8, 12))
    error = signal.b - signal.apply(batch.truth / scale)
    assert float(error.std()) < 0.2 * float(signal.b.std())


def test_contrasts_are_differences_of_means(data):
    """Weights of a core add up to 1, of the tissue about it to -1, or all are 0; the number of
    voxels is the smaller one's."""
    seen = 0
    for step in range(12):
        batch = data.batch(step, BATCH, range(4))
        assert batch.contrast.shape == (4, ROIS, *CONFIG.shape)
        for contrast, voxels in zip(
            batch.contrast.flatten(0, 1), batch.voxels.flatten(), strict=True
        ):
            if not float(voxels):
                assert not contrast.any()
                continue
            seen += 1
            assert float(contrast.clamp_min(0).sum()) == pytest.approx(1.0, abs=1e-4)
            assert float(contrast.clamp_max(0).sum()) == pytest.approx(-1.0, abs=1e-4)
            assert float(voxels) == min(int((contrast > 0).sum()), int((contrast < 0).sum()))
    assert seen >= 6


def test_contrasts_keep_away_from_borders_where_there_is_room(tmp_path):
    """Of a whole core: what lies one voxel deep in it, all of it where less than eight would be
    left."""
    fine = replace(CONFIG, voxel_mm=0.2, shape=(24, 20, 20), scenes={"core_size": (0.5, 2.0)})
    plain = Data(fine, 3, tmp_path)
    inner = Data(replace(fine, roi_margin=1), 3, tmp_path)
    assert inner.views.folder == plain.views.folder
    kinds = set()
    for step in range(6):
        of = [d.batch(step, BATCH, range(4)).contrast[:, -1] for d in (plain, inner)]
        for core, kept in zip(*((v > 0).numpy() for v in of), strict=True):
            within = ndimage.binary_erosion(core, np.ones((3, 3, 3)), border_value=1)
            room = within.sum() >= 8
            kinds.add((bool(core.any()), bool(room)))
            assert np.array_equal(kept, within if room else core)
    assert {(True, True), (True, False)} <= kinds


def test_exposures_lie_in_their_range(data):
    scales = torch.cat([data.batch(step, BATCH, range(4)).problem.unit_hu for step in range(3)])
    ratio = float(scales.max() / scales.min())
    assert 1.1 < ratio < 1.3 * math.sqrt(4.0)  # two situations: their information differs


@pytest.mark.parametrize("number", range(16))
def test_every_orientation_has_its_inverse(number):
    v = torch.arange(2 * 3 * 4 * 4.0).reshape(2, 3, 4, 4)
    there, back = turn(number, square=True)
    assert torch.equal(back(there(v)), v)
    assert torch.equal(there(v), v) == (number == 0)
    oblong = torch.arange(24.0).reshape(1, 2, 3, 4)
    there, back = turn(number, square=False)
    assert there(oblong).shape == oblong.shape
    assert torch.equal(back(there(oblong)), oblong)


@pytest.mark.extended
def test_views_are_computed_once(data, tmp_path, monkeypatch):
    """By processes beforehand as when they are used; a later run reads them, also one that
    shares the folder."""
    few = replace(CONFIG, scenes_kept=2, situations=CONFIG.situations[:1])
    ahead = Data(few, 3, tmp_path)
    ahead.prepare(1)
    used = Data(few, 3, tmp_path / "other")
    used._terms = data._terms
    with monkeypatch.context() as patch:
        patch.setattr(Data, "_seen", lambda *a: pytest.fail("computed again"))
        again = Data(few, 3, tmp_path)
        for number in range(2):
            assert number in again.views
            again.sample(number)
    for number in range(2):
        one, other = ahead.sample(number), used.sample(number)
        assert torch.equal(one.truth, other.truth)
        assert torch.equal(one.labels, other.labels)
        torch.testing.assert_close(one.views, other.views, rtol=2e-3, atol=2e-3)
        assert one.exposure == other.exposure


@pytest.mark.extended
def test_a_gpu_computes_the_views_that_the_cpu_would(data, tmp_path, monkeypatch):
    """Processes paint, the device that trains computes, and holds the scenes while there is
    room."""
    few = replace(CONFIG, scenes_kept=3, situations=CONFIG.situations[:1])
    free = [90, 90, 10]
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (free.pop(0), 100))
    ahead = Data(few, 3, tmp_path)
    ahead._accelerated, ahead._terms = True, data._terms
    ahead.prepare(1)
    assert sorted(ahead._on_device) == [0, 1]
    plain = Data(few, 3, tmp_path / "other")
    plain._terms = data._terms
    for number in range(2):
        one, other = ahead.sample(number), plain.sample(number)
        assert one is ahead._on_device[number]
        for name in ("views", "truth", "labels", "exposure"):
            assert torch.equal(*(torch.as_tensor(getattr(v, name)) for v in (one, other)))
    free.append(10)
    assert torch.equal(ahead.sample(2).views, plain.sample(2).views)
    assert 2 not in ahead._on_device


def test_folders_of_other_data_are_not_mixed_up(tmp_path):
    folders = {
        Views(tmp_path, c, seed).folder
        for c, seed in ((CONFIG, 1), (CONFIG, 2), (replace(CONFIG, views=60), 1))
    }
    assert len(folders) == 3
    path = Views(tmp_path, CONFIG, 1).folder / "truth.npy"
    np.save(path, np.zeros((3, 3), np.float16))
    with pytest.raises(ValueError, match="damaged"):
        Views(tmp_path, CONFIG, 1)


def test_a_disk_that_is_too_small_is_noticed_at_the_start(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match=r"no room for .* GB of views .*--views"):
        Views(tmp_path, CONFIG, 1)
    assert not [p for p in tmp_path.rglob("*") if p.is_file()]
