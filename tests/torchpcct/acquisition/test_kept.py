"""Another realisation of a scan costs its noise alone: in one process, and from file to file."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchpcct.acquisition import acquire as module
from torchpcct.acquisition import kept
from torchpcct.acquisition.acquire import acquire, readings_key
from torchpcct.acquisition.kept import ReadingsFolder, fingerprint, forget_readings
from torchpcct.scanner import presets
from torchpcct.scene import Body, Ellipsoid, EllipticCylinder, Scene, SinusoidalMotion

BALL = Body("ball", Ellipsoid(3.0, position=(20.0, 0.0, 0.0)), "cortical_bone", "water")
SCENE = Scene([Body("water", EllipticCylinder(60.0), "water"), BALL])
SYSTEM = presets.pcct(views=70, rows=2)
OPTIONS = {"duty": 0.02, "sub_rays": 1}


@pytest.fixture
def computed(monkeypatch):
    """How often expected readings were computed; the memory is empty before and after."""
    calls = []

    def expected(*given):
        calls.append(1)
        return original(*given)

    original = module.expected_readings
    forget_readings()
    monkeypatch.setattr(module, "expected_readings", expected)
    yield calls
    forget_readings()


def test_another_seed_or_exposure_computes_nothing_but_noise(computed):
    first = acquire(SCENE, SYSTEM, exposure_s=1.0, seed=0, **OPTIONS)
    assert computed
    computed.clear()
    again = Scene(SCENE.bodies)  # the content counts, not the object
    second = acquire(again, SYSTEM, exposure_s=2.0, seed=1, **OPTIONS)
    assert not computed
    forget_readings()
    fresh = acquire(SCENE, SYSTEM, exposure_s=2.0, seed=1, **OPTIONS)
    assert computed
    assert torch.equal(second.counts, fresh.counts)
    assert not torch.equal(second.counts, first.counts)


def test_whatever_changes_a_reading_is_another_one():
    moving = Scene(SCENE.bodies, SinusoidalMotion("ball", 1.0))
    other = Scene([SCENE.bodies[0], replace(BALL, material="water")])
    g = SYSTEM.geometry
    keys = [
        readings_key(SCENE, SYSTEM, rotation_s=1.0),
        readings_key(SCENE, SYSTEM, rotation_s=1.0, tolerance_hu=0.1),
        readings_key(other, SYSTEM, rotation_s=1.0),
        readings_key(SCENE, SYSTEM.replace(geometry=replace(g, sod=g.sod + 1e-9)), rotation_s=1.0),
        readings_key(moving, SYSTEM, rotation_s=1.0),
        readings_key(moving, SYSTEM, rotation_s=2.0),
    ]
    assert len(set(keys)) == len(keys)
    assert readings_key(SCENE, SYSTEM, rotation_s=2.0) == keys[0]  # nothing moves
    assert fingerprint(lambda: 0) is None


def test_the_oldest_are_released(computed, monkeypatch):
    acquire(SCENE, SYSTEM, **OPTIONS)
    (size,) = [k.bytes for k in kept._held.values()]
    for module_ in (kept, module):
        monkeypatch.setattr(module_, "MOST_BYTES", int(2.5 * size))
    for radius in (2.0, 2.5):
        small = replace(BALL, shape=replace(BALL.shape, semi_axes=radius))
        acquire(Scene([SCENE.bodies[0], small]), SYSTEM, **OPTIONS)
    assert len(kept._held) == 2
    computed.clear()
    acquire(SCENE, SYSTEM, **OPTIONS)
    assert computed  # the first went
    for module_ in (kept, module):
        monkeypatch.setattr(module_, "MOST_BYTES", size // 2)
    forget_readings()
    acquire(SCENE, SYSTEM, **OPTIONS)
    assert sum(k.bytes for k in kept._held.values()) <= size // 2  # a part of it
    computed.clear()
    acquire(SCENE, SYSTEM, **OPTIONS)
    assert computed


def test_files_are_kept_read_and_bounded(tmp_path):
    def of(value):
        return lambda: torch.full((100,), value)

    def fails():
        raise AssertionError

    keep = ReadingsFolder("a", tmp_path, most_bytes=1500)
    assert torch.equal(keep("views", of(1.0)), of(1.0)())
    assert torch.equal(keep("views", fails), of(1.0)())
    (tmp_path / "a" / "views.npy").write_bytes(b"\x93NUMPY cut off")
    assert torch.equal(keep("views", of(2.0)), of(2.0)())
    np.testing.assert_array_equal(np.load(tmp_path / "a" / "views.npy"), 2.0)
    for key in "bcd":
        ReadingsFolder(key, tmp_path, most_bytes=1500)("views", of(3.0))
    assert len(list(tmp_path.iterdir())) == 2
    assert (tmp_path / "d").exists()
    closed = tmp_path / "closed"
    closed.write_text("a file")
    assert torch.equal(ReadingsFolder("a", closed)("views", of(1.0)), of(1.0)())
    assert torch.equal(ReadingsFolder(None, tmp_path)("views", of(1.0)), of(1.0)())
