"""The comparison's tables, text and figure."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.study.checks import Check, checks_section
from recon.study.compare.measure import Compared
from recon.study.paper import facts as paper
from recon.study.paper.plaque_scan import REFERENCE_KERNEL, REFERENCE_VOXEL_MM
from recon.study.paper.tables import published, table_checks
from recon.study.report import Report, markdown_table
from recon.study.study import environment
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.roi import sample_axial
from torchpcct.viz import Panel, panels

__all__ = ["build_report"]


def build_report(result: Compared) -> Report:
    """Report of :func:`recon.study.compare.measure.run`: ``report.json``, ``report.md``, ``compare.png``."""
    checks = _checks(result)
    data = {
        "study": "compare",
        **result.as_dict(),
        "checks": [c.as_dict() for c in checks],
        "environment": environment(),
    }
    sections = [
        "# Plaque CNR by FBP and PWLS, beside the paper",
        _intro(result),
        _noise_free_table(result),
        *(_tables(result, name, exposure) for name, exposure in result.settings.doses.items()),
        _noise_table(result),
        _pwls_table(result),
        checks_section(checks, every=False),
        _footer(result),
    ]
    figure = _figure(result)
    return Report("compare", data, "\n\n".join(s for s in sections if s), {"compare.png": figure})


def _intro(result: Compared) -> str:
    s, r = result.settings, result.rois.as_dict()
    return (
        f"{s.realizations} noise realisations per dose (seeds {s.seed}…{s.seed + s.realizations - 1}, the same for "
        f"every method), {s.views} views. Foreground ROI (necrotic core): {r['foreground_pixels']} pixels of "
        f"{r['pixel_mm']} mm, {r['foreground_mm2']:.2f} mm²; background ROI (fibrous tissue): "
        f"{r['background_pixels']} pixels, {r['background_mm2']:.2f} mm². "
        "CNR = (mean_bg − mean_fg) / sqrt(var_bg + var_fg) of the ROI means across "
        "realisations. Square brackets: 95 % interval. “exact”: expectation and SD of FBP without sampling error (one "
        "adjoint pass per ROI). The paper's number follows after “paper”; its tables are for "
        f"{paper.TABLE_EXPOSURE_S:g} s (our inference)."
    )


def _rows(result: Compared) -> list[tuple[str, str]]:
    rows = [("fbp", kernel) for kernel in result.settings.kernels]
    if result.settings.pwls:
        rows.append(("pwls", "q-GGMRF"))
    return rows


def _label(method: str, kernel: str) -> str:
    return f"FBP {kernel}" if method == "fbp" else f"PWLS {kernel}"


def _paper(table: Any, method: str, kernel: str, voxel: float, exposure: float) -> Any:
    """The paper's entry for this setting, or None."""
    return published(table, kernel, voxel, exposure) if method == "fbp" else None


def _noise_free_table(result: Compared) -> str:
    voxels = [REFERENCE_VOXEL_MM, *result.settings.voxels_mm]
    entries = {(e["kernel"], e["voxel_mm"]): e for e in result.noise_free}

    def cell(kernel: str, voxel: float) -> str:
        e = entries.get((kernel, voxel))
        if e is None:
            return "–"
        text = f"{e['foreground_hu']:.1f} / {e['background_hu']:.1f}"
        if (kernel, voxel) == (REFERENCE_KERNEL, REFERENCE_VOXEL_MM):
            p = paper.NOISE_FREE_ROI_HU
            text += f" (paper {p['foreground']:.1f} / {p['background']:.1f})"
        return text

    kernels = list(dict.fromkeys([*result.settings.kernels, REFERENCE_KERNEL]))
    rows = [[f"FBP {k}", *(cell(k, v) for v in voxels)] for k in kernels]
    table = markdown_table(["core / fibrous, HU", *(f"{v:.2f} mm" for v in voxels)], rows)
    return f"## Noise-free ROI means\n\n{table}"


def _tables(result: Compared, name: str, exposure: float) -> str:
    s = result.settings
    header = [*(f"{v:.2f} mm" for v in s.voxels_mm)]
    parts = [f"## {name} dose: {exposure:.2f} s"]
    for roi, title, table in (
        ("foreground", "Core ROI mean (SD), HU", paper.FOREGROUND),
        ("background", "Fibrous ROI mean (SD), HU", paper.BACKGROUND),
    ):

        def moments(method: str, kernel: str, voxel: float, roi: str = roi, table: Any = table) -> str:
            stat = result.find(method, kernel, voxel, exposure)
            if stat is None:
                return "–"
            d = stat.as_dict()[roi]
            low, high = d["mean_interval"]
            text = f"{d['mean_hu']:.1f} [{low:.0f}, {high:.0f}] ({d['sd_hu']:.1f})"
            entry = _paper(table, method, kernel, voxel, exposure)
            return text if entry is None else f"{text} paper {entry[0]:.1f} ({entry[1]:.1f})"

        rows = [[_label(m, k), *(moments(m, k, v) for v in s.voxels_mm)] for m, k in _rows(result)]
        index = 0 if roi == "foreground" else 1
        rows += [[f"FBP {k}, exact", *(_exact(result, k, v, exposure, index) for v in s.voxels_mm)] for k in s.kernels]
        parts.append(markdown_table([title, *header], rows))

    def ratio(method: str, kernel: str, voxel: float) -> str:
        stat = result.find(method, kernel, voxel, exposure)
        if stat is None:
            return "–"
        d = stat.as_dict()
        low, high = d["cnr_interval"]
        text = f"{d['cnr']:.2f} [{low:.1f}, {high:.1f}]"
        entry = _paper(paper.CNR, method, kernel, voxel, exposure)
        return text if entry is None else f"{text} paper {entry:.2f}"

    rows = [[_label(m, k), *(ratio(m, k, v) for v in s.voxels_mm)] for m, k in _rows(result)]
    rows += [[f"FBP {k}, exact", *(_exact(result, k, v, exposure, None) for v in s.voxels_mm)] for k in s.kernels]
    parts.append(markdown_table(["CNR", *header], rows))
    return "\n\n".join(parts)


def _exact(result: Compared, kernel: str, voxel: float, exposure: float, roi: int | None) -> str:
    """Exact mean (SD) of one ROI, or the exact CNR."""
    for e in result.noise_free:
        if (e["kernel"], e["voxel_mm"]) == (kernel, voxel) and "covariance_hu2_s" in e:
            means = (e["foreground_hu"], e["background_hu"])
            variance = np.diag(e["covariance_hu2_s"]) / exposure
            if roi is None:
                return f"{(means[1] - means[0]) / np.sqrt(variance.sum()):.2f}"
            return f"{means[roi]:.1f} ({np.sqrt(variance[roi]):.1f})"
    return "–"


def _noise_table(result: Compared) -> str:
    slopes = result.as_dict()["noise_against_dose"]
    if not slopes:
        return ""
    rows = [
        [_label(e["method"], e["kernel"]), f"{e['voxel_mm']:.2f}", f"{e['pixel']:.3f}"] for e in slopes if "pixel" in e
    ]
    text = (
        "## Noise against dose\n\n"
        "Slope of log σ (voxel noise over the inset) against log exposure; −0.5 for counting noise."
    )
    return f"{text}\n\n{markdown_table(['method', 'voxel, mm', 'slope'], rows)}"


def _pwls_table(result: Compared) -> str:
    if not result.pwls:
        return ""
    rows = [
        [
            f"{e['exposure_s']:.2f} s, {e['voxel_mm']:.2f} mm",
            str(e["exact_pairs"]),
            str(sum(e["inner_iterations"])),
            f"{e['gradient'][-1]:.1e}",
            f"{e['largest_rmsd_hu']:.2f}",
            f"{e['seconds_per_volume']:.1f}",
        ]
        for e in result.pwls
    ]
    header = ["PWLS", "exact pairs", "inner steps", "gradient left", "HU from minimum", "s / volume"]
    text = "## PWLS, convergence\n\nFirst realisation; “HU from minimum” is the worst of all, rms over the volume."
    return f"{text}\n\n{markdown_table(header, rows)}"


def _checks(result: Compared) -> list[Check]:
    """Every row of the paper that this study covers, with its tolerance."""
    checks: list[Check] = []

    def add(name: str, ours: float, published: float, low: float, high: float) -> None:
        checks.append(Check(name, ours, published, low, high))

    for e in result.noise_free:
        if (e["kernel"], e["voxel_mm"]) == (REFERENCE_KERNEL, REFERENCE_VOXEL_MM):
            for roi in ("foreground", "background"):
                p = paper.NOISE_FREE_ROI_HU[roi]
                add(f"noise-free {roi} mean, standard 0.10 mm, HU", e[f"{roi}_hu"], p, p - 8, p + 8)
        if "covariance_hu2_s" in e:
            means = (e["foreground_hu"], e["background_hu"])
            covariance = np.array(e["covariance_hu2_s"]) / paper.TABLE_EXPOSURE_S
            checks += table_checks(e["kernel"], e["voxel_mm"], means, covariance)
    for e in result.as_dict()["noise_against_dose"]:
        if e["method"] == "fbp" and "pixel" in e:
            add(
                f"slope of voxel noise against dose, {e['kernel']} {e['voxel_mm']:.2f} mm",
                e["pixel"],
                -0.5,
                -0.515,
                -0.485,
            )
    return checks


def _footer(result: Compared) -> str:
    seconds = ", ".join(f"{k} {v:.1f} s" for k, v in result.seconds.items())
    return f"Time: {seconds}. Peak memory: {_peak_memory_gib():.1f} GiB."


def _peak_memory_gib() -> float:
    import resource
    import sys

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**30 if sys.platform == "darwin" else peak / 2**20


def _figure(result: Compared) -> Any:
    """Axial and longitudinal sections of one realisation at the tables' dose, per kernel and method."""
    s = result.settings
    voxel = 0.25 if 0.25 in s.voxels_mm else s.voxels_mm[0]
    columns: list[tuple[str, Any, VolumeGrid]] = []
    noise_free = result.images["noise free", REFERENCE_KERNEL, REFERENCE_VOXEL_MM]
    columns.append(("noise free\nstandard 0.10 mm", noise_free, result.grids[REFERENCE_VOXEL_MM]))
    for method, kernel in _rows(result):
        image = result.images.get((method, kernel, voxel))
        if image is not None:
            columns.append((f"{_label(method, kernel)}\n{voxel:.2f} mm", image, result.grids[voxel]))
    rows: list[list[Panel]] = [[], []]
    for i, (title, volume, grid) in enumerate(columns):
        axial = sample_axial(volume, grid, result.rois.image)[0]
        outlines = ((result.rois.foreground[0], "deepskyblue"), (result.rois.background[0], "tomato"))
        rows[0].append(Panel(axial, _extent(result.rois.image, 1, 2), title, outlines if i == 0 else ()))
        z, y, x = result.rois.image.center
        pixel = result.rois.image.spacing[1]
        section = VolumeGrid((int(8.75 / pixel), 1, result.rois.image.shape[2]), pixel, (z, y, x))
        rows[1].append(Panel(sample_axial(volume, grid, section)[:, 0], _extent(section, 0, 2)))
    exposure = result.shown_exposure_s
    return panels(
        rows,
        ("axial", "sagittal (x–z)"),
        f"Plaque, deep-silicon PCCT, {exposure:g} s, one realisation",
        "C150 / W600 HU. ROI outlines: necrotic core (blue), fibrous tissue (red).",
    )


def _extent(grid: VolumeGrid, vertical: int, horizontal: int) -> tuple[float, float, float, float]:
    """Edges of an image in mm about the plaque's centre, as matplotlib wants them."""
    h, v = grid.extent[horizontal] / 2, grid.extent[vertical] / 2
    return (-h, h, -v, v)
