"""From the samples of the dose-factor study to its figures as JSON values."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from recon.study.dose_factor.exact import Exact
from recon.study.dose_factor.further_scenes import scene_rows
from recon.study.dose_factor.main_scenes import method_entry
from recon.study.dose_factor.measure import Measured
from recon.study.dose_factor.other_rois import other_voxels, wide_entry
from recon.study.dose_factor.vessel_rows import vessel_rows

__all__ = ["analyse"]


def analyse(measured: Measured) -> dict[str, Any]:
    """All figures of the study, each with a 95 % interval where it is not exact."""
    exact, s = Exact(measured), measured.settings
    return {
        "settings": asdict(s),
        "methods_run": measured.methods,
        "rois": exact.variant.rois.as_dict(),
        "truth": exact.true_values(),
        "ceiling": [exact.limit_entry(dose) for dose in s.doses],
        "fbp": list(exact.fbp.values()),
        "methods": [method_entry(exact, name, dose) for dose in s.doses for name in measured.methods],
        "wide_rois": [wide_entry(exact, name) for name in s.rois],
        "other_voxels": other_voxels(exact),
        "shape_limits": exact.shape_limit_entries(),
        "worst_case_gains": [{"exposure_s": dose, **gains} for dose, gains in measured.gains.items()],
        "scenes": scene_rows(exact),
        "scenes_left_out": measured.left_out,
        "vessels": vessel_rows(measured.vessels, exact.paper.contrast_hu),
    }
