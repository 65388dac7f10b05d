"""How Sphinx builds the site (`make docs`). Its source folder is the repository, so that links work on GitHub too.

The build needs no network: mathematics becomes MathML, and no inventory of another project is read.
"""

import shutil
import sys
from pathlib import Path

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.nodes import make_refnode

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))  # the package of this repository
sys.path.insert(0, str(HERE / "site"))

import forbes  # noqa: E402

project, author, release = "forbes", "the authors of forbes", forbes.__version__
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "mathml",
]

# Pages of names that a former version had would be found, and are linked from nowhere.
shutil.rmtree(Path(__file__).parent / "generated", ignore_errors=True)

root_doc = "docs/index"
include_patterns = ["docs/**", "notebooks/**", "*.md", "*/README.md", "data/pretrained/README.md"]
include_patterns += ["benchmarks/gpu.md", "benchmarks/growth.md", "benchmarks/scale.md"]
exclude_patterns = ["README.md", "docs/site", "docs/results/runs", "build", "runs", "tests", ".*", "**/.*"]

default_role = "py:obj"  # a docstring's `name` is code, and a link where it is documented
autodoc_default_options = {"members": True, "show-inheritance": True, "member-order": "bysource"}
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_typehints_format = "short"
autodoc_inherit_docstrings = False
autosummary_generate = True
napoleon_numpy_docstring = False
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4  # the anchors of GitHub
nb_execution_mode = "off"  # notebooks are stored with their outputs; tests/test_notebooks.py runs them
copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True

html_theme = "furo"
html_title = f"forbes {release}"
html_static_path = ["site/static"]
html_css_files = ["site.css"]
templates_path = [str(HERE / "site" / "templates")]  # autosummary looks from the source folder, Sphinx from here
html_additional_pages = {"index": "to-the-front.html"}
html_show_copyright = False
html_copy_source = False

nitpicky = True
nitpick_ignore_regex = [  # what has no page here
    (r"py:.*", r"(lightning|matplotlib|numpy|torch|torchmetrics)\..*"),
    (r"py:.*", r"(abc|argparse|collections|functools|inspect|pathlib|typing)\..*"),
    (r"py:class", r"forbes\.\w+\..*"),
    (r"py:obj", r".*"),  # `(B, T)`
    (r"py:.*", r"(Any|Callable|Literal|Sequence|Mapping|Iterator|Path|Self|Tensor|ndarray|ABC|module|optional)"),
]


def link_to_public_name(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element
) -> nodes.Element | None:
    """Link a class by the module that a user imports it from: `forbes.models.base.State` is `forbes.models.State`."""
    target, python = node["reftarget"], env.domains.python_domain
    name = target.rpartition(".")[2] if target.startswith("forbes.") else target
    if not name[:1].isupper():  # `filter` may be anybody's
        return None
    for prefix in ("forbes", "forbes.beliefs", "forbes.models", "forbes.data", "forbes.envs", "forbes.pomdps"):
        if found := python.objects.get(f"{prefix}.{name}"):
            return make_refnode(app.builder, node["refdoc"], found.docname, found.node_id, content)
    return None


def without_type(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Let a colon in `Returns:` and in an attribute's line be one; napoleon takes what is before it for a type."""
    if what in ("attribute", "property"):
        lines[0] = f": {lines[0]}"
    for before, (number, line) in zip(lines, enumerate(lines[1:], 1), strict=False):
        if before.strip() in ("Returns:", "Yields:"):
            text = line.lstrip()
            lines[number] = f"{line.removesuffix(text)}: {text}"


def setup(app: Sphinx) -> None:
    """Add what is ours to Sphinx."""
    app.connect("missing-reference", link_to_public_name)
    app.connect("autodoc-process-docstring", without_type, priority=400)  # before napoleon
