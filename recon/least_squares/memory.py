"""What a reconstruction will need, before it allocates anything."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from recon.gram.impulse_response import slice_reach
from torchpcct.devices import available_bytes
from torchpcct.geometry import Geometry, VolumeGrid
from torchpcct.validate import whole

if TYPE_CHECKING:
    from torchpcct.projector import Projector


VOLUMES = 26
"""Arrays of one volume's size that live at once: right-hand side, volume, gradients, two steps with
their images, the prior's and the transform's temporaries, those of the iterations on the model of a
whole field."""
MODEL = 12
"""Arrays of one volume's size that the model of a whole field holds, whatever the batch: weights
and spectra of its sectors, and what it was made of."""
COARSE = 1
"""Arrays of the data's size, at most, that it holds in a volume: weights of the coarser scan."""
SINOGRAMS = 3
"""Arrays of the data's size besides the arguments: weighted data, projection, their product."""


def resident_bytes() -> int:
    """Memory that this process holds now; 0 where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):
        return 0


def pwls_bytes(A: Projector, batch: int, dtype: torch.dtype, device: torch.device) -> int:
    """Largest memory that :func:`recon.least_squares.pwls.pwls` needs besides its arguments.

    Args:
        A: the exact operator; one without ``memory_estimate`` counts as if it needed nothing
            itself.
        batch: volumes at a time.
        dtype: of the data.
        device: where the data lie.
    """
    volume, data = torch.Size(A.domain_shape).numel(), torch.Size(A.range_shape).numel()
    item = dtype.itemsize * max(batch, 1)
    estimate = getattr(A, "memory_estimate", None)
    inside = (
        estimate(max(batch, 1), dtype, device) - item * (volume + data)
        if estimate is not None
        else 0
    )
    model = dtype.itemsize * (MODEL * volume + COARSE * data)
    return int(inside + model + item * (VOLUMES * volume + SINOGRAMS * data))


def require_memory(A: Projector, batch: int, like: Tensor, memory: int | None) -> None:
    """Refuse a reconstruction that does not fit into ``memory`` bytes.

    Args:
        A: the exact operator.
        batch: volumes at a time.
        like: of the dtype and on the device of the data.
        memory: None: what is available.

    Raises:
        ValueError: too little; the message names both figures and what to change.
    """
    if memory is not None:
        whole("memory", memory)
    need = pwls_bytes(A, batch, like.dtype, like.device)
    free = available_bytes(like.device) if memory is None else memory
    if need > free:
        where = "" if like.device.type == "cpu" else f" on {like.device}"
        raise ValueError(
            f"PWLS of {batch} volume(s) {tuple(A.domain_shape)} from data {tuple(A.range_shape)} "
            f"needs {need / 2**30:.2f} GiB, {free / 2**30:.2f} GiB are available{where}: take "
            "larger or fewer voxels, float32, fewer volumes at a time, or bin the readings"
        )


def gram_bytes(geometry: Geometry, grid: VolumeGrid, itemsize: int, nodes: int = 9) -> int:
    """Bytes of the impulse responses that :class:`recon.gram.gram.Gram` is fitted to."""
    slices = grid.shape[0] if grid.ndim == 3 else 1
    bands = 2 * slice_reach(geometry, grid) + 1
    return nodes * bands * slices * (2 * grid.shape[-2] - 1) * (2 * grid.shape[-1] - 1) * itemsize
