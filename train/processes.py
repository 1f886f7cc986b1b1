"""The processes of a run, and the gradient of a batch that they share.

Each process takes every n-th scene of the batch; gradients are summed and divided by the whole
batch. All then take the same step, so the weights stay equal without being sent.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

import torch
from torch import Tensor, distributed, nn

from train.config import TrainConfig
from train.data import Data, InTurn, seed_of
from train.objective import Objective

if distributed.is_available():
    # now: it keeps the group that exists at its import, whose threads then abort the exit
    import torch.distributed.nn


class Group:
    """The processes of a run: one, or those of an initialised ``torch.distributed`` (gloo)."""

    def __init__(self) -> None:
        several = distributed.is_available() and distributed.is_initialized()
        self.rank = distributed.get_rank() if several else 0
        self.size = distributed.get_world_size() if several else 1

    def sum(self, values: Tensor) -> Tensor:
        """Sum over the processes, in place and the same bits in all."""
        if self.size > 1:
            distributed.all_reduce(values)
        return values

    def gather(self, values: Mapping[str, float]) -> list[Mapping[str, float]]:
        """The figures of every process, in the order of ranks."""
        out: list[Mapping[str, float]] = [values] * self.size
        if self.size > 1:
            distributed.all_gather_object(out, dict(values))
        return out


def gradient(
    config: TrainConfig,
    model: nn.Module,
    data: Data | InTurn,
    objective: Objective,
    step: int,
    group: Group,
    stop: bool = False,
) -> tuple[dict[str, float], bool]:
    """Put the gradient of the mean loss over the batch of a step into the parameters of ``model``.

    It is equal in all processes, and equal for any number of processes but for the rounding of the
    sums. Where the loss is not finite, neither is the gradient.

    Args:
        step: counted from 0.
        group: processes that share the batch.
        stop: this process wants to stop.

    Returns:
        The loss and its parts as means over the batch; whether any process wants to stop. Equal in
        all processes.
    """
    torch.manual_seed(seed_of("step", config.seed, step))
    model.zero_grad()
    parameters = list(model.parameters())
    total, parts = parameters[0].new_zeros(1), Counter[str]()
    loss = objective(
        model,
        data.batch(step, config.batch, range(group.rank, config.batch, group.size)),
        step / config.steps,
    )
    loss.total.backward()
    total += loss.total.detach()
    parts.update(loss.parts)
    pieces = [(torch.zeros_like(p) if p.grad is None else p.grad).reshape(-1) for p in parameters]
    # One message: the gradient, the loss (for whether it is finite), and the wish to stop, on which
    # all must agree.
    flat = group.sum(torch.cat([*pieces, total, total.new_tensor([float(stop)])]))
    mean = (
        flat[:-2] / config.batch
        if torch.isfinite(flat[-2])
        else torch.full_like(flat[:-2], math.nan)
    )
    for p, piece in zip(parameters, mean.split([p.numel() for p in parameters]), strict=True):
        p.grad = piece.view_as(p)
    values: dict[str, float] = {}
    for part in group.gather({"loss": float(total), **parts}):
        for name, value in part.items():
            values[name] = values.get(name, 0.0) + float(value) / config.batch
    return values, bool(flat[-1] > 0)
