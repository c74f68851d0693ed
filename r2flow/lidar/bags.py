"""Point clouds in ROS recordings, read with rosbags: ROS 2 bags (.mcap, .db3 or their folder) and ROS 1 bags (.bag).

Type definitions of the recording are not used, since rosbags would turn them into code: messages are read by the
standard definition of PointCloud2.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from r2flow.errors import InputError, check, naming, require
from r2flow.files import reading_errors
from r2flow.lidar.scan_files.points import Points, column_points

CLOUD = "sensor_msgs/msg/PointCloud2"
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # of a PointField's datatype


def read_bag(path: Path, topic: str | None = None) -> Iterator[tuple[int, Points | InputError]]:
    """Time in nanoseconds and points of each PointCloud2 of a topic (None: the only one), in the order of recording.

    The time is header.stamp, as poses and labels have it; if 0, that of recording. A message that is not a valid scan
    is yielded as an `InputError`.
    """
    require(str(path), "formats", "rosbags")
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys import Stores, get_typestore

    old = path.suffix.lower() == ".bag" and path.is_file()
    folder = path.parent if path.suffix.lower() == ".db3" and path.is_file() else path  # a .db3 is a part of a bag
    check(path.is_dir() or path.is_file(), f"{path} does not exist: give a .mcap, .db3, .bag or a ROS 2 bag's folder.")
    if folder.is_dir():
        whole = (folder / "metadata.yaml").is_file()
        check(whole, f"{folder} has no metadata.yaml: give a .mcap, or make it by ros2 bag reindex {folder}")
    store = get_typestore(Stores.ROS1_NOETIC if old else Stores.ROS2_HUMBLE)
    # rosbags and the stores below it raise many kinds on damaged files
    with reading_errors(path), (Reader1 if old else Reader2)(folder) as reader:
        chosen = _choose(path, list(reader.connections), topic)
        for connection, stamp, data in reader.messages(connections=chosen):
            message: Any = (store.deserialize_ros1 if old else store.deserialize_cdr)(data, connection.msgtype)
            try:
                with naming(f"{path} at {stamp}"):
                    points: Points | InputError = cloud_points(message)
            except InputError as error:
                points = error
            yield 10**9 * message.header.stamp.sec + message.header.stamp.nanosec or stamp, points


def _choose(path: Path, connections: list[Any], topic: str | None) -> list[Any]:
    clouds = [connection for connection in connections if connection.msgtype == CLOUD]
    topics = sorted({connection.topic for connection in clouds})
    types = ", ".join(sorted({connection.msgtype for connection in connections}))[:160]
    listed = ", ".join(topics)
    check(topics, f"{path} has no topic of point clouds ({CLOUD}), but {types}: a ROS driver makes clouds of packets.")
    check(topic or len(topics) == 1, f"{path} holds several topics of point clouds; give one by --topic: {listed}.")
    check(topic in (None, *topics), f"{path} holds no topic {topic!r} of point clouds; known: {listed}.")
    return [connection for connection in clouds if connection.topic == (topic or topics[0])]


def cloud_points(message: Any) -> Points:
    """The points of a PointCloud2 message, checked like points of a scan file."""
    order, step = ">" if message.is_bigendian else "<", message.point_step
    fields = [field for field in message.fields if field.datatype in TYPES]
    kinds = [np.dtype((order + TYPES[field.datatype], (field.count,) if field.count > 1 else ())) for field in fields]
    data = np.asarray(message.data, dtype=np.uint8)
    ends = [field.offset + kind.itemsize for field, kind in zip(fields, kinds, strict=True)]
    fits = step >= max(ends, default=1) and message.row_step >= message.width * step
    fits = fits and data.size == message.row_step * message.height
    check(fits, f"its points of {step} bytes do not fit into its {data.size} bytes.")
    rows = data.reshape(message.height, message.row_step)[:, : message.width * step].tobytes()
    names, offsets = [str(number) for number in range(len(fields))], [field.offset for field in fields]
    point = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": step})
    table = np.frombuffer(rows, point)
    return column_points([field.name for field in fields], [table[name] for name in names])
