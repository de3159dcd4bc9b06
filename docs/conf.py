"""Sphinx configuration."""

import importlib
import os
import runpy
import sys
from pathlib import Path

import matplotlib.pyplot as plt
from sphinx.application import Sphinx

import quell

sys.path.insert(0, str(Path(__file__).parent))
import machine_texts
import part

# Override the environment: with another backend the figures would be missing, without a warning.
os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"
os.environ["QUELL_QUIET"] = "1"  # pages do not show what is compiled
# Optuna's progress bar has no widgets here, and would show a warning with a path of this machine.
os.environ["PYTHONWARNINGS"] = "ignore:IProgress not found"
# Tutorials call the command line of the same installation.
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"

project = "quell"
author = "The quell developers"
copyright = "2026, the quell developers"
release = version = quell.__version__
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "moving_loop",
]
html_theme = "pydata_sphinx_theme"
html_title = "quell"
html_theme_options = {
    "show_prev_next": False,
    "navbar_center": [],  # the sidebar has all pages
    "secondary_sidebar_items": ["page-toc"],
}
html_show_sourcelink = False
templates_path = ["_templates"]
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_sidebars = {"**": ["pages.html"]}
exclude_patterns = ["_build", "jupyter_execute"]

# All code cells are run during the build; a cell that fails stops it.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_execution_in_temp = True  # tutorials write files
if "QUELL_DOCS_PART" in os.environ:
    run = part.chosen(part.part_of(os.environ["QUELL_DOCS_PART"]))
    nb_execution_excludepatterns = [
        path.name for path in Path(__file__).parent.glob("*.md") if path.stem not in run
    ]
    # Only a page that has run knows the language of its cells.
    suppress_warnings = ["myst-nb.lexer"]
nb_merge_streams = True  # else the lines of a command become many boxes
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3

autosummary_generate = True
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"
napoleon_numpy_docstring = True
napoleon_google_docstring = False


def draw_gallery() -> None:
    """Run the scripts of the gallery, and save their figures for the pages."""
    here = Path(__file__).parent
    folder = here / "images" / "gallery"
    folder.mkdir(exist_ok=True)
    plt.switch_backend("agg")
    for script in sorted((here.parent / "examples" / "gallery").glob("*.py")):
        picture = folder / f"{script.stem}.png"
        if not picture.exists() or picture.stat().st_mtime < script.stat().st_mtime:
            runpy.run_path(str(script))
            plt.gcf().savefig(picture, dpi=100, bbox_inches="tight")
            plt.close("all")


draw_gallery()


def setup(app: Sphinx) -> None:
    """Write the texts for machines beside the pages, which are read in parallel."""
    # MathJax comes from its package, which does not say that pages may be read in parallel.
    importlib.import_module("sphinx-mathjax-offline").setup(app)

    def finish(app: Sphinx, exception: Exception | None) -> None:
        if exception is None and app.builder.format == "html":
            machine_texts.write(Path(app.outdir))

    app.connect("build-finished", finish)
