"""Which passes a tensor takes: the CPU's, or on any other device the Triton counterparts, once they
have reproduced the CPU's there. Nothing is copied from one to the other."""

from __future__ import annotations

import itertools
import math
import weakref
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.devices import require_triton
from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam, VolumeGrid
from torchpcct.kernel_cache import announce_compilation
from torchpcct.projector.cuda import passes as cuda
from torchpcct.projector.cuda import vector_passes as cuda_vectors
from torchpcct.projector.tables import Tables, VectorTables
from torchpcct.vector_geometry import VectorGeometry

_TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-10}
"""Relative error up to which a device's kernels agree with the CPU's."""
_CHECKED: dict[tuple[str, torch.dtype], float] = {}
"""What was found of a device's kernels, by device and kind of scan, and dtype."""


ENGINES: weakref.WeakValueDictionary[int, Engine] = weakref.WeakValueDictionary()
"""Engines by their handles: what a traced graph can hold, which holds tensors and numbers only."""
_HANDLES = itertools.count()
"""Those that were given out."""


class _CpuPasses(Protocol):
    def forward(self, x: NDArray) -> NDArray: ...

    def adjoint(self, y: NDArray) -> NDArray: ...

    def workspace(self, batch: int, itemsize: int) -> int: ...


class Engine:
    """Forward and adjoint passes of one scan on tensors with any number of leading batch axes."""

    def __init__(self, tables: Tables | VectorTables) -> None:
        self.tables = tables
        self._devices: dict[torch.device, cuda.DevicePasses] = {}
        self._enter()

    def _enter(self) -> None:
        self.handle = next(_HANDLES)
        ENGINES[self.handle] = self

    def __setstate__(self, state: dict[str, object]) -> None:
        """Of a copy, or in another process: a handle of its own."""
        self.__dict__.update(state)
        self._enter()

    @cached_property
    def cpu(self) -> _CpuPasses:
        # The numba kernels are imported when first needed: importing the package stays quick.
        if isinstance(self.tables, VectorTables):
            from torchpcct.projector.cpu.vector_passes import VectorPasses

            return VectorPasses(self.tables)
        if self.tables.grid.ndim == 3:
            from torchpcct.projector.cpu.cone_passes import ConePasses

            return ConePasses(self.tables)
        from torchpcct.projector.cpu.plane_passes import PlanePasses

        return PlanePasses(self.tables)

    def on(self, device: torch.device) -> cuda.DevicePasses:
        """The Triton passes, with their tables on ``device``."""
        if device in self._devices:
            return self._devices[device]
        if isinstance(self.tables, VectorTables):
            self._devices[device] = cuda_vectors.GpuVectorPasses(self.tables, device)
        else:
            from torchpcct.projector.cpu.cone_kernels import tabulate_cells

            t, r = self.tables, self.tables.rays
            cells, axes = (
                np.empty((r.views, r.columns, 8)),
                np.empty((r.views, r.columns), dtype=np.int32),
            )
            tabulate_cells(
                t.segments.table,
                t.pose,
                r.edges,
                r.centers,
                r.first,
                t.lattice,
                r.parallel,
                cells,
                axes,
            )
            self._devices[device] = cuda.GpuPasses(t, device, cells, axes)
        return self._devices[device]

    def shapes(self, transposed: bool) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Of one input and of one output."""
        shapes = self.tables.domain_shape, self.tables.range_shape
        return shapes[::-1] if transposed else shapes

    def apply(self, x: Tensor, transposed: bool) -> Tensor:
        """One pass, ``(..., *domain_shape)`` to ``(..., *range_shape)`` or, ``transposed``,
        back; no autograd."""
        inner, outer = self.shapes(transposed)
        batch_shape = x.shape[: x.dim() - len(inner)]
        batch = math.prod(batch_shape)
        if batch == 0:
            return x.new_zeros((*batch_shape, *outer))
        flat = x.detach().reshape(batch, *inner)
        if x.device.type == "cpu":
            found = self._on_cpu(flat, transposed)
        else:
            passes = self._trusted_on(x.device, x.dtype)
            found = passes.adjoint(flat) if transposed else passes.forward(flat)
        return found.reshape(*batch_shape, *outer)

    def _on_cpu(self, x: Tensor, transposed: bool) -> Tensor:
        array = x.contiguous().numpy()
        announce_compilation()
        result = self.cpu.adjoint(array) if transposed else self.cpu.forward(array)
        return torch.from_numpy(np.ascontiguousarray(result))

    def workspace(self, batch: int, itemsize: int, device: str) -> int:
        """Bytes that one pass holds besides its input and output (the larger of the two
        directions)."""
        if device == "cpu":
            return self.cpu.workspace(batch, itemsize)
        if isinstance(self.tables, VectorTables):
            return cuda_vectors.workspace(self.tables, batch, itemsize)
        return cuda.workspace(self.tables, batch, itemsize)

    def _trusted_on(self, device: torch.device, dtype: torch.dtype) -> cuda.DevicePasses:
        """The passes on a device, once they have reproduced the CPU's there.

        Raises:
            ValueError: Triton is missing. RuntimeError: they compute something else.
        """
        require_triton(device, "the projector")
        kind, small = _small_scan(self.tables)
        key = (f"{device} {kind}", dtype)
        if key not in _CHECKED:
            _CHECKED[key] = Engine(small).deviation(device, dtype)
        if not _CHECKED[key] <= _TOLERANCE[dtype]:
            raise RuntimeError(
                f"the Triton projector on {device} differs from the CPU's by {_CHECKED[key]:.1e} "
                f"(allowed {_TOLERANCE[dtype]:.0e}): check the installed triton version, or move "
                "the data to the CPU with .cpu()"
            )
        return self.on(device)

    def deviation(self, device: torch.device, dtype: torch.dtype) -> float:
        """Relative difference of the device's kernels from the CPU's on random data of this
        scan, the larger one of both directions."""
        worst = 0.0
        generator = torch.Generator().manual_seed(0)
        passes = self.on(device)
        for transposed in (False, True):
            given = torch.randn((1, *self.shapes(transposed)[0]), generator=generator, dtype=dtype)
            expect = self._on_cpu(given, transposed)
            there = given.to(device)
            found = (passes.adjoint(there) if transposed else passes.forward(there)).cpu()
            error = float(
                (found - expect).norm() / expect.norm().clamp_min(torch.finfo(dtype).tiny)
            )
            worst = max(worst, error if math.isfinite(error) else math.inf)
        return worst


_ANGLES = np.array([0.1, 1.9, 4.0])
"""Views in rad of the small scans that compile the kernels."""
_PLANE = VolumeGrid((9, 8), 2.0, (1.0, -2.0))
"""Their grid in the plane."""
_SMALL: dict[type[Geometry], tuple[Geometry, VolumeGrid]] = {
    ParallelBeam: (ParallelBeam(_ANGLES, 15, 1.9), _PLANE),
    FanBeam: (FanBeam(_ANGLES, 60.0, 110.0, 21, 2.1), _PLANE),
    ConeBeam: (
        ConeBeam(_ANGLES, 60.0, 110.0, 14, 9, (1.8, 2.5)),
        VolumeGrid((5, 7, 6), (1.5, 2.0, 2.2), (0.4, 1.0, -2.0)),
    ),
}
"""A small scan of each kind of beam."""


def _small_scan(tables: Tables | VectorTables) -> tuple[str, Tables | VectorTables]:
    """Name of a scan's kernels, and the tables of a small scan that takes them."""
    if isinstance(tables, Tables):
        kind = type(tables.geometry)
        return kind.__name__, Tables(*_SMALL[kind])
    parallel, flat = tables.geometry.parallel, tables.grid.ndim == 2
    geometry, grid = _SMALL[(ParallelBeam if parallel else FanBeam) if flat else ConeBeam]
    vectors = VectorGeometry.of(geometry)
    if flat:
        turned = vectors.turned(slant=0.2)
    else:
        turned = vectors.turned(0.3, -0.2, 0.1)
        if parallel:
            rays = vectors.poses[:, 1] - vectors.poses[:, 0]
            turned = VectorGeometry(
                np.concatenate([rays, turned.vectors[:, 3:]], 1), turned.columns, turned.rows, True
            )
    name = f"VectorGeometry, {'parallel' if parallel else 'point source'}, {grid.ndim}-D"
    return name, VectorTables(turned, grid)
