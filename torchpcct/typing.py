"""Types that annotations name all over the package; imported by type checkers alone.

Arrays are those of numpy. ``Json`` is what a JSON or YAML file holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias, TypedDict

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.generic]
"""Of numbers of any kind."""

Bools: TypeAlias = NDArray[np.bool_]

Floats: TypeAlias = NDArray[np.float64]

Floats32: TypeAlias = NDArray[np.float32]

Ints: TypeAlias = NDArray[np.int64]

Reals: TypeAlias = NDArray[np.float32 | np.float64]
"""Readings, images and volumes: computed in the precision in which they come."""

Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"

JsonObject: TypeAlias = dict[str, Any]
"""A JSON object whose values are read by their keys: the data of a study, a report. What stands
under which key is described where it is made."""

Views: TypeAlias = slice | Sequence[int] | NDArray[np.integer] | NDArray[np.bool_]
"""Which views: an index array, a mask or a slice."""


class CountsOptions(TypedDict, total=False):
    """Of :meth:`torchpcct.Scan.from_counts`, what the readers of files pass on."""

    gain: float | str | None
    flux: object
    dead: object
    electronic_noise: float | None
    linearisation: object
    exposure_s: float
