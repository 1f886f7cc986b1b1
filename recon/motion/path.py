"""The path of an inset: what an estimate gives, and as a table and a picture."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torchpcct.typing import Floats, JsonObject

__all__ = ["TABLE_HEADER", "InsetMotion", "Jump", "PathTooLongError", "path_figure", "path_table"]

TABLE_HEADER = ("view", "z_mm", "y_mm", "x_mm", "z_error_mm", "y_error_mm", "x_error_mm")
"""Columns of :func:`path_table`."""

_AXES = ("z", "y", "x")
"""In the order of a path."""


class PathTooLongError(ValueError):
    """The inset moves further than is looked for, or too little of it can be seen to tell."""


@dataclass(frozen=True)
class Jump:
    """A displacement at once.

    Attributes:
        view: first view of the scan after it.
        mm: ``(3,)`` z, y, x.
        errors: ``(3,)`` standard errors.
    """

    view: int
    mm: Floats
    errors: Floats

    @property
    def length(self) -> float:
        """Of the displacement, mm."""
        return float(np.linalg.norm(self.mm))

    @property
    def error(self) -> float:
        """Standard error of :attr:`length`."""
        return float(np.linalg.norm(self.mm * self.errors)) / max(self.length, 1e-12)

    def report(self) -> JsonObject:
        """All numbers, for JSON."""
        return {
            "view": self.view,
            "mm": np.round(self.mm, 4).tolist(),
            "errors_mm": np.round(self.errors, 4).tolist(),
        }


@dataclass(frozen=True)
class InsetMotion:
    """Result of :func:`estimate_motion`.

    Attributes:
        path: ``(views, 3)`` z, y, x mm, displacement of the inset in every view of the scan, of
            mean zero; zeros if no motion is held.
        errors: ``(views, 3)`` standard errors of the path that was found, applied or not.
        held: whether the readings hold a motion.
        evidence: logarithm of the marginal likelihood of the motion over that of rest.
        rms_mm: root mean square displacement of the path that was found, applied or not.
        misfit: what is left of the smoothed readings over their noise, root mean square, at rest
            and along ``path``.
        steps: iterations done.
        warnings: what restrains trust in the result.
        jump: that the path has, if the readings hold one; None: the path is smooth.
    """

    path: Floats
    errors: Floats
    held: bool
    evidence: float
    rms_mm: float
    misfit: tuple[float, float]
    steps: int
    warnings: list[str] = field(default_factory=list)
    jump: Jump | None = None

    def report(self) -> JsonObject:
        """All numbers, for JSON."""
        return {
            "held": self.held,
            "rms_mm": self.rms_mm,
            "evidence": self.evidence,
            "misfit": list(self.misfit),
            "steps": self.steps,
            "path_mm": np.round(self.path, 4).tolist(),
            "errors_mm": np.round(self.errors, 4).tolist()
            if np.isfinite(self.errors).all()
            else None,
            "jump": None if self.jump is None else self.jump.report(),
        }


def path_table(motion: JsonObject) -> str:
    """The displacement in every view with its standard errors, as CSV.

    Args:
        motion: :meth:`recon.motion.InsetMotion.report`, which is ``volume.report["motion"]``.

    Returns:
        A line of :data:`TABLE_HEADER` and one for every view; errors that are unknown are empty.

    Raises:
        ValueError: a report without a path.
    """
    path, errors = _read(motion)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(TABLE_HEADER)
    for view, place in enumerate(path.tolist()):
        writer.writerow([view, *place, *(["", "", ""] if errors is None else errors[view])])
    return text.getvalue()


def path_figure(motion: JsonObject) -> Figure:
    """The displacement along every axis over the views, with two standard errors either way, and a
    line where the inset jumps.

    Args:
        motion: as for :func:`path_table`.

    Returns:
        ``matplotlib.figure.Figure``; save it with ``figure.savefig(path)``.

    Raises:
        ValueError: a report without a path.
    """
    from matplotlib.figure import Figure

    path, errors = _read(motion)
    figure = Figure(figsize=(6.4, 5.2), dpi=130, layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, sharey=True)
    views = np.arange(len(path))
    for k, (ax, name) in enumerate(zip(axes, _AXES, strict=True)):
        ax.plot(views, path[:, k], color="black", lw=1.0)
        if errors is not None:
            low, high = (path[:, k] + sign * 2.0 * errors[:, k] for sign in (-1.0, 1.0))
            ax.fill_between(views, low, high, color="tab:blue", alpha=0.3, lw=0)
        if motion.get("jump"):
            ax.axvline(motion["jump"]["view"] - 0.5, color="tab:red", lw=0.8, ls="--")
        ax.set_ylabel(f"{name}, mm")
        ax.grid(alpha=0.3)
    axes[-1].set_xlabel("view")
    found = "applied" if motion["held"] else "none applied"
    figure.suptitle(
        f"path of the inset, {motion['rms_mm']:.2g} mm root mean square ({found}); band: two "
        "standard errors",
        fontsize=9,
    )
    return figure


def _read(motion: JsonObject) -> tuple[Floats, Floats | None]:
    """Path and errors ``(views, 3)``."""
    if "path_mm" not in motion:
        raise ValueError(
            "this report has no path: give InsetMotion.report(), or volume.report['motion'] of "
            'a volume reconstructed with motion="estimate"'
        )
    path = np.asarray(motion["path_mm"], dtype=np.float64)
    errors = motion.get("errors_mm")
    return path, None if errors is None else np.asarray(errors, dtype=np.float64)
