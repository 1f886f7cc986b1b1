"""Operators as other libraries call them, narrow dtypes, forks and the notice of compilation."""

import copy
import importlib.metadata
import importlib.util
import os

import numpy as np
import pytest
import torch
from fresh_python import run_python
from geometries import REGISTRY
from inset_operators import dense

from torchpcct import Projector

CASES = ["parallel_half_turn", "fan_curved_short_scan", "cone_window"]


@pytest.fixture(params=CASES)
def A(request):
    return Projector(*REGISTRY[request.param])


def test_product_and_adjoint(A):
    x, y = torch.randn(2, *A.domain_shape), torch.randn(*A.range_shape)
    assert torch.equal(A @ x, A(x))
    assert torch.equal(A.H @ y, A.T(y))
    assert A.H.H is A


def test_norm_is_the_largest_singular_value(A):
    exact = float(torch.linalg.matrix_norm(dense(A), 2))
    assert A.norm() == pytest.approx(exact, rel=1e-3)
    assert A.norm() <= exact * (1 + 1e-5)
    assert A.T.norm() == pytest.approx(exact, rel=1e-3)


def test_norm_is_kept(A, monkeypatch):
    first = A.norm()
    monkeypatch.setattr(type(A), "forward", lambda self, x: pytest.fail("computed again"))
    assert A.norm() == first
    with pytest.raises(pytest.fail.Exception):
        A.norm(tolerance=1e-6)  # closer than what is kept


def test_scipy_solves_with_it(A):
    from scipy.sparse.linalg import lsqr

    S, M = A.as_scipy(np.float64), dense(A).numpy()
    assert S.shape == M.shape
    assert S.dtype == np.float64
    rng = np.random.default_rng(0)
    X, Y = rng.standard_normal((M.shape[1], 3)), rng.standard_normal((M.shape[0], 2))
    np.testing.assert_allclose(S @ X, M @ X, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(S.H @ Y, M.T @ Y, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(S @ X[:, 0], M @ X[:, 0], rtol=1e-9, atol=1e-9)
    y = M @ X[:, 0]
    found = lsqr(S, y, damp=0.1, atol=1e-12, btol=1e-12, iter_lim=3000)[0]
    expected = np.linalg.solve(M.T @ M + 0.01 * np.eye(M.shape[1]), M.T @ y)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    assert A.as_scipy().matvec(X[:, 0]).dtype == np.float32
    with pytest.raises(TypeError, match="float32 or float64"):
        A.as_scipy(np.float16)


def test_pylops_takes_it(A):
    pylops = pytest.importorskip("pylops")
    P = A.as_pylops(np.float64)
    assert isinstance(P, pylops.LinearOperator)
    assert pylops.utils.dottest(P, rtol=1e-9, raiseerror=False)
    x = np.random.default_rng(0).standard_normal(P.shape[1])
    np.testing.assert_allclose(
        P @ x, A(torch.from_numpy(x).reshape(A.domain_shape)).numpy().ravel(), rtol=1e-12
    )


@pytest.fixture(scope="session")
def deepinv():
    """Once, as operators cannot be registered again. It imports torchvision, whose compiled
    operators (no one is used here) lack beside a PyTorch for CPUs alone, unless torchvision is of
    https://download.pytorch.org/whl/cpu, too; it then looks for two of them in vain."""
    if importlib.util.find_spec("deepinv") is None:
        pytest.skip("deepinv is not installed")
    if torch.version.cuda is None and "+cpu" not in importlib.metadata.version("torchvision"):
        for name in ("nms", "qnms"):
            torch.library.define(
                f"torchvision::{name}", "(Tensor boxes, Tensor scores, float threshold) -> Tensor"
            )
    return importlib.import_module("deepinv")


def test_deepinv_takes_it(A, deepinv):
    physics = A.as_deepinv()
    assert isinstance(physics, deepinv.physics.LinearPhysics)
    x = torch.randn(2, 1, *A.domain_shape)
    assert torch.equal(physics.A(x), A(x))
    assert float(physics.adjointness_test(x)) == pytest.approx(
        0.0, abs=1e-3 * float(A(x).square().sum())
    )


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_narrow_numbers_are_computed_in_float32(A, dtype):
    x = torch.rand(*A.domain_shape).to(dtype).requires_grad_()
    y = A(x)
    assert y.dtype == torch.float32
    assert torch.equal(y, A(x.detach().float()))
    y.sum().backward()
    assert x.grad.dtype == dtype
    torch.testing.assert_close(x.grad, A.T(torch.ones_like(y)).to(dtype))


def test_autocast(A):
    """A network before the projector leaves bfloat16; the loss and its gradient are those of
    float32 from there on."""
    layer = torch.nn.Linear(A.domain_shape[-1], A.domain_shape[-1])
    x = torch.rand(*A.domain_shape)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = layer(x)
        assert mixed.dtype == torch.bfloat16
        y = A(mixed)
    assert y.dtype == torch.float32
    y.square().sum().backward()
    assert torch.isfinite(layer.weight.grad).all()


class _Step(torch.nn.Module):
    def __init__(self, A):
        super().__init__()
        self.A = A
        self.scale = torch.nn.Parameter(torch.tensor(0.5))

    def forward(self, x):
        return x - self.scale * self.A.T(self.A(x))


@pytest.mark.slow  # the tracer takes seconds to load
def test_compiled_and_exported(A):
    """To the tracer a pass is one operation, in a whole graph, with its gradient; a copy has a
    handle of its own."""
    step, x = _Step(A), torch.rand(2, *A.domain_shape)
    expected = step(x)
    compiled = torch.compile(step, backend="aot_eager", fullgraph=True)
    torch.testing.assert_close(compiled(x), expected)
    compiled(x).square().sum().backward()
    found, step.scale.grad = step.scale.grad, None
    step(x).square().sum().backward()
    torch.testing.assert_close(found, step.scale.grad)
    program = torch.export.export(step, (x,))
    torch.testing.assert_close(program.module()(x), expected)
    twin = copy.deepcopy(A)
    assert twin._engine.handle != A._engine.handle
    assert torch.equal(twin(x), A(x))


CHILD = """
import os, sys, threading, time
import torch
from torchpcct import ParallelBeam, Projector, VolumeGrid, full_turn
from torchpcct.threads import set_num_threads
set_num_threads(2)
A = Projector(ParallelBeam(full_turn(9), 5, 1.9), VolumeGrid((3, 3), 2.0))
x = torch.ones(3, 3)
B = Projector(ParallelBeam(full_turn(180), 300, 1.0), VolumeGrid((256, 256), 1.0))
if sys.argv[1] != "never":
    expected = A(x)
if sys.argv[1] == "meanwhile":
    image = torch.ones(256, 256)
    B(image)
    busy = threading.Event()
    def project():
        while True:
            B(image)
            busy.set()
    threading.Thread(target=project, daemon=True).start()
    busy.wait()
for _ in range(5):
    pid = os.fork()
    if pid == 0:
        A(x)
        found = sum(t.name.startswith("torchpcct") for t in threading.enumerate())
        os._exit(0 if found == 1 and (sys.argv[1] == "never" or torch.equal(A(x), expected)) else 3)
    deadline = time.monotonic() + 300
    while (ended := os.waitpid(pid, os.WNOHANG))[0] == 0 and time.monotonic() < deadline:
        time.sleep(0.02)
    if ended[0] == 0:
        os.kill(pid, 9)
        os.waitpid(pid, 0)
        sys.exit("a child hung")
    print("status", ended[1], flush=True)
"""


@pytest.mark.extended
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this platform")
@pytest.mark.parametrize(
    "used", ["before", "meanwhile", pytest.param("never", marks=pytest.mark.slow)]
)
def test_a_forked_process_computes_on_threads_of_its_own(used):
    """After its parent has projected; while another thread of the parent projects; with a parent
    that never did."""
    done = run_python(CHILD, used, check=False, PYTHONWARNINGS="ignore")
    assert done.stdout.splitlines() == ["status 0"] * 5, done.stdout + done.stderr
