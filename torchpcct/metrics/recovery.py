"""Contrast recovery: how much of a feature's contrast a volume shows."""

from __future__ import annotations

from torch import Tensor

_BODY = 0.5
"""Voxels that the feature changes by more than this share of what it changes at most are its own;
the others are its edge."""


def recovered_contrast(shown: Tensor, truth: Tensor) -> float:
    """Share of a feature's contrast that a difference of two volumes shows: the mean over the
    feature's own voxels, over that of the truth.

    Args:
        shown: a volume with the feature less one without it, HU.
        truth: the same of the scenes, averages over voxels, HU; not 0 everywhere.
    """
    where = truth.abs() > _BODY * float(truth.abs().max())
    return float((shown * truth.sign())[where].mean() / truth.abs()[where].mean())
