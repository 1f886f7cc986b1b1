"""The figure of the conventions page, drawn from what the package computes, so that the two
cannot disagree."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from torchpcct import ConeBeam, VolumeGrid
from torchpcct.vector_geometry import VectorGeometry


def draw(path: Path) -> None:
    """The plane z = 0 seen from +z, and the side view of the same ray fan; an SVG file."""
    g = ConeBeam([np.deg2rad(35.0)], 60.0, 100.0, 9, 5, (8.0, 8.0), offset=(4.0, 6.0))
    source, middle, u, _ = VectorGeometry.of(g).vectors[0].reshape(4, 3)
    foot = source * (1 - g.sdd / g.sod)  # where the central ray meets the detector
    columns = middle + (np.arange(9)[:, None] - 4) * u
    figure = Figure(figsize=(10.5, 5.6), layout="constrained")
    ax, side = figure.subplots(1, 2, width_ratios=(1.25, 1))

    def arrow(axes, start, end, text, colour="black", shift=(2, 2)):
        axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.6})
        axes.text(end[0] + shift[0], end[1] + shift[1], text, color=colour, fontsize=10)

    turn = np.linspace(0, 2 * np.pi, 200)
    ax.plot(g.sod * np.cos(turn), g.sod * np.sin(turn), color="0.8", lw=0.8)
    for axis in VolumeGrid((6, 6), 6.0).axes[:1]:
        edges = [axis[0] - 3, *(axis + 3)]
        ax.vlines(edges, -18, 18, color="0.85", lw=0.8)
        ax.hlines(edges, -18, 18, color="0.85", lw=0.8)
        ax.plot(*[a.ravel() for a in np.meshgrid(axis, axis)], ".", color="0.6", ms=3)
    ax.plot(*np.stack([source, columns[0]])[:, :2].T, color="tab:orange", lw=0.8)
    ax.plot(*np.stack([source, columns[-1]])[:, :2].T, color="tab:orange", lw=0.8)
    ax.plot(*np.stack([source, foot])[:, :2].T, color="tab:orange", lw=0.8, ls="--")
    ax.plot(*columns[:, :2].T, "s", color="tab:blue", ms=5)
    ax.plot(*source[:2], "o", color="tab:orange", ms=9)
    ax.text(
        *np.add(source[:2], (-3, 6)), "source, at sod · e_r(β)", color="tab:orange", ha="center"
    )
    for j, name in ((0, "column 0"), (8, "column n − 1")):
        ax.text(
            *np.add(columns[j, :2], (-4, -7 if j == 0 else 3)),
            name,
            color="tab:blue",
            ha="right",
            fontsize=9,
        )
    arrow(ax, foot[:2], middle[:2], "", "tab:red")
    ax.text(
        *np.add(middle[:2], (-6, 2)),
        "offset\n(column)",
        color="tab:red",
        fontsize=9,
        ha="right",
        va="center",
    )
    start = columns[1, :2] - 10 * source[:2] / g.sod
    arrow(ax, start, start + 22 * u[:2] / 8, "", "tab:blue")
    ax.text(
        *np.add(start, (-11, 0)),
        "columns grow\nalong e_t(β)",
        color="tab:blue",
        fontsize=9,
        ha="right",
    )
    arrow(ax, (0, 0), (28, 0), "x", shift=(1, -5))
    arrow(ax, (0, 0), (0, 28), "y")
    arc = np.linspace(0, g.angles[0], 30)
    ax.plot(14 * np.cos(arc), 14 * np.sin(arc), color="black", lw=1)
    ax.text(15.5, 3.5, "β", fontsize=12)
    ax.text(
        73,
        -66,
        "voxel centres (grey): index k of n stands\nat (k − (n − 1)/2) · spacing + center",
        ha="right",
        va="bottom",
        color="0.35",
        fontsize=9,
    )
    ax.set(
        title="seen from +z: β grows counter-clockwise",
        xlabel="x, mm",
        ylabel="y, mm",
        aspect="equal",
        xlim=(-75, 75),
        ylim=(-68, 68),
    )

    rows = g.row_positions
    side.plot([0, g.sdd], [0, 0], color="tab:orange", ls="--", lw=0.8)
    for z in rows[[0, -1]]:
        side.plot([0, g.sdd], [0, z], color="tab:orange", lw=0.8)
    side.plot(np.full(5, g.sdd), rows, "s", color="tab:blue", ms=5)
    side.plot(0, 0, "o", color="tab:orange", ms=9)
    side.plot([g.sod, g.sod], [-30, 30], color="black", lw=1)
    side.text(g.sod, 31, "rotation axis", ha="center")
    side.text(g.sdd + 2, rows[0], "row 0", color="tab:blue", va="center", fontsize=9)
    side.text(g.sdd + 2, rows[-1], "row n − 1", color="tab:blue", va="center", fontsize=9)
    arrow(side, (g.sdd, 0), (g.sdd, g.offset[0]), "", "tab:red")
    side.text(g.sdd - 2, 6.5, "offset (row)", color="tab:red", fontsize=9, ha="right")
    arrow(side, (0, -8), (0, 14), "z", shift=(1, 1))
    for length, height, name in ((g.sod, -38, "sod"), (g.sdd, -46, "sdd")):
        side.annotate("", (length, height), (0, height), arrowprops={"arrowstyle": "<|-|>"})
        side.text(length / 2, height + 1.5, name, ha="center")
    side.set(
        title="seen from the side: rows grow along +z",
        xlabel="distance from the source, mm",
        ylabel="z, mm",
        xlim=(-6, 128),
        ylim=(-52, 40),
    )
    figure.savefig(path, metadata={"Date": None})
