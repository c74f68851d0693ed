"""r2flow train-extractor as a user types it."""

from r2flow.metrics.extractors import training
from r2flow.metrics.extractors.embedded import Embedded
from tests.test_cli import r2flow  # noqa: F401  a fixture


def test_it_trains_judges_and_says_where_the_weights_lie(r2flow, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setattr(training, "COUNTED", 4)
    monkeypatch.setattr(training, "HELD_OUT", 2)
    out = tmp_path / "new" / "mine.safetensors"
    arguments = ("train-extractor", "--seed", 1, "--size", "16x64", "--batch-size", 2, "--workers", 0, "--out", out)
    code, said, _ = r2flow(*arguments, "--steps", 2)
    assert code == 0
    for words in ("hdl64e 16x64, range and reflectance", "hdl64e 16x64, range alone", "classes", f"{out}: "):
        assert words in said
    notes = Embedded.trained(out).notes
    assert notes["settings"]["steps"] == 2
    again = "r2flow train-extractor --seed 1 --steps 2 --batch-size 2 --sensor hdl64e --size 16x64"
    assert notes["command"] == again
    first = Embedded.trained(out).notes["weights_sha256"]
    assert r2flow(*again.split()[1:], "--workers", 0, "--out", out)[0] == 0
    assert Embedded.trained(out).notes["weights_sha256"] == first
    assert set(notes["held_out"]) == {"hdl64e 16x64, range and reflectance", "hdl64e 16x64, range alone"}


def test_a_mistake_is_one_line(r2flow, tmp_path):  # noqa: F811
    code, _, said = r2flow("train-extractor", "--sensor", "vlp17", "--out", tmp_path / "x.safetensors")
    assert code == 2
    assert "Did you mean 'vlp16'?" in said
    assert said.count("\n") == 1
