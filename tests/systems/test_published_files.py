"""Every published layout, given as it is to the verbs: scans in files, and their distance to others."""

import json
from pathlib import Path

import pytest

# Options, and the evaluations that a scan takes: steps x noise levels and one to take the last noise off.
FILES = {
    "vanilla_published.pth": ([], 1),
    "dusty1_published.pth": ([], 1),
    "dusty2_published.pth": ([], 1),
    "r2dm_published.pth": (["--steps", 2], 2),
    "lidargen_published.pth": (["--steps", 1], 10 + 1),
    "lidm_published.ckpt": (["--steps", 1], 1),
}
LARGE = ("lidargen_published.pth", "lidm_published.ckpt")  # of 64 x 1024


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n in LARGE else ()) for n in FILES])
def test_a_published_file_is_sampled_and_evaluated(r2flow, shared, tmp_path: Path, name: str):
    path = shared / "oracle_baselines" / name
    if not path.exists():
        pytest.skip("the reference checkpoint is not here")
    options, evaluations = FILES[name]
    out = tmp_path / "scans"
    code, said, error = r2flow("sample", path, *options, "--num", 2, "--pictures", 0, "--device", "cpu", "--out", out)
    assert code == 0, error
    assert (out / "000001.npy").is_file()
    alone = ["--num", 2, "--metrics", "jsd", "--no-reference", "--no-baselines", "--workers", 0, "--device", "cpu"]
    code, _, error = r2flow("evaluate", out, path, *options, *alone, "--json", tmp_path / "e.json")
    assert code == 0, error
    (found,) = json.loads((tmp_path / "e.json").read_text())["comparisons"]
    assert found["generated"]["num"] == 2
    # The same sampler and seed, but the noise of evaluation, which no sample has.
    assert 0 <= found["metrics"][0]["figures"]["jsd"] <= 0.8326
    speed = next(metric for metric in found["metrics"] if metric["metric"] == "speed")
    assert speed["figures"]["evaluations"] == evaluations
