from dataclasses import dataclass
from typing import Annotated

import pytest

from r2flow.backbones import BACKBONES
from r2flow.base.errors import InputError
from r2flow.base.registry import MISSING, Registry, check_options, options_of, presets


def test_a_name_that_is_taken_is_refused_except_in_a_notebook():
    table, cell = (
        Registry("thing", a=1),
        [type("Mine", (), {"__module__": "__main__"}) for _ in range(2)],
    )
    for version in cell:  # it runs twice
        table.add("b", version)
    assert table["b"] is cell[1]
    assert repr(table) == "Registry(thing: a, b)"
    for name, entry in (("a", 3), ("a", cell[0]), ("b", 3)):
        with pytest.raises(ValueError, match="exists already"):
            table.add(name, entry)


def test_a_missing_name_calls_each_hook_once_and_is_looked_up_again(monkeypatch):
    table, calls = Registry("thing", a=1), []

    def load():
        calls.append("load")
        assert "c" not in table  # a plug-in that looks something up does not start the hooks again
        table.add("b", 2)

    monkeypatch.setattr(Registry, "on_missing", [load])
    assert table["a"] == 1
    assert not calls
    assert ["b" in table, [] in table] == [True, False]
    assert table["b"] == 2
    with pytest.raises(InputError, match="no thing named 'c'; known: a, b"):
        table["c"]
    assert calls == ["load"]


def test_an_annotated_option_is_checked_as_what_it_annotates():
    def make(
        width: Annotated[int, "pixels"], name: Annotated[str | None, "of a file"] | bool = None
    ) -> None:
        pass

    for good in (
        {"width": 1},
        {"width": 1, "name": "a"},
        {"width": 1, "name": None},
        {"width": 1, "name": True},
    ):
        check_options("thing", make, good)
    with pytest.raises(
        InputError, match=r"thing: width: input should be a valid integer.* found 1\.5"
    ):
        check_options("thing", make, {"width": 1.5})
    with pytest.raises(InputError, match="thing: name: input should be .*, found 3"):
        check_options("thing", make, {"width": 1, "name": 3})


def test_options_are_those_by_keyword():
    @dataclass
    class Settings:
        size: int
        damping: float = 0.5

    assert options_of(Settings) == {"size": MISSING, "damping": 0.5}
    assert options_of(lambda *given, damping=1.0: None, given=2) == {"damping": 1.0}


def test_of_several_bases_of_a_file_the_last_one_holds_as_in_hydra(tmp_path, monkeypatch):
    folder = tmp_path / "several_bases"
    folder.mkdir()
    (folder / "first.yaml").write_text("{x: 1, y: 1, z: 1}")
    (folder / "last.yaml").write_text("{x: 2, y: 2}")
    (folder / "both.yaml").write_text("{defaults: [first, last, _self_], x: 3}")
    monkeypatch.setattr("r2flow.base.registry.files", lambda package: tmp_path)
    assert presets("several_bases")["both"] == {"x": 3, "y": 2, "z": 1}


def test_the_names_of_backbones_are_those_of_the_error():
    with pytest.raises(InputError) as error:
        BACKBONES["hditt"]
    assert f"known: {', '.join(BACKBONES)}. Did" in str(error.value)
    assert BACKBONES["hdit_tiny"].keywords["base_channels"] == 48
    assert len(list(BACKBONES)) == len(BACKBONES) > len(BACKBONES._entries)
