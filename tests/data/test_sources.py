from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from r2flow import simulator
from r2flow.base.errors import InputError
from r2flow.data.files import ScanFiles
from r2flow.data.reading import Reading, read_image
from r2flow.data.simulated import SimulatedScans
from r2flow.data.sources import InMemory, holdout_block
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS
from tests.conftest import memory_below, numbers, write_scan

SENSOR = SENSORS["hdl64e"].resized(16, 64)
STRICT = Reading(SENSOR, reflectance=True, on_bad_scan="error")


def files(folder: Path, **options) -> ScanFiles:
    return ScanFiles(sorted(folder.glob("*.bin")), replace(STRICT, **options))


def test_skipping_takes_the_next_good_scan_of_the_same_block(numbered: Path, caplog):
    for bad in (3, 4, 11):
        (numbered / f"{bad:06d}.bin").write_bytes(b"\0" * 30)
    source = files(numbered, on_bad_scan="skip")
    for _ in range(2):
        assert numbers(source) == [0, 1, 2, 5, 5, 5, 6, 7, 8, 9, 10, 0]
    assert caplog.text.count("left out") == 3  # each is said once
    with memory_below(4 << 20):  # two lists of 120,000 paths; as many numbers take 5 MB more
        ScanFiles(source.paths * 10_000, source.reading)[2]
    # A block never reaches into its neighbour: scan 11 is not replaced by scan 0 of the training
    # block.
    assert numbers(source.subset(range(9, 12))) == [9, 10, 9]
    # The same length and order in memory, or a run could not go on with other memory.
    kept = InMemory(source.batch(range(12)).numpy(), source.names)
    assert [numbers(kept), numbers(kept.subset([2, 3]))] == [numbers(source), [2, 5]]
    for path in numbered.glob("*.bin"):
        path.write_bytes(b"")
    with pytest.raises(InputError, match="all 12 scans were left out"):
        files(numbered, on_bad_scan="skip")[0]


def test_a_scan_out_of_range_says_its_numbers(tmp_path: Path):
    write_scan(tmp_path / "far.bin", 200)
    with pytest.raises(
        InputError, match=r"far.bin: none of its 1 points lies within 1.45-80 m .* 205-205 m"
    ):
        read_image(tmp_path / "far.bin", STRICT)


def test_reflectance_out_of_scale_names_the_key(tmp_path: Path):
    words = r"in \[0, 1\], found up to {0}\..*reflectance_scale={1},"
    for stored, said in (
        (-1, "negative, found -1;"),
        (4e4, words.format(40000, 65535)),
        (204, words.format(204, 255)),
    ):
        write_points(tmp_path / "scan.ply", np.array([[10, 0, -1]]), np.array([stored]))
        with pytest.raises(InputError, match=said):
            read_image(tmp_path / "scan.ply", STRICT)
    assert read_image(tmp_path / "scan.ply", replace(STRICT, reflectance_scale=255))[
        1
    ].max() == pytest.approx(0.8)


def test_the_held_out_block_is_contiguous_and_last():
    training, held = holdout_block(19, 0.1)
    assert (list(training), list(held)) == (list(range(17)), [17, 18])
    assert [len(part) for part in holdout_block(3, 0.0)] == [3, 0]
    # something must be left to learn from
    assert [len(part) for part in holdout_block(1, 0.5)] == [1, 0]


def test_whole_drives_are_held_out_where_they_come_within_half_of_the_share():
    def held(share: float, starts: list[int]) -> int:
        training, last = holdout_block(100, share, starts)
        assert [*training, *last] == list(range(100))
        return len(last)

    assert held(0.1, [0, 50, 85, 93]) == 7  # 15 and 7 come near, 7 nearer
    assert held(0.2, [0, 50, 85, 93]) == 15
    assert held(0.1, [0, 50, 70]) == 10  # 30 is too much: the end of the last drive
    assert held(0.1, [0, 98]) == 10
    assert held(0.0, [0, 99]) == 0
    assert (held(0.9, [0, 10]), held(0.7, [0])) == (90, 70)  # never all


def test_many_simulated_scans_are_kept_on_the_disk(tmp_path, monkeypatch):
    monkeypatch.setenv("R2FLOW_CACHE", str(tmp_path))
    monkeypatch.setattr("r2flow.data.simulated.WORTH_KEEPING", 3)
    sensor = SENSORS["hdl64e"].resized(8, 16)
    scans = SimulatedScans(sensor, 5, range(7, 10), reflectance=True)
    shape = (2, 8, 16)
    simulated = scans.read_all("scans", shape)
    assert np.array_equal(simulated, np.stack([scans[number] for number in range(3)]))
    monkeypatch.setattr(simulator, "simulate", Mock(side_effect=AssertionError))
    assert np.array_equal(scans.read_all("scans", shape), simulated)
    with pytest.raises(AssertionError):
        SimulatedScans(sensor, 6, range(7, 10), reflectance=True).read_all("scans", shape)
    (kept,) = tmp_path.iterdir()
    whole = bytearray(kept.read_bytes())
    whole[-9] ^= 1
    kept.write_bytes(whole)
    with pytest.raises(AssertionError):  # a flipped bit: simulated again
        scans.read_all("scans", shape)
