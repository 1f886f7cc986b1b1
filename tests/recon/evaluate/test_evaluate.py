"""The instrument: tasks, methods, figures, on a scan of few views."""

import json
import math
import shlex
import shutil
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from scipy import ndimage
from tiny_studies import INSERT

from recon.cli import main
from recon.evaluate.estimates import _Figures, pivot
from recon.evaluate.experiment import _note_export, evaluate, export_scans
from recon.evaluate.measure import Reader, kept_as
from recon.evaluate.methods import Method, denoiser, method_of, volume_files
from recon.evaluate.names import TASKS
from recon.evaluate.realisations import Realisations
from recon.evaluate.report import COLUMNS, save, text_of
from recon.evaluate.rivals import tuned
from recon.evaluate.tasks import AnatomyTask, VesselTask, read_task, task_text
from recon.evaluate.without_truth import evaluate_scans, evaluate_volumes
from recon.filters import deepinv_denoiser
from recon.jobs.store import Store
from torchpcct import Volume
from torchpcct.geometry import VolumeGrid


@pytest.fixture(scope="module")
def task(tmp_path_factory):
    path = tmp_path_factory.mktemp("task") / "insert.yaml"
    path.write_text(INSERT, encoding="utf-8")
    return read_task(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


def halved(scan, grid):
    """The user's own reconstruction: FBP with half of the contrast to water."""
    from recon import reconstruct

    return reconstruct(scan, grid, "fbp", kernel="soft").data / 2


def shrunk(volume, sigma):
    """The user's own denoiser, told the noise."""
    assert 1.0 < sigma < 1000.0
    return volume.mean() + 0.5 * (volume - volume.mean())


@pytest.fixture(scope="module")
def found(task, folder):
    methods = [
        "fbp:soft",
        "fbp:detail",
        "gaussian@fbp:soft",
        denoiser(shrunk, "fbp:soft"),
        Method("mine", run_half),
    ]
    return evaluate(task, methods, n=8, folder=folder)


def run_half(realisation):
    return halved(realisation.scan, realisation.grid)


def value(found, figure, method, where):
    (record,) = [
        r
        for r in found.records
        if (r["figure"], r["method"], r["where"]) == (figure, method, where)
    ]
    return record


@pytest.mark.parametrize("name", TASKS)
def test_ready_tasks_have_regions(name):
    ready = read_task(name)
    assert ready.title
    # Painting takes seconds: of the vessels only the middle, where the signal lies, and on voxels
    # half as large again, which leave the regions less room.
    grid, painted = ready.grid, isinstance(ready, AnatomyTask | VesselTask)
    shape = (16 if painted else grid.shape[0], *grid.shape[1:])
    coarse = VolumeGrid(
        tuple(round(n / 1.5) for n in shape), tuple(1.5 * s for s in grid.spacing), grid.center
    )
    if ready.rois:
        with pytest.raises(ValueError, match=r"ROI 'small' have the shape .* rois=\{\}"):
            replace(ready, grid=coarse)
    else:
        ready = replace(ready, grid=coarse)
    for signal, background in ready.regions.values():
        assert float(signal.sum()) == pytest.approx(1.0)
        assert float(background.sum()) == pytest.approx(1.0)
        # No voxel is read as both.
        assert not bool(((signal > 1e-3) & (background > 1e-3)).any()) or name.startswith(
            ("plaque", "half_contrast")
        )
    for mask in (ready.near, ready.beside, ready.quiet):
        assert mask.any()
    assert yaml.safe_load(task_text(name))["signal"]


def test_what_a_task_knows(task, found):
    (seen,) = found.results
    values = dict(zip(seen.ground_truth.tissues, seen.ground_truth.values_hu, strict=True))
    assert values["patient"] == pytest.approx(0.0, abs=1.0)
    assert 30.0 < values["signal"] < 70.0
    assert seen.true_hu["lesion"] == pytest.approx(-values["signal"] + values["patient"], abs=0.5)
    # Information grows with the exposure; the limit holds for one second.
    soft = value(found, "contrast SD at slope 1", "fbp:soft", "lesion")["value"]
    assert seen.ground_truth.bound_hu / math.sqrt(20.0) < soft


def test_linear_methods_are_exact(found):
    for figure in ("slope", "contrast SD at slope 1", "contrast without signal"):
        record = value(found, figure, "fbp:detail", "lesion")
        assert math.isnan(record["low"])
    assert value(found, "slope", "fbp:detail", "lesion")["value"] == pytest.approx(0.9, abs=0.15)
    factor = value(found, "dose factor: contrast at slope 1", "fbp:soft", "slice")
    assert factor["value"] == pytest.approx(1.0)


def test_exact_variance_is_that_of_draws(task, folder):
    """FBP passed off as a nonlinear method: drawn figures about the exact ones."""
    other = Method("drawn", lambda realisation: realisation.fbp("detail"), kernels=("detail",))
    both = evaluate(task, ["fbp:detail", other], n=40, folder=folder)
    for figure, where in (
        ("contrast SD at slope 1", "lesion"),
        ("CNR", "small"),
        ("slope", "slice"),
        ("contrast without signal", "small"),
    ):
        exact, drawn = (value(both, figure, name, where) for name in ("fbp:detail", "drawn"))
        half = (drawn["high"] - drawn["low"]) / 2
        assert abs(drawn["value"] - exact["value"]) <= 2.0 * half + 1e-6, figure


def test_a_users_denoiser_and_reconstruction(found):
    shrink = value(found, "slope", "shrunk@fbp:soft", "lesion")
    soft = value(found, "slope", "fbp:soft", "lesion")
    assert shrink["value"] == pytest.approx(0.5 * soft["value"], rel=0.02)
    # What only scales saves no dose at slope 1, however quiet it looks.
    factor = value(found, "dose factor: contrast at slope 1", "shrunk@fbp:soft", "lesion")
    assert factor["low"] < 1.02
    assert factor["high"] > 0.98
    assert value(found, "dose factor: noise", "shrunk@fbp:soft", "patient")[
        "value"
    ] == pytest.approx(4.0, rel=0.02)
    assert value(found, "slope", "mine", "lesion")["value"] == pytest.approx(
        0.5 * soft["value"], rel=0.05
    )


def test_a_second_call_computes_nothing_again(task, folder, found):
    def never(realisation):
        raise AssertionError("this block was measured before")

    again = evaluate(task, ["fbp:soft", Method("mine", never)], n=8, folder=folder)
    assert value(again, "error", "mine", "near the bodies") == value(
        found, "error", "mine", "near the bodies"
    )


@pytest.mark.extended
def test_a_changed_task_takes_no_old_results(tmp_path):
    """The same name in the same folder, another scene: other scans, other figures."""
    texts = INSERT, INSERT.replace("material: soft_tissue", "material: adipose")
    slopes = []
    for text in texts:
        (tmp_path / "insert.yaml").write_text(text, encoding="utf-8")
        again = read_task(tmp_path / "insert.yaml")
        (seen,) = evaluate(again, "fbp:soft", n=8, folder=tmp_path / "cache").results
        slopes.append(seen.true_hu["lesion"])
    assert slopes[0] < -20.0
    assert slopes[1] > 50.0
    assert len(list((tmp_path / "cache").rglob("present-*.h5"))) == 1
    assert read_task(tmp_path / "insert.yaml").fingerprint == again.fingerprint


def figures(**readings):
    given = SimpleNamespace(**readings)
    return _Figures(given, np.ones(1), np.zeros(1), None, None)


def test_invented_contrast_is_what_both_halves_of_the_draws_show():
    noise = 30.0 * np.random.default_rng(5).standard_normal((24, 1500))
    nothing = figures(invented=noise, n=24).invented().estimate()
    assert nothing.low < 0.0 < nothing.high
    assert abs(nothing.value) < 10.0
    # A dark spot in one voxel of a hundred; its sign is that of what is there, so it does not
    # cancel.
    spot = noise - 80.0 * (np.arange(1500) < 15)
    found = figures(invented=spot, n=24).invented().estimate()
    assert found.low < 80.0 < found.high
    assert found.value == pytest.approx(80.0, abs=6.0)
    # What one draw alone shows is not confirmed by the other half.
    once = noise.copy()
    once[3, :15] += 2000.0
    assert abs(figures(invented=once, n=24).invented().value) < 60.0
    exact = np.tile(np.where(np.arange(300) < 3, 7.0, 0.0), (8, 1))
    assert figures(invented=exact, n=8).invented().value == 7.0


def test_a_false_contour_is_a_fall_of_the_mean_error_with_the_distance():
    profile = np.array([4.0, 9.0, -1.0, -3.0, -2.0])
    up_and_down = np.stack([profile + 5.0, profile - 5.0] * 4)
    found = figures(shells=up_and_down, n=8).contour()
    assert found.value == pytest.approx(12.0)
    np.testing.assert_allclose(found.left_out, 12.0)
    assert figures(shells=np.tile(np.arange(4.0), (8, 1)), n=8).contour().value == 0.0


def test_only_what_lies_away_from_edges_is_read_as_nothing(task, found):
    (seen,) = found.results
    reader = Reader(task, task.truth(seen.ground_truth))
    shares = np.max(list(task.volume_fractions.values()), axis=0)
    assert (shares[task.quiet.numpy()] > 1.0 - 1e-6).all()
    away = ndimage.distance_transform_edt(shares > 0.999, sampling=task.grid.spacing)
    assert away[task.quiet.numpy()].min() > 0.6
    # A constant error is smoothed to itself, however narrow the region is; so is its mean in every
    # shell.
    np.testing.assert_allclose(reader.invented(reader.truth[0] + 5.0), 5.0, rtol=1e-5)
    np.testing.assert_allclose(reader.shells(reader.truth[0] + 5.0), 5.0, rtol=1e-5)
    assert reader.false_body(reader.truth[0] + 5.0) == pytest.approx(0.0, abs=1e-9)
    assert len(reader.shells(reader.truth[0])) >= 3
    square = value(found, "error", "fbp:soft", "beside the signal")["value"]
    assert abs(value(found, "invented contrast", "fbp:soft", "about the bodies")["value"]) < square


def test_a_false_body_is_the_largest_ball_where_nothing_is(task, found):
    (seen,) = found.results
    reader = Reader(task, task.truth(seen.ground_truth))
    empty = task.empty.numpy()
    about = ndimage.uniform_filter(empty.astype(float), 7, mode="constant")
    deep = about * ndimage.binary_erosion(empty)
    at = np.array(np.unravel_index(deep.argmax(), empty.shape))
    away = np.linalg.norm(
        (np.moveaxis(np.indices(empty.shape), 0, -1) - at) * task.grid.spacing, axis=-1
    )
    ball = torch.from_numpy(away <= 0.5)
    for hu in (80.0, -60.0):
        assert reader.false_body(reader.truth[0] + hu * ball) == pytest.approx(abs(hu), rel=1e-3)
    # At edges and in the bodies it is no false one.
    there = torch.from_numpy(~empty)
    assert reader.false_body(reader.truth[0] + 500.0 * there) == pytest.approx(0.0, abs=1e-9)
    read = value(found, "false body", "fbp:soft", "where nothing is")
    assert read["low"] < read["value"] < read["high"]
    assert read["value"] > 5.0


def test_the_report_names_who_shows_less_and_does_not_say_so(found):
    slope = value(found, "slope", "shrunk@fbp:soft", "lesion")
    for share, named in ((0.25, True), (1.0, False)):
        said = {
            **slope,
            "figure": "share with a warning",
            "where": "with the signal",
            "value": share,
        }
        text = text_of(replace(found, records=[*found.records, said]))
        assert ("without always warning of it: shrunk@fbp:soft (slope" in text) is named


def test_report_and_tidy_table(found, tmp_path):
    files = {p.name: p for p in save(found, tmp_path, "torchpcct evaluate")}
    assert {"report.md", "report.json", "report.csv", "report.html", "insert.png"} == set(files)
    lines = files["report.csv"].read_text(encoding="utf-8").splitlines()
    assert lines[0].split(",") == list(COLUMNS)
    assert len(lines) == 1 + len(found.records)
    data = json.loads(files["report.json"].read_text(encoding="utf-8"))
    assert len(data["records"]) == len(found.records)
    page = files["report.html"].read_text(encoding="utf-8")
    assert page.count('src="data:image/png;base64,') == 1
    assert "http" not in page
    text = text_of(found)
    assert "Least dose" in text
    assert "nan" not in text
    assert pivot(found.records, "slope")["fbp:soft", 20.0, "lesion"]["n"] == 8


@pytest.mark.parametrize(
    ("run", "expected_text"),
    [
        (lambda d: d.fbp("soft")[1:], "shape"),
        (lambda d: d.fbp("soft") * math.nan, "NaN"),
        (lambda d: (d.fbp("soft") / 1000 + 1) * 0.02, "does it give HU"),
        (lambda d: d.fbp("soft").roll(1, 0), "shifted by"),
        (lambda d: "volume", "str"),
        (lambda d: Volume(d.fbp("soft"), VolumeGrid(d.grid.shape, 0.4)), "asked was"),
    ],
)
def test_what_a_method_gives_is_checked(task, folder, run, expected_text):
    with pytest.raises((ValueError, TypeError), match=expected_text):
        evaluate(task, Method(expected_text, run, kernels=("soft",)), n=8, folder=folder)


@pytest.mark.parametrize(
    ("changes", "expected_text"),
    [
        ({"signal": "core"}, "no body 'core'"),
        ({"signal": []}, "names no body"),
        ({"background": "insert"}, "both signal and background"),
        ({"inset": {"size": [6, 8, 8], "voxel_mm": 0.4, "center": [0, 0, 0]}}, "wholly|lie in"),
        ({"inset": {"size": [6, 8, 8], "voxels": 0.4}}, "unknown voxels"),
        ({"colour": "red"}, "unknown colour"),
        ({"name": "../../evil"}, "name of a task"),
        ({"name": "/tmp/evil"}, "name of a task"),
        ({"name": ".hidden"}, "name of a task"),
        ({"name": ""}, "name of a task"),
        ({"name": "a" * 65}, "name of a task"),
        ({"name": "two words"}, "name of a task"),
        ({"name": "new\nline"}, "name of a task"),
        ({"exposures_s": -1}, "exposures_s"),
        ({"scene": {"kind": "volume", "file": "a.nii"}}, "a.nii"),
    ],
)
def test_bad_tasks_are_named(tmp_path, folder, changes, expected_text):
    path = tmp_path / "bad.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(INSERT), **changes}), encoding="utf-8")
    with pytest.raises((ValueError, TypeError, OSError), match=expected_text):
        assert read_task(path).regions


@pytest.mark.parametrize(("height", "said"), [(6, False), (1.2, True)])
def test_a_signal_that_the_inset_cuts_is_named(tmp_path, caplog, height, said):
    """Its iterative methods place a part of what goes on beyond the inset into the end slices."""
    path = tmp_path / "cut.yaml"
    path.write_text(INSERT.replace("size: [6, 8, 8]", f"size: [{height}, 8, 8]"), encoding="utf-8")
    read_task(path).scan(Store(tmp_path / "kept"), "present")
    assert ("task cut: what differs from the exterior goes on" in caplog.text) == said


def test_names_that_are_paths_stay_within(task, tmp_path):
    """A file's name makes a task's, whatever it is; a method's never leaves the folder of the
    task."""
    path = tmp_path / ".my task (2).yaml"
    path.write_text(INSERT, encoding="utf-8")
    assert read_task(path).name == "my_task__2_"
    for name in ("..", "../..", "/tmp/evil", "x" * 500, "ä" * 100):
        place = kept_as(Method(name, run_half), 1.0, task, 0)[0]
        folder, rest = place.split("/")
        assert rest == "1s"
        assert not folder.startswith(".")
        assert 0 < len(folder.encode()) <= 120
    assert kept_as(Method("fbp:soft", run_half), 1.0, task, 0)[0] == "fbp_soft/1s"


def test_results_of_another_seed_method_or_exposure_are_not_taken(task, tmp_path):
    """A second call with another --seed must compute: its realisations are other ones."""
    first = kept_as(Method("half", run_half), 1.0, task, 0)
    others = [
        kept_as(Method("half", run_half), 1.0, task, 1),
        kept_as(Method("half", run_half), 2.0, task, 0),
        kept_as(Method("other", run_half), 1.0, task, 0),
    ]
    store = Store(tmp_path)
    assert store.cached(first[0], first[1], lambda: {"of": 0}) == {"of": 0}
    for k, (place, key) in enumerate(others, start=1):
        assert store.cached(place, key, lambda k=k: {"of": k}) == {"of": k}


@pytest.mark.parametrize(
    ("spec", "expected_text"),
    [
        ("fbp:hard", "kernel"),
        ("mbir:sharp=1", "option of mbir"),
        ("mbir:prior=tw", "prior of mbir"),
        ("nothing", "unknown method"),
        ("bilateral@pwls", "needs FBP"),
        ("no.such.module:run", "cannot load"),
        ("files:nowhere", "no such folder"),
        ("json:loads@nowhere", "unknown method"),
        (3, "must be a name"),
    ],
)
def test_bad_methods_are_named(spec, expected_text):
    with pytest.raises((ValueError, TypeError, FileNotFoundError), match=expected_text):
        method_of(spec)


def test_two_volumes_of_one_name_are_refused(tmp_path):
    volume = Volume(torch.zeros(2, 3, 4), VolumeGrid((2, 3, 4), 1.0))
    for name in ("a.nii", "b_fbp.NII.GZ", "c.4", "1.2.3.zarr"):
        volume.save(tmp_path / name)
    assert set(volume_files(tmp_path)) == {"a", "b_fbp", "c.4", "1.2.3"}
    volume.save(tmp_path / "a.mha")
    with pytest.raises(ValueError, match=r"a\.mha and a\.nii are volumes of one name: leave one"):
        volume_files(tmp_path)


def test_volumes_with_voxels_that_are_no_numbers_are_named(here, cli):
    data, grid = torch.zeros(4, 8, 8), VolumeGrid((4, 8, 8), 1.0)
    data[0, :2] = torch.nan
    for folder in ("one", "two"):
        (here / folder).mkdir()
        Volume(data, grid).save(here / folder / "fbp.nii.gz")
    said = "one/fbp.nii.gz: 16 of 256 voxels are NaN or infinite: make it again or, "
    assert said in cli("evaluate --volumes one two --out m", 2)
    realisation = SimpleNamespace(label="insert/fbp", grid=grid)
    with pytest.raises(ValueError, match=said):
        method_of("files:one").run(realisation)
    with pytest.raises(ValueError, match="mine: 16 of 256 voxels of a volume are NaN or infinite"):
        evaluate_volumes({"mine": [data, data]}, [data.nan_to_num()] * 2, 1.0)


@pytest.mark.extended
def test_volumes_of_another_program(here, cli):
    """From --export to a report without renaming a file, by the commands of the how-to."""
    (here / "insert.yaml").write_text(INSERT, encoding="utf-8")
    planned = cli("evaluate --task insert.yaml --export scans --n 8 --dry-run")
    assert "18 scans" in planned
    assert not (here / "scans").exists()
    cli("evaluate --task insert.yaml --export scans --n 8 --no-progress")
    names = " ".join(str(p) for p in sorted((here / "scans" / "insert").glob("*.h5")))
    cli(f"reconstruct {names} --kernel soft --out volumes/insert --no-progress")
    command = "evaluate --task insert.yaml --method files:volumes --n 8 --no-progress"
    assert "files:volumes" in cli(f"{command} --method fbp:soft --out o")
    report = json.loads((here / "o" / "report.json").read_text(encoding="utf-8"))
    theirs, ours = (
        value(SimpleNamespace(**report), "slope", name, "lesion")["value"]
        for name in ("files:volumes", "fbp:soft")
    )
    assert theirs == pytest.approx(ours, abs=0.01)
    # A DICOM folder in place of a file, the scan's own name, and summaries beside.
    first = here / "volumes" / "insert" / "20s_000_present_fbp.nii.gz"
    volume = Volume.load(first)
    volume.save(here / "volumes" / "insert" / "20s_000_present")
    assert "are volumes of one scan" in cli(f"{command} --out p", 2)
    first.unlink()
    cli(f"{command} --out p")
    Volume(volume.data, VolumeGrid(volume.grid.shape, 0.4)).save(first)
    shutil.rmtree(here / "volumes" / "insert" / "20s_000_present")
    assert "has the grid" in cli(f"{command} --out q", 2)
    first.unlink()
    assert "has no volume" in cli(f"{command} --out q", 2)


def test_scans_of_two_seeds_or_tasks_are_not_exported_into_one_folder(task, tmp_path):
    """Volumes of a mixture would be read as noise realisations that they are not."""
    folder = tmp_path / "insert"
    _note_export(task, 3, folder)
    (folder / "20s_000_present.h5").write_bytes(b"")
    _note_export(task, 3, folder)  # the same export goes on
    with pytest.raises(ValueError, match=r"insert holds scans of another seed or task, .* a new"):
        export_scans(task, tmp_path, n=8, seed=4)
    other = replace(task, tolerance_hu=1.0)
    with pytest.raises(ValueError, match="holds scans of another seed or task"):
        export_scans(other, tmp_path, n=8, seed=3)
    (folder / "export.json").unlink()  # an export of an earlier version, or scans of the user's
    with pytest.raises(ValueError, match="holds scans of another seed or task"):
        export_scans(task, tmp_path, n=8, seed=3)
    assert sorted(path.name for path in folder.iterdir()) == ["20s_000_present.h5"]
    with pytest.raises(ValueError, match="tasks: insert given twice"):
        export_scans([task, other], tmp_path / "new", n=8)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("slices", [False, True])
def test_a_denoiser_of_deepinv(slices):
    """Its unit and its axes; the model sees values about 1."""
    seen = []

    def model(x, sigma):
        seen.append((tuple(x.shape), float(x.max()), sigma))
        return x * 0.5

    volume = torch.full((3, 4, 5), 500.0)
    found = deepinv_denoiser(model, slices=slices)(volume, 20.0)
    torch.testing.assert_close(found, volume / 2)
    assert seen == [((3, 1, 4, 5) if slices else (1, 1, 3, 4, 5), 0.5, 0.02)]


def test_the_weights_in_a_denoiser_count_for_what_is_kept_of_it():
    """The same function with other weights is another method; with equal ones it is the same in
    every process."""
    layers = [torch.nn.Conv3d(1, 1, 3, padding=1) for _ in range(2)]
    twin = torch.nn.Conv3d(1, 1, 3, padding=1)
    twin.load_state_dict(layers[0].state_dict())

    def key(layer):
        return denoiser(deepinv_denoiser(layer), "fbp:soft").key

    assert key(layers[0]) == key(twin) != key(layers[1])


def test_rivals_come_with_their_tuned_settings():
    assert tuned("bilateral", "detail", 2.0) == {"edge": 2.0, "reach": 2.5, "sigma": 1.4}
    assert (
        tuned("bilateral", "detail", 0.3)
        == tuned("bilateral", "detail", 0.35)
        != tuned("bilateral", "detail", 2.0)
    )
    assert tuned("bilateral", "bone", 2.0) == {}


def test_commands(here, cli):
    """Ready tasks are listed and printed; a user's task and denoiser from the folder where the
    command runs."""
    assert {line.split()[0] for line in cli("show-task").splitlines()} == set(TASKS)
    assert yaml.safe_load(cli("show-task rod"))["signal"] == "rod"
    (here / "insert.yaml").write_text(INSERT, encoding="utf-8")
    (here / "my_own_filter.py").write_text(
        "def half(volume):\n    return volume / 2\n", encoding="utf-8"
    )
    command = "evaluate --task insert.yaml --denoiser my_own_filter:half@fbp:soft --n 8"
    out = cli(f"{command} --out o --no-progress")
    assert "my_own_filter:half@fbp:soft" in out
    assert "o/report.csv" in out
    sys.path.remove(str(here))  # as in another process
    del sys.modules["my_own_filter"]
    # A second run into the same folder keeps the first methods on its page.
    again = cli("evaluate --task insert.yaml --method fbp:detail --n 8 --out o --no-progress")
    assert "my_own_filter:half@fbp:soft" in again
    assert "fbp:detail" in again
    other = cli("evaluate --task insert.yaml --method fbp:soft --n 9 --out o --no-progress")
    assert "my_own_filter" not in other
    assert "does not name the method" in cli(f"{command} --denoiser my_own_filter:half --out o", 2)
    (here / "f").write_bytes(b"mine")
    assert "is a file" in cli(f"{command} --out f", 2)


def test_pwls_is_that_of_a_user(task, folder):
    """What is measured is what recon.reconstruct gives for the same scan, with the signal and
    without."""
    from recon import reconstruct

    for realisation in Realisations(task, Store(folder / task.name)).pair(20.0, 3):
        theirs, ours = reconstruct(realisation.scan, task.grid, "pwls").data, realisation.pwls()
        assert float((ours - theirs).square().mean().sqrt()) < 0.1
        assert float((ours - theirs).abs().max()) < 1.0


def test_two_measured_scans(task, folder):
    present, _ = task.scans(Store(folder / task.name))
    scans = [present.with_noise(200.0, k) for k in range(2)]
    names = ["fbp:soft", "gaussian@fbp:ram-lak"]
    (alone,) = evaluate_scans(scans, task.grid, names[1:])
    soft, blurred = evaluate_scans(scans, task.grid, names, n=2, seed=1)
    for row in (alone, blurred):
        assert row["dose_factor"] == pytest.approx(1.0, abs=0.1)
        assert row["low"] < 1.02
        assert row["high"] > 0.98
    assert blurred["noise"] < soft["noise"]
    assert not soft["why"]
    with pytest.raises(ValueError, match="two of the same object"):
        evaluate_scans([scans[0], object()], task.grid, "fbp:soft")
    with pytest.raises(ValueError, match="one scan gives one pair"):
        evaluate_scans(scans[0], task.grid, "fbp:soft", n=2)


def test_volumes_in_two_folders(here, cli, capsys):
    """Of other programs: noise at equal resolution, a row a method. A blur saves nothing, in no
    direction; half of its noise is four times the dose."""
    generator, grid = (
        torch.Generator().manual_seed(0),
        VolumeGrid((4, 64, 64), (1.0, 0.5, 0.5), (3.7, -30.38, 29.63)),
    )
    object_ = torch.zeros(grid.shape)
    object_[:, 20:44, 20:44] = 100.0
    pairs = {"fbp": [], "mine.v2": [], "half": []}
    for folder in ("one", "two"):
        (here / folder).mkdir()
        plain = object_ + torch.randn(grid.shape, generator=generator) * 10
        soft, clean = (
            torch.from_numpy(ndimage.gaussian_filter(v.numpy(), [0.6, 1.5, 1.5]))
            for v in (plain, object_)
        )
        for name, data in (("fbp", plain), ("mine.v2", soft), ("half", (clean + soft) / 2)):
            Volume(data, grid).save(here / folder / f"{name}.nii.gz")
            (here / folder / f"{name}.nii.gz.json").write_text("{}", encoding="utf-8")
            pairs[name].append(data)
    said = cli("evaluate --volumes one two --out measured")
    assert "report.html" in said
    report = json.loads((here / "measured" / "report.json").read_text(encoding="utf-8"))
    factors = {r["method"]: r for r in report["records"]}
    assert set(factors) == {"mine.v2", "half"}
    assert factors["mine.v2"]["low"] < 1.0 < factors["mine.v2"]["high"]
    assert factors["half"]["dose_factor"] == pytest.approx(4.0, rel=0.1)
    page = (here / "measured" / "report.html").read_text(encoding="utf-8")
    assert "mine.v2" in page
    for text in (said, page):
        assert "no smaller than the voxels, 0.5 mm in the plane" in text.replace("&#39;", "'")
    assert "along z" in page
    (here / "one" / "fbp.nii.gz.json").write_text(
        json.dumps({"cells_mm": [0.3, 0.2, 0.2]}), encoding="utf-8"
    )
    assert "not to be trusted: the voxels of 1 × 0.5 × 0.5 mm" in cli(
        "evaluate --volumes one two --out coarse"
    )
    cli("evaluate --volumes one two --region :,4:60,4:60 --out part")
    part = json.loads((here / "part" / "report.json").read_text(encoding="utf-8"))["records"]
    assert part[0]["noise"] != report["records"][0]["noise"]
    Volume(torch.zeros(grid.shape).index_put([torch.tensor(1)], torch.tensor(1.0)), grid).save(
        here / "mask.nii.gz"
    )
    cli("evaluate --volumes one two --region mask.nii.gz --out masked")
    for options, expected in (
        ("--reference other", "both have fbp, half, mine"),
        ("--n 9", "--n applies to --scans"),
        ("--task rod", "simulated"),
        ("--region 3:3,:,:", "0 voxels"),
        ("--region 9:,:,:", "9: reaches beyond the 4 voxels along z: ranges are of voxels, not mm"),
        ("--region :,:,0:65", "0:65 reaches beyond the 64 voxels along x"),
        ("--region=:,-65:,:", "-65: reaches beyond the 64 voxels along y"),
        ("--region 3,5,5", "neither an existing file nor ranges of voxels, Z0:Z1,Y0:Y1,X0:X1 (one"),
        ("--region 0:4:0,:,:", "neither an existing file nor ranges"),
        ("--region :,:", "neither an existing file nor ranges"),
        ("--region nowhere", "neither an existing file nor ranges"),
        ("--method pwls", "--scans"),
    ):
        assert expected in cli(f"evaluate --volumes one two {options} --out m", 2)
    assert not (here / "m").exists()
    Volume(pairs["fbp"][0], grid).save(here / "one" / "net.nii.gz")
    capsys.readouterr()
    assert main(shlex.split("evaluate --volumes one two --out odd")) == 0
    alone = "left out, as the other folder has none of that name: one/net.nii.gz"
    assert f"warning: {alone}\n" in capsys.readouterr().err
    for name, changed in (
        ("is in mm^-1, one/fbp.nii.gz in HU", Volume(pairs["fbp"][0], grid, unit="mm^-1")),
        ("resample it", Volume(pairs["fbp"][0], VolumeGrid(grid.shape, 0.5))),
    ):
        changed.save(here / "two" / "half.nii.gz")
        said = cli("evaluate --volumes one two --out m", 2)
        assert name in said
        assert "two/half.nii.gz" in said
    (here / "lone").mkdir()
    Volume(pairs["fbp"][0], grid).save(here / "lone" / "fbp.nii.gz")
    assert "both have fbp alone: put" in cli("evaluate --volumes one lone --out m", 2)
    assert "no such file: no" in cli("evaluate --volumes one no", 2)
    assert "is not a folder" in cli("evaluate --volumes one mask.nii.gz", 2)
    assert "with --scans or --volumes" in cli("evaluate --task rod --region 1:2,3:4,5:6", 2)
    reference = pairs.pop("fbp")
    with pytest.raises(ValueError, match="shape"):
        evaluate_volumes({"other": [np.zeros((4, 64, 32))] * 2}, reference, 0.5)
    with pytest.raises(ValueError, match="mine: the method has a constant volume"):
        evaluate_volumes({"mine": [np.ones((4, 64, 64))] * 2}, reference, 0.5)


@pytest.fixture(scope="module")
def voxel_task(tmp_path_factory):
    """The insert of :data:`INSERT` again, as a user would have segmented it: on voxels of 0.1
    mm."""
    folder = tmp_path_factory.mktemp("voxels")
    at = (np.arange(70) - 34.5) * 0.1
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    far = np.sqrt(z**2 + y**2 + x**2)
    labels = np.where(far < 1.5, 7, np.where(far < 3.2, 2, 0))
    grid = VolumeGrid(labels.shape, 0.1)
    Volume(torch.from_numpy(labels).float(), grid).save(folder / "labels.nii.gz")
    values = yaml.safe_load(INSERT)
    values["scene"]["bodies"] = values["scene"]["bodies"][:1]
    tissues = {"insert": {"label": 7, "hu": 52.0}, "rim": {"label": 2, "hu": 0.0}}
    values |= {"voxels": {"file": "labels.nii.gz", "tissues": tissues}, "background": "rim"}
    values["inset"] = {**values["inset"], "center": {"z": 0, "y": 10, "x": 30}}
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    return path


@pytest.mark.extended
def test_a_segmented_lesion_is_a_task(voxel_task, task, folder, tmp_path):
    """The same figures as the analytic scene, whose insert reads so many HU, within the
    staircase of the voxels."""
    mine, store, there = (
        read_task(voxel_task),
        Store(tmp_path / "voxels"),
        Store(tmp_path / "analytic"),
    )
    ground_truth, known = mine.ground_truth(store), task.ground_truth(there)
    assert ground_truth.tissues == ("signal", "rim", "patient")
    assert ground_truth.values_hu[2] == pytest.approx(0.0, abs=1.0)
    assert ground_truth.bound_hu == pytest.approx(known.bound_hu, rel=0.4)
    present, absent = mine.scans(store)
    other = task.scans(there)
    scale = known.contrast_hu / ground_truth.contrast_hu
    change = (present.line_integrals() - absent.line_integrals()) * scale
    exact = other[0].line_integrals() - other[1].line_integrals()
    # A column beside it would be 0.23; the staircase of the labels makes the sphere 1.3 % larger.
    assert float((change - exact).norm() / exact.norm()) < 0.08
    assert float(change.sum() / exact.sum()) == pytest.approx(1.0, abs=0.04)
    assert float(mine.volume_fractions["signal"].sum()) * 0.4**3 == pytest.approx(
        float((mine.labels == 7).sum()) * 0.1**3
    )
    truth, without = mine.truth(ground_truth)
    assert float(truth.max()) == pytest.approx(52.0)
    assert float(without.abs().max()) < 1.0
    assert float(mine.regions["lesion"][0].sum()) == pytest.approx(1.0)
    found = evaluate(mine, ["fbp:soft"], n=8, folder=tmp_path / "found")
    slope = value(found, "slope", "fbp:soft", "lesion")["value"]
    assert 0.5 < slope < 1.1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"signal": 5},
            "signal must be the name of a body of the scene, or a list of names, got 5",
        ),
        ({"signal": [["nodule"]]}, "signal must be the name"),
        ({"signal": None}, "needs signal"),
        ({"title": ["a"]}, r"title must be a text, got \['a'\]"),
        ({"background": 5}, "background must be a text, got 5"),
        ({"name": True}, "name must be a text, got True"),
        ({"reference": "fbp:hard"}, "unknown kernel 'hard'"),
        ({"reference": "mbir"}, "reference must be FBP, fbp:KERNEL, .* got 'mbir'"),
        ({"reference": "nlm@fbp:soft"}, "reference must be FBP"),
        ({"exposures_s": True}, r"exposures_s\[0\] must be a number in s, got True"),
        ({"exposures_s": [1, 2, 1.0]}, "exposures_s has 1 s twice"),
        ({"exposures_s": 1e300}, r"exposures_s\[0\] must be at most 1e\+06 s"),
        ({"tolerance_hu": True}, "tolerance_hu must be a number in HU, got True"),
        ({"inset": {"size": 5}}, "inset.size must be 3 numbers, got 5"),
        ({"inset": {"size": {"z": 5, "y": 5}}}, "inset.size must have z, y and x in mm, got"),
        ({"inset": {"size": [5, 5, 5], "center": 5}}, "inset.center must be 3 numbers, got 5"),
        ({"inset": {"size": [5, 5, 5], "center": [0, 0, 1e30]}}, r"center\[2\] must lie in"),
        ({"inset": {"size": [5, 5, 5], "voxel_mm": 1e-9}}, "voxel_mm must make 1 to 10000 voxels"),
        ({"inset": {"size": [5, 5, 5], "voxel_mm": 9}}, "voxel_mm must make 1 to 10000 voxels"),
        ({"inset": {"size": [1e300, 5, 5]}}, "voxel_mm must make"),
    ],
)
def test_what_makes_no_task_is_named(tmp_path, change, said):
    path = tmp_path / "mine.yaml"
    values = {**yaml.safe_load(task_text("nodule")), **change}
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    with pytest.raises((ValueError, TypeError), match=said):
        read_task(path)


def test_what_a_task_leaves_empty_has_its_default(tmp_path):
    path = tmp_path / "mine.yaml"
    empty = dict.fromkeys(("name", "title", "background", "reference", "exposures_s", "rois"))
    values = {**yaml.safe_load(task_text("nodule")), **empty}
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    made = read_task(path)
    assert (made.name, made.title, made.background) == ("mine", "", "lung")
    assert (made.reference, made.exposures_s) == ("fbp:soft", (0.35, 2.0))


def test_an_exposure_given_twice_is_refused_before_anything_is_simulated(task):
    with pytest.raises(ValueError, match=r"exposures_s has 0\.5 s twice"):
        evaluate(task, "fbp:soft", exposures_s=[0.5, 0.5], n=8)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"voxels": {"file": "labels.nii.gz"}}, "takes file"),
        (
            {"voxels": {"file": "labels.nii.gz", "tissues": {"insert": {"label": 7}}}},
            "needs label and hu",
        ),
        (
            {"voxels": {"file": "labels.nii.gz", "tissues": {"insert": {"label": 9, "hu": 1}}}},
            "no voxel has the label 9",
        ),
        ({"background": "patient"}, "each be one of"),
        ({"background": ""}, "name the background"),
        ({"inset": {"size": [6, 8, 8]}}, "needs center"),
    ],
)
def test_voxels_that_make_no_task(voxel_task, change, said):
    values = {**yaml.safe_load(voxel_task.read_text(encoding="utf-8")), **change}
    path = voxel_task.with_name("other.yaml")
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    with pytest.raises(ValueError, match=said):
        read_task(path)
