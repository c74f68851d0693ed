from pathlib import Path

import pytest
import yaml

from r2flow.errors import InputError
from r2flow.lidar.sensor_files import read_sensor, write_sensor
from r2flow.lidar.sensors import SENSORS, Sensor

MINE = "name: mine\nelevations: [10, 4.5, -3, -20]\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text)
    return path


def test_a_written_sensor_is_read_back(sensor, tmp_path):
    mine = Sensor(**{**vars(sensor), "name": "mine"})
    write_sensor(mine, tmp_path / "mine.yaml", "two\nlines")
    assert read_sensor(tmp_path / "mine.yaml") == mine
    assert read_sensor(tmp_path / "mine.yaml", 8, 64) == mine.resized(8, 64)


def test_name_and_elevations_are_enough(tmp_path):
    assert read_sensor(written(tmp_path, MINE)) == Sensor("mine", (10.0, 4.5, -3.0, -20.0))


def test_every_option_can_be_given(tmp_path):
    text = MINE + "rays: centre\nrows: 2\ncolumns: 64\nmin_range: 1\nmax_range: 50\nheight: 2\nfiring: [3, 1, 2, 0]\n"
    sensor = read_sensor(written(tmp_path, text))
    assert sensor == Sensor("mine", sensor.elevations, 64, 1.0, 50.0, 2.0)
    assert sensor.shape == (2, 64)


def test_the_configs_of_built_in_sensors_are_sensor_files():
    conf = Path(__file__).resolve().parents[2] / "conf" / "sensor"
    assert read_sensor(conf / "vlp32c.yaml") == SENSORS["vlp32c"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("just text", "is no sensor"),
        ("1: 2", "is no sensor"),
        ("name: [", "not a readable .yaml file"),
        ("name: !!python/object/apply:os.system [ls]", "not a readable .yaml file"),
        ("name: 2001-13-45", "not a readable .yaml file"),
        ("name: 0b_", "not a readable .yaml file"),
        ("elevations: [2, 1]", "needs the option 'name'"),
        (MINE + "colums: 3", "Did you mean 'columns'?"),
        (MINE + "firing: [0, 1]", "firing must name"),
        ("name: mine\nelevations: 5", "elevations must be a list"),
        ("name: mine", "no sensor named 'mine'"),
    ],
)
def test_a_wrong_file_is_one_line_with_its_name(tmp_path, text, words):
    with pytest.raises(InputError) as error:
        read_sensor(written(tmp_path, text))
    assert words in str(error.value)
    assert "mine.yaml" in str(error.value)
    assert "\n" not in str(error.value)


def test_files_that_are_not_yaml_are_refused(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_sensor(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="is a folder"):
        read_sensor(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(bytes(range(128, 256)))
    with pytest.raises(InputError, match="not a readable .yaml file"):
        read_sensor(tmp_path / "binary.yaml")
    (tmp_path / "large.yaml").write_bytes(b"#" * (2 << 20))
    with pytest.raises(InputError, match="too many"):
        read_sensor(tmp_path / "large.yaml")


def test_the_file_is_plain_yaml(tmp_path):
    write_sensor(SENSORS["vlp32c"], tmp_path / "x.yaml", "a comment")
    options = yaml.safe_load((tmp_path / "x.yaml").read_text())
    assert options["elevations"] == list(SENSORS["vlp32c"].elevations)
    assert options["firing"] == list(SENSORS["vlp32c"].firing)
    assert options["rows"] is None
