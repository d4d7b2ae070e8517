"""Settings of Sphinx, which builds the site of these pages: `make docs`.

The pages that repeat the code (settings, command line, API) or recorded results are written when
the build begins, so that they cannot differ from these.
"""

import sys
from importlib.metadata import version as version_of
from pathlib import Path

from sphinx.application import Sphinx

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS))

project = "worldpose"
author = "the worldpose developers"
copyright = author
version = release = version_of("worldpose")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["build"]
default_role = "code"
autodoc_typehints = "none"  # the signature has them
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]

suppress_warnings = ["ref.python"]  # words in docstrings such as frames are no links

html_theme = "furo"
html_title = "worldpose"


def setup(app: Sphinx) -> None:
    """Write the generated pages before Sphinx looks for sources."""
    from generate_reference import write_reference, write_results

    def write_pages(*_: object) -> None:
        write_reference(DOCS / "reference" / "generated")
        write_results(DOCS / "results" / "data", DOCS / "results" / "generated")

    app.connect("config-inited", write_pages)
