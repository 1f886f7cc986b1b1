"""Every study at its smallest scale, measured when it is first asked for.

A session's fixture is one for each process, and ``--dist worksteal`` gives a process tests that
stand together. So a study is measured once or, where a file is shared, twice a session, if only its
own test file asks for it; once with ``--dist loadfile``, which ``.ci/run`` gives the long tests.
"""

import functools

import pytest
from tiny_studies import run_tiny


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """``tiny("noise")``: that study, measured once; see :class:`tiny_studies.TinyStudy`."""
    return functools.cache(lambda name: run_tiny(name, tmp_path_factory.mktemp(name)))
