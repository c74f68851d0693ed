"""Checks that every command of the README and of the pages still parses: its verb and options, or
the config that its overrides compose. Nothing is run: python docs/commands.py
"""

import argparse
import functools
import os
import re
import shlex
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import typer
from hydra.errors import HydraException

from r2flow.base.errors import InputError
from r2flow.base.plugins import take_plugins
from r2flow.cli.verbs import USAGE_ERROR, app
from r2flow.lidar.sensors import SENSORS, write_sensor
from r2flow.runs.composing import compose, in_one_line

DOCS = Path(__file__).resolve().parent
BLOCK = re.compile(r"^```sh\n(.*?)^```", re.M | re.S)


def commands(text: str) -> Iterator[list[str]]:
    """The words of each command of this project in the sh blocks of a page, without what launches
    it.
    """
    for block in BLOCK.findall(text):
        for line in block.replace("\\\n", " ").splitlines():
            for one in re.split(r"&&|\|", line):
                if "$" in one or "NAME=" in one:  # the shell's, or a placeholder's
                    continue
                found = re.search(r"(^\s*r2flow|-m r2flow\.cli|train\.py)(?:\s|$)", one)
                if found:
                    verb = [] if "r2flow" in found[1] else ["train"]
                    yield verb + shlex.split(one[found.end() :], comments=True)


def quieten(group: typer.Typer) -> None:
    """Let verbs be parsed and do nothing."""
    for command in group.registered_commands:
        command.callback = functools.update_wrapper(lambda **_: None, command.callback)
    for part in group.registered_groups:
        quieten(part.typer_instance)


def check(words: list[str]) -> None:
    """Parse a command as r2flow itself does.

    Raises:
        InputError, HydraException: an unknown verb, option, key or choice.
    """
    words, plugins = take_plugins(words)
    if words[:1] != ["train"]:
        typer.main.get_command(app).main(words, standalone_mode=False)
        return
    parser = argparse.ArgumentParser(exit_on_error=False)
    parser.add_argument("--config-dir")
    parser.add_argument("--cfg")
    parser.add_argument("-m", action="store_true")
    parser.add_argument("overrides", nargs="*")
    given = parser.parse_intermixed_args(words[1:])
    overrides = [one for one in given.overrides if not one.startswith("hydra")]
    if given.m:  # the first job of the sweep
        overrides = [re.sub(r"^([\w.]+=[\w.]+)(,[\w.]+)+$", r"\1", one) for one in overrides]
        interval = r"=(?:tag\(\w+, )?interval\(([^,]+),.*"
        overrides = [re.sub(interval, r"=\1", one) for one in overrides]
    if plugins:  # whose choices are theirs
        overrides = [one for one in overrides if not re.match(r"(backbone|stage|data)=", one)]
    compose(overrides, [DOCS.parent / given.config_dir] if given.config_dir else [])


def main() -> None:
    wrong, count = [], 0
    quieten(app)
    with tempfile.TemporaryDirectory() as scratch:
        os.chdir(scratch)
        write_sensor(replace(SENSORS["hdl64e"], name="mine"), "mine.yaml", "")
        for page in [DOCS.parent / "README.md", *sorted(DOCS.rglob("*.md"))]:
            for words in commands(page.read_text()):
                count += 1
                try:
                    check(words)
                except (InputError, HydraException, argparse.ArgumentError, USAGE_ERROR) as error:
                    said = in_one_line(error) if isinstance(error, HydraException) else error
                    wrong.append(
                        f"{page.relative_to(DOCS.parent)}: r2flow {shlex.join(words)}\n    {said}"
                    )
    print("\n".join(wrong) or f"{count} commands parse.")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
