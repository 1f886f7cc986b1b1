"""The residual's tests: their rate of false alarms, their power, and what they refuse."""

import itertools
import math
from dataclasses import asdict

import numpy as np
import pytest
import torch
from refusals import refused
from scipy import stats

from torchpcct.metrics import residual_sums
from torchpcct.metrics.residual_test import _upper_tail, residual_test

SHAPE = (60, 6, 24)
W = torch.linspace(500.0, 1500.0, math.prod(SHAPE), dtype=torch.float64).reshape(SHAPE)
U = torch.arange(24, dtype=torch.float64) - 11.5
LINES = 0.1 * torch.exp(
    -((U - 4.0 * torch.sin(torch.linspace(0, 6.2, 60))[:, None, None]) ** 2) / 8
).expand(SHAPE)


def noise(seed):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(SHAPE, dtype=torch.float64, generator=generator) / W.sqrt()


def shifted(columns):
    """LINES of a detector that is moved by so many columns, less LINES: what a wrong centre
    leaves."""
    moved = 0.1 * torch.exp(
        -((U - columns - 4.0 * torch.sin(torch.linspace(0, 6.2, 60))[:, None, None]) ** 2) / 8
    )
    return moved.expand(SHAPE) - LINES


def test_false_alarms_keep_their_rate():
    """p-values of noise are uniform (Kolmogorov–Smirnov), and findings as rare as promised."""
    found = [residual_test(noise(seed), W, LINES, false_alarms=0.2) for seed in range(150)]
    alarms = sum(bool(f.findings) for f in found)
    # At most 0.2, three standard errors above; the centre alone has its fifth of it, as what level,
    # angles, views and rows tolerate leaves them less.
    assert alarms <= 150 * (0.2 + 3 * math.sqrt(0.2 * 0.8 / 150))
    assert alarms >= 150 * 0.02
    assert stats.kstest([f.p_values["centre"] for f in found], "uniform").pvalue > 1e-3
    assert sum(bool(residual_test(noise(s), W, LINES).findings) for s in range(150)) <= 5


@pytest.mark.parametrize("rows", [1, 2, 6])
@pytest.mark.parametrize("steep", [False, True])
def test_sums_do_not_depend_on_the_blocks_of_views(rows, steep, monkeypatch):
    """Those of all views at once are sums over blocks, each with the views beside it."""
    weights = W * (noise(3) > -0.03)
    lines = LINES + 5.0 * noise(4).abs() if steep else LINES
    given = [v[:, :rows].contiguous() for v in (noise(1) + shifted(-0.1), weights, lines)]
    whole = residual_sums.sums(*given)
    monkeypatch.setattr(residual_sums, "_BLOCK", 1)
    monkeypatch.setattr(residual_sums, "_FEWEST_VIEWS", 7)
    torch.testing.assert_close(asdict(residual_sums.sums(*given)), asdict(whole))


def test_a_quarter_of_a_column_is_found_and_measured():
    found = residual_test(noise(1) + shifted(-0.25), W, LINES)
    assert len(found.findings) == 1
    assert "rotation centre" in found.findings[0]
    # Of the shift the score's standard error is 1 / √⟨t, W t⟩.
    t = torch.zeros(SHAPE, dtype=torch.float64)
    t[..., 1:-1] = (LINES[..., 2:] - LINES[..., :-2]) / 2
    assert found.sizes["centre"] == pytest.approx(
        0.25, abs=0.01 + 4 / math.sqrt(float((W * t * t).sum()))
    )
    assert abs(found.chi2 - 1) < 0.1  # χ² alone does not see it


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (torch.linspace(0, 0.01, 60)[:, None, None], "readings of some views"),
        (
            0.005 * torch.randn(60, 1, 1, generator=torch.Generator().manual_seed(5)),
            "readings of some views",
        ),
        (torch.tensor([0.0, 0, 0.01, 0, 0, 0])[:, None], "readings of some rows"),
    ],
)
def test_gains_are_found(change, match):
    findings = residual_test(noise(2) + change.double(), W, LINES).findings
    assert any(match in text for text in findings)


def test_a_hundredth_of_a_column_is_no_finding_however_sure():
    """Noise of millions of readings: 0.012 columns once was "the rotation centre is wrong"."""
    found = residual_test(noise(1) / 1000 + shifted(-0.012), 1e6 * W, LINES)
    assert found.p_values["centre"] < 1e-6
    assert abs(found.sizes["centre"]) == pytest.approx(0.012, rel=0.1)
    assert not any("rotation centre" in text for text in found.findings)


def test_what_dense_rays_show_alone_is_beam_hardening_first():
    """Bone in some rows: said as a change of the gain once."""
    bone = torch.tensor([0.0, 0, 1, 1, 0, 0])[:, None] * (LINES > 0.06)
    (text,) = residual_test(noise(2) / 10**0.5 + 0.03 * bone, 10 * W, LINES).findings[-1:]
    assert "readings of some rows" in text
    assert text.index("beam hardening") < text.index("the gain changed")
    # In readings so clear the step of 3 % is one that voxels may leave, too.
    (text,) = residual_test(noise(2) / 10 + 0.03 * bone, 100 * W, LINES).findings
    assert "or the geometry is not that of the scan" in text
    rows = torch.tensor([0.0, 0, 0.01, 0, 0, 0])[:, None].expand(SHAPE)
    assert "beam hardening" not in residual_test(noise(2) / 10 + rows, 100 * W, LINES).findings[-1]


def test_a_wrong_noise_level_is_found():
    assert "stated noise variance" in residual_test(1.1 * noise(3), W, LINES).findings[0]
    assert "stated noise variance" in residual_test(0.9 * noise(3), W, LINES).findings[0]
    # A tenth of the readings were fitted: χ² of 0.9 is what must be.
    assert (
        residual_test(math.sqrt(0.9) * noise(3), W, LINES, unknowns=W.numel() // 10).findings == ()
    )


def test_what_voxels_leave_at_edges_is_no_error_of_the_scan():
    """Sound scans were told that "exposure, geometry or exterior are not those of the scan"."""
    step = torch.zeros(SHAPE, dtype=torch.float64)
    step[..., 8:16] = 0.1
    edge = torch.zeros(SHAPE, dtype=torch.float64)
    edge[..., [7, 15]] = 1.0  # at which the fitted ones lie a fifth of the step off, to either side
    edge[..., [8, 16]] = -1.0
    for clear, told in ((1.0, False), (100.0, True)):
        found = residual_test(noise(5) / clear**0.5 + 0.02 * edge, clear * W, step)
        assert found.chi2 > 1.05
        assert any("at edges" in text for text in found.findings) == told
        assert not any("exposure" in text for text in found.findings)
    # All readings too noisy, those at edges or not.
    found = residual_test(0.15 * noise(5), 100 * W, step)
    assert "exposure" in found.findings[0]


def test_gains_that_air_leaves_are_no_wrong_noise():
    cells = 0.001 * torch.randn(SHAPE[1:], generator=torch.Generator().manual_seed(3)).double()
    assert residual_test(noise(6) / 20 + cells, 400 * W, LINES).findings == ()
    assert residual_test(noise(6) / 20 + 10 * cells, 400 * W, LINES).findings != ()


def test_readings_without_weight_do_not_count():
    weights, residual = W.clone(), noise(4)
    weights[::7, 2] = 0
    damaged = residual.clone()
    damaged[::7, 2] = math.nan
    a = residual_test(damaged, weights, LINES)
    b = residual_test(residual, weights, LINES)
    assert a == b
    assert a.findings == ()


def test_bad_input_is_named():
    r = noise(0)
    refused(
        ("one shape", lambda: residual_test(r[0], W[0], LINES[0])),
        ("one shape", lambda: residual_test(r, W[1:], LINES)),
        ("weights must be 0 or more", lambda: residual_test(r, -W, LINES)),
        ("weights must be 0 or more", lambda: residual_test(r, 0 * W, LINES)),
        ("finite", lambda: residual_test(r * math.nan, W, LINES)),
        ("false_alarms", lambda: residual_test(r, W, LINES, false_alarms=1.5)),
    )
    assert np.isfinite(residual_test(r.float(), W.float(), LINES.float()).chi2)


@pytest.mark.parametrize("degrees", [1, 2, 37, 10**5])
@pytest.mark.parametrize("noncentrality", [0.0, 1e-30, 1.0, 576.0, 9.9e4, 1e6, 1e15])
def test_tails_of_any_size_are_probabilities_that_fall(degrees, noncentrality):
    """Also where SciPy's own function overflows: far below a large mean, and where it takes
    seconds."""
    mean = degrees + noncentrality
    sd = math.sqrt(2 * (degrees + 2 * noncentrality))
    at = sorted(
        {
            0.0,
            1e-300,
            mean / 100,
            max(mean - 4 * sd, 0.0),
            mean,
            mean + 3 * sd,
            mean + 60 * sd,
            1e300,
            math.inf,
        }
    )
    tails = [_upper_tail(x, degrees, noncentrality) for x in at]
    assert all(0.0 <= p <= 1.0 for p in tails)
    assert all(later <= earlier + 1e-12 for earlier, later in itertools.pairwise(tails))
    assert (tails[0], tails[-1]) == (1.0, 0.0)
    if mean < 1e7:
        assert _upper_tail(mean + 2 * sd, degrees, noncentrality) == pytest.approx(
            stats.ncx2.sf(mean + 2 * sd, degrees, noncentrality), abs=2e-4
        )


def test_a_single_row_that_fits_exactly():
    """Its gain is fitted to rounding by a volume that has converged; the non-central χ² is then
    asked far below 1."""
    w = torch.full((120, 1, 160), 3e4, dtype=torch.float64)
    r = (
        torch.randn(w.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        / w.sqrt()
    )
    found = residual_test(r - r.mean(), w, torch.ones_like(r).cumsum(-1) / 100)
    assert found.findings == ()
    assert found.p_values["rows"] == 1.0


def test_what_voxels_leave_in_whole_rows_and_views_is_no_gain():
    """Faces between two slices: the fit spreads a part of what it cannot explain."""
    disc = torch.zeros(SHAPE, dtype=torch.float64)
    disc[:, 2:4, 6:18] = 0.3
    face = torch.zeros(SHAPE, dtype=torch.float64)
    face[:, [1, 2, 3, 4], 6:18] = 0.05
    spread = torch.tensor([0.004, 0.0, -0.003, -0.003, 0.0, 0.004])[:, None]
    clear = 400.0
    found = residual_test(noise(7) / clear**0.5 + face + spread, clear * W, disc)
    assert ["at edges" in text for text in found.findings] == [True]
    # The same where the volume has no edges.
    found = residual_test(noise(7) / clear**0.5 + spread, clear * W, torch.zeros_like(disc))
    assert any("readings of some rows" in text for text in found.findings)


def test_the_noise_of_few_frames_of_air_is_no_gain_of_rows_nor_of_the_whole():
    """Nine frames of as many photons as a reading has."""
    cells = torch.randn(SHAPE[1:], generator=torch.Generator().manual_seed(8)).double()
    for frames, sound in ((9, True), (0.5, False)):
        found = residual_test(noise(8) + cells / (frames * W.mean()) ** 0.5, W, LINES)
        assert (found.findings == ()) == sound


def test_gains_of_two_rows_are_told_from_a_face_between_them():
    shape = (60, 2, 24)
    weights, still = W[:, :2], noise(9)[:, :2] / 10
    step = torch.zeros(shape, dtype=torch.float64)
    step[:, 0, 6:18] = 0.3
    wave = 0.05 * torch.sin(torch.linspace(0, 12.5, 60, dtype=torch.float64))[:, None]
    face = torch.zeros(shape, dtype=torch.float64)
    face[:, 0, 6:18] = wave
    assert not any(
        "some views" in t for t in residual_test(still + face, 100 * weights, step).findings
    )
    gains = residual_test(still + 0.2 * wave[:, None], 100 * weights, LINES[:, :2])
    assert any("some views" in text for text in gains.findings)


def turned(steps):
    """LINES of views that lie so many steps behind their places, less LINES."""
    at = torch.linspace(0, 6.2, 60) + 6.2 / 59 * steps
    moved = 0.1 * torch.exp(-((U - 4.0 * torch.sin(at)[:, None, None]) ** 2) / 8)
    return moved.expand(SHAPE) - LINES


def test_views_beside_their_angles_are_named_and_measured():
    steps = 0.4 * torch.randn(60, generator=torch.Generator().manual_seed(6)).double()
    found = residual_test(noise(10) / 5 + turned(steps), 25 * W, LINES)
    assert ["beside the described angles" in text for text in found.findings] == [True]
    assert found.sizes["angles"] == pytest.approx(float(steps.square().mean().sqrt()), rel=0.2)
    # Of a wrong centre all views lie beside their places, and by what edges leave none.
    (text,) = residual_test(noise(10) / 5 + shifted(0.3), 25 * W, LINES).findings
    assert "rotation centre" in text
    left = 0.2 * LINES.diff(dim=-1, append=LINES[..., -1:]).abs()
    found = residual_test(noise(10) / 5 + left, 25 * W, LINES)
    assert not any("angles" in text for text in found.findings)


def test_what_columns_do_not_share_is_no_gain():
    """What voxels leave of a scan from view to view differs among the columns; a gain does not."""
    generator = torch.Generator().manual_seed(11)
    each = 0.004 * torch.randn((60, 1, 6), dtype=torch.float64, generator=generator)
    shared = each.mean(2, keepdim=True).expand(60, 1, 24)
    shape = (60, 2, 24)
    clear, still = 25 * W[:, :2], noise(12)[:, :2] / 5
    edges = torch.zeros(shape, dtype=torch.float64)
    edges[:, :, ::2] = 0.2
    for off, told in ((each.repeat_interleave(4, 2), False), (5.0 * shared, True)):
        found = residual_test(still + off, clear, edges).findings
        assert any("some views" in text for text in found) == told


def test_an_object_that_ends_within_the_outermost_rows_is_no_gain_and_no_wrong_noise():
    """The nearer it is to the source, the more of it a row sees, which voxels of a whole row do
    not show: three of four such scans once were told that the gain changes from view to view."""
    lines = (1.2 * (1.0 - (U / 8.0) ** 2).clamp_min(0.0).sqrt()).expand(SHAPE)
    nearer = 0.01 * torch.sin(torch.linspace(0, 6.2, 60, dtype=torch.float64))[:, None, None]
    two, clear, still = lines[:, :2], 25 * W[:, :2], noise(13)[:, :2] / 5
    wide = (1.2 * (1.0 - (U / 14.0) ** 2).sqrt()).expand(60, 2, 24)
    flat = torch.zeros((60, 2, 24), dtype=torch.float64)
    flat[..., 4:20] = 0.6
    beside = torch.zeros_like(flat)
    beside[..., :4] = 0.7  # what the fit puts there
    for body, like, size in (
        (two, two, 1.0),
        (wide, wide, 0.7),
        (flat, flat, 1.0),
        (flat, beside, 0.6),
    ):
        assert residual_test(still + size * nearer * like, clear, body).findings == ()
    found = residual_test(still + nearer.expand(60, 2, 24), clear, two).findings
    assert any("some views" in text for text in found)
    # Rows between others of the same object do not see more of it.
    found = residual_test(noise(13) / 5 + nearer * lines, 25 * W, lines).findings
    assert any("some views" in text for text in found)
