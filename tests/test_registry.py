import pytest

from r2flow.errors import InputError
from r2flow.registry import Registry

TABLE = Registry("backbone", hdit=dict, adm_unet=dict)


def test_a_wrong_name_says_what_exists_and_what_was_meant():
    with pytest.raises(InputError) as error:
        TABLE["hditt"]
    assert str(error.value) == "no backbone named 'hditt'; known: adm_unet, hdit. Did you mean 'hdit'?"


def test_a_wrong_option_says_what_exists_and_what_was_meant():
    def make(width: int = 1, depth: int = 2) -> int:
        return width

    with pytest.raises(InputError, match=r"no option 'widht'; it knows: width, depth. Did you mean 'width'\?"):
        Registry("thing", make=make).build({"name": "make", "widht": 3})


def test_options_reach_the_constructor():
    assert Registry("thing", make=lambda a, b: (a, b)).build({"name": "make", "b": 2}, 1) == (1, 2)


def test_a_name_is_entered_once():
    table = Registry("thing", a=1)
    table.add("b", 2)
    assert table["b"] == 2
    with pytest.raises(ValueError, match="exists already"):
        table.add("a", 3)
