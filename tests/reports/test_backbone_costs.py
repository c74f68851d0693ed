import os

import pytest

from r2flow.errors import InputError
from r2flow.lidar.sensors import SENSORS
from r2flow.reports.backbones import backbone_costs

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


def test_a_size_that_one_cannot_take_is_said_in_its_row():
    (row,) = backbone_costs(SENSORS["hdl64e"].resized(64, 1000), ["hdit"], repeats=0)
    assert row["latency_ms"] is None
    assert "1000" in row["error"]
    with pytest.raises(InputError, match="Did you mean 'hdit_tiny'"):
        list(backbone_costs(SENSORS["hdl64e"], ["hdit_tny"]))


def test_latency_is_measured():
    (row,) = backbone_costs(SENSORS["hdl64e"].resized(16, 64), ["hdit_tiny"], repeats=2)
    assert row["latency_ms"] > 0


@pytest.mark.slow
def test_every_configuration_takes_every_sensor_s_shape(sensor):
    assert [row for row in backbone_costs(sensor, list(PARAMETERS), repeats=0) if "error" in row] == []


def test_the_verb_measures_what_it_is_asked_for(r2flow):
    options = ("--only", "hdit_tiny,adm_unet_large", "--size", "16x64", "--repeats", 0, "--device", "cpu")
    code, out, _ = r2flow("report", "backbones", *options)
    assert code == 0
    assert [line.split()[0] for line in out.splitlines()[2:4]] == ["hdit_tiny", "adm_unet_large"]
    code, _, err = r2flow("report", "backbones", "--only", "hditt", "--repeats", 0)
    assert code != 0
    assert "'hdit'" in err


@pytest.mark.parametrize(("load", "busy"), [(0.0, False), (1e4, True)])
def test_a_busy_machine_is_named(r2flow, monkeypatch, load, busy):
    monkeypatch.setattr(os, "getloadavg", lambda: (load, load, load))
    options = ("--only", "hdit_tiny", "--size", "16x64", "--repeats", 1, "--device", "cpu")
    assert ("machine was busy" in r2flow("report", "backbones", *options)[1]) == busy
