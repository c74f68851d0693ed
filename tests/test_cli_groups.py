from dataclasses import dataclass
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from r2flow.cli.options import grouped


@dataclass(frozen=True)
class Size:
    rows: Annotated[int, typer.Option(help="Rows of the image.")]
    columns: Annotated[int, typer.Option("--columns", "-w")] = 8


@pytest.fixture
def run():
    app, given = typer.Typer(), []

    @app.command()
    @grouped
    def verb(name: str, size: Size, flip: bool = False) -> None:
        """What it does."""
        given.append((name, size, flip))

    return lambda *words: (CliRunner().invoke(app, words), given)


def test_each_field_is_an_option_and_the_verb_is_given_the_dataclass(run):
    run("a", "--rows", "4", "--flip")
    result, given = run("b", "-w", "16", "--rows", "2")
    assert result.exit_code == 0
    assert given == [("a", Size(4, 8), True), ("b", Size(2, 16), False)]


def test_a_field_without_default_is_asked_for_and_help_has_every_option(run):
    result, given = run("a")
    assert result.exit_code == 2
    assert given == []
    said = run("--help")[0].output
    for words in ("What it does.", "--rows", "Rows of the image.", "--columns", "--flip"):
        assert words in said
