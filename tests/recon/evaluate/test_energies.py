"""Methods on energy bins that are summed with weights: what the weights alone bring, and by whom it
is drawn."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refused
from tiny_studies import INSERT

from recon.evaluate.energies import EnergyRealisations, mean_paths, with_bins
from recon.evaluate.experiment import evaluate
from recon.evaluate.methods import Method, method_of
from recon.evaluate.names import check_method
from recon.evaluate.realisations import Realisations
from recon.evaluate.tasks import read_task
from recon.jobs.store import Store
from recon.names import split_energies, split_method
from torchpcct.spectral import weighting_gain

IODINE = "iodine 10 mg/ml in soft_tissue"
OWN = "fbp:soft,energies"


def drawn(realisation):
    return realisation.fbp("soft")


@pytest.fixture(scope="module")
def task(tmp_path_factory):
    """An insert with iodine in soft tissue."""
    path = tmp_path_factory.mktemp("task") / "insert.yaml"
    path.write_text(INSERT, encoding="utf-8")
    plain = read_task(path)
    return replace(plain, scene=plain.scene.replace_material(plain.signal[0], IODINE))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def found(task, folder):
    methods = [
        "fbp:soft",
        OWN,
        Method("drawn", drawn, kernels=("soft",), energies="task"),
        "pwls",
        "pwls:energies=iodine",
    ]
    records = evaluate(task, methods, n=16, folder=folder).records
    return {(r["figure"], r["method"], r["where"]): r for r in records}


@pytest.mark.extended
def test_exact_factor_of_the_weights_alone(task, folder, found):
    """FBP's exact noise of the lesion's contrast beside the limit of one ray, 97 % or more of it;
    drawn by a method that is not known to be linear, and by PWLS."""
    figure = "dose factor: contrast at slope 1"
    exact = found[figure, OWN, "lesion"]
    assert math.isnan(exact["low"])
    behind = mean_paths(task.scene, task.grid.center)
    assert sum(behind.values()) == pytest.approx(200, rel=0.2)
    scanner = with_bins(task.scanner)
    gain = weighting_gain(scanner, (IODINE, "water"), behind)
    limit = float(gain[len(gain) // 2])
    assert limit > 1.15
    assert 0.97 * limit < exact["value"] < 1.01 * limit
    sample = found[figure, "drawn", "lesion"]
    assert sample["low"] < exact["value"] < sample["high"]
    pwls, weighted = (found[figure, m, "lesion"]["value"] for m in ("pwls", "pwls:energies=iodine"))
    # more than the limit of a linear method, for its prior follows the larger contrast, too
    assert weighted / pwls > 0.85 * limit


@pytest.mark.extended
def test_weighted_volumes_are_in_hu_of_their_own(found):
    """Slope, error and limit are those of weighted noise-free scans: none is larger for the larger
    contrast."""
    for method in ("fbp:soft", OWN):
        assert found["slope", method, "lesion"]["value"] == pytest.approx(0.97, abs=0.06)
    plain, weighted = (
        found["dose factor: Cramér–Rao bound", m, "lesion"]["value"] for m in ("fbp:soft", OWN)
    )
    factor = found["dose factor: contrast at slope 1", OWN, "lesion"]["value"]
    assert weighted / plain == pytest.approx(factor, rel=0.03)
    assert found["error without noise", OWN, "near the bodies"]["value"] > 0


def test_realisations_are_those_of_the_summed_counts(task, folder):
    """The same photons: with the weight 1 in all bins the noise is that of the plain sum."""
    task = replace(task, scanner=task.scanner.with_views(24))
    base = Realisations(task, Store(folder / task.name), 0, ("soft",))
    weighted = EnergyRealisations(base, "task", ())
    weighted.weights[:] = 1.0
    pair = [realisations.pair(20.0, 3) for realisations in (base, weighted)]
    for plain, split in zip(*pair, strict=True):
        torch.testing.assert_close(split.scan.counts, plain.scan.counts, rtol=1e-4, atol=1e-3)
        assert (split.fbp("soft") - plain.fbp("soft")).abs().max() < 0.2
    other = EnergyRealisations(base, "iodine", ())
    noisy = other.pair(20.0, 3)[0].scan
    clean = other.clean[0]
    z = (noisy.counts / 20.0 - clean.counts) / (clean.quantum * clean.counts / 20.0).sqrt()
    assert float(z.square().mean()) == pytest.approx(1.0, abs=5 * (2 / z.numel()) ** 0.5)
    # most of it is the luck of the summed counts
    summed = pair[0][0].scan.counts / 20.0 - base.clean[0].counts
    assert np.corrcoef(z.flatten(), (summed / base.clean[0].counts.sqrt()).flatten())[0, 1] > 0.7


@pytest.mark.parametrize(
    ("spec", "plain", "energies"),
    [
        ("fbp:soft,energies=iodine", "fbp:soft", "iodine"),
        ("fbp:energies=iodine", "fbp", "iodine"),
        ("pwls:energies", "pwls", ""),
        ("mbir:energies=task,fidelity=1", "mbir:fidelity=1", "task"),
        ("mbir:fidelity=1,energies=water/bone", "mbir:fidelity=1", "water/bone"),
        ("bilateral@fbp:detail,energies=iodine", "bilateral@fbp:detail", "iodine"),
        ("fbp:soft", "fbp:soft", None),
        ("my.energies:method", "my.energies:method", None),
    ],
)
def test_the_option_stands_anywhere(spec, plain, energies):
    assert split_energies(spec) == (plain, energies)


def test_methods_carry_their_energies_to_other_processes():
    method = method_of(OWN)
    assert (method.name, method.energies, method.kernels) == (OWN, "", ("soft",))
    make, given = method.__reduce__()
    assert make(*given).energies == ""


def test_what_is_refused(task, folder):
    painted = read_task("tilted")
    from torchpcct.scanner import Scintillator

    integrating = replace(task, scanner=task.scanner.replace(detector=Scintillator()))
    refused(
        ("iodine or two materials A/B, got 'gold'", lambda: check_method("fbp:soft,energies=gold")),
        ("unknown material 'wader'", lambda: check_method("pwls:energies=wader/bone")),
        ("reads volumes", lambda: check_method("files:out,energies=iodine")),
        ("option of evaluations", lambda: split_method("fbp:soft,energies=iodine")),
        ("are given in HU, without energies", lambda: evaluate(painted, OWN, n=8, folder=folder)),
        (
            "given in HU",
            lambda: EnergyRealisations(Realisations(painted, Store(folder / "t")), "", ()),
        ),
        (
            "Scintillator without energy bins",
            lambda: EnergyRealisations(Realisations(integrating, Store(folder / "t")), "", ()),
        ),
        (
            "attenuate alike",
            lambda: EnergyRealisations(Realisations(task, Store(folder / "t")), "water/water", ()),
        ),
    )
