"""Configuration of the documentation site: `make docs`."""

import os
import shutil
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
sys.path[:0] = [str(ROOT), str(DOCS / "_ext")]
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "agg")
os.environ["COLUMNS"] = "110"

import saved_pictures  # noqa: E402

import neuido  # noqa: E402

project, author, version = "neuido", "the neuido authors", neuido.__version__
copyright = author
extensions = [
    "generate",  # docs/_ext: the pages under docs/generated
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx_design",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = [
    "_build",
    "_ext",
    "**/.ipynb_checkpoints",
    "pictures/*.py",
    "gallery/*.ipynb",
    "gallery/*.py",
    "gallery/*.md5",
    "gallery/*.json",
]
myst_enable_extensions = ["colon_fence", "dollarmath", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # the snippets of the pages are run by tests/test_docs.py, the gallery by the build
default_role = "code"
suppress_warnings = ["config.cache", "mystnb.unknown_mime_type"]

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
napoleon_use_rtype = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = "neuido"
html_static_path = ["_static"]
html_css_files = ["neuido.css"]
html_extra_path = ["formats/schemas"]
copybutton_prompt_text = r"\$ "
copybutton_prompt_is_regexp = True


def copy_examples() -> str:
    """Return a copy of the examples for the gallery to run in, so that what they write stays out of the repository."""
    target = DOCS / "_build" / "examples"
    target.mkdir(parents=True, exist_ok=True)
    for path in (ROOT / "examples").iterdir():
        if path.suffix == ".rst" or (path.suffix == ".py" and path.name[:2].isdigit()):
            shutil.copyfile(path, target / path.name)
    return str(target)


sphinx_gallery_conf = {
    "examples_dirs": copy_examples(),
    "gallery_dirs": str(DOCS / "gallery"),
    "filename_pattern": r"/\d\d_",
    "ignore_pattern": r"/(?!\d\d_)[^/]*\.py$",
    "image_scrapers": (saved_pictures.SavedPictures(),),
    "capture_repr": (),
    "within_subsection_order": "FileNameSortKey",
    "thumbnail_size": (460, 230),
    "download_all_examples": False,
    "show_memory": False,
    "show_signature": False,
    "min_reported_time": 1,
    "remove_config_comments": True,
    "abort_on_example_error": False,
    "only_warn_on_example_error": False,
    "plot_gallery": os.environ.get("NEUIDO_DOCS_GALLERY", "1") == "1",
}
