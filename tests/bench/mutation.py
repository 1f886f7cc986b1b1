"""Planted faults: does a test fail for each? ``python tests/bench/mutation.py [NAME …]``

Every entry of :data:`FAULTS` is a fault that a person could make, in one place of the source, and the test that must
notice. The repository's packages are copied, the fault is planted in the copy, and the test runs on it, in a process
that is forked after the slow imports. A fault that its test does not notice is printed, and the exit status is 1. First
every test must pass on the sound copy. What was found is kept in ``mutation.json`` beside this file, fault by fault.
"""

import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent.parent
RESULT = Path(__file__).with_suffix(".json")
LIMIT_S = 300
HOW = {1: "fails", 2: "cannot be collected", 124: f"hangs ({LIMIT_S} s)"}
"""Exit status of pytest → how a fault is noticed: a test failed; an import broke; nothing came back."""


class Fault(NamedTuple):
    """``old`` in ``file`` becomes ``new``; ``test`` must fail."""

    name: str
    file: str
    old: str
    new: str
    test: str


_T = "tests/torchpcct/test_no_silent_errors.py::"
_R = "tests/recon/test_no_silent_errors.py::"
_C = "tests/recon/test_cli_refusals.py::"
_FIELD, _WF = "recon/least_squares/field_model.py", "tests/recon/least_squares/test_whole_field.py::"
_D = "tests/torchpcct/checks/test_defects.py::"
_Q = "tests/torchpcct/metrics/test_residual_test.py::"
_O = "tests/torchpcct/checks/test_opposite_rays.py::"
_OPP = "torchpcct/checks/opposite_rays.py"
_P = "tests/recon/evaluate/test_store.py::"
_SAME = _P + "test_finished_pieces_are_used_again_by_the_same_settings_and_source_only"
_W = "tests/recon/analytic/test_angular_weights.py"
_N = "tests/torchpcct/metrics/test_cnr.py::"
_G = "torchpcct/geometry.py"
_L = "torchpcct/scanner/linearisation.py"
_A = "recon/analytic/angular_weights.py"
_V = "torchpcct/vector_geometry.py"
_VG = "tests/torchpcct/projector/test_vector_geometry.py::"
_TURN = _VG + "test_roll_tilt_and_slant_turn_right_handed"
_FILTERS, _YAML, _DATA = "torchpcct/scanner/filters.py", "torchpcct/formats/geometry_yaml.py", "train/data.py"
_SC, _ALL = "tests/torchpcct/formats/test_scans.py::", "tests/train/test_data.py::test_scenes_of_a_batch_differ"
_VOX = "tests/torchpcct/acquisition/test_voxels.py::"
_TISSUE = "recon/mbir/tissues.py"
_M = "tests/recon/mbir/test_tissues.py::"
_LAYER, _LAYER_TESTS = "recon/plaque/layer.py", "tests/recon/plaque/test_layer.py::"
_SHIPPED = "tests/recon/mbir/test_shipped_prior.py"
_STEP = _SHIPPED + "::test_the_network_is_given_a_step_towards_the_data_and_where_it_is"
_SHARE = _SHIPPED + "::test_the_error_is_that_share_of_the_rivals"
_KEPT = _SHIPPED + "::test_fat_and_lumen_keep_their_values"
_WORD = _SHIPPED + "::test_final_data_consistency_makes_the_network_s_volume_explain_the_data"
_UN, _MB, _READ = "recon/mbir/unrolled.py", "recon/mbir/mbir.py", "recon/plaque/reading.py"
_PQ = "tests/recon/plaque/test_quality.py::"
_F = "tests/test_precision.py::"
_TABLE = "tests/test_bad_input.py::test_a_bad_value_is_refused_by_its_name"
_DAMAGED = "tests/torchpcct/formats/test_damage.py::test_damaged_files"

FAULTS = (
    Fault("offset sign", _G, "2.0) * pitch + offset", "2.0) * pitch - offset",
          _T + "test_the_row_offset_moves_the_rows_up"),
    Fault("index centre", _G, "- (count - 1) / 2.0)", "- count / 2.0)", _T + "test_the_row_offset_moves_the_rows_up"),
    Fault("view step of stored neighbours", _G, "np.diff(np.sort(angles))", "np.abs(np.diff(angles))",
          _T + "test_view_step_by_hand"),
    Fault("repeated views count", _G, "steps = steps[steps > 1e-9]", "", _T + "test_view_step_by_hand"),
    Fault("degrees unnoticed", _G, "_DEGREES_STEP_RAD = 20.0, 0.04", "_DEGREES_STEP_RAD = 1e9, 0.04",
          _T + "test_degrees_for_radians_are_noticed"),
    Fault("helix taken for degrees", _G, "_DEGREES_STEP_RAD = 20.0, 0.04", "_DEGREES_STEP_RAD = 20.0, 0.001",
          _T + "test_degrees_for_radians_are_noticed"),
    Fault("complex angles", _G, 'kind not in "fiu"', 'kind not in "fiuc"',
          _TABLE),
    Fault("coverage of 1", "torchpcct/validate.py", "if not 0.0 < share < 1.0", "if not 0.0 <= share <= 1.0",
          _TABLE),
    Fault("zero is positive", "torchpcct/validate.py", "positive and result <= 0", "positive and result < 0", _TABLE),
    Fault("NaN is a number", "torchpcct/validate.py", "if math.isnan(result) or", "if False or", _TABLE),
    Fault("grid beside the rows", "torchpcct/detector_window.py", "if row1 < 0.0 or row0 > geometry.rows - 1:",
          "if False:", _T + "test_a_grid_that_no_row_sees_casts_no_shadow"),
    Fault("short water table", _L, "coefficients.shape[0] != scale.size", "False", _TABLE),
    Fault("scale 0", _L, "if not (scale > 0).all():", "if False:", _TABLE),
    Fault("infinite water table", _L, "if not np.isfinite(array).all():", "if False:", _TABLE),
    Fault("window beyond the table", _L, "+ columns > self.scale.size:", "+ columns > 9 * self.scale.size:",
          _T + "test_a_window_beyond_the_water_correction_is_refused"),
    Fault("checksum ignored", "torchpcct/files.py", "    if head != (_MAGIC", "    if False and head != (_MAGIC",
          _DAMAGED),
    Fault("checksum of the first bytes", "torchpcct/files.py",
          '        file.seek(_BLOCK)\n        digest = hashlib.file_digest(file, "sha256").hexdigest()',
          '        file.seek(_BLOCK)\n        digest = hashlib.sha256(file.read(64)).hexdigest()',
          _DAMAGED),
    Fault("abandoned files stay", "torchpcct/files.py", "if _abandoned(left, _ABANDONED_S):", "if False:",
          _C + "test_what_a_killed_process_left_is_swept_by_the_next_write"),
    Fault("failed write leaves its part", "torchpcct/files.py",
          "    finally:\n        _remove(part)\n\n\n@contextmanager\ndef marker",
          "    finally:\n        pass\n\n\n@contextmanager\ndef marker", "tests/torchpcct/test_files.py"),
    Fault("writers of one name share their part", "torchpcct/files.py", "-{secrets.token_hex(4)}.part.",
          "-00000000.part.", "tests/torchpcct/test_files.py::test_two_writers_of_one_name_do_not_meet"),
    Fault("HDF5 sees a full disk", "torchpcct/files.py",
          "        except BaseException as error:\n            self.failure = error\n        return size",
          "        except ZeroDivisionError:\n            pass\n        return size",
          "tests/torchpcct/test_files.py::test_what_cannot_be_written_is_an_error_in_one_sentence_and_leaves_nothing"),
    Fault("a compressed file's checksum unread", "torchpcct/formats/volume_files.py", "while file.read(2**24):",
          "while False:", "tests/torchpcct/formats/test_volume_files.py"),
    Fault("write to a file's name as folder", "torchpcct/files.py", "if path.exists() and not path.is_dir():",
          "if False:", _C + "test_folders_that_cannot_be_written_are_refused"),
    Fault("each line counts twice", _A, "(offset_share(gamma) if is_offset(geometry) else 0.5)",
          "(offset_share(gamma) if is_offset(geometry) else 1.0)", _W),
    Fault("Parker's rise mirrored", _A, "rise = 2.0 * (half_fan + gamma)", "rise = 2.0 * (half_fan - gamma)", _W),
    Fault("Parker's fall mirrored", _A, "fall = math.pi + 2.0 * gamma", "fall = math.pi - 2.0 * gamma", _W),
    Fault("repeated views weigh double", _A, "share = steps / np.bincount(group, minlength=distinct.size)",
          "share = steps", _W),
    Fault("four views pass", _A, "WIDEST_STEP_RAD = math.radians(75.0)", "WIDEST_STEP_RAD = math.radians(400.0)",
          _R + "test_a_handful_of_views_is_refused"),
    Fault("gaps pass", _A, "if inner > INNER_GAP_RAD:", "if False:",
          _R + "test_views_that_lack_inside_of_the_scan_are_refused_or_named"),
    Fault("small gaps unnamed", _A, "        _LOG.warning(", "        _LOG.debug(",
          _R + "test_views_that_lack_inside_of_the_scan_are_refused_or_named"),
    Fault("volume beside the rows", "recon/analytic/coverage.py", "if not by_some.any():", "if False:",
          _R + "test_fbp_of_a_tensor_refuses_a_grid_beyond_the_rows"),
    Fault("interleave without offset", "recon/analytic/fbp.py", "if abs(quarters - 0.25) > 0.1:", "if False:",
          _R + "test_interleave_needs_a_quarter_column_opposite_rays_and_many_views"),
    Fault("interleave an arc", "recon/analytic/fbp.py", "if span < 2.0 * math.pi:", "if False:",
          _R + "test_interleave_needs_a_quarter_column_opposite_rays_and_many_views"),
    Fault("noise added, not in squares", "torchpcct/metrics/cnr.py", "noise = np.hypot(fg_noise, bg_noise)",
          "noise = fg_noise + bg_noise", _N + "test_definition_by_hand"),
    Fault("variance of n", "torchpcct/metrics/cnr.py", "fg.std(-1, ddof=1), bg", "fg.std(-1, ddof=0), bg",
          _N + "test_definition_by_hand"),
    Fault("degrees of freedom of n", "torchpcct/metrics/cnr.py", "dof = realizations - 1", "dof = realizations",
          _N + "test_sd_interval_matches_the_known_factors"),
    Fault("indefinite covariance", "torchpcct/spectral/vmi.py", "if not bool((c[1] ** 2 <=",
          "if False and bool((c[1] ** 2 <=", _T + "test_an_indefinite_covariance_has_no_noise"),
    Fault("half the covariance", "torchpcct/spectral/vmi.py", "2 * g[:, 0] * g[:, 1]", "g[:, 0] * g[:, 1]",
          "tests/torchpcct/spectral/test_vmi.py"),
    Fault("shift of two columns", "torchpcct/metrics/residual_test.py", "lines[..., :-2]) / 2.0", "lines[..., :-2])",
          _Q + "test_a_quarter_of_a_column_is_found_and_measured"),
    Fault("one-sided p-value", "torchpcct/metrics/residual_test.py", "float(2.0 * stats.norm.sf(abs(score)))",
          "float(stats.norm.sf(abs(score)))", _Q + "test_false_alarms_keep_their_rate"),
    Fault("unknowns forgotten", "torchpcct/metrics/residual_test.py", "min(unknowns / count, 1.0)", "0.0",
          _Q + "test_a_wrong_noise_level_is_found"),
    Fault("a wide range of χ²", "torchpcct/metrics/residual_test.py", "MISFIT = 0.03", "MISFIT = 0.3",
          _Q + "test_a_wrong_noise_level_is_found"),
    Fault("views untested", "torchpcct/metrics/residual_test.py", '(("views", (1, 2), 2), ("rows", (0, 2), 1))',
          '(("rows", (0, 2), 1),)', _Q + "test_gains_are_found"),
    Fault("noise taken for dead cells", "torchpcct/checks/defects.py", "BRIGHT = 30.0", "BRIGHT = 0.3",
          _D + "test_starved_data_are_left_alone"),
    Fault("half lost is dead", "torchpcct/checks/defects.py", "dark > 0.98 * seen", "dark > 0.25 * seen",
          _D + "test_readings_lost_at_random_are_found"),
    Fault("edges of metal are lost readings", "torchpcct/checks/defects.py", "] for side in (-1, 1)]",
          "] for side in (1, 1)]", _D + "test_readings_lost_at_random_are_found"),
    Fault("dead views pass", "torchpcct/checks/defects.py", "share > 0.99", "share > 9",
          _D + "test_every_kind_of_defect_is_found_and_nothing_else"),
    Fault("hot cells pass", "torchpcct/checks/defects.py", "lost | (dead | hot)[part]", "lost | dead[part]",
          _D + "test_every_kind_of_defect_is_found_and_nothing_else"),
    Fault("bridged from the wrong side", "torchpcct/readings.py", "share = (place - left)", "share = (right - place)",
          "tests/torchpcct/checks/test_readings.py::test_lost_columns_rows_and_views_of_linear_data_come_back"),
    Fault("window ignored", "torchpcct/checks/defects.py", "parts = [np.s_[:, c : c + columns] for c in first]",
          "parts = [np.s_[:, 0:columns] for c in first]", _D + "test_cells_are_followed_through_a_window"),
    Fault("damaged pieces pass", "recon/evaluate/store.py", "if digest !=", "if False and digest !=",
          _C + "test_damaged_pieces_are_computed_again"),
    Fault("threads left behind by a fork", "torchpcct/threads.py", "after_in_child=_renew", "after_in_parent=_renew",
          "tests/torchpcct/projector/test_operator.py::test_a_forked_process_computes_on_threads_of_its_own"),
    Fault("ends of pieces forgotten", "torchpcct/threads.py", "kernel(begin, end, *given",
          "kernel(begin, end - 1, *given", "tests/torchpcct/test_threads.py::test_every_index_once"),
    Fault("kernels with two copies of a function", "torchpcct/projector/cpu/cone_kernels.py", '"forceinline": True',
          '"forceinline": False', "tests/torchpcct/test_kernel_cache.py::test_a_fresh_process_and_later_ones"),
    Fault("rows by the wrong gain", "torchpcct/projector/cpu/cone_kernels.py", "real(1.0 / step), out, out.size)",
          "real(step), out, out.size)",
          "tests/torchpcct/projector/test_accuracy.py::test_small_inset_far_from_the_axis"),
    Fault("layers of the window", "torchpcct/projector/tables.py",
          "self.grid, self.rays.row_edge, self.rays.row_pitch, rows)",
          "self.grid, self.heights[2], self.rays.row_pitch, self.rays.rows)",
          _T + "test_a_windowed_projection_equals_the_whole_one"),
    Fault("opposite rays of the same side", _OPP, "pi - (0.0 if self.parallel", "pi + (0.0 if self.parallel",
          _O + "test_a_wrong_centre_is_found_and_measured"),
    Fault("the centre's error upside down", _OPP, "score = -self.difference", "score = self.difference",
          _O + "test_a_wrong_centre_is_found_and_measured"),
    Fault("every pair counts twice", _OPP, "(gamma > 0) & close", "(gamma != 0) & close",
          _O + "test_each_pair_of_rays_counts_once"),
    Fault("no tolerance of the centre", _OPP, "CENTRE_TOLERANCE = 0.1", "CENTRE_TOLERANCE = 0.0",
          _O + "test_an_error_within_the_tolerance_is_measured_but_no_finding"),
    Fault("centre untested", "recon/api.py", "*consistency_warnings(scan, grid), ", "",
          _R + "test_fbp_of_a_wrong_rotation_centre_is_named"),
    Fault("pieces of other settings", "recon/evaluate/store.py", "if found == key:", "if True:", _SAME),
    Fault("pieces of another version", "recon/evaluate/store.py",
          'f"{settings!r} {_study_digest(settings)}"', 'f"{settings!r}"', _SAME),
    Fault("pieces written in place", "recon/evaluate/store.py",
          'with atomic_write(self.path(name + ".npz")) as part:', "for part in [path]:",
          _P + "test_kills_at_random_moments_lose_one_piece_at_most"),
    Fault("a threshold that ignores the noise", "recon/least_squares/qggmrf.py", "threshold=16.0, relative=True)",
          "threshold=300.0)",
          "tests/recon/least_squares/test_inset_problem.py::test_the_default_prior_follows_the_noise"),
    Fault("any number of voxels", "recon/cli/scans.py", "MOST_VOXELS = 2**31", "MOST_VOXELS = 2**200",
          _C + "test_refusals_name_value_and_remedy_and_leave_nothing"),
    Fault("kept views are computed again", "torchpcct/acquisition/acquire.py", "values = keep(", "values = _computed(",
          "tests/torchpcct/acquisition/test_acquire.py::test_an_interrupted_scan_goes_on_with_what_was_kept"),
    Fault("a vessel's prior that is not the user's", "recon/plaque/vessel.py",
          "values = (_FAT_SD, wall_sd, fibrous_sd, _LUMEN_SD)", "values = (_FAT_SD, 15.0, 25.0, _LUMEN_SD)",
          "tests/recon/plaque/test_vessel_prior.py"),
    Fault("the outer outline moves inwards for outwards", "recon/plaque/vessel.py",
          "self._outer.spread(outward, single[:, self.outer_part])",
          "self._outer.spread(-outward, single[:, self.outer_part])", "tests/recon/plaque/test_vessel.py"),
    Fault("tissues counted twice", "recon/mbir/outlines.py", "part.beta - part.apply(t)", "part.beta",
          _M + "test_the_vessel_is_sharper_and_its_core_at_full_contrast"),
    Fault("a core drawn that is not proven", _TISSUE, "share * image + (1.0 - share) * around", "image",
          _M + "test_a_core_is_drawn_as_far_as_it_is_probable"),
    Fault("what a layer holds bends no outline", _LAYER,
          "v - fit.curved @ cho_solve(fit.factor, pull).astype(np.float32) if moves else v", "v",
          _LAYER_TESTS + "test_contents_and_step_are_those_of_the_joint_mode"),
    Fault("a step of outlines that leads up", _LAYER, "if energy < fit.energy:", "if True:",
          _LAYER_TESTS + "test_a_step_that_leads_up_is_not_taken"),
    Fault("a changed scan counts as reconstructed", "recon/cli/scans.py", 'if note["state"] == state():', "if True:",
          "tests/recon/evaluate/test_execute.py::test_many_scans_go_on_after_an_interruption"),
    Fault("the middle's starved directions are taken for everybody's", "recon/mbir/field.py", "return mean[..., index]",
          "return spectrum.reshape(-1, index.numel())",
          "tests/recon/mbir/test_field.py::"
          "test_a_step_towards_the_data_is_not_mostly_noise_where_other_rays_are_starved_than_in_the_middle"),
    Fault("tissues that do not fit are used", _TISSUE, "if reading.warnings:", "if False:",
          _M + "test_tissues_that_do_not_explain_the_data_are_not_used"),
    Fault("another fidelity forgets the tissues", "recon/mbir/mbir.py", "other = copy.copy(self)",
          "other: Any = Mbir(self.model, self.fidelity, **self.parts)",
          _M + "test_another_fidelity_keeps_the_tissues_and_noise_units_are_the_inverse_of_hu"),
    Fault("MBIR's tissues do not hear what is believed", _TISSUE, "vessel_prior=self.vessel_prior", "vessel_prior=None",
          _M + "test_what_is_believed_of_the_vessel_reaches_the_reading"),
    Fault("half of a plaque body is not drawn", "recon/plaque/kernels.py", "points[:, 0], cz - largest",
          "points[:, 0], cz", "tests/recon/plaque/test_kernels.py::test_volume_of_an_ellipsoid"),
    Fault("kernels older than what they hold are kept", "torchpcct/kernel_cache.py", "_changed(index) < newest",
          "False", "tests/torchpcct/test_kernel_cache.py::test_an_edited_function_reaches_the_kernels_that_call_it"),
    Fault("many BLAS threads for the tissues", "recon/plaque/reading.py",
          '@threadpool_limits.wrap(limits=1, user_api="blas")', '@threadpool_limits.wrap(limits=2, user_api="blas")',
          "tests/recon/plaque/test_reading.py::test_one_blas_thread_reads_the_tissues"),
    Fault("noise taken for metal", "recon/metal.py", "DENSEST_HU + _SIGMAS * noise", "DENSEST_HU",
          _R + "test_noise_and_bone_are_no_metal"),
    Fault("metal in other units", "recon/api.py", '"mbir" and scan.unit == "HU":', '"mbir":',
          _R + "test_fbp_names_metal_in_hu_and_knows_nothing_of_it_in_other_units"),
    Fault("rows flipped with the columns", _V, "-self.poses[:, 3] if rows else None", "-self.poses[:, 3]",
          _VG + "test_flips_and_shifts_are_those_of_the_readings"),
    Fault("detector shifted the other way", _V, "+ r * poses[:, 3]", "- r * poses[:, 3]",
          _VG + "test_flips_and_shifts_are_those_of_the_readings"),
    Fault("a helix downwards", _V, "out[:, 0] = -height", "out[:, 0] = height",
          _VG + "test_a_helix_takes_the_native_passes"),
    Fault("a far start keeps its rounding", "recon/least_squares/pwls.py", "FAR_START = 2.0", "FAR_START = 1e9",
          _F + "test_pwls_forgets_a_start_far_away"),
    Fault("bins of one spectrum pass", "torchpcct/spectral/model.py", "_ALIKE = 1e-7", "_ALIKE = -1.0",
          _F + "test_what_has_no_answer_is_refused"),
    Fault("unmet voxels scaled by themselves", _FIELD, "LEAST_MET = 0.5", "LEAST_MET = 1e-4",
          _WF + "test_slices_beyond_the_rows_do_not_slow_the_rest_down"),
    Fault("one spectrum for all slices", _FIELD, "NODES, FACTOR = 5, 3.0", "NODES, FACTOR = 5, 1e30",
          _WF + "test_slices_share_the_field"),
    Fault("an approach that gets faster", "recon/least_squares/pwls.py", "(6, 0.7)", "(4, 1.0)",
          _WF + "test_an_approach_that_gets_faster_is_seen"),
    Fault("slow steps count once", "recon/least_squares/pwls.py", "return d * (1 + q) / (1 - q)", "return d",
          "tests/recon/least_squares/test_pwls.py::test_distance_is_right_where_the_model_converges_slowly"),
    Fault("indefinite frequencies pass", "recon/gram/gram.py", "    run(damp, todo.size",
          "    _ = (damp, todo.size", "tests/recon/gram/test_gram.py::test_spectra_become_definite_whatever_they_are"),
    Fault("bowtie straight between its nodes", _FILTERS,
          "curve = PchipInterpolator(np.r_[-nodes[:0:-1], nodes], np.r_[values[:0:-1], values])",
          "curve = lambda at: np.interp(at, nodes, values)",
          "tests/torchpcct/scanner/test_scanner_parts.py::test_bowtie_between_its_nodes_by_hand"),
    Fault("roll the other way", _V, "_with(2, _rotated(u, normal, roll), 3, _rotated(v, normal, roll))",
          "_with(2, _rotated(u, normal, -roll), 3, _rotated(v, normal, -roll))", _TURN),
    Fault("tilt the other way", _V, "_rotated(v, u, tilt)", "_rotated(v, u, -tilt)", _TURN),
    Fault("slant the other way", _V, "_rotated(u, v, slant)", "_rotated(u, v, -slant)", _TURN),
    Fault("a pose turned the other way", _YAML, "name[:-4]: np.deg2rad(", "name[:-4]: -np.deg2rad(", _TURN),
    Fault("angles begin at 0", _YAML, "np.deg2rad(start + step * np.arange(count))",
          "np.deg2rad(step * np.arange(count))", _SC + "test_angles_start_where_they_are_said_to"),
    Fault("all scenes of a batch alike", _DATA, "own = [seed_of(seed, step, i) for", "own = [seed_of(seed, step) for",
          _ALL),
    Fault("all scenes of a batch the first", _DATA, "own = [seed_of(seed, step, i) for",
          "own = [seed_of(seed, step, indices[0]) for", _ALL),
    Fault("all scenes of the pool alike", _DATA, 'seed_of("scene", seed, number)', 'seed_of("scene", seed)', _ALL),
    Fault("microns are millimetres", "torchpcct/formats/data_exchange.py", '"microns", "micrometer"', '"micrometer"',
          _SC + "test_pixel_sizes_in_every_unit"),
    Fault("a micron is a nanometre", "torchpcct/formats/data_exchange.py", '"micrometre"), 1e-3)',
          '"micrometre"), 1e-6)', _SC + "test_pixel_sizes_in_every_unit"),
    Fault("long cells are not cut into parts", "torchpcct/projector/cpu/vector_kernels.py", "_MOST_PARTS = 256",
          "_MOST_PARTS = 1", _VG + "test_long_cells_that_are_rolled"),
    Fault("iodine scanned as bone", "torchpcct/scene/voxels.py", '"iodine": ("iodine 200 mg/ml in blood",)',
          '"iodine": BODY_TISSUES[4:]', _VOX + "test_what_is_above_muscle_is_the_users_choice"),
    Fault("numbers at 70 keV whatever the scanner", "torchpcct/scene/voxels.py", "if not self.scanners_own:",
          "if True:", _VOX + "test_numbers_come_back_from_a_polychromatic_scan"),
    Fault("axes by name in the wrong order", "torchpcct/acquisition/config.py",
          "[value[a] for a in order if a in value]", "[value[a] for a in value]",
          "tests/recon/test_cli.py::test_numbers_by_the_names_of_their_axes"),
    Fault("g/ml for mg/ml", "torchpcct/scene/materials.py", "most = 1000.0 * dissolved", "most = dissolved",
          "tests/torchpcct/scene/test_materials.py::test_a_concentration_of_iodine_by_its_name"),
    Fault("a step away from the data", _UN, "towards = v + filtered(", "towards = v - filtered(", _SHARE),
    Fault("steps away from the data, part by part", _UN, "problem.beta - problem.apply(v), 1.0 / (spectrum + _TOWARDS)",
          "problem.apply(v) - problem.beta, 1.0 / (spectrum + _TOWARDS)", _STEP),
    Fault("no step towards the data", _UN, "1.0 / (spectrum + _TOWARDS))", "0.0 * spectrum)", _SHARE),
    Fault("the second step of another length", _UN, "1.0 / (spectrum + _TOWARDS))",
          "(1.0 - 0.7 * k) / (spectrum + _TOWARDS))", _STEP),
    Fault("the network does not know which step it is", _UN, "float(k))], 1)", "0.0)], 1)", _STEP),
    Fault("the network hears another noise level", _UN, "level = torch.log(scale / REFERENCE_SCALE_HU)",
          "level = torch.log(REFERENCE_SCALE_HU / scale)", _STEP),
    Fault("the network is left out", _UN, "v = (prior or self.network)(v, towards, condition, smoothed)",
          "v = towards", _SHARE),
    Fault("the network's inputs change places", _UN, "(prior or self.network)(v, towards, condition, smoothed)",
          "(prior or self.network)(towards, v, condition, smoothed)", _SHARE),
    Fault("weights of zero", _MB, "model.load_state_dict(tensors)",
          "model.load_state_dict({k: v if 'seen' in k else 0 * v for k, v in tensors.items()})", _SHARE),
    Fault("weights in another order", _MB, "model.load_state_dict(tensors)",
          "model.load_state_dict({k: v if 'seen' in k else v.flip(0) for k, v in tensors.items()})", _SHARE),
    Fault("final data consistency against the data", _UN, "return v + conjugate_gradient(",
          "return v - conjugate_gradient(", _WORD),
    Fault("no final data consistency", _UN, "fidelities, solves[1]) if final_data_consistency else v",
          "fidelities, solves[1]) if False else v", _WORD),
    Fault("the surround's zero is lost", _MB, "return to_hu(u * scale + problem.level, problem.mu_ref)",
          "return to_hu(u * scale + 1.02 * problem.level, problem.mu_ref)", _KEPT),
    Fault("the surround's zero is another", "recon/least_squares/inset_problem.py",
          "self.level = float(static_fbp(self._background, scan.geometry, grid).mean())",
          "self.level = 1.02 * float(static_fbp(self._background, scan.geometry, grid).mean())",
          "tests/recon/mbir/test_mbir.py::test_noise_free_values_in_hu"),
    Fault("a second vessel passes", _READ, "if self.left.score > STRIKING:", "if False:",
          _PQ + "test_beside_a_second_vessel_that_is_not_known_nothing_of_a_plaque_is_claimed"),
    Fault("a second vessel stays in the data", _READ, "_ROUNDS = 2", "_ROUNDS = 0",
          _PQ + "test_a_second_vessel_apart_is_taken_off_the_data"),
    Fault("lumens without contrast agent are read", "recon/plaque/start.py", "_LEAST_LUMEN_HU = 180.0",
          "_LEAST_LUMEN_HU = 0.0", _PQ + "test_what_is_no_enhanced_vessel_is_refused_in_words"),
    Fault("a second core is painted over", _READ, "if found is not None and other_core is None:", "if False:",
          _PQ + "test_a_second_core_is_read_beside_the_first"),
    Fault("what projecting averages stays in a lumen", "recon/plaque/kernels.py", "0.5 * excess", "0.25 * excess",
          "tests/recon/plaque/test_kernels.py::test_what_is_taken_off_is_what_drawing_and_projecting_have_averaged"),
    Fault("noise of a residual by the wrong power", "recon/plaque/data.py", "(pairs * passed**2 * spectrum)",
          "(pairs * passed * spectrum)", _PQ + "test_noise_alone_is_not_striking_anywhere_in_the_volume"),
)  # fmt: skip


def _run(copy: Path, tests: list[str]) -> int:
    """Exit status of pytest on the copy, 124 if it takes too long."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        os.chdir(copy)
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        os.environ["PYTHONPATH"] = str(copy)
        sys.path.insert(0, str(copy))
        import pytest

        os._exit(int(pytest.main(["-n", "0", "-x", "-q", "-p", "no:cacheprovider", *tests])))
    end = time.monotonic() + LIMIT_S * len(tests)
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.05)
    os.kill(child, 9)
    os.waitpid(child, 0)
    return 124


def _keep(fault: Fault, found: str) -> None:
    """Put the finding of a fault into :data:`RESULT`; faults that no longer exist leave it."""
    rows = {r["fault"]: r for r in json.loads(RESULT.read_text(encoding="utf-8"))} if RESULT.exists() else {}
    rows[fault.name] = {"fault": fault.name, "file": fault.file, "test": fault.test, "test_then": found}
    listed = [rows[f.name] for f in FAULTS if f.name in rows]
    RESULT.write_text(json.dumps(listed, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def main(names: list[str]) -> int:
    """Plant the faults (all, or those whose names are given); 0 if all are noticed."""
    if unknown := set(names) - {f.name for f in FAULTS}:
        print(f"no such fault: {', '.join(sorted(unknown))}")
        return 2
    chosen = [f for f in FAULTS if not names or f.name in names]
    # Slow imports, none of them ours, once for all forks; no thread is started yet.
    import h5py  # noqa: F401
    import numba  # noqa: F401
    import scipy.stats  # noqa: F401
    import torch  # noqa: F401

    missed = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        for part in ("torchpcct", "recon", "train", "tests"):
            shutil.copytree(ROOT / part, copy / part)  # with the kernels that numba has compiled
        for file in ("pyproject.toml", "README.md"):
            shutil.copy2(ROOT / file, copy / file)
        if (status := _run(copy, sorted({f.test for f in chosen}))) != 0:
            print(f"the tests do not pass on the sound source (status {status})")
            return 1
        for fault in chosen:
            path = copy / fault.file
            good = path.read_text(encoding="utf-8")
            if good.count(fault.old) != 1:
                print(f"{fault.name}: {fault.file} holds {fault.old!r} {good.count(fault.old)} times, not once")
                missed.append(fault)
                continue
            before = path.stat()
            path.write_text(good.replace(fault.old, fault.new), encoding="utf-8")
            status = _run(copy, [fault.test])
            path.write_text(good, encoding="utf-8")
            os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
            for stale in (copy / fault.file).parent.glob(f"__pycache__/{path.stem}.cpython-*.pyc"):
                stale.unlink()
            print(f"{'caught' if status in HOW else 'MISSED'}  {fault.name:<36} {fault.test}", flush=True)
            _keep(fault, HOW.get(status, "MISSED"))
            if status not in HOW:
                missed.append(fault)
    print(f"{len(chosen) - len(missed)} of {len(chosen)} planted faults caught")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
