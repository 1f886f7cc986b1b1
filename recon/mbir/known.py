"""What is known of the object before MBIR reconstructs the rest: a plug-in, see
:meth:`recon.mbir.mbir.Mbir.with_known`.

With T an image of what is known, fitted to the scan's own data,

    u = T + MBIR(b − H T),

so whatever T lacks comes from the data as ever, beside an edge that is no longer there to bleed
into it. Nothing in :mod:`recon.mbir` says what T shows: :mod:`recon.vessel.known` models
a contrast-enhanced vessel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from torch import Tensor

from recon.data_term import Quadratic

if TYPE_CHECKING:
    from torchpcct.typing import JsonObject

__all__ = ["Known", "KnownImage"]


def _no_objection(volume: Tensor) -> str:
    return ""


@dataclass(frozen=True, eq=False)
class KnownImage:
    """What is known of the object of one scan.

    Attributes:
        image: T, HU ``(z, y, x)``, differentiable in the data as far as it says so; None: nothing.
        why: there is no image, for the report and its warning; empty with an image.
        report: added to the volume's report.
        warnings: added to those of the volume's report.
        objection: what speaks against T, given the reconstruction around it, HU ``(z, y, x)``;
            empty: nothing. A T that is objected to is not used.
    """

    image: Tensor | None
    why: str = ""
    report: JsonObject = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    objection: Callable[[Tensor], str] = _no_objection

    def __post_init__(self) -> None:
        if (self.image is None) != bool(self.why):
            raise ValueError(
                "KnownImage takes either an image or, in why, the reason that there is none"
            )


class Known(Protocol):
    """A plug-in: an image of what is known of the object, fitted to each scan.

    Attributes:
        name: what it models, such as ``vessel``; in reports the key under which ``used`` and
            ``why`` stand.
        caution: the warning of a volume for which the model was used.
    """

    @property
    def name(self) -> str:
        """See the class."""
        ...

    @property
    def caution(self) -> str:
        """See the class."""
        ...

    def image_of(self, term: Quadratic, fidelity: float) -> KnownImage:
        """The image of one scan.

        Args:
            term: of the scan, in mm⁻¹, a batch of one; its operator is a
                :class:`recon.gram.gram.Gram`.
            fidelity: of the reconstruction, 0 (viewing) … 1 (measuring).
        """
        ...
