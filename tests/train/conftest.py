"""One whole run that interrupted ones are compared with."""

import pytest
from tiny_training import STEPS, run


@pytest.fixture(scope="session")
def uninterrupted(tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "whole"
    state, signal = run(out, command="python -m train --out whole")
    assert (state.step, signal) == (STEPS, 0)
    return out
