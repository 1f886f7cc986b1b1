"""Names of settings and of hard cases, checked before anything that computes is loaded.

They are read from the text of the studies' modules, where they are defined: a second list would
fall behind.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

from torchpcct.validate import choice, meant

_HERE = Path(__file__).parent
"""Folder of the studies."""
_TABLES = {"_PLAQUE": "", "_BODY": "body-", "_CONE": "cone-"}
"""Of ``hardcases/cases.py``, in their order, and what stands before their names."""


def settings_name(folder: str) -> str:
    """Name of the class of a study's settings, ``SomeNameSettings`` of the module ``some_name``."""
    return "".join(word.capitalize() for word in folder.split("_")) + "Settings"


@cache
def setting_names(folder: str) -> tuple[str, ...]:
    """Fields of a study's settings.

    Args:
        folder: name of its module or package.
    """
    files = [_HERE / f"{folder}.py", *sorted((_HERE / folder).glob("*.py"))]
    for tree in (ast.parse(path.read_bytes()) for path in files if path.is_file()):
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and node.name == settings_name(folder):
                lines = [
                    n
                    for n in node.body
                    if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)
                ]
                return tuple(
                    ast.unparse(n.target)
                    for n in lines
                    if "ClassVar" not in ast.unparse(n.annotation)
                )
    raise LookupError(f"no {settings_name(folder)} in {files}")


@cache
def case_names() -> tuple[str, ...]:
    """Of :data:`recon.study.hardcases.cases.CASES`."""
    names: list[str] = []
    for node in ast.parse((_HERE / "hardcases" / "cases.py").read_bytes()).body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.value, ast.Dict):
            start = _TABLES.get(ast.unparse(node.target))
            keys = [key.value for key in node.value.keys if isinstance(key, ast.Constant)]
            names += [f"{start}{key}" for key in keys if start is not None and isinstance(key, str)]
    return tuple(names)


def check_setting(folder: str, change: str) -> tuple[str, str]:
    """Name and value of a change ``field=value``.

    Raises:
        ValueError: no such field, or no ``=``.
    """
    name, equals, value = change.partition("=")
    known = setting_names(folder)
    if not equals or name not in known:
        fields = f"with one of the fields {', '.join(sorted(known))}{meant(name, known)}"
        raise ValueError(f"--set {change}: give field=value {fields}")
    return name, value


def check_case(name: str) -> None:
    """Refuse what is no hard case.

    Raises:
        ValueError: with the names that there are.
    """
    choice("case", name, case_names())
