"""Types that annotations name all over the package; imported by type checkers alone.

Arrays are those of numpy. ``Json`` is what a JSON or YAML file holds.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Bools: TypeAlias = NDArray[np.bool_]

Floats: TypeAlias = NDArray[np.float64]

Ints: TypeAlias = NDArray[np.int64]

Reals: TypeAlias = NDArray[np.float32 | np.float64]
"""Readings, images and volumes: computed in the precision in which they come."""

Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"
