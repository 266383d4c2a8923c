"""Sphinx configuration of the static site; `build.py` lays out the sources and calls Sphinx."""

import importlib.metadata
import re

project = "cmc"
author = "The authors of cmc"
copyright = author
release = importlib.metadata.version("cmc")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx-mathjax-offline",
]
exclude_patterns = ["playback/*", "live/*"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
suppress_warnings = ["mystnb.unknown_mime_type", "myst.header", "ref.python"]

# The notebooks come executed; static/widgets.js plays their widgets, no widget manager is loaded.
nb_execution_mode = "off"
nb_merge_streams = True
nb_render_markdown_format = "myst"  # tables and mathematics in what a cell shows
nb_mime_priority_overrides = [
    ("html", "application/vnd.jupyter.widget-view+json", 0),
]
nb_ipywidgets_js = {}

default_role = "literal"
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_type_aliases = {"Array": "Array", "ArrayLike": "ArrayLike"}
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "pydata_sphinx_theme"
html_title = "cmc"
html_static_path = ["static"]
html_css_files = ["cmc.css"]
html_js_files = ["widgets.js"]
html_sidebars = {"**": []}
html_show_sourcelink = False
html_copy_source = False
html_context = {"default_mode": "auto"}
html_theme_options = {
    "navbar_align": "left",
    "header_links_before_dropdown": 4,
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "navigation_with_keys": False,
}


def plain_text(app, what, name, obj, options, lines):
    """Docstrings are plain text: |x| is a size, a * b a product, and an indented block is code."""
    out, code, section = [], False, False
    for line in lines:
        section |= line in ("Args:", "Returns:", "Raises:", "Yields:")
        code &= not line or line.startswith("    ")
        if line.startswith("    ") and not (section or code or (out and out[-1])):
            out += ["::", ""]
            code = True
        if not code:
            parts = re.split(r"(`[^`]*`|^ *\* )", line)
            parts[::2] = [re.sub(r"([|*])", r"\\\1", part) for part in parts[::2]]
            line = "".join(parts)
            # napoleon takes what stands before a colon in an attribute's text for its type
            line = line.replace(":", "\\ \N{RATIO}") if what in ("data", "attribute") else line
        out.append(line)
    lines[:] = out


def setup(app):
    """Run before napoleon reads the sections."""
    app.connect("autodoc-process-docstring", plain_text, priority=100)
