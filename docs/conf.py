"""The site: Sphinx, MyST pages, furo's theme, and a reference from the code (`tools/site_pages.py`)."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))  # Sphinx imports this file from wherever it was started

from tools.site_pages import write_notebooks, write_pages  # noqa: E402

project = "mastctl"
author = "the mastctl developers"
copyright = "the mastctl developers, Apache-2.0"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "tools.site_tables",
]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4
smartquotes = False  # "--option" in a table would become an en dash, which a shell does not take
exclude_patterns = ["_build"]
copybutton_prompt_text = "$ "  # commands are copied without it, and without what they print
html_theme = "furo"
html_title = "mastctl"
html_favicon = "../mastctl/web/operator/icon.svg"
html_copy_source = False  # the wheel holds the site, and needs no page twice
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"  # no bare list of the fields above their descriptions
html_static_path = ["style"]
html_css_files = ["site.css"]
autodoc_member_order = "bysource"
napoleon_google_docstring = False

write_pages(HERE / "reference" / "generated")
write_notebooks(HERE / "tutorials")
