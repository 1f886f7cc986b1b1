"""The shape of the packages, read from the sources: which way imports go.

Imports count wherever they stand: at the top, in a function, and for the type checker only.
"""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parent.parent
UPWARDS = ("torchpcct", "recon", "recon.study", "recon.cli", "train")


def _modules():
    for top in ("torchpcct", "recon", "train"):
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


MODULES = dict(_modules())


def _imports(module):
    """Modules of this repository that a module names in its import statements, itself excluded."""
    path = MODULES[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = (
                package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            )
            base = ".".join([*above, *([node.module] if node.module else [])])
            # What is imported may be a module of the package or a name in it.
            names += [
                f"{base}.{alias.name}" if f"{base}.{alias.name}" in MODULES else base
                for alias in node.names
            ]
    return {name for name in names if name in MODULES and name != module}


GRAPH = {module: _imports(module) for module in MODULES}


def _reached(package):
    """Modules that those of a package import, themselves or through others."""
    found, new = set(), {m for m in MODULES if f"{m}.".startswith(f"{package}.")}
    while new:
        found |= new
        new = {needed for m in new for needed in GRAPH[m]} - found
    return found


def _level(module):
    return max(n for n, package in enumerate(UPWARDS) if f"{module}.".startswith(f"{package}."))


def test_no_import_circles():
    TopologicalSorter(GRAPH).prepare()  # raises CycleError with the modules of a circle


def test_no_import_points_up():
    """torchpcct ← recon ← train, and within recon the studies and the command line above all
    else."""
    assert not [
        (m, needed) for m, needs in GRAPH.items() for needed in needs if _level(needed) > _level(m)
    ]


def test_mbir_knows_no_application():
    """What MBIR may know of an object is a plug-in of its own package (:mod:`recon.mbir.known`)."""
    assert not [m for m in _reached("recon.mbir") if m.startswith("recon.vessel")]
    assert [m for m in _reached("recon.api") if m.startswith("recon.vessel")]
