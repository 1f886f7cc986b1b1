"""The prior is a seam: networks, filters and denoisers of a user's own between the same data
steps."""

import sys
from functools import partial

import pytest
import torch
from inset_operators import HU, problem, tissue
from small_scan import GRID
from torch import nn

from recon import reconstruct
from recon.data_term import Quadratic
from recon.evaluate import method_of
from recon.filters import denoiser_of, perona_malik
from recon.gram.gram import Gram
from recon.mbir.field import blockwise
from recon.mbir.mbir import WEIGHTS_FORMAT, Mbir
from recon.mbir.network import Network, NetworkConfig, bilateral_prior
from recon.mbir.priors import PlugAndPlay, name_of, network_of, prior_of
from recon.mbir.residual import MissingBody
from recon.mbir.unrolled import Unrolled, first_views, guide_noise
from recon.mbir.weights_io import write_tensors
from torchpcct import Volume, VolumeGrid

SHAPE = (8, 12, 12)
VOXEL = 0.4
OURS = """
import torch
from torch import nn

IMPORTED = True

class MyNet(nn.Module):
    def __init__(self, width=2):
        super().__init__()
        self.inner = nn.Conv3d(2, width, 3, padding=1)
        self.outer = nn.Conv3d(width, 1, 1)

    def forward(self, estimate, towards, condition, smoothed):
        return towards + self.outer(self.inner(torch.stack([towards, smoothed], 1)))[:, 0]

class Wider(MyNet):
    def __init__(self, width=2):
        super().__init__(width + 1)

def denoise(volume, sigma):
    return volume.clamp(max=volume.mean() + sigma)
"""


@pytest.fixture(scope="module")
def normal():
    """A small noisy problem of two scans at 0.4 mm, in noise units."""
    A, w = problem(shape=SHAPE, rows=10)
    gram = Gram(A, w, nodes=1)
    b = gram.apply(tissue(A.grid))[None] + gram.noise(
        (2,), generator=torch.Generator().manual_seed(0)
    )
    return Quadratic(gram, b, torch.ones(2), (VOXEL,) * 3, 1000 * HU).in_noise_units()


@pytest.fixture
def nets(tmp_path, monkeypatch):
    """The name of a module of a user's own, which can be imported and has not been."""
    name = f"nets_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(OURS, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    yield name
    sys.modules.pop(name, None)


def half(estimate, towards, condition, smoothed):
    return 0.5 * towards + 0.25 * smoothed + 0.0 * estimate


# --- any module or function between the data steps ------------------------------------------------


def test_a_prior_is_any_module_or_function_of_the_four_tensors(normal):
    """It gets what the package's network gets, and what it returns goes on."""
    torch.manual_seed(0)
    own = Unrolled(NetworkConfig((6, 8, 8), VOXEL, bilateral=True), 2).eval()
    for prior in (
        own.network,
        lambda *given: own.network(*given),
        partial(own.network, mirrored=True),
    ):
        same = Unrolled(prior, 2, voxel_mm=VOXEL).eval()
        assert same.voxel_mm == VOXEL
        assert same.bilateral
        assert torch.equal(own(normal), same(normal))
    seen = []

    def prior(estimate, towards, condition, smoothed):
        seen.append((estimate, towards, condition, smoothed))
        return half(estimate, towards, condition, smoothed)

    found = Unrolled(prior, 1, voxel_mm=VOXEL).eval()(normal, 0.7)
    for given, expected in zip(
        (seen[0][0], seen[0][1], seen[0][3]), first_views(normal, True), strict=True
    ):
        assert torch.equal(given, expected)
    level = torch.log(normal.unit_hu / 200.0)
    torch.testing.assert_close(
        seen[0][2], torch.stack([level, torch.full((2,), 0.2), torch.zeros(2)], 1)
    )
    assert torch.equal(found, Unrolled(half, 1).eval()(normal, 0.7))

    def blind(estimate, towards, condition, smoothed):
        assert smoothed is None
        return towards

    Unrolled(blind, 1, bilateral=False).eval()(normal)


def test_a_module_of_a_users_own_is_part_of_the_model(nets):
    module = network_of({"class": f"{nets}:MyNet", "width": 3}, f"{nets}:MyNet")
    model = Unrolled(module, voxel_mm=VOXEL)
    assert {"network.inner.weight", "seen_scale_hu"} <= set(model.state_dict())
    assert module.inner.out_channels == 3
    with pytest.raises(ValueError, match=r"voxels of 0\.4 mm, got voxel_mm=0\.2"):
        Unrolled(Network(NetworkConfig((6, 8, 8), VOXEL)), voxel_mm=0.2)


@pytest.mark.parametrize(
    ("prior", "text"),
    [
        (
            lambda e, t, c, s: t[:, 1:],
            r"the prior <lambda> returned the shape \(2, 7, 12, 12\) for \(2, 8, 12, 12\)",
        ),
        (
            lambda e, t, c, s: t.double(),
            r"returned torch\.float64 on cpu for torch\.float32 on cpu",
        ),
        (lambda e, t, c, s: t.numpy(), "returned ndarray: it must return a tensor"),
        (
            lambda volume: volume[1:],
            r"the prior <lambda> returned the shape \(7, 12, 12\) for \(8, 12, 12\)",
        ),
        (lambda volume, sigma: volume.double(), r"float64 on cpu for torch\.float32"),
        (lambda volume: volume.numpy(), "returned ndarray"),
    ],
)
def test_another_shape_or_precision_is_named(normal, prior, text):
    with pytest.raises((ValueError, TypeError), match=text):
        Unrolled(prior, 1, voxel_mm=VOXEL).eval()(normal)


def test_nan_of_a_prior_is_named(clean, problem):
    def spoilt(volume):
        return torch.where(torch.arange(volume.shape[-1]) == 3, torch.nan, volume)

    scan = clean.with_noise(2.0, 0)
    model = Mbir(Unrolled(spoilt, voxel_mm=VOXEL))
    for network in (model, Mbir(Unrolled(half, voxel_mm=VOXEL), prior=spoilt)):
        with pytest.raises(
            ValueError,
            match=rf"the prior spoilt returned NaN .* in {8 * 18} of {8 * 18 * 18} voxels",
        ):
            reconstruct(scan, GRID, "mbir", network=network, problem=problem)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (nn.Identity, "got the class Identity: make one"),
        (3, "must be a function, a module or a name, got int"),
        (
            lambda a, b, c: a,
            r"a denoiser \(volume\) or \(volume, sigma\): <lambda> takes \(a, b, c\)",
        ),
        ("perona", r"unknown prior of mbir 'perona': use one of .*did you mean"),
        ("no.such.module:run", "cannot load 'no.such.module:run': No module named"),
        ("json:nothing", "cannot load 'json:nothing': module 'json' has no attribute"),
        ("json:__version__", "no attribute|not a function"),
        ("json:decoder", "json:decoder is not a function"),
    ],
)
def test_what_is_no_prior_is_named(given, text):
    with pytest.raises((ValueError, TypeError), match=text):
        Mbir(prior=given)


def test_blocks_of_a_field_are_checked_one_by_one():
    v, told = torch.zeros(1, 8, 8, 24), torch.zeros(1, 3)
    with pytest.raises(
        ValueError, match=r"the prior <lambda> returned the shape .* one value for each voxel"
    ):
        blockwise(
            lambda e, t, c, s: t[..., :1], torch.ones(8, 8, 24), v, v, told, None, block=8, halo=0
        )


# --- denoisers ------------------------------------------------------------------------------------


def test_a_denoiser_sees_hu_and_is_told_the_noise_of_what_it_sees(normal):
    """sigma is the standard deviation of a voxel over draws of the noise; filters get that of
    the smoothed volume."""
    seen = []

    def denoise(volume, sigma):
        seen.append((volume, sigma))
        return volume

    gram = normal.operator
    noise = gram.noise((96,), generator=torch.Generator().manual_seed(1))
    draws = Quadratic(gram, noise, torch.ones(96), (VOXEL,) * 3, 1000 * HU, level=910 * HU)
    draws = draws.in_noise_units()
    Unrolled(denoise, 1, voxel_mm=VOXEL).eval()(draws)
    volumes = torch.stack([v for v, _ in seen])
    assert seen[0][1] == pytest.approx(float((volumes + 90.0).square().mean().sqrt()), rel=0.04)
    assert float(volumes.mean()) == pytest.approx(-90.0, abs=0.1 * seen[0][1])
    scales = draws.unit_hu.reshape(-1, 1, 1, 1)
    torch.testing.assert_close(
        (volumes + 90.0) / scales, first_views(draws, False)[1], rtol=1e-4, atol=1e-4
    )
    spectrum = normal.spectrum()
    assert PlugAndPlay(perona_malik).smoothed_by == 0.7
    assert (
        guide_noise(spectrum, SHAPE, VOXEL, 0.7) < guide_noise(spectrum, SHAPE, VOXEL, 0.0)
    ).all()


def test_filters_by_name_and_functions_of_the_volume_alone(normal):
    model = Unrolled(half, 1, voxel_mm=VOXEL).eval()
    by_name, itself = (model(normal, prior=prior_of(p)) for p in ("perona-malik", perona_malik))
    assert torch.equal(by_name, itself)
    assert prior_of("perona_malik").denoiser is perona_malik
    assert prior_of("bilateral") is bilateral_prior
    assert [name_of(prior_of(p)) for p in ("nlm", bilateral_prior, half)] == [
        "nlm",
        "bilateral_prior",
        "half",
    ]
    # Nothing taken away: what the prior returns is the step towards the data.
    step = first_views(normal, True)[1]
    free = model(
        normal,
        prior=prior_of(lambda volume: volume),
        final_data_consistency=False,
        cut_overshoot=False,
        restore=False,
    )
    torch.testing.assert_close(free, step, rtol=1e-4, atol=1e-4)
    assert prior_of(model.network) is model.network


@pytest.mark.parametrize("kind", [nn.Conv2d, nn.Conv3d])
def test_denoisers_of_deepinv_are_known_by_their_module(kind):
    """They see images with batch and channel whose values are about 1: slices, or volumes if
    they convolve in 3-D."""
    seen = []

    class Denoiser(nn.Module):
        __module__ = "deepinv.models.base"

        def __init__(self):
            super().__init__()
            self.layer = kind(1, 1, 1)

        def forward(self, x, sigma):
            seen.append((tuple(x.shape), sigma))
            return x / 2

    volume = torch.full((3, 4, 5), 500.0)
    for found in (denoiser_of(Denoiser()), prior_of(Denoiser())._denoised):
        torch.testing.assert_close(found(volume, lambda: 20.0), volume / 2)
        assert seen.pop() == ((3, 1, 4, 5) if kind is nn.Conv2d else (1, 1, 3, 4, 5), 0.02)
    assert name_of(prior_of(Denoiser())) == "Denoiser"
    assert not Mbir(prior=Denoiser()).parts["prior"].denoiser.training


def test_a_filter_knows_any_noise_and_says_that_it_is_the_prior(clean, problem):
    """No weights take part: nothing is said of a training, and the report names the prior in
    their place."""
    scan = clean.with_noise(0.2, 0)
    network = Mbir(Unrolled(half, voxel_mm=VOXEL), prior="nlm")
    volume = reconstruct(scan, GRID, "mbir", network=network, problem=problem)
    assert volume.report["prior"] == "nlm"
    assert "weights_sha256" not in volume.report
    assert not any("training" in text for text in volume.report["warnings"])
    assert network.check([1e4], 3000.0) == [
        "the volume reaches 3000 HU, more than 2000 HU: metal shades the tissue beside it"
    ]
    other = reconstruct(
        scan,
        GRID,
        "mbir",
        network=Mbir(Unrolled(half, voxel_mm=VOXEL)),
        prior="nlm",
        problem=problem,
    )
    assert torch.equal(other.data, volume.data)


@pytest.mark.parametrize(("contrast_hu", "word"), [(90.0, "brighter"), (-90.0, "darker")])
def test_a_body_that_the_volume_lacks_is_said_with_its_place(
    clean, problem, monkeypatch, contrast_hu, word
):
    body = MissingBody(0.7, contrast_hu, 8.2, (4, 9, 12))
    monkeypatch.setattr("recon.mbir.mbir.missing_body", lambda *_: [body])
    network = Mbir(Unrolled(half, voxel_mm=VOXEL))
    volume = reconstruct(clean.with_noise(2.0, 0), GRID, "mbir", network=network, problem=problem)
    assert volume.report["missing_body"] == body._asdict()
    (text,) = (w for w in volume.report["warnings"] if "more than the volume shows" in w)
    z, y, x = (axis[n] for axis, n in zip(GRID.axes, body.voxel, strict=True))
    assert f"at z, y, x = {z:.1f}, {y:.1f}, {x:.1f} mm a body of about 0.7 mm" in text
    assert f"{word} (8.2 standard deviations of noise)" in text


# --- weights of another network -------------------------------------------------------------------


@pytest.fixture
def saved(nets, tmp_path):
    """A file with weights of a user's own network, and the model; its module is not imported any
    more."""
    torch.manual_seed(0)
    model = Unrolled(
        network_of({"class": f"{nets}:MyNet", "width": 4}, f"{nets}:MyNet"), 1, voxel_mm=VOXEL
    )
    model.seen_scale_hu = torch.tensor([10.0, 2000.0])
    header = {"network": {"class": f"{nets}:MyNet", "width": 4}, "unroll": 1, "voxel_mm": VOXEL}
    write_tensors(tmp_path / "w.safetensors", WEIGHTS_FORMAT, model.state_dict(), header)
    del sys.modules[nets]
    return tmp_path / "w.safetensors", model.eval().requires_grad_(False)


def test_a_file_alone_imports_nothing(saved, nets):
    path, model = saved
    with pytest.raises(
        ValueError, match=rf"of a class of its own, {nets}:MyNet, .*--network {nets}:MyNet"
    ):
        Mbir.load(path)
    assert nets not in sys.modules
    with pytest.raises(ValueError, match=r"^(?!.*(new installation|holds no weights))"):
        Mbir.load(path)
    found = Mbir.load(path, network=f"{nets}:MyNet")
    assert nets in sys.modules
    made = sys.modules[nets].MyNet
    assert found.voxel_mm == VOXEL
    for network in (found, Mbir.load(path, network=made), Mbir.load(path, network=made(4))):
        assert network.weights_sha256 == Mbir(model).weights_sha256


def test_weights_of_another_class_are_named(saved, nets):
    path, _ = saved
    wider = (
        r"they do not fit Wider: network\.inner\.weight has the shape \(4, 2, 3, 3, 3\) in "
        r"the file, \(5, 2"
    )
    for network, text in (
        (f"{nets}:Wider", wider),
        (f"{nets}:denoise", "denoise cannot be made with width=4"),
        (f"{nets}:Nothing", f"cannot load '{nets}:Nothing'"),
        (dict, "dict must make a torch.nn.Module, got dict"),
    ):
        with pytest.raises(ValueError, match=text):
            Mbir.load(path, network=network)
    with pytest.raises(ValueError, match="the network is the package's own: leave out"):
        Mbir.load(network=f"{nets}:MyNet")


# --- names of methods -----------------------------------------------------------------------------


def test_priors_in_the_name_of_a_method(saved, nets):
    path, _ = saved
    own = method_of(f"mbir:prior={nets}:denoise")
    assert own.network is None
    assert own.key != method_of("mbir:prior=nlm").key
    assert method_of("mbir:prior=bilateral").network.parts["prior"] is bilateral_prior
    trained = method_of(f"mbir:weights={path},network={nets}:MyNet,fidelity=1")
    assert trained.network.fidelity == 1.0
    assert trained.network.model.voxel_mm == VOXEL
    for bad, text in (
        (f"mbir:network={nets}:MyNet", "give weights=FILE, too"),
        (
            f"mbir:weights={path},network=MyNet",
            "network of mbir must be package.module:Class, got 'MyNet'",
        ),
        (f"mbir:weights={path}", "no file alone may import"),
        ("mbir:prior=tw", "unknown prior of mbir 'tw'"),
    ):
        with pytest.raises(ValueError, match=text):
            method_of(bad)


def test_the_library_and_the_command_take_the_same_names(clean, nets, here, cli):
    """``mbir:prior=…`` in recon.reconstruct and in torchpcct reconstruct: the same volume, the
    user's module here."""
    scan, grid = clean.with_noise(2.0, 0), VolumeGrid((4, 9, 9), 0.4, GRID.center)
    scan.save("scan.h5")
    spec = f"mbir:fidelity=1,prior={nets}:denoise"
    found = reconstruct(scan, grid, spec)
    assert found.report["prior"] == "denoise"
    assert found.report["fidelity"] == 1.0
    center, extent = (" ".join(f"{v:g}" for v in values) for values in (grid.center, grid.extent))
    said = cli(
        f"reconstruct scan.h5 --method {spec} --voxel 0.4 --center {center} --extent {extent} "
        "--json"
    )
    assert '"prior": "denoise"' in said
    torch.testing.assert_close(
        Volume.load(here / "scan_mbir.nii.gz").data, found.data, rtol=1e-5, atol=1e-3
    )
    assert torch.equal(
        reconstruct(clean, grid, "fbp:soft").data,
        reconstruct(clean, grid, "fbp", kernel="soft").data,
    )
    with pytest.raises(
        TypeError, match=r"fidelity is given in the method 'mbir:fidelity=1,.* and as an argument"
    ):
        reconstruct(scan, grid, spec, fidelity=0.5)
    for words, text in (
        (f"--method {spec} --fidelity 1", "--fidelity is given in --method"),
        (f"--method mbir --network {nets}:MyNet", "give its --weights FILE, too"),
        (
            f"--method mbir --network {nets} --weights scan.h5",
            "--network must be package.module:Class",
        ),
        ("--method mbir:prior=tw", "unknown prior of mbir 'tw'"),
        ("--method pwls:soft", "pwls has no options"),
    ):
        assert text in cli(f"reconstruct scan.h5 {words}", 2)
