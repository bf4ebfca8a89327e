"""Sphinx configuration."""

import os
import sys
from importlib.metadata import version as installed_version
from pathlib import Path

# The gallery's examples draw without a screen and run on the CPU.
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("JAX_PLATFORMS", "cpu")

project = "liethermo"
author = "The liethermo authors"
copyright = "2026, The liethermo authors"
release = installed_version("liethermo")
version = ".".join(release.split(".")[:2])

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from rooms import draw  # noqa: E402

draw(HERE / "generated" / "rooms.svg")

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "numpydoc",
    "myst_parser",
    "sphinx_gallery.gen_gallery",
]

exclude_patterns = ["_build"]
nitpicky = False  # types in the docstrings are prose

myst_enable_extensions = ["amsmath", "dollarmath"]
myst_heading_anchors = 3

autosummary_generate = True
autodoc_typehints = "none"  # the docstrings state the types
autodoc_member_order = "bysource"
numpydoc_show_class_members = False

sphinx_gallery_conf = {
    "examples_dirs": ["../examples"],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"/plot_",
    "ignore_pattern": r"/(?!plot_)[^/]*\.py$",
    "download_all_examples": False,
    "remove_config_comments": True,
    "reset_modules": ("matplotlib",),
    "show_signature": False,
}

html_theme = "pydata_sphinx_theme"
html_title = f"liethermo {release}"
html_show_sourcelink = False
html_theme_options = {"show_prev_next": False, "navigation_with_keys": False}
