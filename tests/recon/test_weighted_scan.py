"""Energy bins summed with weights, reconstructed: FBP, PWLS and exact noise of one channel."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_scan import SPECTRAL_GRID, scanner

from recon import reconstruct
from recon.analytic.exact_noise import line_integral_variance
from recon.least_squares.inset_problem import InsetProblem
from torchpcct.spectral import bin_weights

SCANNER = scanner("spectral", rows=10)


@pytest.fixture(scope="module")
def summed(spectral):
    """The plain sum of the bins, as a counting scanner reads it."""
    clean = spectral[0]
    return replace(
        clean, counts=clean.counts.sum(0), air=clean.air.sum(0), exterior=clean.exterior.sum(0)
    )


@pytest.mark.parametrize("method", ["fbp", "pwls"])
def test_equal_weights_give_the_volume_of_the_summed_counts(spectral, summed, method):
    ones = spectral[0].weighted(np.ones((8, 1500)), SCANNER)
    volumes = [reconstruct(s, SPECTRAL_GRID, method).data for s in (ones, summed)]
    assert (volumes[0] - volumes[1]).abs().max() < 0.1


def test_pwls_weighs_by_the_second_moment_of_the_sum(spectral, summed):
    """Inverse variances of an inset's line integrals at 1 s, from the background's spectrum."""
    clean = spectral[0]
    iodine = bin_weights(SCANNER, ("blood_iodine", "fibrous_tissue"), {"adipose": 240.0})
    scan = clean.weighted(iodine)
    problem = InsetProblem(scan, SPECTRAL_GRID)
    exact = scan.window.crop(1.0 / line_integral_variance(scan, 1.0), problem.window)
    # the ball changes the counts behind it by some per cent, which the weights leave out
    assert (problem.weights / exact - 1).abs().max() < 0.1
    # in a ray beside the ball: from the expected counts of the bins
    w = torch.from_numpy(np.asarray(iodine))[:, None]
    counts = clean.exterior.double()
    variance = (w**2 * counts).sum(0) / (w * counts).sum(0) ** 2
    p = torch.log(scan.air / scan.exterior)
    variance = variance * scan.linearisation.slope(p).double() ** 2
    found = scan.exterior_weights().double() * variance
    seen = scan.window.column_indices
    middle = found[:, int(seen.min()) : int(seen.max()) + 1]
    assert (middle - 1).abs().max() < 0.01
    # water reads 0 HU, fat less than with all energies alike: iodine's are the low ones
    fat, fibrous = (
        [float(reconstruct(s, SPECTRAL_GRID, "pwls").data[at]) for s in (scan, summed)]
        for at in ((0, 0, 0), (3, 6, 6))
    )
    assert fat[0] < fat[1] - 5
    assert abs(fibrous[0] - fibrous[1]) < 25


def test_a_measured_scan_knows_what_its_weights_need(spectral):
    """Of a noisy scan whose bins are weighted: its PWLS weights are those of the expectations."""
    clean = spectral[0]
    iodine = bin_weights(SCANNER, ("blood_iodine", "fibrous_tissue"), {"adipose": 240.0})
    noisy = clean.with_noise(0.35, 4).weighted(iodine)
    found, exact = (s.exterior_weights() for s in (noisy, clean.weighted(iodine)))
    seen = noisy.window.column_indices
    inside = slice(int(seen.min()), int(seen.max()) + 1)
    assert (found / (0.35 * exact) - 1)[:, inside].abs().max() < 0.05


def test_electronic_noise_is_refused_by_an_inset(summed):
    """Its share of the variance changes with the exposure, and one set of weights serves all."""
    signal = replace(
        summed, counting=False, quantum=torch.ones_like(summed.counts), electronic_noise=3.0
    )
    with pytest.raises(ValueError, match="electronic noise"):
        InsetProblem(signal, SPECTRAL_GRID)
    quiet = InsetProblem(replace(signal, electronic_noise=0.0), SPECTRAL_GRID)
    torch.testing.assert_close(quiet.weights, InsetProblem(summed, SPECTRAL_GRID).weights)
