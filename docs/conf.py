"""The site: python -m sphinx -W -b html docs site

Sphinx with furo, and not mkdocs: its search works from a folder on disk, no page loads anything
from elsewhere, and one tool holds links, docstrings and the executed notebook to account.
"""

import importlib
import pkgutil
import re
from pathlib import Path

import r2flow

project, author, copyright = "r2flow", "The r2flow authors", "The r2flow authors"
version = release = r2flow.__version__

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "myst_nb"]
html_theme = "furo"
html_title = f"r2flow {version}"
exclude_patterns = ["**.ipynb_checkpoints"]

myst_heading_anchors = 4  # #links to headings, as GitHub makes them
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_output_stderr = "remove"

suppress_warnings = ["ref.python"]  # `x` of a docstring may be several names

autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
autodoc_default_options = {"members": True, "show-inheritance": True, "ignore-module-all": True}
python_maximum_signature_line_length = 100
napoleon_use_ivar = True

PAGES = Path(__file__).parent / "api"
EXTRAS = ("r2flow.model.hub", "r2flow.model.onnx_graphs")  # which need further packages
ROOMS = ("", "model", "generators", "samplers", "flow", "backbones", "systems", "lidar", "data", "simulator", "metrics",
         "evaluation", "stages", "training", "store", "base")  # fmt: skip


def write_api() -> None:
    """A page for each room with the docstrings of its modules, in api/, which git ignores."""
    PAGES.mkdir(exist_ok=True)
    for room in ROOMS:
        top = importlib.import_module(".".join(filter(None, ("r2flow", room))))
        below = (
            pkgutil.walk_packages(top.__path__, f"{top.__name__}.")
            if room and hasattr(top, "__path__")
            else ()
        )
        names = [
            top.__name__,
            *(module.name for module in below if module.name not in EXTRAS),
        ]
        parts = [f"## {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n```\n" for name in names]
        (PAGES / f"{top.__name__}.md").write_text(
            "\n".join([f"# {top.__name__}\n", *parts]), encoding="utf-8"
        )


write_api()

NAME = re.compile(r"[A-Za-z_][\w.]*")


def from_markdown(_app, _what, _name, _object, _options, lines):
    """Docstrings are Markdown, autodoc reads reStructuredText: `names` become links, the rest loses
    its stars.
    """

    def part(text):
        if text.startswith("`"):
            return f":py:obj:{text}" if NAME.fullmatch(text.strip("`")) else f"`{text}`"
        return re.sub(r"(?<![\s*])(_)(?!\w)|(?<=\S)([*|])|([*|])(?=\S)", r"\\\g<0>", text)

    written, above, code = [], "", False
    for line in lines:
        indented = line.startswith("    ")
        if not line or (code and indented):
            written.append(line)
            continue
        code = indented and bool(written) and not written[-1] and not above.startswith(" ")
        above = line
        if code:  # an indented block of its own
            written += ["::", "", line]
            continue
        argument = re.match(r"\s*\*{1,2}\w+(?=:)", line)  # napoleon writes these itself
        start = argument.end() if argument else 0
        written.append(line[:start] + "".join(map(part, re.split(r"(`[^`]*`)", line[start:]))))
    lines[:] = written


def without_bounds(_app, _what, _name, _object, _options, signature, returned):
    """`Annotated[int, Bound(...)]` is an int to a reader."""
    return signature and re.sub(
        r"~?(?:typing\.)?Annotated\[(.+?), Bound\(.+? at 0x\w+>\)\]", r"\1", signature
    ), returned


def setup(app):
    app.connect("autodoc-process-signature", without_bounds)
    app.connect("autodoc-process-docstring", from_markdown, priority=400)  # napoleon's is 500
