"""Checks of arguments: clean values pass, the rest is refused by name, with the reason and the
unit."""

import math

import numpy as np
import pytest

from torchpcct.validate import checked, choice, number, numbers, per_axis, whole


def test_clean_values_pass():
    assert number("x", np.float32(2.0), positive=True) == 2.0
    assert number("x", math.inf, finite=False) == math.inf
    assert number("x", "1.5", low=1.5, high=1.5) == 1.5
    assert numbers("x", np.arange(3), 3) == (0.0, 1.0, 2.0)
    assert numbers("x", [4]) == (4.0,)
    assert per_axis("x", 2, 3, positive=True) == (2.0, 2.0, 2.0)
    assert per_axis("x", (1, 2), 2) == (1.0, 2.0)
    assert whole("n", np.int64(3)) == 3
    assert whole("n", 0, low=0) == 0
    assert choice("kind", "a", ("a", "b")) == "a"


@pytest.mark.parametrize(
    ("check", "error", "message"),
    [
        (
            lambda: number("x", "two", unit="mm"),
            TypeError,
            r"x must be a number in mm, got 'two' \(str\)",
        ),
        (lambda: number("x", 1j), TypeError, "x must be a real number"),
        (lambda: number("x", None), TypeError, "got None"),
        (lambda: number("x", math.inf), ValueError, "x must be finite, got inf"),
        (lambda: number("x", math.nan, finite=False), ValueError, "x must be a number, got nan"),
        (
            lambda: number("x", 0, positive=True, unit="s"),
            ValueError,
            "x must be greater than 0 s, got 0",
        ),
        (lambda: number("x", 3, low=0, high=1), ValueError, r"x must lie in \[0, 1\], got 3"),
        (
            lambda: number("x", -1, low=0, unit="keV"),
            ValueError,
            "x must be at least 0 keV, got -1",
        ),
        (lambda: number("x", 2, high=1), ValueError, "x must be at most 1, got 2"),
        (lambda: numbers("x", (1.0, math.nan)), ValueError, r"x\[1\] must be finite"),
        (lambda: numbers("x", (1.0, 2.0), 3), ValueError, "x must be 3 numbers"),
        (lambda: numbers("x", ()), ValueError, "one number or more"),
        (lambda: numbers("x", "12", 2), ValueError, "x must be 2 numbers"),
        (lambda: per_axis("x", (1, 2), 3), ValueError, "one number or 3 numbers"),
        (lambda: whole("n", 3.0), TypeError, r"n must be a whole number, got 3.0 \(float\)"),
        (lambda: whole("n", True), TypeError, "whole number"),
        (lambda: whole("n", 0), ValueError, "n must be at least 1, got 0"),
        (lambda: choice("kind", "c", ("a", "b")), ValueError, "unknown kind 'c': use one of a, b"),
    ],
)
def test_refusals_name_value_and_remedy(check, error, message):
    with pytest.raises(error, match=message):
        check()


@checked
def mixed(
    first: "int", /, second: "int", third: "int" = 3, *more: int, last: "int" = 5, **rest: int
):
    return first, second, third, more, last, rest


CALLS = [
    ((1, 2), {}),
    ((1,), {"second": 2}),
    ((1, 2, 4, 6, 7), {"last": 8, "other": 9}),
    ((1,), {"second": 2, "last": 8, "first": 9}),
    ((), {}),
    ((1,), {}),
    ((1, 2), {"second": 2}),
    ((), {"first": 1, "second": 2}),
    (("x",), {}),
    ((1, 2), {"second": "x"}),
]


@pytest.mark.parametrize(("args", "kwargs"), CALLS)
def test_arguments_are_bound_as_python_binds_them(args, kwargs):
    def outcome(function):
        try:
            return function(*args, **kwargs)
        except TypeError as error:
            return str(error)

    assert outcome(mixed) == outcome(mixed.__wrapped__)


def test_an_unknown_name_is_refused_before_a_wrong_kind():
    @checked
    def plain(first: "int") -> "int":
        return first

    with pytest.raises(TypeError, match="unexpected keyword argument 'other'"):
        plain("x", other=1)


@pytest.mark.parametrize(
    ("args", "kwargs", "name"),
    [
        (("x", 2), {}, "first"),
        ((1, "x"), {}, "second"),
        ((1,), {"second": "x"}, "second"),
        ((1, 2, "x", 4), {}, "third"),
        ((1, 2), {"last": "x"}, "last"),
        ((1, 2, 3, 4), {"last": "x", "other": 1}, "last"),
    ],
)
def test_a_wrong_kind_is_named_however_it_is_given(args, kwargs, name):
    with pytest.raises(TypeError, match=f"^{name} must be a whole number"):
        mixed(*args, **kwargs)
