"""FBP as a layer."""

import math

import numpy as np
import torch

from recon.analytic.fbp import fbp
from recon.analytic.layer import Fbp
from torchpcct import ParallelBeam, VolumeGrid

GEOMETRY, GRID = ParallelBeam(np.arange(8) * math.pi / 8, 15, 1.9), VolumeGrid((9, 9), 2.0)


def test_layer_is_the_function_with_batch_and_channels():
    y = torch.randn(2, 3, 8, 15, generator=torch.Generator().manual_seed(0))
    layer = Fbp(GEOMETRY, GRID, "soft")
    assert torch.equal(layer(y), fbp(y, GEOMETRY, GRID, "soft"))
    assert not list(layer.parameters())
    narrow = y.bfloat16().requires_grad_()
    out = layer(narrow)
    assert out.dtype == torch.float32
    assert torch.equal(out.detach(), fbp(y.bfloat16().float(), GEOMETRY, GRID, "soft"))
    out.sum().backward()
    assert narrow.grad.dtype == torch.bfloat16
