"""What an HDF5 file holds itself: its links and data sets may stand for other files, which
nobody meant to open."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import h5py


_MOST_LINKS = 16
"""Soft links to soft links; deeper ones lead in a circle."""
_DEEPEST = 16
"""Groups in groups of our own files."""
_REMEDY = "copy all into one file first (h5copy, h5repack), or open the file that it names"
"""Of a file that names others."""


def inside(file: h5py.Group, name: str, links: int = 0) -> Any:
    """Group or data set of an open HDF5 file by its path; None if there is none.

    Soft links within the file are followed.

    Raises:
        ValueError: a link to another file stands on the way, a data set keeps its numbers in other
            files (external storage, a virtual data set), or soft links lead to nothing or in a
            circle. The message has the names.
    """
    import h5py

    at = file
    for part in name.split("/"):
        if part in ("", "."):
            continue
        link = at.get(part, getlink=True) if isinstance(at, h5py.Group) else None
        if link is None:
            return None
        path = f"{at.name.rstrip('/')}/{part}"
        if isinstance(link, h5py.ExternalLink):
            raise ValueError(f"its {path} is a link to another file, {link.filename}: {_REMEDY}")
        if isinstance(link, h5py.SoftLink):
            if links >= _MOST_LINKS:
                raise ValueError(f"its link {path} leads in a circle")
            at = inside(
                file,
                link.path if link.path.startswith("/") else f"{at.name}/{link.path}",
                links + 1,
            )
            if at is None:
                raise ValueError(f"its link {path} leads to {link.path}, which is not there")
        else:
            at = at[part]
    if isinstance(at, h5py.Dataset):
        _check_storage(at)
    return at


def _check_storage(data: h5py.Dataset) -> None:
    """Raise ``ValueError`` for a data set whose numbers are kept in other files."""
    if data.external:
        names = ", ".join(dict.fromkeys(str(name) for name, *_ in data.external))
        raise ValueError(
            f"its {data.name} keeps its numbers in other files, {names:.200}: {_REMEDY}"
        )
    if data.is_virtual:
        names = ", ".join(dict.fromkeys(str(source.file_name) for source in data.virtual_sources()))
        raise ValueError(f"its {data.name} is a virtual data set, made of {names:.200}: {_REMEDY}")


def require_inside(group: h5py.Group, depth: int = 0) -> None:
    """Raise ``ValueError`` if anything in an HDF5 file of ours, which has no links, stands for
    another file."""
    import h5py

    if depth > _DEEPEST:
        raise ValueError(f"its groups are nested more than {_DEEPEST} deep")
    for name in group:
        found = inside(group, name)
        if isinstance(found, h5py.Group):
            require_inside(found, depth + 1)
