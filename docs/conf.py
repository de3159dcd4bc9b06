"""Sphinx configuration."""

import os

import quell

# Override the environment: with another backend the figures would be missing, without a warning.
os.environ["QUELL_QUIET"] = "1"
os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"

project = "quell"
author = "The quell developers"
copyright = "2026, the quell developers"
release = version = quell.__version__
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx-mathjax-offline",
]
html_theme = "pydata_sphinx_theme"
html_title = "quell"
html_theme_options = {"show_prev_next": False, "secondary_sidebar_items": ["page-toc"]}
html_show_sourcelink = False
html_sidebars = {"**": []}
exclude_patterns = ["_build", "jupyter_execute"]

# All code cells are run during the build; a cell that fails stops it.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3

autosummary_generate = True
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"
napoleon_numpy_docstring = True
napoleon_google_docstring = False
