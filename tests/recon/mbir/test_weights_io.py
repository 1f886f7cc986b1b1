"""Files of tensors that know their own checksum."""

import re

import pytest
import torch

from recon.mbir.mbir import SHIPPED, WEIGHTS_FORMAT, Mbir, resources
from recon.mbir.weights_io import TensorFileError, read_tensors, write_tensors


def test_tensors_of_every_kind_round_trip(tmp_path):
    base = torch.randn(4, 3)
    tensors = {
        "shared": base,
        "transposed": base.T,
        "scalar": torch.tensor(2.5),
        "int": torch.arange(3),
        "empty": torch.zeros(0, 2),
        "half": base.to(torch.bfloat16),
        "flag": torch.tensor([True, False]),
    }
    write_tensors(tmp_path / "t", "kind", tensors, {"x": 0.1, "µ": [1, None]})
    found, metadata = read_tensors(tmp_path / "t", "kind")
    assert metadata == {"x": 0.1, "µ": [1, None]}
    for name, value in tensors.items():
        assert found[name].dtype == value.dtype
        assert torch.equal(found[name], value)
    with pytest.raises(TensorFileError, match="not a 'other'"):
        read_tensors(tmp_path / "t", "other")
    with pytest.raises(TensorFileError, match="does not exist"):
        read_tensors(tmp_path / "none", "kind")


@pytest.fixture(scope="module")
def shipped():
    return resources.files("recon") / "mbir" / "weights" / SHIPPED


@pytest.mark.parametrize("bit", [1, 64])
def test_one_changed_byte_anywhere_is_found(shipped, tmp_path, bit):
    """Every byte of the header, and some of the values."""
    tensors, metadata = read_tensors(shipped, WEIGHTS_FORMAT)
    path = tmp_path / "weights.safetensors"
    some = {k: v for k, v in tensors.items() if v.numel() < 10}
    write_tensors(path, WEIGHTS_FORMAT, some, metadata)
    good = path.read_bytes()
    for at in range(len(good)):
        path.write_bytes(good[:at] + bytes([good[at] ^ bit]) + good[at + 1 :])
        with pytest.raises(TensorFileError, match=re.escape(str(path))):
            read_tensors(path, WEIGHTS_FORMAT)


def test_damaged_weights_are_refused_with_the_remedy(shipped, tmp_path):
    good, path = shipped.read_bytes(), tmp_path / "weights.safetensors"
    for bad in (good[:-1] + bytes([good[-1] ^ 1]), good[:-1]):
        path.write_bytes(bad)
        with pytest.raises(
            ValueError, match=rf"{re.escape(str(path))} .*another copy.*new installation"
        ):
            Mbir.load(path)
