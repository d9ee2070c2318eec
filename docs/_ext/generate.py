"""Pages made from the package itself, written to docs/generated before Sphinx reads its sources.

The command line comes from its parsers, the library of effects from `LIBRARY`, the configuration keys from configs/, the reference of the
public names from `neuido.__all__`, the benchmarks from research/results, and the constants of a diagnosis from its sources.
"""

import contextlib
import inspect
import io
import re
from collections.abc import Iterator
from pathlib import Path

from api_examples import EXAMPLES
from benchmark_pages import benchmark_pages
from decision_constants import constant_page

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "docs" / "generated"

UNDERSTOOD = {  # what each kind of data shows: stage -> words
    "flight": "the path of the centre of mass",
    "rotation": "the spin",
    "internal modes": "how the body deforms",
    "contact": "what happens at a collider",
    "rest": "the shape that stays",
    "power": "the loss of energy",
}


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|").replace("\n", " ") for cell in row) + " |" for row in lines) + "\n"


def code(text: str) -> str:
    """Return text as inline code, where it has any."""
    return f"`{text}`" if text else ""


# the command line


def parsers() -> Iterator[tuple[str, str, str]]:
    """Yield each command with its line in the list and its help text, as the command prints it."""
    from neuido.commands import main as cli

    for name, (*_, line) in cli.LIGHT.items():
        yield name, line, help_of(cli, [name, "--help"])
    for name, line in cli.HEAVY.items():
        yield name, line, help_of(cli, [name, "--help"])


def help_of(cli, args: list[str]) -> str:
    """Return what a command prints for `--help`."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        cli.main(args)
    return re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue()).replace(str(ROOT) + "/", "")


def command_page() -> str:
    """Return the page of the command line."""
    parts = [
        "# Command line\n",
        "Every command takes `--config FILE` (a YAML file here, or the name of one that comes with neuido) and writes",
        "its full configuration",
        "with `--print_config`. Any option can stand on the command line too. A mistake that you can mend is one line on stderr and exit",
        "status 2; `NEUIDO_TRACEBACK=1` shows where it came from. This page is made from the parsers.\n",
    ]
    found = list(parsers())
    parts.append(table(["command", "what it does"], [[f"[{name}](#{name})", line] for name, line, _ in found]))
    for name, line, text in found:
        parts += [f"\n## {name}\n", line + "\n", "```text", text.rstrip(), "```\n"]
    return "\n".join(parts)


# the library of effects


def effect_page() -> str:
    """Return the page of the library of effects."""
    from neuido.data.measured.material_test import EFFECTS as OF_TESTS
    from neuido.data.measured.track import EFFECTS as OF_TRACKS
    from neuido.physics.effects import LIBRARY
    from neuido.physics.plane.plane_law import EFFECTS as OF_PLANES

    fields = kernels()
    parts = [
        "# Library of effects\n",
        f"The {len(LIBRARY)} effects that a model may lack. Each is a parameter that is zero when the effect is absent.",
        "This page is made from",
        "`neuido.effects.LIBRARY`.\n",
        "## What can be found with which data and solver\n",
        "A tick says that an effect can act there, so that the data may show it. It does not say that the data can tell",
        "it from the effects in the",
        "last column, which look alike; whether they do is what a diagnosis answers. Finite elements serve for",
        "diagnosis and have no gradients.\n",
    ]
    rows = []
    for e in LIBRARY:
        acts = (not e.only, e.name in OF_TESTS, e.name in OF_PLANES, e.name in OF_TRACKS, not e.only, not e.only)
        marks = ["✓" if ok else "" for ok in acts]
        alike = ", ".join(e.confusions) + (f"; needs {e.needs}" if e.needs else "")
        rows.append([f"[{e.name}](#{anchor(e.name)})", *marks, alike])
    head = ["effect", "points or video of a body", "stress and stretch", "plane specimen", "track of a point", "MPM", "finite elements"]
    head.append("looks like")
    parts.append(table(head, rows))
    for e in LIBRARY:
        parts += [
            f"\n## {e.name}\n",
            f"The model lacks {e.title}: `{e.equation}`\n",
            f"Shows in {e.stage}: {UNDERSTOOD.get(e.stage, e.stage)}. Source: {e.source}.\n",
        ]
        if e.needs:
            parts.append(f"It needs {e.needs}.\n")
        if e.limits:
            parts.append(f"At an end of its range it becomes {', '.join(e.limits)}.\n")
        rows = [
            [
                code(f"{e.name}.{p.name}"),
                "-" if p.unit == "1" else p.unit,
                f"{p.low:g} to {p.high:g}",
                code(p.field),
                fields.get(p.field, ""),
            ]
            for p in e.parameters
        ]
        parts.append(table(["parameter", "unit", "range", "field of `Effects` or `Forces`", "kernels"], rows))
    return "\n".join(parts)


def kernels() -> dict[str, str]:
    """Return the file of the kernels that read each field of `Effects`."""
    from neuido.physics.effects import Effects

    folder = ROOT / "neuido" / "physics"
    files = [
        p
        for pattern in ("effects/*kernels.py", "effects/history_functions.py", "mpm/kernels/grid.py", "mpm/kernels/transfers.py")
        for p in folder.glob(pattern)
    ]
    texts = {p: p.read_text() for p in sorted(files)}
    on_grid = "neuido/physics/mpm/kernels/grid.py"
    found = {}
    for field in Effects._fields:
        stem = field.split("_")[0] if field.startswith(("position", "time_force", "maxwell", "fibre", "yield")) else field
        own = [str(p.relative_to(ROOT)) for p, text in texts.items() if re.search(rf"\b\w*{stem}", text)]
        found[field] = code(own[0]) if own else code(on_grid)
    return found


def anchor(name: str) -> str:
    """Return the anchor that MyST gives a heading."""
    return re.sub(r"[^\w\- ]", "", name.lower()).replace(" ", "-")


# configuration keys


def config_page() -> str:
    """Return the page of the configurations that come with neuido, with the comment that each opens with."""
    parts = [
        "# Configuration files\n",
        "Each YAML file below comes with neuido; `--config` takes its path or its name. A later `--config` wins over an",
        "earlier one, and an option",
        "on the command line over both. `base: FILE` in a file takes what another file says, by its path beside the file",
        "or by the name of one that comes with neuido; the keys beside it win, and of a list of bases the later wins.",
        "Mappings are merged key by key; lists are replaced, and another `class_path` drops the `init_args` of the base.",
        "`--print_config` writes all keys with their values, and [the command",
        "line](commands.md) explains each.",
        "Keys of the models and the data modules stand under `model.init_args` and `data.init_args`.\n",
    ]
    folder = ROOT / "configs"
    for sub in sorted({p.parent for p in folder.rglob("*.yaml")}):
        parts.append(f"\n## {sub.relative_to(ROOT)}\n")
        rows = []
        for path in sorted(sub.glob("*.yaml")):
            text = path.read_text()
            comment = " ".join(line.lstrip("# ") for line in text.split("\n\n")[0].splitlines() if line.startswith("#"))
            keys = re.findall(r"^([a-z_]+):", text, flags=re.MULTILINE)
            rows.append([code(path.name), comment.replace("<", "&lt;"), ", ".join(code(k) for k in keys)])
        parts.append(table(["file", "what it is for", "keys"], rows))
    return "\n".join(parts)


# the public names


def api_pages() -> dict[str, str]:
    """Return a page for each public name, and their list."""
    import neuido

    names = sorted((n for n in neuido.__all__ if n not in ("__version__",)), key=str.lower)
    pages, rows = {}, []
    for name in names:
        value = getattr(neuido, name)
        if name in ("laws", "effects", "colliders"):
            own = [n for n in getattr(value, "__all__", []) if not n.startswith("_")]
            body = f"{(value.__doc__ or '').splitlines()[0]}\n\n" + "\n".join(
                directive(getattr(value, n), f"{value.__name__}.{n}") for n in own
            )
        elif inspect.ismodule(value):
            own = [n for n, v in vars(value).items() if inspect.isfunction(v) and v.__module__ == value.__name__ and not n.startswith("_")]
            body = f"{(value.__doc__ or '').splitlines()[0]}\n\n" + "\n".join(
                directive(getattr(value, n), f"{value.__name__}.{n}") for n in own
            )
        else:
            body = directive(value, f"neuido.{name}")
        example = f"## Example\n\n```python\n{EXAMPLES[name].strip()}\n```\n\n## Reference\n\n" if name in EXAMPLES else ""
        pages[f"api/{name}.md"] = f"# neuido.{name}\n\n{example}{body}\n"
        line = (inspect.getdoc(value) or "").split("\n")[0]
        rows.append([f"[neuido.{name}](api/{name}.md)", line.replace("<", "&lt;")])
    toc = "```{toctree}\n:hidden:\n\n" + "\n".join(f"api/{name}" for name in names) + "\n```\n"
    text = "# Public names\n\nEverything that is meant to be imported, each with an example. `neuido.X` is imported at its first use.\n\n"
    pages["api.md"] = text + table(["name", "what it is"], rows) + "\n" + toc
    return pages


def directive(value, path: str) -> str:
    """Return the autodoc directive of an object."""
    kind = "autoclass" if inspect.isclass(value) else "autofunction" if callable(value) else "autodata"
    members = "   :members:\n" if kind == "autoclass" else ""
    return f"```{{eval-rst}}\n.. {kind}:: {path}\n{members}```\n"


def escape_docstring(app, what, name, obj, options, lines) -> None:
    """Keep absolute values, stars and trailing underscores of formulas from being read as markup."""
    for i, line in enumerate(lines):
        parts = re.split(r"(``.+?``|`[^`]+`)", line)
        for j in range(0, len(parts), 2):
            parts[j] = re.sub(r"(?<!\\)[|]", r"\\|", parts[j])
            parts[j] = re.sub(r"(?<![\\*])\*(?!\*)", r"\\*", parts[j])
            parts[j] = re.sub(r"(\w)_(?=[\s,.;:)]|$)", r"\1\\_", parts[j])
        lines[i] = "".join(parts)


def write_pages(app=None) -> None:
    """Write all generated pages; a page that is the same stays untouched, so that Sphinx need not read it again."""
    pages = {"commands.md": command_page(), "effects.md": effect_page(), "configs.md": config_page(), **api_pages(), **benchmark_pages()}
    pages["decision_constants.md"] = constant_page()
    for name, text in pages.items():
        path = OUT / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.is_file() or path.read_text() != text:
            path.write_text(text)
    for path in OUT.rglob("*.md"):
        if str(path.relative_to(OUT)) not in pages:
            path.unlink()


def setup(app):
    """Register the pages and the docstring filter with Sphinx."""
    app.setup_extension("sphinx.ext.autodoc")
    app.connect("builder-inited", write_pages, priority=100)
    app.connect("autodoc-process-docstring", escape_docstring, priority=900)
    return {"parallel_read_safe": True}


if __name__ == "__main__":
    write_pages()
