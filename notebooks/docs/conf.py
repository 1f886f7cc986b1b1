"""The site: ``sphinx-build -W -n -b html notebooks/docs out/site``.

The gallery runs, for its pictures; not with ``-D sphinx_gallery_conf.filename_pattern=none``, which
is minutes faster. Nothing is downloaded: formulas become MathML (docutils), which browsers draw
themselves. The pages of the API and of the command line are written from the package each time,
into ``reference/generated``.
"""

import importlib
import os
import re
import sys
from pathlib import Path
from types import ModuleType

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.ext.napoleon import GoogleDocstring

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT), str(HERE)]
os.environ["MPLBACKEND"] = "agg"
os.environ["COLUMNS"] = "100"  # argparse breaks the lines of --help there

from drawing import draw  # noqa: E402
from pages import canonical, write_api, write_cli, write_notebooks, write_results  # noqa: E402

project, author = "torchpcct", "the authors of torchpcct"
extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "myst_parser",
    "sphinx_design",
    "sphinx_copybutton",
    "sphinxcontrib.bibtex",
    "sphinx_gallery.gen_gallery",
]
html_theme = "pydata_sphinx_theme"
html_title = "torchpcct"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "navbar_end": ["theme-switcher"],
    "collapse_navigation": True,
    "show_prev_next": False,
    "header_links_before_dropdown": 7,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": [],
    "footer_end": [],
}
html_sidebars = {"index": [], "results": [], "limits": [], "glossary": []}
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
bibtex_bibfiles = ["references.bib"]
exclude_patterns = ["gallery/*.ipynb", "gallery/*.py", "gallery/*.zip"]
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

# what other packages and private bases are; no inventory of theirs is downloaded
nitpick_ignore_regex = [
    (
        "py:.*",
        r"(numpy|torch|jinja2|collections|concurrent|typing|matplotlib|argparse|pathlib|enum|np|nn)\..*",
    ),
    ("py:.*", r"(.*\.)?_\w+"),
    (
        "py:(class|exc)",
        r"(optional|Module|Exception|Tensor|ndarray|\w+Error|(nbclient|scipy|pydicom)\..*)",
    ),
]
autodoc_typehints = "none"  # the docstrings say shapes, units and kinds, in words
autodoc_class_signature = "mixed"
autodoc_member_order = "bysource"
napoleon_use_rtype = False
napoleon_custom_sections = [("Attributes", "params_style")]

sphinx_gallery_conf = {
    "examples_dirs": "../gallery",
    "gallery_dirs": "gallery",
    "filename_pattern": r"\d\d_",
    "plot_gallery": True,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "copyfile_regex": r"$^",
    "within_subsection_order": "FileNameSortKey",
    "write_computation_times": False,
    "image_scrapers": ("matplotlib",),
    "reset_modules": ("matplotlib",),
    "notebook_images": False,
    "show_signature": False,
}


# --- formulas -------------------------------------------------------------------------------------


def _formula(self, node, block=False):
    mathml = re.sub(
        r"^<math\b(?! xmlns)",
        "<math xmlns='http://www.w3.org/1998/Math/MathML'",
        str(tex2mathml(node.astext(), as_block=block)),
    )
    self.body.append(f'<div class="formula">{mathml}</div>' if block else mathml)
    raise nodes.SkipNode


# --- references -----------------------------------------------------------------------------------


def as_python_does(app, env, node, contnode):
    """A name that a docstring uses is what Python finds there: in the module, or handed on by a
    package. One that is not public leads to the text of its module."""
    if node.get("refdomain") != "py":
        return None
    target, inside = node["reftarget"], [node.get("py:module"), None]
    if node.get("py:class"):
        inside.insert(0, f"{node['py:module']}.{node['py:class']}")
    internal = None
    for where in inside:
        parts = [*(where.split(".") if where else []), *target.split(".")]
        for cut in range(len(parts) - 1, 0, -1):
            try:
                value, rest = importlib.import_module(".".join(parts[:cut])), parts[cut:]
                owner, name = value, rest[-1]
                for part in rest[:-1]:
                    owner = getattr(owner, part)
                if isinstance(owner, ModuleType):
                    home, name = canonical(owner.__name__, name)
                    full = f"{home}.{name}"
                else:
                    home, full = owner.__module__, f"{owner.__module__}.{owner.__qualname__}.{name}"
                    if not (hasattr(owner, name) or re.search(rf"\b{name}\b", owner.__doc__ or "")):
                        continue
            except (ImportError, AttributeError, LookupError, TypeError):
                continue
            domain = env.domains["py"]
            found = domain.resolve_xref(
                env, node["refdoc"], app.builder, "obj", full, node, contnode
            )
            if found is not None:
                return found
            internal = internal or home
    if internal is None:
        return None
    domain = env.domains["py"]
    return domain.resolve_xref(env, node["refdoc"], app.builder, "mod", internal, node, contnode)


def setup(app):
    """Called by Sphinx."""
    # Napoleon takes "Shape of one sinogram: …" of a property for a type and a text; what is
    # returned, likewise.
    GoogleDocstring._consume_returns_section = lambda self, preprocess_types=False: [
        ("", "", self._dedent(self._consume_to_next_section()))
    ]
    GoogleDocstring._consume_inline_attribute = lambda self: ("", self._consume_to_end())
    app.connect("missing-reference", as_python_does)
    app.add_html_math_renderer(
        "mathml", (_formula, None), (lambda self, node: _formula(self, node, True), None)
    )
    write_api(HERE / "reference" / "generated")
    write_cli(HERE / "reference" / "generated" / "commands.md")
    write_results(HERE / "reports")
    write_notebooks(HERE / "reports")
    draw(HERE / "reference" / "generated" / "conventions.svg")
    return {"parallel_read_safe": True}
