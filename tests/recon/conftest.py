"""The command line, and the small noise-free scans that several tests reconstruct."""

import shlex

import drawn_vessel
import pytest
from small_scan import GRID, SCENE, SPECTRAL_GRID, scanner

from recon.cli import main
from recon.least_squares.inset_problem import InsetProblem
from torchpcct import acquire
from torchpcct.spectral import SpectralModel, decompose_exterior, decompose_scan


@pytest.fixture(scope="session")
def clean():
    return acquire(SCENE, scanner(), region=GRID, duty=0.06, sub_rays=16)


@pytest.fixture(scope="session")
def problem(clean):
    return InsetProblem(clean, GRID)


@pytest.fixture(scope="session")
def spectral():
    """A noise-free spectral scan of the ball, its model, line integrals and those of the
    exterior."""
    s = scanner("spectral", rows=10)
    clean, model = (
        acquire(SCENE, s, region=SPECTRAL_GRID, duty=0.06, sub_rays=16),
        SpectralModel.of(s, 1.0),
    )
    return (
        clean,
        model,
        decompose_scan(clean, model).line_integrals,
        decompose_exterior(clean, model),
    )


@pytest.fixture(scope="session")
def gram():
    """The operator of a drawn vessel's scan."""
    return drawn_vessel.operator()


@pytest.fixture(scope="session")
def drawn():
    """An inset with it, as MBIR asks for one."""
    return drawn_vessel.inset()


@pytest.fixture(scope="session")
def network():
    """For that inset, not trained."""
    return drawn_vessel.untrained()


@pytest.fixture
def cli(capsys):
    """``cli("info scan.h5", status=0)``: what a command says; on the standard error if it ends
    with another status."""

    def run(words, status=0):
        capsys.readouterr()
        try:
            found = main(shlex.split(words))
        except SystemExit as stop:
            found = stop.code
        said = capsys.readouterr()
        assert found == status, said
        return said.err if status else said.out

    return run


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
