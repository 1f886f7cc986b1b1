"""Geometry of a scan from the object itself: detector offset, axis and roll, with errors.

Variable projection (Golub and Pereyra 1973, SIAM J. Numer. Anal. 10:413): whatever the geometry,
the volume is the one that the readings then give, and what it leaves of them is made small. A
volume explains a part of what another geometry would do to the readings; what it cannot explain is
all that they say about the geometry. With r = P(θ) y what is left of the readings, and P J what is
left of their derivatives J by the geometry's numbers, Gauss and Newton's step is
(JᵀPᵀ M P J)⁻¹ JᵀPᵀ M r.

P = (I − A F)ᵏ: projections of the filtered backprojection F are taken off, again and again. Both
sides are smoothed over neighbouring cells before they are compared, M = Gᵀ W G: an edge between
voxels is nothing that a volume of voxels can explain, and no error of the geometry either.

A tilt of a detector, and the distances, are hardly in the readings: a volume that is stretched
along z in proportion to its height, or larger as a whole, casts the same shadows. Such numbers are
refused, by the share of their effect that no volume explains.
"""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.analytic.fbp import fbp
from recon.variable_projection import (
    normal_equations,
    products,
    smoothed_cells,
    unexplained,
)
from torchpcct.checks.defects import repair_defects
from torchpcct.geometry import Geometry, VolumeGrid
from torchpcct.projector.posed import PosedEngine
from torchpcct.projector.poses import with_parameters
from torchpcct.scan import Scan
from torchpcct.validate import checked, choice

if TYPE_CHECKING:
    from torchpcct.projector.poses import ParametricGeometry
    from torchpcct.typing import JsonObject

__all__ = ["FREE", "Calibration", "calibrate"]

_LOG = logging.getLogger(__name__)
Floats = NDArray[np.float64]

FREE: Mapping[str, str] = {
    "offset": "mm",
    "axis": "mm",
    "row_offset": "mm",
    "sdd": "mm",
    "roll": "°",
    "tilt": "°",
    "slant": "°",
}
"""Parameters that :func:`calibrate` can free, and the unit in which it states them (of a scan that
does not know the size of its cells lengths are in pixels)."""
_TIMES = 4
"""How often what a volume explains is taken off, beside the first time: of a first approximation a
cone beam's offset is 0.7 columns off, of the second 0.17, of the third 0.08 (48 rows, ±11°)."""
_LEAST_SHARE = 0.05
"""Of a number's effect on the readings that no volume explains, below which it is refused."""
_LARGEST_COLUMNS = 1.0
"""Standard error in columns from which on a shift is not determined, and the largest step of an
iteration."""
_LARGEST_DEGREES = 2.0
"""The same of a turn, in degrees."""
_LARGEST_PART = 0.03
"""The same of sdd, as a part of it."""
_STEPS = 8
"""Most iterations."""
_ALIKE = 0.95
"""Correlation of two numbers' effects from which on one may stand for the other."""
_NEAR = 0.1
"""Step, over the largest, below which the effects of the numbers are not computed again."""
_MISFIT = 2.0
"""Times the noise, from which on what is left of the readings is worth a warning."""
_SETTLED = 0.1
"""Part of its standard error by which a number still changes in the last step."""


@dataclass(frozen=True)
class Calibration:
    """Result of :func:`calibrate`.

    Attributes:
        geometry: the scan's, with the parameters that were found;
            ``torchpcct.formats.geometry_yaml`` writes it to a file.
        values: what was found by name: lengths in mm, angles in degrees, with the signs of
            :func:`torchpcct.projector.with_parameters` (which takes angles in rad).
        errors: their standard errors, in the same units.
        shares: of each parameter's effect on the readings, the part that no volume explains, 0…1.
        correlation: of the parameters' errors, ``(parameters, parameters)`` in the order of
            ``values``.
        misfit: residual of the smoothed readings over their noise, root mean square, before and
            after; near or below 1 if the geometry is right.
        steps: iterations done.
        warnings: reasons to distrust the result; empty if there are none.
        lengths: unit of the lengths, "mm", or "pixels" of a scan that does not know the size of its
            cells.
    """

    geometry: Geometry
    values: dict[str, float]
    errors: dict[str, float]
    shares: dict[str, float]
    correlation: list[list[float]]
    misfit: tuple[float, float]
    steps: int
    warnings: list[str] = field(default_factory=list)
    lengths: str = "mm"

    def __str__(self) -> str:
        return "\n".join(
            f"{name:<10} {value:+.4g} ± {self.errors[name]:.2g} {_unit(name, self.lengths)}"
            for name, value in self.values.items()
        )

    def report(self) -> JsonObject:
        """Values, errors, units and all other figures as a mapping, for JSON."""
        return {
            "values": self.values,
            "errors": self.errors,
            "units": {name: _unit(name, self.lengths) for name in self.values},
            "shares": self.shares,
            "correlation": self.correlation,
            "misfit": list(self.misfit),
            "steps": self.steps,
            "warnings": self.warnings,
        }


@checked
def calibrate(
    scan: Scan,
    grid: VolumeGrid,
    free: Sequence[str] | None = None,
    *,
    progress: Callable[[float], None] | None = None,
) -> Calibration:
    """Estimate parameters of a scan's geometry from the readings of the object itself.

    Needs the whole object in all views, and a grid that holds it; voxels of about a cell as it is
    seen at the axis, or larger. The standard errors follow from the readings' noise; where the
    residual exceeds that noise, they are larger by the same factor. The method is variable
    projection (Golub and Pereyra 1973, SIAM J. Numer. Anal. 10:413), see
    :mod:`recon.calibration`.

    Args:
        scan: counting or energy integrating, without energy bins, on the whole detector, which is
            flat; of several slices the middle one is used.
        grid: ``(z, y, x)``, of slices ``(y, x)``.
        free: names of the parameters to find, of :data:`FREE`; what is not named stays. None:
            ``offset``, with rows also ``roll``. ``offset`` is the detector's column offset,
            ``axis`` the distance of the rotation axis from the line through the source
            perpendicular to the detector: both put the axis elsewhere on the detector, and only a
            fan tells them apart.
        progress: called with the finished fraction, 0…1.

    Returns:
        A :class:`Calibration`: the corrected geometry, values and standard errors (mm, of a scan
        that does not know the size of its cells pixels, and degrees).

    Raises:
        ValueError: an unknown parameter, one that the readings do not determine (the message says
            why, and what to leave out), an estimate that does not converge, a scan with energy bins
            or of a part of the detector, a curved detector, a grid that does not fit.
        TypeError: no :class:`torchpcct.Scan`.

    Example:
        >>> import numpy as np, torch
        >>> from torchpcct import FanBeam, Projector, Scan, VolumeGrid, full_turn
        >>> fan = FanBeam(full_turn(40), 40.0, 60.0, 48, 0.4)
        >>> grid = VolumeGrid((32, 32), 0.3)
        >>> y, x = np.meshgrid(*grid.axes, indexing="ij")
        >>> body = torch.from_numpy(0.05 * (np.hypot(x - 0.6, 1.4 * y) < 3.5)).float()
        >>> lines = Projector(fan.with_column_offset(0.2), grid)(body)
        >>> scan = Scan.from_line_integrals(lines, fan, photons=1e5, mu_water=0.02)
        >>> found = calibrate(scan, grid, ["offset"])
        >>> abs(found.values["offset"] - 0.2) < 0.02
        True
    """
    if not isinstance(scan, Scan):
        raise TypeError(f"scan must be a Scan, got {type(scan).__name__}")
    names = _names(scan, free)
    problem = _CalibrationProblem(scan, grid, names)
    tell = progress or (lambda _: None)
    values = problem.start()
    before = 0.0
    texts: list[str] = []
    effects: Tensor | None = None
    for step in range(1, _STEPS + 1):
        now = problem.at(values, effects)
        if step == 1:
            before = now.misfit
            problem.require_determined(now)
        change = now.step
        largest = float(np.max(np.abs(change) / problem.limits))
        values = values + change / max(1.0, largest)
        # Effects are those of a volume that blurs as the geometry is wrong.
        effects = now.effects if largest < _NEAR else None
        tell(step / (_STEPS + 2))
        if np.all(np.abs(change) <= _SETTLED * now.errors):
            break
    else:
        moved = ", ".join(f"{n} by {c:.2g} {u}" for n, c, u in problem.stated(change))
        raise ValueError(
            f"calibration did not converge: the last of {_STEPS} steps still changed {moved}. Free "
            "fewer parameters, or start from a more accurate geometry (the warnings of torchpcct "
            "reconstruct say what contradicts the one given)"
        )
    now = problem.at(values, now.effects, errors=True)
    tell(1.0)
    scale = max(1.0, now.misfit)
    if now.misfit > _MISFIT:
        texts.append(
            f"what the volume leaves of the readings is {now.misfit:.1f} times their noise: the "
            "object may reach beyond the grid or the detector, have moved, or the geometry have "
            "errors that were not freed; the errors stated are larger by as much"
        )
    for text in texts:
        _LOG.warning("%s", text)
    errors = now.errors * scale
    inverse = np.linalg.inv(now.information)
    spread = np.sqrt(np.diag(inverse))
    return Calibration(
        problem.scan_of(values).settled(),
        {n: v for n, v, _ in problem.stated(values)},
        {n: v for n, v, _ in problem.stated(errors)},
        dict(zip(names, now.shares.tolist(), strict=True)),
        (inverse / np.outer(spread, spread)).tolist(),
        (before, now.misfit),
        step,
        texts,
        problem.lengths,
    )


def _unit(name: str, lengths: str) -> str:
    """In which a parameter is stated."""
    return lengths if FREE[name] == "mm" else FREE[name]


def _names(scan: Scan, free: Sequence[str] | None) -> list[str]:
    rows = scan.geometry.has_rows
    if free is None:
        return ["offset", "roll"] if rows else ["offset"]
    names = [free] if isinstance(free, str) else list(free)
    if not names:
        raise ValueError(f"free is empty: name what to estimate, of {', '.join(FREE)}")
    for name in names:
        if name in ("sod", "pitch"):
            raise ValueError(
                f"{name} is not determined by an object of unknown size: with another {name} the "
                "same readings are those of a larger or smaller object; measure it, or scan "
                "something of known size"
            )
        choice("free", name, tuple(FREE))
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ValueError(f"free names {', '.join(twice)} twice")
    return names


@dataclass(frozen=True)
class _State:
    """What the readings say at some values.

    Attributes:
        step: to the values that fit better.
        errors: standard errors from the readings' noise.
        shares: of the numbers' effects, what no volume explains.
        information: the matrix of Gauss and Newton, without unit.
        misfit: of the smoothed readings, over their noise.
        effects: of the numbers on the readings, and what no volume explains of them.
    """

    effects: Tensor
    step: Floats
    errors: Floats
    shares: Floats
    information: Floats
    misfit: float


class _CalibrationProblem:
    """The readings of a scan, and what volumes on a grid leave of them."""

    def __init__(self, scan: Scan, grid: VolumeGrid, names: list[str]) -> None:
        geometry = scan.geometry
        if scan.window is not None:
            raise ValueError(
                "calibration needs the whole detector, and this scan keeps a window of it: acquire "
                "it without region="
            )
        if getattr(geometry, "detector", "flat") == "curved":
            raise ValueError(
                "calibration works for flat detectors only, this one is curved: measure its "
                "position with a phantom"
            )
        with_parameters(geometry, **{n: torch.zeros((), dtype=torch.float64) for n in names})
        scan, _ = repair_defects(scan)
        lines, weights = scan.line_integrals(), scan.weights()
        axes = len(geometry.shape)
        if lines.dim() == axes + 1 and axes == 2:
            lines, weights = (v[v.shape[0] // 2] for v in (lines, weights))
            grid = grid.slice
        if lines.dim() != axes:
            raise ValueError(
                "calibration needs one channel: sum the energy bins with weights before, "
                "scan.weighted(bin_weights(scanner, …))"
            )
        self.base, self.grid, self.names = geometry, grid, names
        self.lengths = "pixels" if scan.unit == "pixel^-1" else "mm"
        self.lines, self.weights = lines.float(), weights.float()
        self.cells = axes - 1
        # Of steps and errors: mm of a column, rad of degrees, a part of a distance.
        largest = {n: _LARGEST_COLUMNS * geometry.column_pitch for n in FREE}
        largest["sdd"] = _LARGEST_PART * getattr(geometry, "sdd", 1.0)
        turns = {n: math.radians(_LARGEST_DEGREES) for n, unit in FREE.items() if unit == "°"}
        self.limits = np.array([{**largest, **turns}[n] for n in names])

    def start(self) -> Floats:
        own = {
            "offset": self.base.column_offset,
            "row_offset": self.base.row_offset,
            "sdd": getattr(self.base, "sdd", 0.0),
        }
        return np.array([own.get(n, 0.0) for n in self.names])

    def stated(self, values: Floats) -> list[tuple[str, float, str]]:
        """Name, number in the unit in which it is stated, and the unit."""
        return [
            (n, float(math.degrees(v) if FREE[n] == "°" else v), _unit(n, self.lengths))
            for n, v in zip(self.names, values, strict=True)
        ]

    def scan_of(self, values: Floats) -> ParametricGeometry:
        return with_parameters(
            self.base,
            **{
                n: torch.tensor(float(v), dtype=torch.float64)
                for n, v in zip(self.names, values, strict=True)
            },
        )

    def _tangents(self, values: Floats) -> Tensor:
        """Changes of the poses with each number, ``(numbers, views, 4, 3)``."""

        def poses(numbers: Tensor) -> Tensor:
            given = dict(zip(self.names, numbers.unbind(), strict=True))
            return with_parameters(self.base, **given).poses()

        at = torch.tensor(values)
        return torch.autograd.functional.jacobian(poses, at, vectorize=False).movedim(-1, 0)

    def at(self, values: Floats, effects: Tensor | None = None, errors: bool = False) -> _State:
        """What the readings say there.

        Args:
            effects: of another state nearby, which are not computed again.
            errors: those of the noise that no volume explains, instead of all noise.
        """
        scan = self.scan_of(values)
        engine = PosedEngine(scan, self.grid)
        geometry = scan.settled()

        def volume(lines: Tensor, kernel: str) -> Tensor:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                return fbp(lines, geometry, self.grid, kernel, outside=0.0)

        def left(lines: Tensor) -> Tensor:
            return unexplained(
                lines,
                lambda v: volume(v, "ram-lak"),
                lambda v: engine.apply(v, False),
                _TIMES + 1,
            )

        w, rest = self.weights, self.lines[None]
        if effects is None:
            # Of a smoother volume: its noise must not be taken for edges that move.
            plain = engine.derivatives(volume(self.lines, "soft"), self._tangents(values))
            both = left(torch.cat([plain, rest]))
            effects, rest = smoothed_cells(torch.stack([plain, both[:-1]]), self.cells), both[-1:]
        else:
            rest = left(rest)
        plain, own, rest = effects[0], effects[1], smoothed_cells(rest, self.cells)
        # of the noise, a volume has explained a part
        found = normal_equations(own, rest, w, self.cells, left if errors else None)
        information = found.information
        shares = np.diag(information) / np.maximum(np.diag(products(plain * w, plain)), 1e-300)
        scaled = np.sqrt(np.maximum(np.diag(information), 1e-300))
        # In units of each number's own error: what is singular is singular whatever the unit.
        unit = information / np.outer(scaled, scaled)
        inverse = np.linalg.pinv(unit, rcond=1e-8, hermitian=True) / np.outer(scaled, scaled)
        step = inverse @ found.pull
        noise = inverse @ found.spread @ inverse
        spread = np.sqrt(np.maximum(np.diag(noise), 0.0))
        if np.linalg.matrix_rank(unit, tol=1e-6, hermitian=True) < len(unit):
            spread = np.full(len(unit), math.inf)
        return _State(effects, step, spread, shares, information, found.misfit)

    def require_determined(self, state: _State) -> None:
        """Refuse numbers that the readings do not determine (ValueError)."""
        for name, share in zip(self.names, state.shares, strict=True):
            if not share >= _LEAST_SHARE:
                raise ValueError(
                    f"{name} is not determined by this object: a change of the volume has the same "
                    f"effect on all but {100 * share:.2g} % of the readings. Leave it out of free, "
                    "or measure it with a phantom of known shape"
                )
        wide = [
            n for n, e, m in zip(self.names, state.errors, self.limits, strict=True) if not e <= m
        ]
        if not wide:
            return
        size = np.sqrt(np.diag(state.information))
        alike = np.abs(state.information / np.outer(size, size)) > _ALIKE
        bound = [n for k, n in enumerate(self.names) if alike[k].sum() > 1]
        if bound:
            raise ValueError(
                f"{' and '.join(bound)} cannot be distinguished in these readings: their effects "
                f"are nearly equal. Leave {bound[-1]} out of free"
            )
        raise ValueError(
            f"{' and '.join(wide)} cannot be determined from these readings: the standard error "
            "would exceed a column, 2° or 3 % of sdd. Leave it out of free, or scan with more "
            "photons"
        )
