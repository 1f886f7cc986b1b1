"""What a result depends on: the sources its module imports, so that a change elsewhere spoils no
cached result."""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
from pathlib import Path

from torchpcct.files import VERSION
from torchpcct.kernel_cache import OURS

_DATA = ("weights/*.safetensors", "*.json")
"""Files that modules of a folder read."""
_ROOT = Path(__file__).parents[2]
"""That the packages of this software lie in."""


@functools.cache
def source_digest(*modules: str) -> str:
    """SHA-256 of the sources that these modules import, directly or not, and of the data beside
    them.

    Args:
        modules: names; those of other software do not count. None at all: all of this software.
    """
    total = hashlib.sha256(VERSION.encode())
    endings: tuple[str, ...] = _DATA
    files: set[Path] = set()
    if modules:
        seen: set[tuple[str, str]] = set()
        for name in modules:
            _follow(name, "", seen)
        files = {
            Path(found[0]) for found in (_source(name) for name, _ in seen) if found is not None
        }
    else:
        files = {_ROOT / package / "__init__.py" for package in ("torchpcct", "recon")}
        endings = "**/*.py", *(f"**/{ending}" for ending in _DATA)
    files |= {
        found
        for folder in {f.parent for f in files}
        for ending in endings
        for found in folder.glob(ending)
    }
    for path in sorted(files):
        total.update(path.relative_to(_ROOT).as_posix().encode() + _content(path))
    return total.hexdigest()


@functools.cache
def _content(path: Path) -> bytes:
    """SHA-256 of a file when it was first asked for."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").digest()


@functools.cache
def _source(name: str) -> tuple[str, bool, tuple[tuple[str, str], ...]] | None:
    """File of a module, whether it is a package, and its imports: module and name (empty: the
    module itself).

    Imports count wherever they stand, but for those of the type checker alone; in a package these
    say where the names are that it loads when they are asked for. None: no module of this software.
    """
    if not f"{name}.".startswith(OURS):
        return None
    try:
        spec = importlib.util.find_spec(name)
    except ModuleNotFoundError:  # a name in a module, not in a package
        return None
    if spec is None or spec.origin is None:
        return None
    found, package = [], spec.submodule_search_locations is not None
    nodes: list[ast.AST] = [ast.parse(Path(spec.origin).read_bytes())]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.Import):
            found += [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found += [(str(node.module), alias.name) for alias in node.names]
        checking = (
            isinstance(node, ast.If)
            and getattr(node.test, "id", "") == "TYPE_CHECKING"
            and not package
        )
        for part in ("orelse",) if checking else ("body", "orelse", "finalbody", "handlers"):
            nodes += (
                getattr(node, part, ())
                if isinstance(node, ast.stmt | ast.Module | ast.ExceptHandler)
                else ()
            )
    return spec.origin, package, tuple(found)


def _follow(name: str, asked: str, seen: set[tuple[str, str]]) -> None:
    """Add a module, or what a package's name comes from, and all that they import."""
    source = _source(name)
    place = name, asked if source is not None and source[1] else ""
    if source is None or place in seen:
        return
    seen.add(place)
    _, package, imports = source
    if package and asked:
        _follow(f"{name}.{asked}", "", seen)
    for module, given in imports:
        if not package or given == asked:
            _follow(module, given, seen)
