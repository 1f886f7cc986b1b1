"""The process that compiles the kernels and one that reads them from the cache give the same bits."""

import os
import subprocess
import sys

SCRIPT = """
import hashlib
import torch
from torchpcct import FanBeam, Projector, VolumeGrid, full_turn

A = Projector(FanBeam(full_turn(50), 400.0, 700.0, 64, 2.0), VolumeGrid((40, 40), 1.0))
x = torch.rand(A.domain_shape, generator=torch.Generator().manual_seed(0))
y = A(x)
print([hashlib.sha256(v.numpy().tobytes()).hexdigest() for v in (y, A.T(y))])
"""


def test_a_fresh_process_and_later_ones(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    found = [
        subprocess.run(
            [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, timeout=300, check=True
        )
        for _ in range(2)
    ]
    assert "compiling kernels" in found[0].stderr
    assert "compiling kernels" not in found[1].stderr
    assert found[0].stdout == found[1].stdout
