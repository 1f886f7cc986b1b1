"""Parts of the dose-factor study that need no run of it: settings, methods, pieces on disk, grids, estimates."""

from dataclasses import replace

import numpy as np
import pytest
from tiny_studies import TINY as SMALLEST

from recon.evaluate.store import Store
from recon.study.dose_factor.measures import crop_window
from recon.study.dose_factor.methods import (
    LinearFilter,
    fingerprint,
    load_methods,
)
from recon.study.dose_factor.settings import METHODS, Settings
from recon.study.dose_factor.tissue_values import tissue_groups
from recon.study.dose_factor.variant import Variant
from torchpcct import VolumeGrid

TINY = Settings(**SMALLEST["dose-factor"])


def test_pieces_of_other_settings_or_cut_off_are_made_again(tmp_path, caplog):
    store = Store(tmp_path)
    assert store.piece("a/b", "one", lambda: {"x": np.arange(3)})["x"].tolist() == [0, 1, 2]
    assert store.piece("a/b", "one", lambda: {"x": np.zeros(1)})["x"].tolist() == [0, 1, 2]
    assert store.piece("a/b", "two", lambda: {"x": np.ones(1)})["x"].tolist() == [1]
    path = store.path("a/b.npz")
    path.write_bytes(path.read_bytes()[:100])
    assert store.piece("a/b", "two", lambda: {"x": np.full(1, 7)})["x"].tolist() == [7]
    assert "computed again" in caplog.text


def test_method_registry(caplog):
    assert [m.name for m in load_methods(["tv", "linear"])] == ["tv", "linear"]
    assert fingerprint(LinearFilter()) != fingerprint(LinearFilter(mu=0.7))
    one, two = load_methods(["mbir_viewing", "mbir"])
    assert fingerprint(one) != fingerprint(two)
    with pytest.raises(ValueError, match="unknown method 'magic'"):
        load_methods(["magic"])


def test_add_back_is_linear_and_restores_contrast():
    plain, added = load_methods(["linear_z", "linear_z_added"])
    assert fingerprint(plain) != fingerprint(added)
    assert replace(added, name="linear_z", add_back=0.0) == plain


def test_ablations_are_told_apart():
    names = ["mbir", "mbir_no_cnn", "mbir_one_step", "mbir_free", "mbir_viewing", "mbir_measuring", "mbir_noise_half",
             "mbir_tissues"]  # fmt: skip
    found = load_methods(names)
    assert [m.name for m in found] == names
    prints = [fingerprint(m) for m in found]
    assert len(set(prints)) == len(names)
    assert prints == [fingerprint(m) for m in load_methods(names)]
    assert found[1].parts == {"steps": 0}
    assert found[3].parts == {"last_word": False}
    assert found[4].look < found[0].look < found[5].look


def test_methods_that_fit_tissues_get_fewer_draws_and_the_estimate_knows_it():
    s = Settings(n=200, tissue_n=104, scene_n=96, slow_n=16)
    assert [s.realizations(m) for m in ("mbir", "mbir_tissues", "tv")] == [200, 104, 16]
    assert [s.scene_realizations(m) for m in ("mbir", "mbir_tissues")] == [96, 8]
    seconds = s.estimated_seconds()
    alone = replace(s, scenes=(), vessels=(), responses=False).estimated_seconds()
    assert seconds["mbir"] > alone["mbir"]  # further scenes, and the control of its own
    assert seconds["mbir_tissues"] == alone["mbir_tissues"] == 3 * (2 * 104 + 2 * 16) * 4.0


def test_missing_weights_leave_mbir_out(monkeypatch, caplog):
    import recon.mbir.mbir

    def missing(**options):
        raise FileNotFoundError("no weights at nowhere")

    monkeypatch.setattr(recon.mbir.mbir.Mbir, "load", missing)
    assert [m.name for m in load_methods(METHODS)] == [m for m in METHODS if "mbir" not in m and m != "fbp_cnn"]
    assert "mbir is left out" in caplog.text
    with pytest.raises(ValueError, match="no method to run"):
        load_methods(["mbir"])


def test_pitch_of_the_scene():
    fine, paper = (Variant(name, TINY).scanner.geometry for name in ("pitch_0.30mm:absent", "paper"))
    assert (fine.pitch[1], paper.pitch[1]) == (0.30, 0.35)
    assert (fine.pitch[0], fine.views, fine.sod) == (paper.pitch[0], paper.views, paper.sod)
    bodies = [Variant(name, TINY).scene.bodies for name in ("pitch_0.30mm:absent", "absent_core")]
    assert [b.name for b in bodies[0]] == [b.name for b in bodies[1]]


def test_tissue_groups_and_crop():
    names = ["patient", "wall", "fibrous", "lumen", "core", "stent_0", "stent_0_blood", "fibrous_texture_3"]
    groups = tissue_groups(names)
    assert groups["lumen"] == ["lumen", "stent_0_blood"]
    assert groups["fibrous"] == ["fibrous", "fibrous_texture_3"]
    assert groups["stent"] == ["stent_0"]
    grid = VolumeGrid((30, 24, 24), 0.4, (0.0, 5.0, -5.0))
    place, crop = crop_window(grid, (0.1, 5.0, -5.3))
    for axis, part, own in zip(grid.axes, place, crop.axes, strict=True):
        np.testing.assert_allclose(axis[part], own)
    with pytest.raises(ValueError, match="leaves the inset"):
        crop_window(grid, (5.9, 5.0, -5.0))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n": 2}, "n must be at least 8"),
        ({"doses": ()}, "doses is empty"),
        ({"doses": (0.0,)}, "doses must be different exposures"),
        ({"methods": ("magic",)}, "'magic' of methods"),
        ({"scenes": ("nowhere",)}, "'nowhere' of scenes"),
        ({"kernels": ("bone",)}, "FBP soft"),
    ],
)
def test_bad_settings(changes, message):
    with pytest.raises(ValueError, match=message):
        Settings(**changes)
    with pytest.raises(TypeError, match="n must be a whole number"):
        Settings(n=7.5)
