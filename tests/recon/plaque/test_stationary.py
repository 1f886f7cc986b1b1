"""A volume with a noise model in place of a scan."""

import drawn_vessel
import numpy as np
import pytest
import torch
from drawn_vessel import VALUES

from recon.plaque import TissueData, read_plaque
from recon.plaque.local_gram import LocalGram
from recon.plaque.stationary import StationaryGram
from torchpcct import VolumeGrid

GRID = VolumeGrid((26, 24, 24), 0.3, (1.0, -30.0, 10.0))
VOXEL = 0.3**3


def coloured(f, g):
    return 30.0 * (0.2 + f + 0.1 * g)


def test_white_noise_weighs_every_voxel_alone():
    v = torch.randn(GRID.shape, generator=torch.Generator().manual_seed(0)) * 20 + 7
    data = TissueData.of_volume(v, GRID, lambda f, g: 400.0 * VOXEL)
    assert torch.allclose(data.b, v / 400, atol=1e-5)
    assert torch.allclose(data.apply(v), v / 400, atol=1e-5)


def test_statistic_has_the_covariance_of_the_operator():
    """b of noise of the power S has the covariance T² / S: that of (T / S) n."""
    gram = StationaryGram(GRID, coloured, lambda f, g: np.exp(-(f**2)))
    f = [np.fft.fftfreq(n, 0.3) for n in gram.padded]
    power = coloured(np.hypot(f[1][:, None], f[2]), np.abs(f[0])[:, None, None])
    rng = np.random.default_rng(0)
    probe = torch.zeros(GRID.shape)
    probe[10:16, 9:15, 8:16] = 1.0
    found = []
    for _ in range(200):
        white = np.fft.fftn(rng.standard_normal(gram.padded))
        noise = np.fft.ifftn(white * np.sqrt(power / VOXEL)).real[:26, :24, :24]
        found.append(float((gram.statistic(torch.from_numpy(noise).float()) * probe).sum()))
    assert np.var(found) == pytest.approx(float((probe * gram.apply(probe)).sum()), rel=0.35)


def test_blocks_are_the_operator():
    gram = StationaryGram(GRID, coloured)
    rng = np.random.default_rng(0)
    index = np.argwhere(rng.random(GRID.shape) < 0.1)
    x = rng.standard_normal((len(index), 1)).astype(np.float32)
    volume = torch.zeros(GRID.shape)
    volume[tuple(index.T)] = torch.from_numpy(x[:, 0])
    exact = gram.apply(volume)[tuple(index.T)].numpy()
    assert np.abs(LocalGram.of(gram, index, 1.0).apply(x)[:, 0] - exact).max() < 1e-5 * np.abs(exact).max()


def test_reading_of_a_volume():
    noise = 20 * torch.randn(GRID.shape, generator=torch.Generator().manual_seed(0))
    volume = drawn_vessel.image(GRID, 100.0) + noise
    reading = read_plaque(TissueData.of_volume(volume, GRID, lambda f, g: 400.0 * VOXEL), particles=100)
    assert reading.presence > 0.95
    for name, truth in (("lumen", VALUES["lumen"]), ("fat", VALUES["fat"]), ("contrast", 100.0)):
        assert abs(reading.figures[name].value - truth) < 3.5 * reading.figures[name].sd
    assert "volume" in reading.info["source"]


def test_refusals():
    with pytest.raises(ValueError, match="its grid"):
        TissueData.of_volume(torch.zeros(2, 2, 2), GRID, coloured)
    with pytest.raises(ValueError, match="noise_power must be finite"):
        StationaryGram(GRID, lambda f, g: np.nan)
