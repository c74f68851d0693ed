"""Fills the blocks of api.md, command_line.md and config.md from the code: python docs/reference.py

A block stands below a comment that says what it is made of, as `<!-- signatures :load -->` for
`r2flow.load`. With --check nothing is written, and a page that differs from the code is an error.
"""

import inspect
import re
import sys
import textwrap
from collections import Counter
from collections.abc import Iterator
from enum import EnumType
from importlib import import_module
from pathlib import Path
from typing import Any

import typer

from r2flow.backbones import BACKBONES
from r2flow.base.registry import Registry
from r2flow.cli.options import SETS
from r2flow.cli.verbs import app
from r2flow.runs.composing import CONF
from r2flow.stages import STAGES, Stage

TABLES = {"stage": STAGES, "backbone": BACKBONES}  # whose docstrings say what keys mean
DOCS = Path(__file__).resolve().parent
BLOCK = re.compile(r"(<!-- (\w+) (.*?) -->\n)(?:```\w*\n.*?```\n)?", re.S)
VERBS = typer.main.get_command(app).commands  # type: ignore[attr-defined]
VERBS |= {f"report-{name}": verb for name, verb in VERBS.pop("report").commands.items()}


def first(text: str | None) -> str:
    """The first sentence of a docstring, a help text or a comment, without its full stop."""
    paragraph = re.sub(r"\s+", " ", (text or "").strip().split("\n\n")[0])
    return re.sub(
        r"(?<=[\w)`%\"+])\.$",
        "",
        re.split(r": python train.py |(?<=\.)\s+(?=[A-Za-z`])", paragraph)[0],
    )


def plain(annotation: Any) -> str:
    """An annotation or a signature without modules, bounds and quotes."""
    text = annotation.__name__ if isinstance(annotation, type) else str(annotation)
    text = re.sub(
        r"Annotated\[(\w+)(?:, (?:\w+\((?:[^()]|\([^()]*\))*\)|<[^>]*>))+\]",
        r"\1",
        re.sub(r"\b(?:[a-z_]\w*\.)+(?=\w)", "", text),
    )
    text = re.sub(r"Optional\[([^()=]+?)\](?= =|,|\)|$)", r"\1 | None", text).replace(
        "<factory>", "{}"
    )
    text = re.sub(r"PosixPath\(('.*?')\)", r"\1", text)
    text = re.sub(r"(= \w+)\(.*<function .*>.*?'\)", r"\1(...)", text)
    return re.sub(r"(: |-> )'([^']*)'", r"\1\2", text)


def own_arguments(thing: Any) -> inspect.Signature:
    """A signature; of a stage, `**stage` stands for the arguments that `Stage` has, too."""
    whole = inspect.signature(thing)
    if not inspect.isclass(thing) or thing is Stage or not issubclass(thing, Stage):
        return whole
    shared = inspect.signature(Stage).parameters
    own = [
        one
        for name, one in whole.parameters.items()
        if name not in shared or one.default != shared[name].default
    ]
    rest = inspect.Parameter("stage", inspect.Parameter.VAR_KEYWORD)
    return whole.replace(parameters=[*own, rest])


def signatures(*places: str) -> Iterator[str]:
    """Of each `module:name` its signature and what it is; of a registry its names."""
    for place in places:
        module, _, names = f"r2flow{place}".partition(":")
        thing = import_module(module)
        for name in names.split("."):
            thing = getattr(thing, name)
        if isinstance(thing, Registry | EnumType):
            known = thing if isinstance(thing, Registry) else thing.__members__
            yield f"{module}.{names}\n" + textwrap.indent(
                textwrap.fill(", ".join(known), 112), "    # "
            )
            continue
        call = (
            ""
            if isinstance(thing, property)
            else plain(own_arguments(thing)).removesuffix(" -> None")
        )
        call = call.replace("(self, ", "(").replace("(self)", "()")
        yield f"{module + '.' if '.' not in names else ''}{names}{call}\n    # {first(inspect.getdoc(thing))}"


def option(parameter: Any, annotation: Any) -> tuple[str, str]:
    """The name of an option with its type and default, and its help."""
    kind = plain(
        getattr(annotation, "__origin__", annotation)
        if hasattr(annotation, "__metadata__")
        else annotation
    )
    kind = re.sub(
        r"Literal\[(.*)\]",
        lambda m: m[1].replace("'", "").replace(", ", "|"),
        kind.removesuffix(" | None"),
    )
    name = "/".join([*parameter.opts, *parameter.secondary_opts])
    if parameter.param_type_name == "argument":
        name = (parameter.metavar or name.upper()) + "..." * kind.startswith("list")
    elif kind not in ("bool", "str"):
        name += f" {parameter.metavar or kind}"
    default = "" if parameter.default is None or kind == "bool" else f" = {parameter.default}"
    return name + default, first(parameter.help).replace(SETS, "scans by name")


def verbs(*names: str) -> Iterator[str]:
    """Verbs with their options; `shared` gives the options that three verbs or more have alike."""
    pages = {}
    for name, verb in VERBS.items():
        known = inspect.signature(verb.callback).parameters
        options = [
            option(one, known[one.name].annotation) for one in verb.params if one.name in known
        ]
        pages[name] = sorted(options, key=lambda one: one[0].startswith("-"))
    counts = Counter(one for options in pages.values() for one in options)
    shared = [one for one, count in counts.items() if count > 2]
    for name in names:
        if name != "shared":
            yield f"\n{'r2flow ' + name.replace('-', ' ')}: {first(VERBS[name].help)}."
        yield from (
            f"  {one[0]}  # {one[1]}"
            for one in pages.get(name, shared)
            if name == "shared" or one not in shared
        )
        if also := " ".join(one[0].split(" ")[0] for one in pages.get(name, ()) if one in shared):
            yield f"  and {also}"


def config(group: str, *shown: str) -> Iterator[str]:
    """The choices of a config group, `.` for the top, and the keys of those that are named."""
    files = [
        file for file in (CONF / group).glob("*.yaml") if file.stem != "base" or "base" in shown
    ]
    files.sort(key=lambda file: ([*shown, file.stem].index(file.stem), file.stem))
    seen: set[str] = set()
    for file in files:
        top = re.match(r"(?:# @.*\n)?((?:# .*\n)*)", text := file.read_text())
        if group != ".":
            yield f"{group}={file.stem}  # {first((top[1] if top else '').replace('# ', ''))}".removesuffix(
                "  # "
            )
        entry = TABLES[group][file.stem] if file.stem in TABLES.get(group, ()) else None
        docs = (
            "\n".join(inspect.getdoc(one) or "" for one in reversed(inspect.getmro(entry)))
            if inspect.isclass(entry)
            else ""
        )
        words = {
            name: first(said)
            for name, said in re.findall(r"^    (\w+): (.*(?:\n     .*)*)", docs, re.M)
        }
        parents: list[tuple[int, str]] = []
        for indent, key, rest in (
            re.findall(r"^( *)(\w+):(.*)$", text, re.M) if file.stem in shown else ()
        ):
            value, _, comment = (part.strip() for part in rest.partition(" #"))
            parents = [*(one for one in parents if one[0] < len(indent)), (len(indent), key)]
            dotted, said = ".".join(one[1] for one in parents), comment or words.get(key, "")
            if value and said and dotted not in seen and parents[0][1] not in ("defaults", "hydra"):
                seen.add(dotted)
                yield f"  {group}.{dotted}={value}  # {said}".replace("  ..", "  ")


def filled(block: re.Match[str]) -> str:
    """A comment with the block that it asks for."""
    kind, lines = block[2], "\n".join(globals()[block[2]](*block[3].split()))
    return f"{block[1]}```{'python' if kind == 'signatures' else 'text'}\n{lines.strip()}\n```\n"


def main() -> None:
    wrong = (
        []
        if set(VERBS) <= set((DOCS / "command_line.md").read_text().split())
        else ["command_line.md lacks a verb"]
    )
    for page in (DOCS / "api.md", DOCS / "command_line.md", DOCS / "config.md"):
        text = page.read_text()
        new = BLOCK.sub(filled, text)
        if "--check" not in sys.argv:
            page.write_text(new)
        elif new != text:
            wrong.append(
                f"docs/{page.name} differs from the code; python docs/reference.py writes it"
            )
    sys.exit("\n".join(wrong) or None)


if __name__ == "__main__":
    main()
