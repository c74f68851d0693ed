"""The advice on files that are not read, followed with the tools it names."""

import gzip
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.lidar.bags import read_bag
from r2flow.lidar.scan_files import read_points, write_points
from tests.lidar.conftest import assert_points

XYZ = np.random.default_rng(0).uniform(2, 50, (300, 3)).astype(np.float32)
INTENSITY = (np.arange(300) / 300).astype(np.float32)


def advice(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_points(path)
    return str(caught.value)


def test_a_compressed_file_is_unpacked(tmp_path):
    write_points(tmp_path / "a.bin", XYZ, INTENSITY)
    packed = tmp_path / "b.bin.gz"
    packed.write_bytes(gzip.compress((tmp_path / "a.bin").read_bytes()))
    assert "unpack it" in advice(packed)
    (tmp_path / "b.bin").write_bytes(gzip.decompress(packed.read_bytes()))
    assert_points(read_points(tmp_path / "b.bin"), XYZ, INTENSITY)


def test_arrays_are_written_by_numpy(tmp_path):
    np.savez(tmp_path / "a.npz", xyz=XYZ, strength=INTENSITY)
    assert "write x, y, z, intensity of each scan by numpy.save" in advice(tmp_path / "a.npz")
    stored = np.load(tmp_path / "a.npz")
    np.save(tmp_path / "a.npy", np.column_stack([stored["xyz"], stored["strength"]]))
    assert_points(read_points(tmp_path / "a.npy"), XYZ, INTENSITY)


# Run by the Python of ouster-cli: two frames of random ranges, and their points by the SDK.
OUSTER = """
import numpy as np
from ouster.sdk import core, osf
info = core.SensorInfo.from_default(core.LidarMode._512x10)
info.config.udp_port_lidar, info.config.udp_port_imu = 7502, 7503
info.config.lidar_mode = core.LidarMode._512x10
info.format.column_window = 0, 511
with osf.Writer("two.osf", [info]) as writer:
    for number in range(2):
        frame = core.LidarFrame(info)
        frame.frame_id = number
        draw = np.random.default_rng(number)
        frame.field("RANGE")[:] = draw.integers(3000, 30000, frame.field("RANGE").shape)
        frame.field("REFLECTIVITY")[:] = draw.integers(0, 255, frame.field("RANGE").shape)
        start = 10**12 + number * 10**8
        frame.timestamp[:] = start + np.arange(512) * 10**8 // 512
        frame.packet_timestamp[:] = start + np.arange(len(frame.packet_timestamp))
        frame.measurement_id[:] = np.arange(512)
        frame.status[:] = 1
        points = core.XYZLut(info, False)(frame.field("RANGE"))
        columns = core.destagger(info, points).transpose(1, 0, 2)
        np.save(f"xyz{number}.npy", columns.reshape(-1, 3))
        strength = core.destagger(info, frame.field("REFLECTIVITY"))
        np.save(f"reflectivity{number}.npy", strength.T.ravel())
        writer.save(0, frame)
"""


@pytest.mark.parametrize("ending", [".osf", ".pcap"])
def test_packets_of_an_ouster_become_a_table_a_scan(tmp_path, ending):
    tool = shutil.which("ouster-cli")
    if tool is None:
        pytest.skip("ouster-cli (ouster-sdk) is not installed")
    python = Path(tool).with_name("python")

    def run(*command: str | Path) -> None:
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, timeout=60)

    run(python, "-c", OUSTER)
    if ending == ".pcap":
        run(tool, "source", "two.osf", "save", "two.pcap")
    path = tmp_path / f"two{ending}"
    command = re.search(r"ouster-cli (source \S+ save \S+),", advice(path))
    assert command
    run(tool, *command[1].split())
    for number in range(2):
        points = read_points(tmp_path / f"scan_s0_{number}.csv")
        expected = np.load(tmp_path / f"xyz{number}.npy")
        np.testing.assert_allclose(points.xyz, expected, atol=1e-4)  # it writes 0.1 mm
        np.testing.assert_array_equal(
            points.reflectance, np.load(tmp_path / f"reflectivity{number}.npy")
        )
        np.testing.assert_array_equal(points.ring, np.tile(np.arange(64), 512))


def test_clouds_of_another_encoding_are_read_by_their_package(tmp_path):
    for package in ("rosbags", "mcap", "mcap_protobuf", "foxglove_schemas_protobuf"):
        pytest.importorskip(package, reason=f"{package} is not installed")
    from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory
    from mcap_protobuf.writer import Writer

    path = tmp_path / "a.mcap"
    table = np.column_stack([XYZ, INTENSITY])
    cloud = PointCloud(point_stride=16, data=table.tobytes())
    for offset, name in enumerate(("x", "y", "z", "intensity")):
        kind = PackedElementField.FLOAT32
        cloud.fields.append(PackedElementField(name=name, offset=4 * offset, type=kind))
    with path.open("wb") as stream, Writer(stream) as writer:
        writer.write_message("/points", cloud)
    with pytest.raises(InputError, match=r"mcap-protobuf-support, .* and write .* by numpy\.save"):
        list(read_bag(path))
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        (found,) = [message.decoded_message for message in reader.iter_decoded_messages()]
    np.save(tmp_path / "a.npy", np.frombuffer(found.data, "<f4").reshape(-1, 4))
    assert_points(read_points(tmp_path / "a.npy"), XYZ, INTENSITY)
