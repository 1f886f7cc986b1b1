"""The path of an inset as a table and as a picture, from what a volume's report says of it."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torchpcct.typing import Floats, JsonObject

__all__ = ["TABLE_HEADER", "path_figure", "path_table"]

TABLE_HEADER = ("view", "z_mm", "y_mm", "x_mm", "z_error_mm", "y_error_mm", "x_error_mm")
"""Columns of :func:`path_table`."""

_AXES = ("z", "y", "x")
"""In the order of a path."""


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
            "this report holds no path: give InsetMotion.report(), or volume.report['motion'] of "
            'a volume reconstructed with motion="estimate"'
        )
    path = np.asarray(motion["path_mm"], dtype=np.float64)
    errors = motion.get("errors_mm")
    return path, None if errors is None else np.asarray(errors, dtype=np.float64)
