"""Sphinx configuration."""

import inspect
import os
import re
import sys
from importlib.metadata import version as installed_version
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE / "_ext")]

# Examples draw without a screen and run on the CPU. What is compiled for them is kept for the next build.
KEPT = HERE / "_build" / "compiled"
for setting, value in {
    "MPLBACKEND": "Agg",
    "JAX_PLATFORMS": "cpu",
    "LIETHERMO_CACHE": str(KEPT / "liethermo"),
    "JAX_COMPILATION_CACHE_DIR": str(KEPT / "xla"),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}.items():
    os.environ.setdefault(setting, value)  # for the processes that run the pages too

import liethermo  # noqa: E402
import manifolds  # noqa: E402

for package in (liethermo, manifolds):  # what is imported on demand as an attribute autodoc imports as a module
    on_demand = ("plot", "scipy", "sympy", "diffrax") if package is liethermo else ("sympy",)
    for name in (*package.__all__, *on_demand):
        if inspect.ismodule(value := getattr(package, name)):
            sys.modules.setdefault(f"{package.__name__}.{name}", value)

from manifolds._class_members import CLASS_MEMBERS, HELP_MEMBERS  # noqa: E402

HELP_MEMBERS.update(CLASS_MEMBERS)  # autodoc finds members by dir(), and a page shows more of them than help()

import api_members  # noqa: E402
import beside  # noqa: E402
from facts import write_facts  # noqa: E402
from made_by import digest, forget_others  # noqa: E402
from rooms import draw  # noqa: E402
from spec_keys import write_table  # noqa: E402

draw(HERE / "generated" / "rooms.svg")
beside.draw_once(HERE / "generated" / "beside.svg", digest())
forget_others(HERE / "gallery", HERE / "_build" / "gallery.txt", digest())  # an example's own file is all it looks at
write_facts(HERE / "generated" / "facts.md")
write_table(HERE / "generated" / "spec_keys.md")

project = "liethermo"
author = "The liethermo authors"
copyright = "2026, The liethermo authors"
release = installed_version("liethermo")
version = ".".join(release.split(".")[:2])

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "numpydoc",
    "myst_parser",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "code_links",
    "executed",
    "moving_pictures",
    "offline_mathjax",
]

templates_path = ["_templates"]
exclude_patterns = ["_build", "_ext", "generated/executed", "generated/spec_keys.md", "generated/facts.md"]
nitpicky = False  # types in the docstrings are prose

myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
mathjax_path = "mathjax/tex-chtml-full.js"  # shipped with the site

notebook_folders = ("tutorials/",)
never_executed = ["reference/changelog"]

autosummary_generate = True
autosummary_context = {"class_pages": api_members.pages()}
viewcode_line_numbers = True
autodoc_typehints = "none"  # the docstrings state the types
autodoc_member_order = "bysource"
toc_object_entries_show_parents = "hide"
numpydoc_show_class_members = False
numpydoc_use_plots = False

copybutton_exclude = ".linenos, .gp, .go"
copybutton_selector = "div:not(.output) > div.highlight > pre"

sphinx_gallery_conf = {
    "examples_dirs": ["../examples"],
    "gallery_dirs": ["gallery"],
    "subsection_order": [
        *map("../examples/{}".format, "bodies algebras spins fluids heat quantum studies methods".split()),
        "*",
    ],
    "filename_pattern": r"/plot_",
    "ignore_pattern": r"/(?!plot_)[^/]*\.py$",
    "download_all_examples": False,
    "remove_config_comments": True,
    "reset_modules": ("matplotlib",),
    "show_signature": False,
    "thumbnail_size": (520, 364),
    "nested_sections": False,
    "write_computation_times": False,
}

html_theme = "pydata_sphinx_theme"
html_title = f"liethermo {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_js_files = ["turning.js", "momentum_sphere.js", "sphere_field.js", "tumbling_rod.js"]
html_show_sourcelink = False
html_search_scorer = str(HERE / "search_scorer.js")  # lists of everything come last
html_theme_options = {
    "logo": {"text": "liethermo"},
    "header_links_before_dropdown": 6,
    "navbar_align": "left",
    "navbar_persistent": ["search-button"],
    "navbar_end": ["theme-switcher"],
    "secondary_sidebar_items": ["page-toc"],
    "show_prev_next": True,
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "footer_start": ["copyright"],
    "footer_end": ["theme-version"],
}
html_sidebars = {"index": []}
html_context = {"default_mode": "auto"}  # else the theme complains to a first visitor


def _say_what_thumbnails_show(app, pagename, templatename, context, doctree):
    """Give each picture of the gallery the title of its example as its words."""
    if pagename.startswith("gallery/") and "body" in context:
        thumbnail = r'<img alt=""( src="[^"]*_thumb\.png" />(?:(?!<img).)*?sphx-glr-thumbnail-title">)([^<]*)<'
        context["body"] = re.sub(thumbnail, r'<img alt="Figure of: \2"\1\2<', context["body"], flags=re.DOTALL)


LITERAL = re.compile(r"(``.*?``|:math:`.*?`)", re.DOTALL)


def _read_as_meant(app, what, name, value, options, lines):
    """Keep a full stop in a formula from ending the summary, and bars around a length from being markup."""
    parts = LITERAL.split("\n".join(lines))
    parts[1::2] = [part.replace(". ", ".\u2060 ") for part in parts[1::2]]  # a word joiner, which nobody sees
    parts[::2] = [re.sub(r"\|(?=[A-Za-z])([^|\n]*)\|", r"\\|\1\\|", part) for part in parts[::2]]
    lines[:] = "".join(parts).split("\n")


def setup(app):
    app.connect("autodoc-process-docstring", _read_as_meant)
    app.connect("html-page-context", _say_what_thumbnails_show)
