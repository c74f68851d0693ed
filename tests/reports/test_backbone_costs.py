from pathlib import Path

import pytest
import torch
import yaml

from r2flow.backbones import CONFIGURATIONS, build_backbone
from r2flow.errors import InputError
from r2flow.lidar.sensors import SENSORS
from r2flow.reports.backbones import backbone_costs

CONF = Path(__file__).resolve().parents[2] / "conf" / "backbone"

# The paper's table II and its published models.
PARAMETERS = {
    "hdit": 80_908_420,
    "efficient_unet": 31_099_650,
    "efficient_unet_large": 284_624_642,
    "adm_unet": 87_365_058,
    "adm_unet_large": 125_246_466,
}
GMAC = {
    "hdit": 77.79,
    "efficient_unet": 116.25,
    "efficient_unet_large": 688.31,
    "adm_unet": 265.58,
    "adm_unet_large": 692.69,
}


def test_the_table_is_the_paper_s():
    rows = {row["name"]: row for row in backbone_costs(SENSORS["hdl64e"], list(PARAMETERS), repeats=0)}
    assert {name: row["parameters"] for name, row in rows.items()} == PARAMETERS
    for name, row in rows.items():
        assert row["gmac"] == pytest.approx(GMAC[name], rel=0.005)


def composed(name: str) -> dict:
    """conf/backbone/NAME.yaml over its defaults."""
    own = yaml.safe_load((CONF / f"{name}.yaml").read_text())
    base: dict = {}
    for parent in own.pop("defaults", []):
        base.update(composed(parent) if parent != "_self_" else {})
    return {**base, **own}


@pytest.mark.parametrize("path", sorted(CONF.glob("*.yaml")), ids=lambda path: path.stem)
def test_the_table_of_configurations_is_that_of_conf(path: Path):
    rays = SENSORS["hdl64e"].rays()
    with torch.device("meta"):
        ours = build_backbone(CONFIGURATIONS[path.stem], rays, 2).state_dict()
        conf = build_backbone(composed(path.stem), rays, 2).state_dict()
    assert {name: value.shape for name, value in ours.items()} == {name: value.shape for name, value in conf.items()}


def test_every_configuration_is_in_conf():
    assert {path.stem for path in CONF.glob("*.yaml")} == set(CONFIGURATIONS)


def test_a_size_that_one_cannot_take_is_said_in_its_row():
    (row,) = backbone_costs(SENSORS["hdl64e"].resized(64, 1000), ["hdit"], repeats=0)
    assert row["latency_ms"] is None
    assert "1000" in row["error"]
    with pytest.raises(InputError, match="Did you mean 'hdit_tiny'"):
        list(backbone_costs(SENSORS["hdl64e"], ["hdit_tny"]))


def test_latency_is_measured():
    (row,) = backbone_costs(SENSORS["hdl64e"].resized(16, 64), ["hdit_tiny"], repeats=2)
    assert row["latency_ms"] > 0


def test_every_configuration_takes_every_sensor_s_shape(sensor):
    assert [row for row in backbone_costs(sensor, repeats=0) if "error" in row] == []
