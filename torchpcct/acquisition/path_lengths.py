"""Exact path lengths of rays in the tissues of a scene, averaged over the finite beam of every
reading.

A tissue is a body WITHOUT what lies inside it, so the tissues of a scene are disjoint and their
path lengths add up to the chord of the outermost body. They are the columns of the linear model
that the limit of :mod:`torchpcct.metrics.cramer_rao` rests on.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchpcct.acquisition.bodies import BodySet
from torchpcct.acquisition.transmission import Beam, expected_readings
from torchpcct.acquisition.transmission import sub_rays as sub_rays_of
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam
from torchpcct.scene.chords import pack
from torchpcct.scene.scene import Scene

if TYPE_CHECKING:
    from torchpcct.typing import Floats


_MU = 1e-4
"""mm⁻¹ of the medium whose readings tell its path: so thin that they are computed to second
order everywhere."""
_VIEWS = 16
"""Views whose readings are held at once."""


def tissue_path_lengths(
    scene: Scene,
    names: Sequence[str | Sequence[str]],
    geometry: ConeBeam,
    window: DetectorWindow | None = None,
    *,
    sub_rays: int = 16,
    focal_spot: tuple[float, float] = (0.0, 0.0),
    view_step: float = 0.0,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Mean path length in each tissue over the sub-rays of every reading.

    Args:
        scene: bodies at rest.
        names: for every tissue the name of its body, or several names whose path lengths are added.
            What lies inside a body does not count to it.
        geometry: cone beam.
        window: the cells to compute; None: the whole detector.
        sub_rays: beam samples a reading, one of
            :data:`torchpcct.acquisition.transmission.SUB_RAY_COUNTS`.
        focal_spot: ``(width, length)`` in mm, along ``e_t`` and z; 0: a point.
        view_step: rad that the gantry turns while a view is read; 0: standing still.
        dtype: of the result; the chords are computed in float64.

    Returns:
        ``(tissues, views, rows, columns)`` in mm.

    Raises:
        ValueError: no names, an unknown or repeated body, a moving scene, a window of other views,
            a bad ``sub_rays``.
        TypeError: a geometry that is not a cone beam.
    """
    if not isinstance(geometry, ConeBeam):
        raise TypeError(f"geometry must be a ConeBeam, got {type(geometry).__name__}")
    if not scene.is_static:
        raise ValueError(
            "the scene moves, and path lengths need one position: give scene.with_motion(None)"
        )
    if window is None:
        window = DetectorWindow.full(geometry)
    window.check(geometry)
    used, mixing = _mixing(scene, names)
    kinds, params = pack([scene.shapes[b] for b in used])
    # Of a medium of μ and one of −μ: a reading is exp(−μ mean + μ² variance / 2), so that half the
    # difference of the logarithms is the mean path times μ.
    contrast = _MU * np.concatenate([mixing.T, -mixing.T], axis=1)
    active = (focal_spot[0] > 0, focal_spot[1] > 0, True, True, view_step > 0)
    alone = np.repeat(np.eye(2 * len(names))[:, None], geometry.columns, axis=1)
    beam = Beam(alone, np.ones(geometry.rows), focal_spot, sub_rays_of(sub_rays, active))
    out = torch.empty((len(names), *window.shape), dtype=dtype)
    for first in range(0, geometry.views, _VIEWS):
        views = slice(first, min(first + _VIEWS, geometry.views))
        part, still = geometry.select(views), np.zeros((len(used), views.stop - first, 3))
        bodies = BodySet(kinds, params, contrast, still, still, (0.0, 0.0, np.inf))
        logs = expected_readings(
            part, window.select(views), bodies, beam, np.full(part.views, view_step)
        ).log()
        out[:, views] = ((logs[len(names) :] - logs[: len(names)]) / (2.0 * _MU)).to(dtype)
    return out


def _mixing(scene: Scene, names: Sequence[str | Sequence[str]]) -> tuple[list[int], Floats]:
    """The bodies whose chords are needed, and the ``(tissues, bodies)`` signs that turn chords
    into path lengths."""
    if isinstance(names, str) or not len(names):
        raise ValueError(f"names must be a non-empty sequence of bodies, got {names!r}")
    signs = np.zeros((len(names), len(scene)))
    seen: set[str] = set()
    parents = scene.parents
    for tissue, group in enumerate(names):
        for name in (group,) if isinstance(group, str) else group:
            if name in seen:
                raise ValueError(f"the body {name!r} is named twice: tissues must not overlap")
            seen.add(name)
            index = scene.index(name)
            signs[tissue, index] += 1.0
            signs[tissue, parents == index] -= 1.0
    used = np.flatnonzero(signs.any(0))
    return used.tolist(), signs[:, used]
