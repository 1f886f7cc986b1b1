"""The examples in the docstrings of what ``recon`` exports do what they say."""

import doctest

import pytest

import recon


@pytest.mark.parametrize("name", [n for n in recon.__all__ if callable(getattr(recon, n))])
def test_the_example_of_a_public_function_runs(name):
    function = getattr(recon, name)
    (found,) = doctest.DocTestFinder(recurse=False).find(function, name, globs={name: function})
    outcome = doctest.DocTestRunner().run(found)
    assert outcome.attempted > 4
    assert not outcome.failed
