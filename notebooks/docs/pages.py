"""Pages that are written from the package itself: its public names, its commands, its committed
results."""

import argparse
import ast
import base64
import functools
import importlib.util
import json
import re
from pathlib import Path
from types import ModuleType

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


@functools.cache
def public_modules():
    """Modules without an underscore in their names, by package: ``{package: [(module, own, others),
    …]}``.

    ``own`` are the names of ``__all__`` that the module defines; ``others`` those it hands on from
    elsewhere.
    """
    packages = {}
    for top in ("torchpcct", "recon", "train"):
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            if path.stem.startswith("_") and path.stem != "__init__":
                continue
            module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            tree = ast.parse(path.read_text(encoding="utf-8"))
            public, own = [], set()
            for node in tree.body:
                targets = getattr(node, "targets", [getattr(node, "target", None)])
                names = [n.id for t in targets if t for n in ast.walk(t) if isinstance(n, ast.Name)]
                names += [getattr(node, "name", "")]
                if "__all__" in names:
                    public = ast.literal_eval(node.value)
                own.update(names)
            if public or ast.get_docstring(tree):
                entry = (
                    module,
                    [n for n in public if n in own],
                    [n for n in public if n not in own],
                )
                package = module if path.name == "__init__.py" else module.rpartition(".")[0]
                packages.setdefault(package, []).append(entry)
    return packages


def canonical(module, name):
    """Where a name is defined that a module has or hands on, ``(module, name)``."""
    value = getattr(importlib.import_module(module), name)
    if isinstance(value, ModuleType):
        return value.__name__.rpartition(".")[::2]
    home = getattr(value, "__module__", None)
    if home and getattr(value, "__qualname__", None):
        return home, value.__qualname__
    tree = ast.parse(Path(importlib.import_module(module).__file__).read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and any(
            (a.asname or a.name) == name for a in node.names
        ):
            return node.module, name
        if isinstance(node, ast.Name) and node.id == name and isinstance(node.ctx, ast.Store):
            return module, name
    raise LookupError(f"{module}.{name}: nobody defines it")


def write_api(folder):
    """A page a package: each module's text, its names, and those it hands on."""
    packages, bare = public_modules(), {}
    for module in (m for modules in packages.values() for m, *_ in modules):
        body = ast.parse(
            Path(importlib.util.find_spec(module).origin).read_text(encoding="utf-8")
        ).body
        after = zip(body, [*body[1:], None], strict=True)  # a constant's text stands below it
        bare[module] = {
            n.id
            for node, below in after
            if isinstance(node, ast.Assign | ast.AnnAssign) and not isinstance(below, ast.Expr)
            for n in ast.walk(node)
            if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
        }
    for package, modules in packages.items():
        lines = [package, "=" * len(package), ""]
        for module, own, others in sorted(modules, key=lambda m: m[0] != package):
            if module != package:
                lines += [module, "-" * len(module), ""]
            lines += [f".. automodule:: {module}"]
            told = [name for name in own if name not in bare[module]]
            lines += (
                [f"   :members: {', '.join(told)}", "   :undoc-members:", "   :show-inheritance:"]
                if told
                else []
            )
            lines += ["", *(_constant(module, name) for name in own if name in bare[module])]
            for name in others:
                home, qualname = canonical(module, name)
                lines += [f"* ``{name}``: :py:obj:`~{home}.{qualname}`"]
            lines += [""]
        _write(folder / f"{package}.rst", "\n".join(lines))
    top = [p for p in packages if not p.startswith(("recon.study", "recon.cli"))]
    listed = [f"   generated/{p}" for p in (*top, *(p for p in packages if p not in top))]
    _write(folder / "toctree.txt", "\n".join([".. toctree::", "   :maxdepth: 1", "", *listed, ""]))


def _constant(module, name):
    """Of a constant without a text autodoc would show the text of its type."""
    value = " ".join(repr(getattr(importlib.import_module(module), name)).split())
    return (
        f".. py:data:: {name}\n   :module: {module}\n   :value: "
        f"{value if len(value) < 72 else value[:70] + ' …'}\n"
    )


def write_cli(path):
    """The command line, from the parsers themselves."""
    from recon.cli import _parser
    from train.__main__ import _parser as training

    parser, commands, _ = _parser()
    shown = {c.dest: c.help for c in commands._choices_actions}
    lines = ["# Command line", "", "What `--help` prints for each command.", "", _help(parser)]
    for name, command in sorted(commands.choices.items(), key=lambda item: item[0] == "train"):
        lines += [f"## torchpcct {name}", "", f"{shown.get(name) or ''}", ""]
        lines += [_help(command)] if name != "train" else []  # it reads its own options
    _write(path, "\n".join([*lines, _help(training())]))


def _help(parser):
    assert isinstance(parser, argparse.ArgumentParser)
    return f"```text\n{parser.format_help()}```\n"


def write_results(folder):
    """The committed results as pages, each with its pictures; links lead to these pages, or are
    plain text."""
    notebooks, names = HERE.parent, []
    for report in sorted(notebooks.glob("*/report.md")):
        names.append(name := report.parent.name)
        title, _, text = report.read_text(encoding="utf-8").partition("\n")
        shown = sorted(p.name for p in report.parent.glob("*.png") if f"({p.name})" not in text)
        pictures = [f"![{p}](../../{name}/{p})\n" for p in shown]
        text = re.sub(r"\]\((\w+\.png)\)", rf"](../../{name}/\1)", text)
        _write(
            folder / f"{name}.md",
            _linked("\n".join([f"# {name}: {title[2:]}", *pictures, text]), ""),
        )
    measured = ("projectors", "peers", "solvers", "peers_pwls")
    records = (ROOT / "tests" / "bench" / f"{name}.md" for name in measured)
    speed = re.sub(
        r"^#", "##", "\n".join(r.read_text(encoding="utf-8") for r in records), flags=re.MULTILINE
    )
    speed = re.sub(r"\]\((\w+\.png)\)", r"](../../../tests/bench/\1)", speed)
    _write(folder / "speed.md", f"# Speed against error\n\n{speed}")
    names.append("speed")
    toctree = "\n".join(
        ["", "```{toctree}", ":hidden:", *(f"reports/{name}" for name in names), "```", ""]
    )
    _write(
        folder.parent / "results.md",
        _linked((notebooks / "RESULTS.md").read_text(encoding="utf-8"), "reports/") + toctree,
    )
    weights = "recon/mbir/weights"
    for name, path in (
        ("card", f"{weights}/card.md"),
        ("training", f"{weights}/training.md"),
        ("experiments", "train/experiments.md"),
    ):
        _write(folder / f"{name}.txt", _linked((ROOT / path).read_text(encoding="utf-8"), ""))


def write_notebooks(folder):
    """The stored notebooks as pages, with what they printed and drew."""
    for path in sorted(HERE.parent.glob("*.ipynb")):
        parts = []
        for number, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
            source = "".join(cell["source"])
            if cell["cell_type"] == "markdown":
                parts.append(
                    _linked(re.sub(r"\]\((\w+)\.ipynb\)", r"](notebook_\1.md)", source), "")
                )
                continue
            parts.append(
                "```python\n" + re.sub(r"^%.*\n", "", source, flags=re.MULTILINE) + "\n```"
            )
            for output in cell["outputs"]:
                data = output.get("data", {})
                if "image/png" in data:
                    picture = folder / f"notebook_{path.stem}_{number}.png"
                    picture.parent.mkdir(parents=True, exist_ok=True)
                    picture.write_bytes(base64.b64decode(data["image/png"]))
                    parts.append(f"![what the cell above drew]({picture.name})")
                elif "text/markdown" in data:
                    parts.append(
                        re.sub(r"^#", "###", "".join(data["text/markdown"]), flags=re.MULTILINE)
                    )
        _write(folder / f"notebook_{path.stem}.md", "\n\n".join([*parts, ""]))


def _linked(text, to):
    text = re.sub(r"\]\((\w+)/report\.md\)", rf"]({to}\1.md)", text)
    text = re.sub(
        r"\]\([^)]*tests/bench/(?:projectors|peers|solvers|peers_pwls)\.md\)",
        rf"]({to}speed.md)",
        text,
    )
    text = text.replace("](docs/", "](")
    return re.sub(
        r"\[([^\]]*)\]\([^)]*(?:card|causes|experiments|training|RESULTS)\.md\)", r"`\1`", text
    )


def _write(path, text):
    """Only what has changed: Sphinx reads a page again when it is newer."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")
