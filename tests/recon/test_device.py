"""The chain on a device that is not the CPU: the same volumes, and nothing copied to the host in
silence."""

from dataclasses import replace

import numpy as np
import pytest
import small_scan
import torch
from standin import DEVICE, standin

from recon.analytic.fbp import fbp
from recon.api import reconstruct
from recon.least_squares.field_problem import FieldProblem
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Projector, Scan, VolumeGrid
from torchpcct.vector_geometry import VectorGeometry

_MU = 0.02


def _scan(geometry, grid, photons=2e4):
    x = torch.zeros(grid.shape)
    inner = tuple(slice(n // 4, -(n // 4) or None) for n in grid.shape)
    x[inner] = _MU
    lines = Projector(geometry, grid)(x)
    mean = photons * torch.exp(-lines)
    counts = torch.poisson(mean, generator=torch.Generator().manual_seed(0)) if photons else mean
    return Scan.from_counts(
        counts, geometry, air=photons, gain=1.0, linearisation=(1.0, 0.01), mu_water=_MU
    )


PLANE = VolumeGrid((8, 8), 2.0)
VOLUME = VolumeGrid((4, 10, 10), (2.0, 2.0, 2.0))
_TURN = np.arange(12) * 2 * np.pi / 12
SCANS = {
    "parallel": (ParallelBeam(np.arange(12) * np.pi / 12, 12, 2.0), PLANE),
    "fan": (FanBeam(_TURN, 60.0, 110.0, 14, 3.5), PLANE),
    "cone": (ConeBeam(_TURN, 60.0, 110.0, 14, 8, (3.5, 3.5)), VOLUME),
    # No circular scan describes them.
    "vectors": (
        VectorGeometry.of(FanBeam(_TURN, 60.0, 110.0, 14, 3.5)).turned(slant=0.1 * np.cos(_TURN)),
        PLANE,
    ),
}


def _same(scan, grid, method, most_copies, **options):
    """The volume on the device is that of the CPU, and copies to the host are those that are
    listed."""
    expect = reconstruct(scan, grid, method, **options)
    with standin() as counter:
        found = reconstruct(scan, grid, method, device=DEVICE, **options)
        copies = [(n, who) for n, who in counter.copies if n > 200]  # beside sums of each view
        volume = found.data.cpu()
    assert found.data.device == DEVICE
    assert "device" not in expect.report
    torch.testing.assert_close(volume, expect.data, rtol=0, atol=0.05)
    assert found.report["device"] == "meta"
    assert found.report["on_cpu"]
    assert found.report["warnings"] == expect.report["warnings"]
    assert len(copies) <= most_copies, copies
    return found


@pytest.mark.parametrize("kind", sorted(SCANS))
def test_fbp_runs_where_device_says(kind):
    geometry, grid = SCANS[kind]
    found = _same(_scan(geometry, grid), grid, "fbp", 0, kernel="soft")
    assert found.report["on_cpu"] == ["tests and repair of the readings"]


@pytest.mark.parametrize("kind", ["fan", "cone", "vectors"])
@pytest.mark.filterwarnings("ignore:PWLS stopped")
def test_pwls_of_a_field_runs_where_device_says(kind):
    geometry, grid = SCANS[kind]
    # Residual, weights and fitted readings, for their test.
    _same(_scan(geometry, grid), grid, "pwls", 3, tolerance=5.0, max_exact=5)


@pytest.mark.parametrize(
    ("method", "options"), [("fbp", {}), ("pwls", {"tolerance": 5.0}), ("mbir", {})]
)
def test_an_inset_is_reconstructed_where_device_says(clean, method, options):
    scan, grid = clean.with_noise(0.35, seed=3), small_scan.GRID
    # Weights for the fit of the model, once; and what is left of the data, for its test.
    found = _same(scan, grid, method, 0 if method == "fbp" else 4, **options)
    fitted = "fit of the FFT model of an inset" in found.report["on_cpu"]
    assert fitted == (method != "fbp")


def test_a_scan_on_a_device_is_reconstructed_there():
    geometry, grid = SCANS["fan"]
    scan = _scan(geometry, grid)
    expect = reconstruct(scan, grid)
    with standin() as counter:
        moved = scan.to(DEVICE)
        assert moved.device == DEVICE
        assert moved.to(DEVICE) is moved
        found = reconstruct(moved, grid)
        assert found.data.device == DEVICE
        asked = len(counter.copies)
        reconstruct(moved, grid, kernel="soft")
        # Its readings were copied for their tests once, and are kept.
        assert all(n < 200 for n, _ in counter.copies[asked:])
        assert sum(n == scan.counts.numel() for n, _ in counter.copies) == 1
        volume = found.data.cpu()
    torch.testing.assert_close(volume, expect.data, rtol=0, atol=0.01)


def test_line_integrals_and_weights_are_made_on_the_device():
    """Of few counts, whose logarithm is biased, with dead readings and water that hardens."""
    scan = _scan(*SCANS["cone"], photons=6.0)
    dead = torch.zeros_like(scan.counts, dtype=torch.bool)
    dead[2, 3, 4:6] = dead[5, 2] = True
    scan = replace(scan, dead=dead)
    with standin() as counter:
        there = scan.to(DEVICE)
        lines, weights = there.line_integrals(), there.weights()
        assert not counter.copies
        found = lines.cpu(), weights.cpu()
    torch.testing.assert_close(found[0], scan.line_integrals(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(found[1], scan.weights(), rtol=1e-5, atol=1e-5)


def test_gradients_of_the_projector_and_of_fbp_stay_on_the_device():
    geometry, grid = SCANS["fan"]
    A = Projector(geometry, grid)
    y = torch.randn(A.range_shape, generator=torch.Generator().manual_seed(0))
    with standin() as counter:
        there = y.to(DEVICE).requires_grad_()
        loss = fbp(there, geometry, grid, outside=0.0).square().sum() + A.T(there).square().sum()
        loss.backward()
        assert not counter.copies
        found = there.grad.cpu()
    here = y.clone().requires_grad_()
    (fbp(here, geometry, grid, outside=0.0).square().sum() + A.T(here).square().sum()).backward()
    assert (found - here.grad).norm() < 1e-5 * here.grad.norm()


def test_devices_that_cannot_are_refused_in_one_sentence(monkeypatch):
    geometry, grid = SCANS["fan"]
    scan = _scan(geometry, grid)
    with pytest.raises(
        ValueError, match=r"no device 'cuda:99' here that torch can use .*use \"cpu\""
    ):
        reconstruct(scan, grid, device="cuda:99")
    with pytest.raises(ValueError, match="no device 'gpu'"):
        scan.to("gpu")
    with pytest.raises(TypeError, match=r"got bool"):
        reconstruct(scan, grid, device=True)
    with pytest.raises(TypeError, match=r"counts must be a tensor of float32 or float64, got .*16"):
        replace(scan, counts=scan.counts.half())
    problem = FieldProblem(scan, grid)
    with standin():
        with pytest.raises(ValueError, match=r"scan is on meta, the problem .* on cpu"):
            reconstruct(scan, grid, "pwls", problem=problem, device=DEVICE)
        with pytest.raises(ValueError, match="counts is on meta, air on cpu"):
            replace(scan, counts=scan.counts.to(DEVICE))
        monkeypatch.setattr("torchpcct.devices.available_bytes", lambda device: 1000)
        monkeypatch.setattr("recon.least_squares.memory.available_bytes", lambda device: 1000)
        with pytest.raises(ValueError, match=r"FBP needs 0\.\d+ GiB on meta, 0\.00 GiB are free"):
            reconstruct(scan, grid, device=DEVICE)
        with pytest.raises(ValueError, match="GiB are available on meta: take"):
            reconstruct(scan, grid, "pwls", device=DEVICE)


def test_a_full_device_is_told_of_in_one_sentence(monkeypatch):
    def full(*_, **__):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB. And more.")
        yield

    monkeypatch.setattr("recon.api._fbp", full)
    geometry, grid = SCANS["fan"]
    with pytest.raises(
        ValueError, match=r"^cpu has too little memory \(CUDA out of memory\): take"
    ):
        reconstruct(_scan(geometry, grid), grid)
