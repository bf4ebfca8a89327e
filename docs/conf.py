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


INTERNALS = frozenset(
    """
    accessed_names across added_momentum algebra_by_constants as_provenance balance_entries base_step
    bind_attitude bind_to bind_to_structure block_results body_at_attitude body_dim can_be_embedded
    can_transport_attitude can_unroll carries_compensation check_components clock_components component_scales
    consecutive_increments constant_names couplings decompose difference_quotient difference_rounding_scale
    dim_without_ledger displace dissipation_keeps_casimirs dissipations divergence_terms dot_at_sites drop_baths
    drop_ledger drop_torque energy_of_vectors entropy_gradient evaluations_per_iteration extend external_torque
    factor_at_state field_and_law_rates first_velocity_index freeze_at friction_at general generator_field
    grid_seeds has_impulse has_ledger has_matrix_functions has_poisson_by_construction heating_sites
    impulse_names initial initial_compensation initial_run_state initial_state inner inner_arguments inner_at
    input_residuals intervals invariant_names invariant_verdicts is_coordinate_order_independent is_hidden
    is_noiseless is_projection_trivial is_smooth jackknife_blocks jacobian_probe join_state ledger ledger_rates
    local_system lower_index make_blocks map_defect mechanical_energy member_stats member_status
    method_with_noise midpoint_gradients momentum_jacobians momentum_system needs_attitude noisy nonnegative
    orbit_levels outer_scalars precession_rates predict preserved_labels preserves_function production_name
    pullback pullback_to_chart raise_index rate_of_change record_initial requested_invariants residual_jvp
    residual_weights rounding_scale row_counts row_pointer samples scale_at_sites site_spins solution_builder
    solved_subsystem sparsity_pattern specific_residuals split_state stage_velocities start_blocks state_array
    state_blocks step_without_compensation surface system_without_span temperature_at term_index
    to_user_solution to_user_state torque_arguments torque_free_components torque_invariant_casimirs torque_name
    torque_velocity torques_need_attitude trajectory_numbers transport user_state user_state_at uses_charts
    value_type why_singular why_step_failed
    """.split()
)
"""Members that the rooms of the library ask of each other: no user calls them, so the reference leaves them out."""


def _is_internal(app, what, name, value, skip, options):
    return True if what == "class" and name in INTERNALS else None


def _is_bare_value(app, what, name, value, skip, options):
    """Leave out attributes that are mere values: autodoc would print the documentation of their type."""
    told = callable(value) or isinstance(value, (property, classmethod, staticmethod)) or hasattr(value, "__get__")
    return True if what == "class" and not told else None


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
    app.connect("autodoc-skip-member", _is_internal)
    app.connect("autodoc-skip-member", _is_bare_value)
    app.connect("html-page-context", _say_what_thumbnails_show)
