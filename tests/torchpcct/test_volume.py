"""Volume files: round trips, and what is refused."""

import nibabel
import numpy as np
import pytest
import torch

from torchpcct.files import atomic_write
from torchpcct.geometry import VolumeGrid
from torchpcct.volume import Volume

GRID = VolumeGrid((8, 45, 46), 0.2, (0.1, -30.38, -29.63))


def test_files_round_trip(tmp_path):
    data = torch.randn(GRID.shape, generator=torch.Generator().manual_seed(1))
    volume = Volume(data, GRID, {"method": "fbp", "kernel": "soft"})
    volume.save(tmp_path / "v.h5")
    back = Volume.load(tmp_path / "v.h5")
    assert torch.equal(back.data, data)
    assert back.grid == GRID
    assert back.report == volume.report
    volume.save(tmp_path / "v.nii.gz")
    image = nibabel.load(tmp_path / "v.nii.gz")
    corner = image.affine @ [3, 2, 1, 1]
    np.testing.assert_allclose(corner[:3], [GRID.axes[2][3], GRID.axes[1][2], GRID.axes[0][1]], rtol=1e-6)
    np.testing.assert_array_equal(np.asarray(image.dataobj)[3, 2, 1], data[1, 2, 3])


def test_no_half_written_file(tmp_path):
    def interrupted():
        with atomic_write(tmp_path / "v.h5") as part:
            part.write_bytes(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_foreign_and_truncated_files(tmp_path):
    volume = Volume(torch.zeros(GRID.shape), GRID)
    volume.save(tmp_path / "v.h5")
    content = (tmp_path / "v.h5").read_bytes()
    (tmp_path / "cut.h5").write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match="truncated"):
        Volume.load(tmp_path / "cut.h5")
    with pytest.raises(ValueError, match="unknown volume format"):
        volume.save(tmp_path / "v.png")
