"""A log message before the first call that compiles kernels."""

from __future__ import annotations

import logging
from functools import cache
from typing import Any

from torchpcct.kernel_cache import OURS

__all__ = ["announce_compilation"]

_LOG = logging.getLogger(__name__)


@cache
def announce_compilation() -> None:
    """From now on, log a warning when the first kernel of the package is compiled rather than read from the cache."""
    from numba.core import event

    class Announce(event.Listener):
        announced = False

        def on_start(self, event: Any) -> None:
            function = getattr(event.data.get("dispatcher"), "py_func", None)
            if not self.announced and getattr(function, "__module__", "").startswith(OURS):
                Announce.announced = True
                _LOG.warning(
                    "compiling kernels for this processor: this call takes up to a minute longer, later ones read them "
                    "from numba's cache"
                )

        def on_end(self, event: Any) -> None:
            pass

    event.register("numba:compile", Announce())
