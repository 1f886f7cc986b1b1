"""Filtered backprojection for parallel, fan and cone beams (FDK), flat and curved detectors."""

from __future__ import annotations

import itertools
import logging
import math
import warnings
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from recon.analytic.angular_weights import angular_weights
from recon.analytic.any_orbit import at_slices, rebin_to_circle
from recon.analytic.backproject import BackprojectionPlan, check_data, data_shape
from recon.analytic.coverage import check_rows, refuse_helix
from recon.analytic.detector_edges import Rows, continued, cut_off, mirrored
from recon.analytic.filter_plan import CHUNK_BYTES, FilterPlan, kernel_names
from torchpcct.angles import view_steps
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.devices import require_room
from torchpcct.geometry import Beam, Geometry, VolumeGrid, beam, view_step
from torchpcct.projector.operator import apply_linear, is_free
from torchpcct.readings import interpolate_dead
from torchpcct.validate import checked, number, reals
from torchpcct.vector_geometry import VectorGeometry

__all__ = ["Fbp", "FbpPlan", "fbp", "filter_sinogram", "interleave"]

_LOG = logging.getLogger(__name__)

G = TypeVar("G", bound=Geometry)


def _check_weights(
    weights: object, geometry: Geometry, grid: VolumeGrid | None = None
) -> NDArray[np.float64]:
    if weights is None:
        return angular_weights(geometry, grid)
    w = reals("weights", weights)
    if w.shape == (geometry.views,):
        w = w[:, None]
    if w.shape not in ((geometry.views, 1), (geometry.views, geometry.columns)):
        raise ValueError(
            f"weights must have the shape ({geometry.views},) or ({geometry.views}, "
            f"{geometry.columns}), got {w.shape}"
        )
    return w


@checked
def filter_sinogram(
    sinogram: Tensor,
    geometry: Geometry,
    kernel: str | Sequence[str] = "standard",
    window: DetectorWindow | None = None,
    *,
    held: DetectorWindow | None = None,
    weights: object = None,
) -> Tensor:
    """Weight and ramp-filter the rows of a scan: the first half of filtered backprojection.

    The result carries the cosine, angular and redundancy weights, ready for
    :func:`~recon.analytic.backproject.backproject`. Filtering is linear: after the scan of a
    background has been filtered once, the scan of a small inset or of other noise in its footprint
    is filtered from that footprint alone (``held``). The result equals that of the whole rows to
    rounding.

    Args:
        sinogram: line integrals ``(..., views, [rows,] columns)``, float32 or float64, filtered
            where they lie.
        geometry: parallel, fan or cone beam.
        kernel: reconstruction kernel (:data:`recon.names.KERNELS`) or a sequence of them.
        window: return only these readings of every view (rows and columns); default: all. Its rows
            must be held.
        held: the readings that ``sinogram`` holds, default: all; what is not held is zero.
        weights: angular weights ``(views,)`` or ``(views, columns)`` in rad that replace
            :func:`recon.analytic.angular_weights.angular_weights`.

    Returns:
        ``(..., views, [rows,] columns)`` on the window, mm⁻¹; with a sequence of kernels a leading
        axis of kernels. Differentiable to any order. Temporary memory is bounded by
        :data:`recon.analytic.filter_plan.CHUNK_BYTES` or one view.

    Raises:
        ValueError: a wrong shape, an unknown kernel, a window beyond the detector, views that do
            not suffice.
        TypeError: data that are not float32 or float64 tensors.
    """
    whole = DetectorWindow.full(geometry)
    held = whole if held is None else held
    check_data("sinogram", sinogram, data_shape(geometry, held))
    names, several = kernel_names(kernel)
    plan = FilterPlan(
        geometry,
        names,
        _check_weights(weights, geometry),
        held,
        whole if window is None else window,
    )
    flat = not geometry.has_rows
    given = sinogram.unsqueeze(-2) if flat else sinogram
    out = apply_linear(given, plan.forward, plan.transpose)
    out = out.squeeze(-2) if flat else out
    kernel_axis = -3 if flat else -4
    return out.movedim(kernel_axis, 0) if several else out.squeeze(kernel_axis)


@checked
def interleave(sinogram: Tensor, geometry: G) -> tuple[Tensor, G]:
    """Spread the columns over a detector of half the pitch, for scans with a quarter-column offset.

    The conjugate ray of a detector shifted by a quarter column falls between two columns. Filtering
    every view on a grid of half the pitch, zeros between the readings, reaches up to twice the
    Nyquist frequency of one view; what one view aliases there, its conjugate cancels. The windows
    of :mod:`recon.analytic.ramp` then refer to the doubled Nyquist frequency. Without the offset
    nothing cancels: details near the isocentre come out aliased.

    The conjugate of a ray falls between two views. What is aliased cancels where neighbouring views
    shift the object by less than half a column: within pitch / (2 · view step) of the axis (of the
    paper's scan 78 mm, of one with 120 views 5 mm). Beyond, the two rays see different places, and
    the aliased details remain; a warning is logged if this radius is less than a quarter of the
    field of view.

    Args:
        sinogram: ``(..., columns)``.
        geometry: parallel, fan or cone beam of a closed scan with an offset of about a quarter
            column.

    Returns:
        ``(..., 2 · columns)`` and its geometry, for :func:`fbp`.

    Raises:
        ValueError: a wrong shape; a scan that is not closed (half a turn suffices for parallel
            rays); columns without the quarter offset (more than a tenth of a column from it).
        TypeError: a wrong dtype.
    """
    check_data("sinogram", sinogram, geometry.shape)
    _check_conjugates(beam(geometry))
    # the mean of a reading and a zero is half the reading
    spread = torch.stack([2.0 * sinogram, torch.zeros_like(sinogram)], dim=-1).flatten(-2)
    return spread, geometry.interleaved()


def _check_conjugates(geometry: Beam) -> None:
    """Whether the conjugate rays that :func:`interleave` relies on were measured, and fall
    between two columns."""
    pitch, offset = geometry.column_pitch, geometry.column_offset
    quarters = (geometry.column_positions[0] / pitch) % 0.5
    if abs(quarters - 0.25) > 0.1:
        raise ValueError(
            f"interleave needs columns a quarter pitch beside the axis, offset {offset:g} mm at a "
            f"pitch of {pitch:g} mm leaves conjugate rays on one another: filter the sinogram as "
            "it is"
        )
    _, _, span = view_steps(geometry.angles)
    if span < 2.0 * math.pi:
        raise ValueError(
            "interleave needs the conjugate of every ray, the views cover "
            f"{math.degrees(span):.1f}° of 360°"
        )
    radius = geometry.cell / (2.0 * view_step(geometry.angles))
    field = geometry.fov_radius
    if radius < field / 4.0:
        _LOG.warning(
            "interleave: with %d views aliasing cancels only within %.1f mm of the axis: use more "
            "views, or filter the sinogram as it is",
            geometry.views,
            radius,
        )


@checked
def fbp(
    sinogram: Tensor,
    geometry: Geometry,
    grid: VolumeGrid,
    kernel: str | Sequence[str] = "standard",
    *,
    weights: object = None,
    motion: object = None,
    outside: float | None = None,
) -> Tensor:
    """Filtered backprojection (Feldkamp, Davis and Kress, J. Opt. Soc. Am. A 1, 612, 1984, for a
    cone beam).

    With ``motion`` each view's filtered data are backprojected along the rays that met the
    displaced object (Schäfer, Borgert, Rasche and Grass, IEEE Trans. Med. Imaging 25, 895, 2006).
    That neglects how the motion changes the density of the rays through the object, by (mm per rad
    of rotation) / sod: 0.1 % for a coronary artery.

    A full turn of an offset detector (half fan) is weighted after Wang (Med. Phys. 29, 1634, 2002),
    and the grid may reach as far as the long side. Where the rows end inside the object, they are
    continued by cylinders of ``outside``.

    Args:
        sinogram: line integrals ``(..., views, [rows,] columns)``, float32 or float64. NaN and Inf
            are dead readings: they are interpolated from their neighbours
            (:func:`torchpcct.readings.interpolate_dead`) with a warning.
        geometry: parallel, fan or cone beam; a closed circle, a short scan (at least π plus the fan
            angle), views in any order, irregularly spaced or repeated; or a
            :class:`~torchpcct.vector_geometry.VectorGeometry` that is nearly so
            (:mod:`recon.analytic.any_orbit`).
        grid: voxels to reconstruct, 2-D for parallel and fan beams, 3-D for cone beams.
        kernel: reconstruction kernel ``"soft"``, ``"standard"``, ``"detail"``, ``"bone"``,
            ``"ram-lak"``, or several.
        weights: angular weights that replace the automatic ones, see :func:`filter_sinogram`.
        motion: displacement of everything in the scan in every view, see
            :func:`~recon.analytic.backproject.backproject`.
        outside: attenuation in mm⁻¹ (unit of ``sinogram`` per mm) of the object beyond the
            detector's edges, e.g. that of water; 0: there is none, rows that do not end in air are
            inconsistent. None: 0, with a warning if the rows look cut off.

    Returns:
        ``(..., *grid.shape)`` mm⁻¹; with a sequence of kernels a leading axis of kernels.
        Differentiable to any order (columns that were added beyond the edges count as constant);
        by a ``motion`` that is a tensor and requires a gradient, to the first.

    Raises:
        ValueError, TypeError: as :func:`filter_sinogram` and
            :func:`~recon.analytic.backproject.backproject`; gradients by the motion of a
            VectorGeometry; views of which more than a quarter is
            dead; a negative ``outside``.

    Example:
        >>> import numpy as np, torch
        >>> from torchpcct import ParallelBeam, VolumeGrid
        >>> geometry = ParallelBeam(np.arange(90) * np.pi / 90, 64, 1.0)
        >>> # Line integrals of a disc of water.
        >>> chords = 0.04 * np.sqrt(np.clip(20.0**2 - geometry.column_positions**2, 0.0, None))
        >>> sinogram = torch.from_numpy(np.tile(chords, (90, 1)))
        >>> image = fbp(sinogram, geometry, VolumeGrid((33, 33), 1.0), "soft")
        >>> round(float(image[12:21, 12:21].mean()), 3)
        0.02
    """
    if isinstance(geometry, VectorGeometry):
        if is_free(motion):
            raise ValueError(
                "FBP has gradients by a motion of parallel, fan and cone beams: of a "
                "VectorGeometry give the motion as numbers (.detach()), or use Projector, which "
                "has them on every geometry"
            )
        lines, circle = rebin_to_circle(
            sinogram, geometry if motion is None else geometry.moved(motion)
        )
        if circle.slices is not None:
            lines, grid = at_slices(lines, circle.slices, grid), grid.slice
        return fbp(
            lines,
            circle.geometry,
            grid,
            kernel,
            weights=weights,
            motion=circle.motion,
            outside=outside,
        )
    check_data("sinogram", sinogram, geometry.shape)
    path = _plain(motion)
    refuse_helix(geometry, path)
    for text in check_rows(geometry, grid, path):
        _LOG.warning("%s", text)
    lines = _without_dead(sinogram, geometry)
    weights = _check_weights(weights, geometry, grid)
    plan = FbpPlan(
        geometry,
        [grid],
        kernel,
        weights=weights,
        motion=motion,
        sides=_cut_sides(lines, beam(geometry), weights, outside),
        outside=outside or 0.0,
    )
    return plan(lines)[0]


class FbpPlan:
    """The way from readings to volumes, of one geometry onto one or several grids: the rows are
    completed, weighted and filtered, backprojected.

    :func:`fbp` goes it with whole rows, :class:`recon.analytic.inset.InsetFbp` with the readings
    of a window, :mod:`recon.slabs` with some rows at a time of a volume larger than memory.

    Args:
        geometry: parallel, fan or cone beam.
        grids: voxels to reconstruct; each reads the same filtered data.
        kernel: reconstruction kernel, or several.
        weights: ``(views, 1)`` or ``(views, columns)`` rad; None:
            :func:`recon.analytic.angular_weights.angular_weights`.
        motion: displacement of the grids in every view, see
            :func:`~recon.analytic.backproject.backproject`.
        sides: whether the rows end inside the object at the first and at the last column, and are
            continued there by cylinders of ``outside`` (mm⁻¹).
        window: the readings that are filtered, of rows that need no completion; None: the
            footprint of the grids on the completed rows.

    Attributes:
        completed: geometry of the completed rows.
        window: the readings of ``completed`` that are filtered.
        backprojections: of each grid.
    """

    def __init__(
        self,
        geometry: Geometry,
        grids: Sequence[VolumeGrid],
        kernel: str | Sequence[str] = "standard",
        *,
        weights: NDArray[np.float64] | None = None,
        motion: Any = None,
        sides: tuple[bool, bool] = (False, False),
        outside: float = 0.0,
        window: DetectorWindow | None = None,
    ) -> None:
        self.geometry, self.grids, self.kernel = beam(geometry), tuple(grids), kernel
        self._sides, self._outside, self._whole_rows = sides, outside, window is None
        path = _plain(motion)
        self._travel = 0.0 if path is None else float(np.hypot(*path[:, -2:].T).max())
        # What a grid needs of an offset detector's short scan is not known of several at once.
        only = self.grids[0] if len(self.grids) == 1 else None
        self.weights = angular_weights(geometry, only) if weights is None else weights
        shape_only = self.complete(torch.empty(geometry.shape, device="meta"))
        self.completed, self._completed_weights = shape_only.geometry, shape_only.weights
        self.window = (
            DetectorWindow.union(
                [_footprint_or_all(self.completed, grid, path) for grid in self.grids],
                self.completed.columns,
            )
            if window is None
            else window
        )
        self.backprojections = [
            BackprojectionPlan(self.completed, grid, self.window, motion) for grid in self.grids
        ]

    def complete(self, lines: Tensor, geometry: Beam | None = None) -> Rows:
        """Rows that end inside the object continued, those of an offset detector with zeros on the
        short side.

        Args:
            lines: ``(..., views, [rows,] columns)``.
            geometry: of a cone beam's lines that hold some of the rows; None: they hold all.
        """
        rows = Rows(lines, geometry or self.geometry, self.weights)
        if any(self._sides):
            rows = continued(rows, self._sides, self._outside)
        if self._whole_rows:
            for grid in self.grids:
                rows = mirrored(rows, grid, self._travel)
        return rows

    def filtered(
        self,
        lines: Tensor,
        held: DetectorWindow | None = None,
        rows: tuple[int, int] | None = None,
    ) -> Tensor:
        """Completed rows, weighted and filtered, ``([kernels,] ..., views, [rows,] columns)``.

        Args:
            lines: ``(..., views, [rows,] columns)``.
            held: the readings of the completed detector that ``lines`` holds; None: all.
            rows: the first of the detector's rows that are wanted, and the one after the last;
                None: those of the window.
        """
        window = self.window if rows is None else self.window.with_rows(rows[0], rows[1] - rows[0])
        return filter_sinogram(
            lines, self.completed, self.kernel, window, held=held, weights=self._completed_weights
        )

    def filtered_static(self, cells: Tensor) -> Tensor:
        """:meth:`filtered` of readings ``(..., rows, columns)`` that are the same in every view."""
        weights = self._completed_weights
        if not np.allclose(weights, weights[0, 0], rtol=1e-6, atol=0):
            views = (*cells.shape[:-2], *self.completed.shape)
            return self.filtered(cells.unsqueeze(-3).expand(views))
        one_view = self.completed.select([0])
        filtered = filter_sinogram(
            cells.unsqueeze(-3), one_view, self.kernel, weights=weights[:1, :1]
        )
        return self.window.take(filtered.squeeze(-3))

    def backprojected(self, filtered: Tensor) -> list[Tensor]:
        """The volumes on every grid, ``([kernels,] ..., *grid.shape)`` mm⁻¹."""
        return [backprojection(filtered) for backprojection in self.backprojections]

    def __call__(self, lines: Tensor) -> list[Tensor]:
        """:meth:`backprojected` of line integrals of the whole detector."""
        rows = self.complete(lines).lines
        if rows.device.type != "cpu":
            require_room(self._bytes(rows), rows.device, "FBP")
        return self.backprojected(self.filtered(rows))

    def _bytes(self, lines: Tensor) -> int:
        """Largest memory of :meth:`__call__` on a device, besides the completed rows ``lines``."""
        axes = len(self.completed.shape)
        batch = math.prod(lines.shape[:-axes]) * len(kernel_names(self.kernel)[0])
        # Filtered readings and a copy with the rows innermost; volumes, the last in both orders.
        numbers = 2 * math.prod(self.window.shape)
        numbers += sum(grid.voxels for grid in self.grids) + max(g.voxels for g in self.grids)
        return batch * lines.element_size() * numbers + 4 * CHUNK_BYTES


class Fbp(nn.Module):
    """:func:`fbp` of one geometry on one grid as a layer of a network, without parameters of its
    own.

    Shape: ``(..., views, [rows,] columns)`` → ``(..., *grid.shape)``: axes of batch and channel go
        through. float32 or float64; float16 and bfloat16, as autocast leaves them, are computed and
        returned in float32.

    Args:
        geometry: parallel, fan or cone beam.
        grid: ``(y, x)`` or ``(z, y, x)``.
        kernel: reconstruction kernel.
        motion: of :func:`fbp`. Of a tensor that requires a gradient images have one, of first
            order; its values are read at every pass, so that an optimiser may change them, and an
            ``nn.Parameter`` is one of the layer's.
    """

    def __init__(
        self,
        geometry: Geometry,
        grid: VolumeGrid,
        kernel: str = "standard",
        *,
        motion: object = None,
    ) -> None:
        super().__init__()
        self.geometry, self.grid, self.kernel, self.motion = geometry, grid, kernel, motion
        self._enter()

    def _enter(self) -> None:
        global _apart
        if is_free(self.motion) and _apart is None:
            _apart = torch.compiler.disable(Fbp._computed)
        self._handle = next(_HANDLES)
        _LAYERS[self._handle] = self

    def __setstate__(self, state: dict[str, object]) -> None:
        """Of a copy, or in another process: a handle of its own."""
        super().__setstate__(state)
        self._enter()

    def forward(self, sinogram: Tensor) -> Tensor:
        if is_free(self.motion):
            return (_apart or Fbp._computed)(self, sinogram)
        if torch.compiler.is_compiling():
            return cast(Tensor, _traced(sinogram, self._handle))
        return self._computed(sinogram)

    def _computed(self, sinogram: Tensor) -> Tensor:
        narrow = isinstance(sinogram, Tensor) and sinogram.dtype in (torch.float16, torch.bfloat16)
        lines = sinogram.float() if narrow else sinogram
        return fbp(lines, self.geometry, self.grid, self.kernel, motion=self.motion)

    def extra_repr(self) -> str:
        return (
            f"{type(self.geometry).__name__}, {self.geometry.shape} -> {self.grid.shape}, "
            f"{self.kernel}"
        )


# To torch.compile and torch.export a layer is one operation, as a pass of the projector is: they
# cannot look into numba kernels. A traced graph holds the handle of its layer.
_LAYERS: weakref.WeakValueDictionary[int, Fbp] = weakref.WeakValueDictionary()
"""Layers by their handles."""
_HANDLES = itertools.count()
"""Those that were given out."""
_apart: Callable[[Fbp, Tensor], Tensor] | None = None
"""What traced graphs leave out: one operation of them knows no gradient by the motion. Made with
the first layer that has such a motion, as it loads torch's compiler, a second of work."""


@torch.library.custom_op(
    "torchpcct::fbp", mutates_args=(), schema="(Tensor sinogram, int layer) -> Tensor"
)
def _traced(sinogram: Tensor, layer: int) -> Tensor:
    return _LAYERS[layer]._computed(sinogram)


@_traced.register_fake
def _shape(sinogram: Tensor, layer: int) -> Tensor:
    of = _LAYERS[layer]
    narrow = sinogram.dtype in (torch.float16, torch.bfloat16)
    lead = sinogram.shape[: sinogram.dim() - len(of.geometry.shape)]
    return sinogram.new_empty(
        (*lead, *of.grid.shape), dtype=torch.float32 if narrow else sinogram.dtype
    )


@torch.library.custom_op(
    "torchpcct::fbp_gradient",
    mutates_args=(),
    schema="(Tensor sinogram, Tensor gradient, int layer) -> Tensor",
)
def _traced_gradient(sinogram: Tensor, gradient: Tensor, layer: int) -> Tensor:
    def compute() -> Tensor:
        given = sinogram.detach().requires_grad_()
        return torch.autograd.grad(_LAYERS[layer]._computed(given), given, gradient)[0]

    # Inside of an operation torch records no graph; another thread knows nothing of it.
    with ThreadPoolExecutor(1) as other:
        return other.submit(compute).result()


@_traced_gradient.register_fake
def _gradient_shape(sinogram: Tensor, gradient: Tensor, layer: int) -> Tensor:
    return torch.empty_like(sinogram)


class _LayerContext(Protocol):
    """What a traced layer keeps for its derivative."""

    layer: int
    saved_tensors: tuple[Tensor, ...]

    def save_for_backward(self, *tensors: Tensor) -> None: ...


def _keep(ctx: _LayerContext, inputs: tuple[Tensor, int], output: Tensor) -> None:
    sinogram, ctx.layer = inputs
    ctx.save_for_backward(sinogram)


def _back(ctx: _LayerContext, gradient: Tensor) -> tuple[Tensor, None]:
    return _traced_gradient(*ctx.saved_tensors, gradient, ctx.layer), None


_traced.register_autograd(_back, setup_context=_keep)


_SIDES = ("first", "last")
"""Ends of a row, in words."""


def _transformed() -> bool:
    """Whether values cannot be looked at: inside ``torch.func`` transforms the data may stand
    for a whole batch."""
    return torch._C._functorch.maybe_current_level() is not None


def _without_dead(sinogram: Tensor, geometry: Geometry) -> Tensor:
    if (
        _transformed()
        or not sinogram.numel()
        or all(map(math.isfinite, torch.aminmax(sinogram.detach())))
    ):
        return sinogram
    dead = ~torch.isfinite(sinogram.detach())
    warnings.warn(
        f"{int(dead.sum())} of {dead.numel()} readings are NaN or Inf: they are taken for dead and "
        "interpolated from their neighbours",
        UserWarning,
        stacklevel=4,
    )
    return interpolate_dead(sinogram, dead, geometry.has_rows)


def _cut_sides(
    lines: Tensor, geometry: Beam, weights: NDArray[np.float64], outside: float | None
) -> tuple[bool, bool]:
    """Where the rows end inside the object, as far as anything is to be done about it; a warning
    where the exterior is not known."""
    if outside is not None and number("outside", outside, low=0.0, unit="mm⁻¹") == 0:
        return False, False
    if not lines.numel() or _transformed():
        return False, False
    sides = cut_off(lines, geometry, weights)
    if any(sides) and outside is None:
        warnings.warn(
            "the rows end inside the object at the "
            f"{' and the '.join(_SIDES[i] for i in (0, 1) if sides[i])} column: CT numbers "
            "will be wrong, most near the edge of the field of view; pass outside= the "
            "attenuation in mm⁻¹ of what lies beyond (0 to do without)",
            UserWarning,
            stacklevel=4,
        )
    return sides


def _plain(motion: object) -> NDArray[np.float64] | None:
    """A motion as numbers, of a tensor that requires a gradient, too."""
    if motion is None:
        return None
    if isinstance(motion, Tensor):
        motion = motion.detach().cpu().numpy()
    return np.asarray(motion, dtype=np.float64)


def _footprint_or_all(geometry: Geometry, grid: VolumeGrid, motion: object) -> DetectorWindow:
    try:
        return footprint(geometry, grid, margin=1, motion=motion)
    except ValueError:
        # a grid larger than the field of view: the backprojection decides
        return DetectorWindow.full(geometry)
