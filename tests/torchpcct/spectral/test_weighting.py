"""Energy bins summed with weights: the best weights, what they bring, and scans of the sum."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from torchpcct import Scan
from torchpcct.scan import NOISE_FREE_EXPOSURE_S
from torchpcct.scanner import SiliconDetector, presets
from torchpcct.scene.materials import calcification, material
from torchpcct.spectral import BinWeights, bin_weights, contrast_information, weighting_gain

SCANNER = presets.pcct(views=40, rows=6, columns=48, mode="spectral")
LUMEN = ("blood_iodine", "fibrous_tissue")
FAT = {"pericoronary_fat": 240.0}
QUOTED = {
    "lumen": (LUMEN, FAT, 1.49),
    "lumen behind water": (LUMEN, {"water": 320.0}, 1.43),
    "fibrous tissue": (("fibrous_tissue", "pericoronary_fat"), FAT, 1.05),
    "core": (("necrotic_core", "fibrous_tissue"), FAT, 1.02),
}


def behind(scanner, paths, scan_s=NOISE_FREE_EXPOSURE_S):
    """The noise-free scan of slabs that all rays cross, without the code that is tested."""
    energies, weights = scanner.weights()
    depth = sum(material(m).attenuation(energies) * t for m, t in paths.items())
    factor = scanner.mas_per_view(scan_s) * scanner.row_factor
    air, counts = (
        np.einsum("bce,r->brc", weights * transmitted, factor)
        for transmitted in (1.0, np.exp(-depth))
    )
    views = scanner.geometry.views
    return Scan(
        counts=torch.from_numpy(counts).float()[:, None].repeat(1, views, 1, 1),
        air=torch.from_numpy(air).float(),
        geometry=scanner.geometry,
        linearisation=scanner.water_linearisation(),
    )


@pytest.fixture(scope="module")
def clean():
    return behind(SCANNER, FAT)


@pytest.fixture(scope="module")
def iodine():
    return bin_weights(SCANNER, LUMEN, FAT)


@pytest.mark.parametrize("name", QUOTED)
def test_what_weights_bring_by_an_independent_calculation(name):
    """Counts with and without a thin slab of the contrast, and the largest eigenvalue of signal
    over noise: no formula of the weights."""
    (a, b), paths, quoted = QUOTED[name]
    energies, spectra = SCANNER.weights()
    tube = spectra[:, 24] * np.exp(
        -sum(material(m).attenuation(energies) * t for m, t in paths.items())
    )
    slab = 1e-4 * (material(a).attenuation(energies) - material(b).attenuation(energies))
    counts = tube.sum(-1)
    change = counts - (tube * np.exp(-slab)).sum(-1)
    white = change / np.sqrt(counts)
    best = np.linalg.eigvalsh(np.outer(white, white))[-1]
    independent = best / (change.sum() ** 2 / counts.sum())
    assert independent == pytest.approx(quoted, abs=0.006)
    found = weighting_gain(SCANNER, (a, b), paths)
    assert found.shape == (48,)
    assert found[24] == pytest.approx(independent, rel=1e-4)
    assert weighting_gain(SCANNER, (a, b), paths, "energies")[24] > found[24]


def test_weights_of_the_contrast_are_those_of_its_bins(iodine):
    assert iodine.shape == (8, 48)
    assert (iodine > 0).all()
    counts = SCANNER.behind({material("pericoronary_fat"): 240.0}).sum(-1)
    np.testing.assert_allclose((iodine * counts).sum(0), counts.sum(0))
    # the bin above the K edge of iodine (33 keV) weighs most
    assert int(iodine[:, 24].argmax()) == 3
    other_way_round = bin_weights(SCANNER, LUMEN[::-1], FAT)
    np.testing.assert_allclose(other_way_round, iodine)
    assert isinstance(pickle.loads(pickle.dumps(iodine)), BinWeights)
    assert pickle.loads(pickle.dumps(iodine)).scanner == SCANNER
    # the bowtie: another beam in every column
    wide = bin_weights(presets.pcct(views=1, rows=1, mode="spectral"), LUMEN, FAT)
    assert abs(wide[3, 0] / wide[3, 750] - 1) > 0.05


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(sorted(QUOTED)),
    st.lists(st.floats(0.0, 10.0), min_size=8, max_size=8).filter(lambda w: max(w) > 0.1),
)
def test_no_weights_are_better(name, weights):
    contrast, paths, _ = QUOTED[name]
    best = weighting_gain(SCANNER, contrast, paths)
    other = weighting_gain(SCANNER, contrast, paths, np.tile(weights, (48, 1)).T)
    assert (other <= best * (1 + 1e-12)).all()


def test_a_contrast_that_changes_its_sign_leaves_no_weight_below_0():
    """Lime and iodine of the same HU at 60 keV: each shows more at some energies."""
    lime = calcification(round(material("blood_iodine").hu(60.0)))
    weights = bin_weights(SCANNER, ("blood_iodine", lime), {"water": 200.0})
    assert (weights >= 0).all()
    assert (weights == 0).any(0).all()
    gain = weighting_gain(SCANNER, ("blood_iodine", lime), {"water": 200.0})
    assert (gain > 1).all()


@pytest.mark.parametrize("detector", [{}, {"dead_time_ns": 100.0}])
def test_water_reads_its_length_whatever_the_weights(detector):
    """The correction of the weighted sum, 0 HU for water: 10 to 380 mm in all columns."""
    scanner = SCANNER.replace(detector=SiliconDetector("spectral", **detector))
    weights = bin_weights(scanner, LUMEN, FAT)
    for length in (10.0, 120.0, 380.0):
        scan = behind(scanner, {"water": length})
        if detector:
            columns, pile_up = np.arange(48), scanner.pile_up()
            scan = replace(
                scan,
                counts=pile_up.apply(scan.counts, scan.air[:, None], columns),
                air=pile_up.apply(scan.air, scan.air, columns),
            )
        weighted = scan.weighted(weights)
        lines = weighted.line_integrals()
        error = lines / (weighted.linearisation.mu_ref * length) - 1
        assert error.abs().max() < (2e-3 if detector else 1e-4)
        if detector:
            plain = scan.linearisation.apply(-torch.log(scan.counts.sum(0) / scan.air.sum(0)))
            assert (plain / (scan.linearisation.mu_ref * length) - 1).abs().max() < 2e-3


def test_the_second_moment_is_that_of_the_counts(clean, iodine):
    """Variance of the weighted noisy counts over many readings, beside the sum of w² N; and of
    their logarithm."""
    weighted = clean.weighted(iodine)
    noisy = clean.with_noise(1.0, 5).weighted(iodine)
    w = torch.from_numpy(np.asarray(iodine))[:, None, None]
    exact = (w**2 * clean.counts).sum(0)
    assert torch.allclose((weighted.quantum * weighted.counts).double(), exact, rtol=1e-5)
    assert float(weighted.quantum.mean()) > 1.3
    z = (noisy.counts - weighted.counts) / exact.sqrt()
    n = z.numel()
    assert abs(float(z.square().mean()) - 1) < 4 * (2 / n) ** 0.5
    assert abs(float(z.mean())) < 4 / n**0.5
    # the noisy scan knows its second moment from its own counts
    assert (noisy.quantum / weighted.quantum - 1).abs().max() < 0.06
    assert (noisy.quantum / weighted.quantum - 1).mean().abs() < 1e-3
    assert torch.allclose(
        weighted.relative_variance(1.0).double(), exact / weighted.counts.double() ** 2, rtol=1e-5
    )
    error = noisy.line_integrals() - weighted.line_integrals()
    spread = error / weighted.weights().rsqrt()
    assert abs(float(spread.square().mean()) - 1) < 0.04
    # the half quantum of the logarithm leaves no bias
    assert abs(float(spread.mean())) < 4 / n**0.5


def test_noise_drawn_afterwards_has_that_variance_too(clean, iodine):
    weighted = clean.weighted(iodine)
    scans = weighted.with_noise(1.0, 2), weighted.with_noise(2.0, 3).at_dose(0.5, 4)
    for scan in scans:
        assert scan.exposure_s == pytest.approx(1.0)
        z = (scan.counts - weighted.counts) / (weighted.quantum * weighted.counts).sqrt()
        assert abs(float(z.square().mean()) - 1) < 4 * (2 / z.numel()) ** 0.5
        assert abs(float(z.mean())) < 4 / z.numel() ** 0.5
    assert scans[1].info["lower_dose"]["exact"] is False
    # thinned before, all moments are exact
    bins = clean.with_noise(2.0, 3).at_dose(0.5, 4)
    assert bins.info["lower_dose"]["exact"] is True
    assert bins.weighted(iodine).quantum.shape == weighted.quantum.shape


def test_equal_weights_are_the_plain_sum(clean):
    ones = clean.weighted(np.ones((8, 48)), SCANNER)
    assert torch.allclose(ones.counts, clean.counts.sum(0))
    assert torch.allclose(ones.air, clean.air.sum(0))
    assert (ones.quantum == 1).all()
    np.testing.assert_allclose(
        ones.linearisation.coefficients, SCANNER.water_linearisation().coefficients
    )
    assert ones.info["energies"]["weights"] == [1.0] * 8


def test_files_keep_weighted_scans(tmp_path, clean, iodine):
    scan = clean.with_noise(0.7, 1).weighted(iodine)
    scan.save(tmp_path / "scan.h5")
    back = Scan.load(tmp_path / "scan.h5")
    assert torch.equal(back.line_integrals(), scan.line_integrals())
    assert torch.equal(back.weights(), scan.weights())
    assert back.info["energies"] == {
        "contrast": list(LUMEN),
        "behind_mm": FAT,
        "weights": [round(float(w), 4) for w in iodine[:, 24]],
    }


def test_parts_of_a_scan_are_those_of_its_scanner(tmp_path, clean, iodine):
    """Some views, some rows of a file, less dose: the weights of the whole scanner fit them all."""
    whole = clean.weighted(iodine)
    clean.with_noise(1.0, 0).save(tmp_path / "scan.h5")
    rows = replace(
        clean,
        counts=clean.counts[:, :, 2:4],
        air=clean.air[:, 2:4],
        geometry=clean.geometry.with_rows(2, 2),
    )
    torch.testing.assert_close(rows.weighted(iodine).counts, whole.counts[:, 2:4])
    some = clean.select(slice(0, 40, 4)).weighted(iodine)
    torch.testing.assert_close(some.line_integrals(), whole.line_integrals()[::4])
    quarter = Scan.load(tmp_path / "scan.h5").at_dose(0.25).weighted(iodine)
    assert float(quarter.counts.mean() / whole.counts.mean()) == pytest.approx(0.25, rel=0.02)


def test_dead_readings_are_those_of_bins_that_weigh(clean, iodine):
    dead = torch.zeros(clean.counts.shape, dtype=torch.bool)
    dead[3, :, 2, 7] = dead[0, 5, 1, 1] = True
    noisy = replace(clean.with_noise(1.0, 0), dead=dead)
    found = noisy.weighted(iodine)
    assert torch.equal(found.dead, dead.any(0))
    assert (found.weights()[found.dead] == 0).all()
    without = np.array(iodine)
    without[0] = 0
    assert torch.equal(noisy.weighted(without, SCANNER).dead, dead[1:].any(0))


def test_a_photon_that_counts_in_two_cells_is_one():
    """Counts of one photon in all bins and cells together, against the photons that count at least
    once; without charge sharing the bins are independent."""
    energies = np.arange(20.0, 100.0, 9.0)
    sharing = SiliconDetector("spectral", charge_sharing=0.3)
    joint = sharing.joint_counts(energies)
    np.testing.assert_allclose(joint, joint.swapaxes(0, 1))
    counts = sharing.response(energies).sum(0)
    twice = counts - sharing.photons_above(energies, sharing.thresholds_kev[:1])[0]
    # of 0, 1 or 2 counts the mean square is the mean and twice the chance of 2
    np.testing.assert_allclose(joint.sum((0, 1)), counts + 2 * twice, rtol=1e-12)
    alone = SiliconDetector("spectral")
    diagonal = np.einsum("ij,je->ije", np.eye(8), alone.response(energies))
    np.testing.assert_allclose(alone.joint_counts(energies), diagonal, atol=1e-15)

    def information(detector, weights):
        scanner = presets.pcct(views=1, rows=1, columns=3, detector=detector)
        return contrast_information(scanner, LUMEN, FAT, weights)[1]

    best, plain = (information(alone, w) for w in ("bins", "sum"))
    assert best / plain == pytest.approx(weighting_gain(SCANNER, LUMEN, FAT)[24], rel=1e-3)
    shared, plain = (information(sharing, w) for w in ("bins", "sum"))
    # sharing costs more of what the bins tell than of the plain sum
    assert 0.6 < shared / best < 0.8
    assert shared > plain
    for seed in range(5):
        weights = np.random.default_rng(seed).uniform(0, 3, (8, 1)) * np.ones(3)
        assert information(sharing, weights) <= shared


def test_what_is_refused(clean, iodine):
    low_voltage = presets.pcct(views=40, rows=6, columns=48, mode="spectral", kvp=60.0)
    lower = SiliconDetector("spectral", thresholds_kev=(5, 12, 22, 32, 42, 52, 60, 70))
    silent = replace(
        clean,
        counts=clean.counts * torch.ones(8).index_fill(0, torch.tensor(3), 0)[:, None, None, None],
    )
    counting = presets.pcct(views=40, rows=6, columns=48)
    negative = np.array(iodine)
    negative[2, 3] = -0.1
    nothing = np.array(iodine)
    nothing[:, 9] = 0
    refused(
        (
            r"bin 7 of 8 .*74 and more keV\) never counts in column",
            lambda: bin_weights(low_voltage, LUMEN, FAT),
        ),
        ("reads 1 bin", lambda: bin_weights(counting, LUMEN, FAT)),
        ("at least 2 energy bins", lambda: bin_weights(presets.eid(views=1), LUMEN)),
        ("attenuate alike", lambda: bin_weights(SCANNER, ("water", "water"))),
        ("two materials", lambda: bin_weights(SCANNER, ("water", "bone", "fat"))),
        ("unknown material", lambda: bin_weights(SCANNER, ("wader", "adipose"))),
        (r"behind\['water'\].*mm", lambda: bin_weights(SCANNER, LUMEN, {"water": -1.0})),
        ("scanner must be", lambda: bin_weights("pcct", LUMEN)),
        (
            "another scanner",
            lambda: clean.weighted(bin_weights(SCANNER.replace(detector=lower), LUMEN)),
        ),
        (
            "another scanner",
            lambda: clean.weighted(
                iodine, presets.pcct(views=40, rows=6, columns=48, mode="spectral", kvp=120.0)
            ),
        ),
        (r"\(8, 48\).*\(8, 47\)", lambda: clean.weighted(iodine[:, 1:])),
        (r"\(8, 48\).*\(8,\)", lambda: clean.weighted(np.ones(8), SCANNER)),
        ("not negative", lambda: clean.weighted(negative, SCANNER)),
        ("not negative", lambda: clean.weighted(iodine * np.nan)),
        ("weights of column 9 are 0", lambda: clean.weighted(nothing, SCANNER)),
        ("give scanner=", lambda: clean.weighted(np.ones((8, 48)))),
        ("real numbers", lambda: clean.weighted("iodine")),
        ("scanner must be a Scanner", lambda: clean.weighted(np.ones((8, 48)), "pcct")),
        ("weight it once", lambda: clean.weighted(iodine).weighted(iodine)),
        (r"bin 3 of 8 .*32…42 keV\) has not counted", lambda: silent.weighted(iodine)),
        ("unknown weights 'bin'", lambda: weighting_gain(SCANNER, LUMEN, FAT, "bin")),
    )
