"""Settings of the documentation: ``make docs``, or ``python -m sphinx docs docs/_build/html``."""

import importlib.metadata
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
os.environ.setdefault("OMP_NUM_THREADS", "1")  # in the kernels of executed pages, too
# So are the commands of this installation.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])

import api
import pages
import short_cells

project = "pinnobs-gym"
author = "the authors of pinnobs-gym"
version = release = importlib.metadata.version("pinnobs-gym")
extensions = ["myst_nb", "mathml"]
html_math_renderer = "mathml"
exclude_patterns = ["_build", "**.ipynb_checkpoints"]
nitpicky = True
python_use_unqualified_type_names = True
toc_object_entries = False
maximum_signature_line_length = 90
smartquotes = False  # the mark of x' is a prime

myst_enable_extensions = ["dollarmath", "attrs_inline"]
myst_heading_anchors = 3
nb_execution_mode = "force"  # what the tutorial and the guides show is what this package does
nb_execution_in_temp = True  # where guides write their models, logs and pictures
nb_execution_raise_on_error = True
nb_execution_timeout = 120
nb_merge_streams = True

html_theme = "furo"
html_title = f"pinnobs-gym {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_copyright = False


def setup(app):
    """Write the pages that are made from the code before Sphinx looks for pages."""
    app.connect("builder-inited", lambda app: pages.write(Path(app.srcdir) / "reference"))
    app.connect("doctree-read", api.unlink_others)
    app.connect("doctree-read", short_cells.mark)
