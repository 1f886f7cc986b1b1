"""Every study at its smallest scale, measured when it is first asked for.

``--dist loadfile`` gives a file of tests to one process, and a session's fixture is one for each process. So a study is
measured once a session if only its own test file asks for it.
"""

import functools

import pytest
from tiny_studies import run_tiny


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """``tiny("noise")``: that study, measured once; see :class:`tiny_studies.TinyStudy`."""
    return functools.cache(lambda name: run_tiny(name, tmp_path_factory.mktemp(name)))
