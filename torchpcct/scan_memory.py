"""What was found out about a scan, kept as long as the scan lives and its readings are the same.

A second method on one scan needs the same tests of its readings, the same repair and the same model
of its data term. They are kept beside the scan, not in it: a copy, a crop or a file knows nothing
of them.
"""

from __future__ import annotations

import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchpcct.scan import Scan

T = TypeVar("T")

MOST = 6
"""Findings kept of a scan; the oldest go first."""
MOST_SCANS = 4
"""Scans of which anything is kept: the latest."""
_TENSORS = ("counts", "air", "exterior", "quantum", "dead")
"""Members of a scan whose change forgets what was found out about it."""

_found: OrderedDict[int, tuple[weakref.ref[Scan], Hashable, OrderedDict[Hashable, Any]]]
_found = OrderedDict()


def once(scan: Scan, name: str, compute: Callable[[], T], *key: Hashable) -> T:
    """What ``compute`` finds out about a scan: computed at the first call.

    Args:
        scan: what it is about. Where its readings were changed in place since, nothing of what was
            found holds any longer.
        name, key: what is found, and what it depends on beside the scan.
        compute: called without arguments. Its result must not hold the scan, which would then
            never be released, and whoever takes it must not change it.
    """
    number, state = id(scan), _state(scan)
    known = _found.get(number)
    if known is None or known[0]() is not scan or known[1] != state:
        of = weakref.ref(scan, lambda _: _found.pop(number, None))
        known = _found[number] = of, state, OrderedDict()
    _found.move_to_end(number)
    while len(_found) > MOST_SCANS:
        _found.popitem(last=False)
    entries = known[2]
    if (name, key) in entries:
        entries.move_to_end((name, key))
    else:
        entries[name, key] = compute()
        while len(entries) > MOST:
            entries.popitem(last=False)
    found: T = entries[name, key]
    return found


def _state(scan: Scan) -> Hashable:
    """Tells readings that were changed in place: by torch, which counts its changes, or through
    memory that is shared with NumPy, by a sum of each view's bits."""
    tensors = [(name, getattr(scan, name)) for name in _TENSORS]
    key = [(name, id(t), t._version) for name, t in tensors if isinstance(t, Tensor)]
    return (*key, _bits(scan.counts), _bits(scan.air), len(scan.info))


def _bits(values: Tensor) -> Hashable:
    """A sum of the bits of each view (of the bins, of every bin's views)."""
    parts = values.shape[0] * (values.shape[1] if values.ndim > 3 else 1)
    flat = values.detach().reshape(parts, -1).contiguous()
    # Words of eight bytes: torch sums them as they are, 25 times as fast as those that it widens.
    single = flat.dtype == torch.float32
    odd = single and (flat.shape[-1] % 2 or flat.storage_offset() % 2)
    return tuple(flat.view(torch.int32 if odd else torch.int64).sum(-1).tolist())
