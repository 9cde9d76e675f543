"""Settings of the documentation: `make docs`, or ``python -m sphinx -W -b html docs results/docs``."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE / "_extensions")]

from dcreg import __version__  # noqa: E402

project = "dcreg"
author = "The dcreg contributors"
copyright = "2026, the dcreg contributors"
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc", "mathml", "listings"]
exclude_patterns = ["_extensions", "images", "tables"]
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3

# Every link must have a target. Names in docstrings that are not from dcreg (parameters,
# other libraries) are shown as code and need no page.
nitpicky = True
nitpick_ignore_regex = [(r"py:.*", r"(?!dcreg\.).*")]
default_role = "py:obj"
smartquotes = False

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings state types, shapes and units
numpydoc_show_class_members = False  # autodoc lists them
python_maximum_signature_line_length = 80

html_theme = "furo"
html_title = f"dcreg {release}"
html_static_path = ["_static"]
html_css_files = ["manual.css"]
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b5cad", "color-brand-content": "#0b5cad"},
    "dark_css_variables": {"color-brand-primary": "#7cb7ff", "color-brand-content": "#7cb7ff"},
}
html_show_sourcelink = False
html_copy_source = False


def without_results(app, what, name, obj, options, signature, annotation):
    """Hide the signature of classes that state attributes: calls return them, users do not build them."""
    return ("", None) if what == "class" and "\n    Attributes\n" in (obj.__doc__ or "") else None


def setup(app):
    app.connect("autodoc-process-signature", without_results)
