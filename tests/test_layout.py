"""The shape of the packages, read from the sources: which way imports go.

Imports count wherever they stand: at the top, in a function, and for the type checker only.
"""

import ast
import functools
import itertools
from graphlib import TopologicalSorter
from pathlib import Path

from parsed import import_statements, parsed

ROOT = Path(__file__).parent.parent
PACKAGES = ("torchpcct", "recon", "train")
IMPORTERS = ("import_module", "__import__", "run_module")


def _modules():
    for top in PACKAGES:
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


MODULES = dict(_modules())


def _imports(module):
    """Modules of this repository that a module names in its import statements, itself excluded."""
    path = MODULES[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    names = []
    for node in import_statements(path):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        else:
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


@functools.cache
def _graph():
    return {module: _imports(module) for module in MODULES}


def _drawn():
    """The layers as CONTRIBUTING draws them, from below: package → number of its line."""
    text = (ROOT / ".github" / "CONTRIBUTING.md").read_text(encoding="utf-8")
    drawing = text.partition("## Layers")[2].partition("```text\n")[2].partition("```")[0]
    found = {}
    for height, line in enumerate(reversed(drawing.splitlines())):
        # Packages of one layer stand side by side; behind a single one stands what it is for.
        names = itertools.takewhile(lambda word: word.split(".")[0] in PACKAGES, line.split())
        found |= dict.fromkeys(names, height)
    return found


LAYERS = _drawn()


def _package(module):
    """What the drawing calls it: recon and train's packages by themselves, torchpcct as a whole."""
    parts = module.split(".")
    return ".".join(parts[:2]) if parts[0] == "recon" else parts[0]


def _named_in_texts(path):
    """Modules of this repository that are imported by a text: of an f-string its first part."""
    source = path.read_text(encoding="utf-8")
    if not any(name in source for name in IMPORTERS):
        return
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Call) and node.args:
            function, text = ast.unparse(node.func), node.args[0]
            if isinstance(text, ast.JoinedStr):
                text = text.values[0]
            if function.split(".")[-1] in IMPORTERS:
                yield str(getattr(text, "value", ""))


def test_no_import_circles():
    TopologicalSorter(_graph()).prepare()  # raises CycleError with the modules of a circle


def test_the_drawing_names_all_packages():
    assert set(LAYERS) == {_package(module) for module in MODULES}


def test_no_import_points_up_or_sideways():
    assert not [
        (module, needed)
        for module, needs in _graph().items()
        for needed in needs
        if _package(needed) != _package(module)
        and LAYERS[_package(needed)] >= LAYERS[_package(module)]
    ]


def test_no_module_is_imported_by_a_text():
    """But by the command line, which loads what a command needs, and by the list of studies."""
    assert not [
        (module, text)
        for module, path in MODULES.items()
        for text in _named_in_texts(path)
        if text.split(".")[0] in PACKAGES
        and path.name != "__init__.py"
        and not module.startswith(("recon.cli", "recon.study.registry", "torchpcct.__main__"))
    ]
