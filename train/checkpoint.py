"""Checkpoints of a run, such that a crash at any moment leaves a whole one: the newest, and the
one before it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from recon.mbir.weights_io import TensorFileError, read_tensors, write_tensors
from torchpcct.files import LEFTOVER

if TYPE_CHECKING:
    from torchpcct.typing import JsonObject

CHECKPOINT_FORMAT = "torchpcct training checkpoint 3"
"""What a checkpoint says of itself."""
UNFINISHED = "checkpoint.next.safetensors"
"""Name of a checkpoint that is being written."""


class CheckpointStore:
    """The checkpoint of a run and the one before it.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.current = folder / "checkpoint.safetensors"
        self.previous = folder / "checkpoint.previous.safetensors"

    def save(self, tensors: Mapping[str, Tensor], metadata: Mapping[str, object]) -> None:
        """Write the checkpoint; the one in place becomes the previous one."""
        fresh = self.current.with_name(UNFINISHED)
        write_tensors(fresh, CHECKPOINT_FORMAT, tensors, metadata)
        # Killed between the two renames, the run goes on from the previous checkpoint, which is
        # then the newest one that had been completed. Renames that a power cut undoes lose a
        # checkpoint, but never both.
        if self.current.exists():
            os.replace(self.current, self.previous)
        os.replace(fresh, self.current)

    def load(self) -> tuple[dict[str, Tensor], JsonObject, str | None]:
        """Tensors and metadata of the newest whole checkpoint, and a warning if that is not the
        current one.

        Raises:
            TensorFileError: there is none; the message says why for each file.
        """
        try:
            return (*read_tensors(self.current, CHECKPOINT_FORMAT), None)
        except TensorFileError as error:
            first = error
        try:
            tensors, metadata = read_tensors(self.previous, CHECKPOINT_FORMAT)
        except TensorFileError as second:
            raise TensorFileError(f"no checkpoint to resume from: {first}; {second}") from second
        return (
            tensors,
            metadata,
            f"{first}; continuing from the previous checkpoint {self.previous.name}",
        )

    def clean(self) -> None:
        """Remove temporary files that a killed process left behind."""
        for path in self.current.parent.iterdir():
            if LEFTOVER.match(path.name) or path.name == UNFINISHED:
                path.unlink(missing_ok=True)


@torch.no_grad()
def start_from(model: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    """Put the weights of another run into a model, whose network may have more channels.

    A wider network computes at first what the narrower one did (Chen, Goodfellow, Shlens 2016,
    ICLR: Net2Net): its additional channels keep their random inputs, and what they give counts
    nothing in the channels that were there.

    Raises:
        ValueError: the weights are of another kind of network, or of a wider one.
    """
    state = model.state_dict()
    for name, value in state.items():
        old = tensors.get(name)
        if (
            old is None
            or old.dim() != value.dim()
            or any(a > b for a, b in zip(old.shape, value.shape, strict=True))
        ):
            shape = "none" if old is None else tuple(old.shape)
            raise ValueError(
                f"the weights to start from do not fit into this network: {name} has the shape "
                f"{shape} there, {tuple(value.shape)} here; name a configuration whose network is "
                "the same or wider"
            )
        if value.dim() > 1:
            value[: old.shape[0], old.shape[1] :] = 0.0
        value[tuple(slice(n) for n in old.shape)] = old
