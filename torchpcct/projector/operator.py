"""The projector as a PyTorch module: line integrals of a grid, and the exact adjoint of the same
weights."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np
import torch
from torch import Tensor, nn

from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import Geometry, VolumeGrid
from torchpcct.projector.engine import ENGINES, Engine
from torchpcct.projector.posed import PosedEngine
from torchpcct.projector.poses import ParametricGeometry, with_parameters
from torchpcct.projector.tables import Tables, VectorTables
from torchpcct.switches import undisturbed, unswitched
from torchpcct.vector_geometry import VectorGeometry

if TYPE_CHECKING:
    import pylops
    from deepinv.physics import LinearPhysics
    from numpy.typing import ArrayLike, DTypeLike
    from scipy.sparse.linalg import LinearOperator

    from torchpcct.typing import Reals

__all__ = ["Operator", "Projector"]

Linear = Callable[[Tensor], Tensor]
_DTYPES = (torch.float32, torch.float64)
"""Precisions in which passes are computed."""
_NARROW = (torch.float16, torch.bfloat16)
"""Precisions that are widened to float32 before."""


class Operator(nn.Module):
    """Passes of an engine from ``domain_shape`` to ``range_shape``, and their matched adjoint
    ``T``."""

    def __init__(self, engine: Engine | PosedEngine, transposed: bool = False) -> None:
        super().__init__()
        self._engine, self._transposed = engine, transposed
        # in a list: a submodule that holds its parent would recurse
        self._other: list[Operator] = []

    @property
    def domain_shape(self) -> tuple[int, ...]:
        """Shape of one input: of a :class:`Projector` that of a volume, ``(y, x)`` or ``(z, y,
        x)``."""
        return self._engine.shapes(self._transposed)[0]

    @property
    def range_shape(self) -> tuple[int, ...]:
        """Shape of one output: of a :class:`Projector` ``(views, columns)`` or ``(views, rows,
        columns)``."""
        return self._engine.shapes(self._transposed)[1]

    @property
    def T(self) -> Operator:
        """The adjoint operator; ``A.T.T is A``."""
        if not self._other:
            other = Operator(self._engine, not self._transposed)
            other._other.append(self)
            self._other.append(other)
        return self._other[0]

    @property
    def H(self) -> Operator:
        """The adjoint operator; all weights are real, so it is ``A.T``."""
        return self.T

    def __matmul__(self, x: Tensor) -> Tensor:
        return cast(Tensor, self(x))

    def forward(self, x: Tensor) -> Tensor:
        name, operator = ("y", "A.T") if self._transposed else ("x", "A")
        return _apply(
            _checked(x, self.domain_shape, name, operator), self._engine, self._transposed
        )

    def extra_repr(self) -> str:
        return (
            f"{type(self._engine.tables.geometry).__name__}, {self.domain_shape} -> "
            f"{self.range_shape}"
        )

    @undisturbed
    def norm(self, tolerance: float = 1e-4, most: int = 200) -> float:
        """Largest singular value, by power iteration on AᵀA in float32; kept after the first call.

        Args:
            tolerance: stop when the value grows by less than this share in one iteration. It is
                approached from below.
            most: largest number of iterations, one pass in either direction each.
        """
        kept = self.__dict__.get("_norm")
        if kept is None or kept[0] > tolerance:
            # A constant start is near the largest eigenvector, and the noise keeps it from being
            # orthogonal to it.
            noise = torch.rand(self.domain_shape, generator=torch.Generator().manual_seed(0))
            x, value = 1 + noise, 0.0
            for _ in range(most):
                x = x / x.norm().clamp_min(torch.finfo(x.dtype).tiny)
                with torch.no_grad():
                    y = self(x)
                    x = self.T(y)
                before, value = value, float(y.norm())
                if value <= before * (1 + tolerance):
                    break
            kept = self.__dict__["_norm"] = (tolerance, value)
        return cast(float, kept[1])

    def as_scipy(self, dtype: DTypeLike = np.float32) -> LinearOperator:
        """A :class:`scipy.sparse.linalg.LinearOperator` on flattened arrays, for SciPy's solvers.

        Args:
            dtype: float32 or float64, in which it computes.

        Raises:
            TypeError: another dtype.
        """
        from scipy.sparse.linalg import LinearOperator

        if np.dtype(dtype) not in (np.dtype(np.float32), np.dtype(np.float64)):
            raise TypeError(f"dtype must be float32 or float64, got {dtype!r}")

        def columns(operator: Operator, values: Reals) -> Reals:
            # Columns of a matrix are a batch.
            batch = np.ascontiguousarray(
                np.asarray(values, dtype=dtype).reshape(values.shape[0], -1).T
            )
            with torch.no_grad():
                out = operator(torch.from_numpy(batch).reshape(-1, *operator.domain_shape))
            return out.reshape(len(batch), -1).numpy().T.reshape(-1, *values.shape[1:])

        return LinearOperator(
            (math.prod(self.range_shape), math.prod(self.domain_shape)),
            matvec=lambda x: columns(self, x),
            rmatvec=lambda y: columns(self.T, y),
            matmat=lambda x: columns(self, x),
            rmatmat=lambda y: columns(self.T, y),
            dtype=dtype,
        )

    def as_pylops(self, dtype: DTypeLike = np.float32) -> pylops.LinearOperator:
        """A ``pylops.LinearOperator`` on flattened arrays; see :meth:`as_scipy`.

        Raises:
            ModuleNotFoundError: PyLops is not installed.
        """
        import pylops

        return pylops.aslinearoperator(self.as_scipy(dtype))

    def as_deepinv(self) -> LinearPhysics:
        """A ``deepinv.physics.LinearPhysics``: differentiable, on batches ``(batch, …, *shape)``.

        Raises:
            ModuleNotFoundError: deepinv is not installed.
        """
        from deepinv.physics import LinearPhysics

        return LinearPhysics(A=lambda x, **_: self(x), A_adjoint=lambda y, **_: self.T(y))


class _Maps(Protocol):
    """What a linear map keeps for its derivatives."""

    forward_map: Linear
    transpose_map: Linear


class _Linear(torch.autograd.Function):
    """``forward(x)``; its gradient is ``transpose``, whose gradient is ``forward`` again (any
    order)."""

    @staticmethod
    def forward(x: Tensor, forward: Linear, transpose: Linear) -> Tensor:
        with unswitched():  # of the backward pass, too
            return forward(x)

    @staticmethod
    def setup_context(ctx: _Maps, inputs: tuple[Tensor, Linear, Linear], output: Tensor) -> None:
        _, ctx.forward_map, ctx.transpose_map = inputs

    @staticmethod
    def backward(ctx: _Maps, *gradients: Tensor) -> tuple[Tensor, None, None]:
        return apply_linear(gradients[0], ctx.transpose_map, ctx.forward_map), None, None

    @staticmethod
    def jvp(ctx: _Maps, *tangents: Tensor) -> Tensor:
        return apply_linear(tangents[0], ctx.forward_map, ctx.transpose_map)

    @staticmethod
    def vmap(
        info: object, in_dims: tuple[int, None, None], x: Tensor, forward: Linear, transpose: Linear
    ) -> tuple[Tensor, int]:
        # Leading dimensions are batch dimensions already.
        return _Linear.apply(x.movedim(in_dims[0], 0), forward, transpose), 0


def apply_linear(x: Tensor, forward: Linear, transpose: Linear) -> Tensor:
    """``forward(x)`` with gradients of any order; both maps take and keep leading batch
    dimensions."""
    return cast(Tensor, _Linear.apply(x, forward, transpose))


# torch.compile and torch.export cannot look into numba kernels; to them a pass is one operation. An
# exported program holds the handle of its engine: it runs in the process that exported it, while
# the projector lives.
@torch.library.custom_op(
    "torchpcct::project",
    mutates_args=(),
    schema="(Tensor x, int engine, bool transposed) -> Tensor",
)
def _traced(x: Tensor, engine: int, transposed: bool) -> Tensor:
    return ENGINES[engine].apply(x, transposed)


@_traced.register_fake
def _shape(x: Tensor, engine: int, transposed: bool) -> Tensor:
    inner, outer = ENGINES[engine].shapes(transposed)
    return x.new_empty((*x.shape[: x.dim() - len(inner)], *outer))


class _TracedPass(Protocol):
    """What a traced pass keeps for its derivative."""

    engine: int
    transposed: bool


def _note(ctx: _TracedPass, inputs: tuple[Tensor, int, bool], output: Tensor) -> None:
    _, ctx.engine, ctx.transposed = inputs


def _back(ctx: _TracedPass, gradient: Tensor) -> tuple[Tensor, None, None]:
    return _traced(gradient, ctx.engine, not ctx.transposed), None, None


_traced.register_autograd(_back, setup_context=_note)


def _apply(x: Tensor, engine: Engine | PosedEngine, transposed: bool) -> Tensor:
    if isinstance(engine, PosedEngine):
        return engine.apply(x, transposed)
    if torch.compiler.is_compiling():
        return cast(Tensor, _traced(x, engine.handle, transposed))
    return apply_linear(
        x, *(partial(engine.apply, transposed=way) for way in (transposed, not transposed))
    )


class Projector(Operator):
    """Cell-averaged line integrals of a voxel grid, and the exact adjoint.

    The model is distance-driven (De Man and Basu 2004, Phys. Med. Biol. 49:2463): in every slab of
    voxels a reading is the mean over the detector cell projected onto the slab's middle plane,
    times the path. It stays accurate for voxels much smaller and much larger than the cell. Rays
    choose their slabs (grid rows or columns) one by one, not view by view, so that the edges of a
    wide fan are as accurate as its centre.

    Shape:
        - ``A(x)``: ``(..., *domain_shape)`` → ``(..., *range_shape)``, any number of leading batch
          dimensions.
        - ``A.T(y)``: ``(..., *range_shape)`` → ``(..., *domain_shape)``.

    In and out have one dtype (float32 or float64) and one device; float16 and bfloat16, as autocast
    leaves them, are computed and returned in float32. ``A @ x``, ``A.H``, ``A.norm()`` and the
    operator in the form of other libraries (``as_scipy``, ``as_pylops``, ``as_deepinv``) come from
    :class:`Operator`. Units: ``x`` in mm⁻¹ gives line integrals without unit. Both directions are
    differentiable any number of times and work under ``torch.func``. NaN and Inf in the input reach
    the output (a NaN may also reach readings that share a grid line with it). ``torch.compile``
    and, within the process, ``torch.export`` take a pass as one operation. The module has no
    parameters and no state. Tensors on a GPU take the Triton kernels, after a check against the CPU
    at their first use; nothing travels to the CPU. They are refused without Triton, and where that
    check fails.

    Args:
        geometry: ``ParallelBeam`` or ``FanBeam`` with a 2-D grid, ``ConeBeam`` with a 3-D grid; or
            a :class:`~torchpcct.vector_geometry.VectorGeometry`: what is a circular scan, at rest
            or moving (a helix), takes the passes of one, anything else general ones, several
            times slower. Of one with tensors
            (:func:`~torchpcct.projector.poses.with_parameters`) readings have gradients by them.
        grid: the voxel grid.
        window: the part of the detector to compute (``torchpcct.detector_window.footprint``), or
            None for all of it.
        motion: displacement of the grid in every view, ``(views, 2)`` (y, x) or ``(views, 3)`` (z,
            y, x) mm, or None: a volume that moves rigidly with its object is projected and
            reconstructed at rest. A last column more is a rotation about the z axis, rad, before
            the displacement. Of a tensor that requires a gradient readings have one, by general
            passes on the CPU; its values are read at every pass, so that an optimiser may change
            them.

    Raises:
        TypeError: an argument of the wrong kind, an input that is not float32 or float64.
        ValueError: geometry, grid, window and motion that do not fit together, a source inside the
            grid, an input of the wrong shape, or on a device that has no passes for the scan.
        RuntimeError: the device's kernels compute something else than the CPU's.
    """

    def __init__(
        self,
        geometry: Geometry | ParametricGeometry,
        grid: VolumeGrid,
        window: DetectorWindow | None = None,
        motion: ArrayLike | None = None,
    ) -> None:
        super().__init__(_engine(geometry, grid, window, motion))
        self.geometry = geometry.base if isinstance(geometry, ParametricGeometry) else geometry
        self.grid = grid
        self.window = window
        self.at_rest = motion is None

    def memory_estimate(
        self, batch: int = 1, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
    ) -> int:
        """Bytes that one pass needs at most: input, output and working memory.

        Args:
            batch: number of volumes (or sinograms) in the pass.
            dtype: float32 or float64.
            device: where the pass runs, "cpu" or a CUDA device: there the estimate is that of the
                whole batch; what does not fit into half of the free memory goes through in slices,
                the same bit for bit.

        Raises:
            TypeError: another dtype. ValueError: a negative batch.
        """
        if dtype not in _DTYPES:
            raise TypeError(f"dtype must be float32 or float64, got {dtype}")
        if batch < 0:
            raise ValueError(f"batch must be at least 0, got {batch}")
        item = dtype.itemsize
        arrays = batch * item * (math.prod(self.domain_shape) + math.prod(self.range_shape))
        if not batch:
            return 0
        return arrays + self._engine.workspace(batch, item, torch.device(device).type)


def _engine(
    geometry: Geometry | ParametricGeometry,
    grid: VolumeGrid,
    window: DetectorWindow | None,
    motion: Tensor | ArrayLike | None,
) -> Engine | PosedEngine:
    if not is_free(motion) and not isinstance(geometry, ParametricGeometry):
        return Engine(_tables(geometry, grid, window, motion))
    scan = geometry if isinstance(geometry, ParametricGeometry) else with_parameters(geometry)
    if motion is not None and not isinstance(motion, Tensor):
        motion = torch.as_tensor(np.array(motion, dtype=np.float64))
    return PosedEngine(scan, grid, window, motion)


def is_free(motion: object) -> bool:
    """Whether somebody wants derivatives by a motion, backward or forward."""
    if not isinstance(motion, Tensor):
        return False
    return motion.requires_grad or torch.autograd.forward_ad.unpack_dual(motion).tangent is not None


def _tables(
    geometry: Geometry,
    grid: VolumeGrid,
    window: DetectorWindow | None,
    motion: ArrayLike | None,
) -> Tables | VectorTables:
    if not isinstance(geometry, VectorGeometry):
        return Tables(geometry, grid, window, motion)
    if window is not None:
        raise ValueError(
            "a window belongs to a circular scan; of a VectorGeometry select the views, or use "
            "all of it"
        )
    if motion is not None:
        geometry = geometry.moved(motion)
    circular = geometry.as_circular()
    return (
        VectorTables(geometry, grid)
        if circular is None
        else Tables(circular[0], grid, None, circular[1])
    )


def _checked(x: object, inner: tuple[int, ...], name: str, operator: str) -> Tensor:
    """``x`` in float32 or float64."""
    if not isinstance(x, Tensor):
        raise TypeError(
            f"{operator}({name}) needs a torch.Tensor, got {type(x).__name__}: use "
            f"torch.as_tensor({name})"
        )
    if x.dtype in _NARROW:  # of an autocast region: sums of hundreds of voxels need more digits
        x = x.float()
    if x.dtype not in _DTYPES:
        raise TypeError(
            f"{operator}({name}) needs float32 or float64, got {x.dtype}: use {name}.float()"
        )
    if tuple(x.shape[-len(inner) :]) != inner:
        raise ValueError(
            f"{operator}({name}) needs a tensor of shape (..., {', '.join(map(str, inner))}), "
            f"got {tuple(x.shape)}"
        )
    return x
