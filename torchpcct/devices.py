"""Devices that a computation is asked to run on: whether they exist, and whether it fits."""

from __future__ import annotations

import importlib.util

import torch
from torch import Tensor

from torchpcct.memory import free_bytes


def device_of(device: object) -> torch.device:
    """The device that is meant, with its number (``"cuda"`` is the current one).

    Raises:
        ValueError: no such device here. TypeError: neither a name nor a ``torch.device``.
    """
    if not isinstance(device, (str, int, torch.device)) or isinstance(device, bool):
        raise TypeError(
            f'device must be a name such as "cpu" or "cuda:0", got {type(device).__name__}'
        )
    try:
        # What is made there says which one it is, and that there is one.
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).partition("\n")[0].rstrip(".")
        raise ValueError(
            f'there is no device {str(device)!r} here that torch can use ({reason}): use "cpu"'
        ) from None


def same_device(**tensors: Tensor | None) -> torch.device:
    """The device of all tensors that are given.

    Raises:
        ValueError: they lie on several; the message names one of each.
    """
    first: tuple[str, torch.device] | None = None
    for name, value in tensors.items():
        if value is None:
            continue
        if first is None:
            first = name, value.device
        elif value.device != first[1]:
            raise ValueError(
                f"{first[0]} is on {first[1]}, {name} on {value.device}: move one of them "
                "with .to(…)"
            )
    if first is None:
        raise ValueError("no tensor is given: give at least one")
    return first[1]


def require_device(scan: torch.device, problem: torch.device) -> None:
    """Refuse a scan that lies on another device than the problem that was made for it.

    Raises:
        ValueError: they differ.
    """
    if scan != problem:
        raise ValueError(
            f"the scan is on {scan}, the problem that was made for it on {problem}: "
            f'move the scan, scan.to("{problem}"), or make the problem from the moved scan'
        )


def available_bytes(device: torch.device) -> int:
    """Memory that can still be allocated: of the device, of the container, or of the machine."""
    if device.type == "cuda":
        # What torch keeps for itself and does not use is as good as free.
        kept = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return int(torch.cuda.mem_get_info(device)[0]) + kept
    return free_bytes()


def require_room(need: int, device: torch.device, what: str) -> None:
    """Refuse what does not fit into a device's memory.

    Args:
        need: bytes.
        device: where.
        what: asks for so much, for the message.

    Raises:
        ValueError: it does not fit.
    """
    free = available_bytes(device)
    if need > free:
        raise ValueError(
            f"{what} needs {need / 2**30:.2f} GiB on {device}, {free / 2**30:.2f} GiB are free "
            'there: take larger or fewer voxels, float32, or device="cpu"'
        )


def require_triton(device: torch.device, what: str) -> None:
    """Refuse kernels on a device without Triton, which compiles them.

    Raises:
        ValueError: it is not installed.
    """
    if importlib.util.find_spec("triton") is None:
        raise ValueError(
            f"{what} on {device} needs Triton: install it (pip install triton), or move the data "
            "to the CPU with .cpu()"
        )
