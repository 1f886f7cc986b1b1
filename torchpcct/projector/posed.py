"""Passes whose poses are tensors: line integrals with gradients by the volume and by the geometry.

The model is that of :mod:`~torchpcct.projector.cpu.vector_kernels` for every geometry, so that
values and derivatives belong together; they differ from the passes of circular scans by what the
models differ (some 1e-4). Derivatives are of first order by the poses, and of second order by a
volume and the poses: of readings that are piecewise linear in the poses a second derivative by the
poses says nothing.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NoReturn, Protocol, cast

import numpy as np
import torch
from torch import Tensor

from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import VolumeGrid
from torchpcct.kernel_cache import announce_compilation
from torchpcct.projector.poses import ParametricGeometry, moved_poses, windowed_poses
from torchpcct.projector.rays import check_pair, check_source
from torchpcct.switches import unswitched
from torchpcct.vector_geometry import VectorGeometry

if TYPE_CHECKING:
    from collections.abc import Callable

    from torchpcct.projector.cpu.vector_passes import PosePasses
    from torchpcct.typing import Reals


class PosedEngine:
    """Forward and adjoint passes of a scan whose poses follow tensors; what they are is read at
    every pass.

    Args:
        scan: the geometry, with the tensors of which its poses are made.
        grid, window: as for ``Projector``.
        motion: tensor ``(views, axes)`` or ``(views, axes + 1)`` as for ``Projector``, or None.

    Raises:
        TypeError, ValueError: as for ``Projector``.
    """

    def __init__(
        self,
        scan: ParametricGeometry,
        grid: VolumeGrid,
        window: DetectorWindow | None = None,
        motion: Tensor | None = None,
    ) -> None:
        base = scan.base
        if isinstance(base, VectorGeometry):
            if window is not None:
                raise ValueError(
                    "a window belongs to a circular scan; of a VectorGeometry select the views, "
                    "or use all of it"
                )
            if not isinstance(grid, VolumeGrid):
                raise TypeError(f"grid must be a VolumeGrid, got {type(grid).__name__}")
            if grid.ndim != 2 + base.has_rows:
                raise ValueError(
                    f"the geometry needs a {2 + base.has_rows}-D grid, got shape {grid.shape}"
                )
        else:
            check_pair(base, grid, window)
        self.scan, self.grid, self.window, self.motion = scan, grid, window, motion
        self.geometry = base
        if motion is not None:
            _check_motion(motion, base.views, grid.ndim)
        rows, columns = (base.shape[1] if base.has_rows else 1), base.columns
        middle = (rows - 1) / 2
        if scan.bend and base.has_rows:  # of a flat detector it is in the centre's place
            middle -= base.row_offset / base.row_pitch
        if window is not None:
            middle -= window.first_row
            rows, columns = window.rows, window.columns
        self._readings = (base.views, rows, columns)
        self._middle = middle
        self._kept: PosePasses | None = None
        if not base.parallel:
            with torch.no_grad():
                place = self.poses()[:, 0, : grid.ndim].flip(1).numpy()
            # Of a circle in the plane, whatever the source's height, as elsewhere.
            circle = base.on_circle
            check_source(place[:, -2:] if circle else place, grid.slice if circle else grid)

    @property
    def tables(self) -> PosedEngine:
        """What an operator asks an engine's tables for: geometry, grid and shapes."""
        return self

    @property
    def domain_shape(self) -> tuple[int, ...]:
        return tuple(self.grid.shape)

    @property
    def range_shape(self) -> tuple[int, ...]:
        views, rows, columns = self._readings
        return (views, rows, columns) if self.grid.ndim == 3 else (views, columns)

    def shapes(self, transposed: bool) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Of one input and of one output."""
        shapes = self.domain_shape, self.range_shape
        return shapes[::-1] if transposed else shapes

    def poses(self) -> Tensor:
        """``(views, 4, 3)`` float64 as the tensors are now, with gradients; of the window's
        columns.

        Raises:
            ValueError: a motion that is not finite.
        """
        poses = self.scan.poses()
        if self.motion is not None:
            motion = self.motion.to("cpu", torch.float64)
            if not torch.isfinite(motion).all():
                raise ValueError("motion has values that are not finite")
            poses = moved_poses(poses, motion, self.grid.ndim, self.geometry.parallel)
        if self.window is not None:
            poses = windowed_poses(poses, self.window, self.geometry.columns, self.scan.bend)
        return poses

    @property
    def passes(self) -> PosePasses:
        if self._kept is None:
            from torchpcct.projector.cpu.vector_passes import PosePasses

            self._kept = PosePasses(
                self.grid, self._readings, self.geometry.parallel, self.scan.bend, self._middle
            )
        return self._kept

    def apply(self, x: Tensor, transposed: bool) -> Tensor:
        """One pass, ``(..., *domain_shape)`` to ``(..., *range_shape)`` or, ``transposed``, back,
        with gradients by x and the tensors.

        Raises:
            ValueError: data on another device than the CPU.
        """
        if x.device.type != "cpu":
            raise ValueError(
                "passes with gradients by motion and geometry are on the CPU only, and the data "
                f"lie on {x.device}: move them with .cpu(), or give motion and geometry as numbers"
            )
        inner, outer = self.shapes(transposed)
        batch_shape = x.shape[: x.dim() - len(inner)]
        if math.prod(batch_shape) == 0:
            return x.new_zeros((*batch_shape, *outer))
        with unswitched():
            poses = self.poses()
            flat = x.reshape(-1, *inner)
            out = cast(Tensor, _Pass.apply(flat, poses, self, transposed))
        return out.reshape(*batch_shape, *outer)

    def derivatives(self, x: Tensor, tangents: Tensor) -> Tensor:
        """Changes of the readings of one volume along ``tangents (directions, views, 4, 3)`` of
        the poses, ``(directions, *range_shape)``; no autograd."""
        announce_compilation()
        with unswitched(), torch.no_grad():
            poses = self.poses().numpy()
            found = self.passes.derivative(poses, _array(x[None]), _array(tangents))
        return torch.from_numpy(found[0])

    def workspace(self, batch: int, itemsize: int, device: str) -> int:
        """Bytes that one pass holds besides its input and output."""
        return 3 * 8 * 12 * self._readings[0]


def _check_motion(motion: Tensor, views: int, axes: int) -> None:
    if not motion.is_floating_point():
        raise TypeError(f"motion must be a tensor of floating point, got {motion.dtype}")
    if motion.shape not in ((views, axes), (views, axes + 1)):
        raise ValueError(
            f"motion needs the shape ({views}, {axes}), views and the grid's axes, or "
            f"({views}, {axes + 1}) with a rotation about z, got {tuple(motion.shape)}"
        )


def _array(x: Tensor) -> Reals:
    return np.ascontiguousarray(x.detach().numpy())


def _run(method: Callable[..., Reals], *args: Tensor, like: Tensor) -> Tensor:
    announce_compilation()
    with unswitched():
        found = torch.from_numpy(method(*(_array(x) for x in args)))
        return found.to(like.dtype)


class _PassContext(Protocol):
    """What the passes keep for their derivatives."""

    engine: PosedEngine
    transposed: bool
    saved_tensors: tuple[Tensor, ...]
    needs_input_grad: tuple[bool, ...]

    def save_for_backward(self, *tensors: Tensor) -> None: ...

    def save_for_forward(self, *tensors: Tensor) -> None: ...


class _Pass(torch.autograd.Function):
    """``A(poses) x`` or its transpose, of one batch axis."""

    @staticmethod
    def forward(x: Tensor, poses: Tensor, engine: PosedEngine, transposed: bool) -> Tensor:
        passes = engine.passes
        return _run(passes.adjoint if transposed else passes.forward, poses, x, like=x)

    @staticmethod
    def setup_context(
        ctx: _PassContext, inputs: tuple[Tensor, Tensor, PosedEngine, bool], output: Tensor
    ) -> None:
        x, poses, ctx.engine, ctx.transposed = inputs
        ctx.save_for_backward(x, poses)
        ctx.save_for_forward(x, poses)

    @staticmethod
    def backward(ctx: _PassContext, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        x, poses = ctx.saved_tensors
        (gradient,) = gradients
        by_x = by_poses = None
        if ctx.needs_input_grad[0]:
            by_x = _Pass.apply(gradient, poses, ctx.engine, not ctx.transposed)
        if ctx.needs_input_grad[1]:
            volume, readings = (gradient, x) if ctx.transposed else (x, gradient)
            by_poses = _ByPoses.apply(volume, readings, _OnceOnly.apply(poses), ctx.engine)
        return by_x, by_poses, None, None

    @staticmethod
    def jvp(ctx: _PassContext, *tangents: Tensor) -> Tensor | float:
        x, poses = ctx.saved_tensors
        by_x, by_poses = tangents[:2]
        out: Tensor | float = 0.0
        if by_x is not None:
            out = _Pass.apply(by_x, poses, ctx.engine, ctx.transposed)
        if by_poses is not None:
            out = out + _along(x, poses, by_poses, ctx.engine, ctx.transposed)
        return out


def _along(
    x: Tensor, poses: Tensor, tangent: Tensor, engine: PosedEngine, transposed: bool
) -> Tensor:
    """The change of a pass along ``tangent`` of its poses; no autograd."""
    passes = engine.passes
    if transposed:
        return _run(passes.transposed_derivative, poses, x, tangent, like=x)
    return _run(lambda p, v, t: passes.derivative(p, v, t[None])[:, 0], poses, x, tangent, like=x)


class _ByPoses(torch.autograd.Function):
    """Gradient of ⟨readings, A(poses) volume⟩ by the poses."""

    @staticmethod
    def forward(volume: Tensor, readings: Tensor, poses: Tensor, engine: PosedEngine) -> Tensor:
        return _run(engine.passes.gradient, poses, volume, readings, like=poses)

    @staticmethod
    def setup_context(
        ctx: _PassContext, inputs: tuple[Tensor, Tensor, Tensor, PosedEngine], output: Tensor
    ) -> None:
        volume, readings, poses, ctx.engine = inputs
        ctx.save_for_backward(volume, readings, poses)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: _PassContext, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        volume, readings, poses = ctx.saved_tensors
        (along,) = gradients
        by_volume = by_readings = None
        if ctx.needs_input_grad[0]:
            by_volume = _along(readings, poses, along, ctx.engine, True)
        if ctx.needs_input_grad[1]:
            by_readings = _along(volume, poses, along, ctx.engine, False)
        return by_volume, by_readings, torch.zeros_like(poses), None


class _OnceOnly(torch.autograd.Function):
    """The poses as they are; that somebody asks for their second derivative is refused here,
    where only those come by who do."""

    @staticmethod
    def forward(ctx: object, poses: Tensor) -> Tensor:
        return poses.view_as(poses)

    @staticmethod
    def backward(ctx: object, *gradients: Tensor) -> NoReturn:
        raise NotImplementedError(
            "projections are piecewise linear in the geometry, so that second derivatives with "
            "respect to it carry no information. Use first derivatives (Gauss-Newton), or detach "
            "the geometry's tensors where you differentiate with respect to the volume"
        )
