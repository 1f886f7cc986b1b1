"""Tables of calls that must be refused."""

import pytest


def refused(*cases):
    """Each ``(pattern, call)``: a ValueError or TypeError in whose words the pattern is found."""
    for pattern, call in cases:
        with pytest.raises((ValueError, TypeError), match=pattern):  # noqa: PT012
            call()
            pytest.fail(f"was not refused: {pattern}")


def refusals(*cases):
    """A test of each case of :func:`refused` by itself."""

    @pytest.mark.parametrize(("pattern", "call"), cases, ids=[pattern for pattern, _ in cases])
    def test(pattern, call):
        refused((pattern, call))

    return test
