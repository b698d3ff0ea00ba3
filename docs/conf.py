"""Settings of the documentation site: `python -m sphinx -W docs results/site` builds it."""

import pathlib
import sys

import rodjax

_HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(_HERE / "_extensions"))

project = "rodjax"
author = "The rodjax developers"
project_copyright = author
version = release = rodjax.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx-mathjax-offline",  # equations need no network
    "plain_docstrings",
    "percent_notebooks",
]
exclude_patterns = ["conf.py", "_extensions"]
suppress_warnings = [
    "mystnb.unknown_mime_type",  # progress bars are widgets where a front end has them
]

# pages
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist", "smartquotes"]
myst_heading_anchors = 3
default_role = "py:obj"  # `Rod` in a docstring links to it, and other code stays code

# notebooks: executed when the site is built, and an error in one fails the build
nb_custom_formats = {".py": ["jupytext.reads", {"fmt": "py:percent"}]}
nb_execution_mode = "cache"
nb_execution_timeout = 900
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_output_stderr = "remove"  # lines of progress

# signatures and docstrings
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # shapes are told in the docstrings
autodoc_class_signature = "mixed"
python_maximum_signature_line_length = 88

# looks
html_theme = "furo"
html_title = f"rodjax {release}"
html_theme_options = {"navigation_with_keys": True}
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
