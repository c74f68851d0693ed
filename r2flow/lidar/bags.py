"""Point clouds in ROS recordings, read with rosbags: ROS 2 bags (.mcap, .db3 or their folder) and
ROS 1 bags (.bag).

Type definitions of the recording are not used, since rosbags would turn them into code: messages
are read by the standard definition of PointCloud2.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from r2flow.errors import InputError, require
from r2flow.files import reading_errors
from r2flow.lidar.scan_files.points import Points, column_points

_CLOUD = "sensor_msgs/msg/PointCloud2"
_TYPES = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")  # by the datatype of a PointField


def read_bag(path: Path, topic: str | None = None) -> Iterator[tuple[int, Points | InputError]]:
    """Time in nanoseconds and points of each PointCloud2 of a topic, in the order of recording.

    The time is header.stamp, as poses and labels have it; if 0, that of recording. A message that
    is not a valid scan is yielded as an `InputError`.

    Args:
        topic: None takes the only one.
    """
    require(str(path), "formats", "rosbags")
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    reader: Any
    ros1 = path.suffix.lower() == ".bag"
    # rosbags and the stores below it raise many kinds on damaged files
    with reading_errors(path):
        if ros1:
            deserialize = get_typestore(Stores.ROS1_NOETIC).deserialize_ros1
            reader = rosbag1.Reader(path)
        else:
            deserialize = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr
            reader = rosbag2.Reader(path)
        with reader:
            chosen = _connections_of(reader.connections, topic)
            for connection, recorded, data in reader.messages(connections=chosen):
                message: Any = deserialize(data, connection.msgtype)
                points: Points | InputError
                try:
                    points = cloud_points(message)
                except (TypeError, ValueError) as error:
                    points = InputError(f"{path} at {recorded}: {error}")
                stamp = message.header.stamp
                yield 10**9 * stamp.sec + stamp.nanosec or recorded, points


def _connections_of(connections: list[Any], topic: str | None) -> list[Any]:
    """The connections of a topic of point clouds, or of the only one."""
    clouds = [connection for connection in connections if connection.msgtype == _CLOUD]
    topics = sorted({connection.topic for connection in clouds})
    if topic is None and len(topics) == 1:
        return clouds
    if topic not in topics:
        known = ", ".join(topics) or "it has none"
        raise InputError(f"give one of its topics of point clouds by --topic: {known}.")
    return [connection for connection in clouds if connection.topic == topic]


def cloud_points(message: Any) -> Points:
    """The points of a PointCloud2 message, checked like points of a scan file."""
    order = ">" if message.is_bigendian else "<"
    point = np.dtype(
        {
            "names": [str(number) for number in range(len(message.fields))],
            "formats": [
                (order + _TYPES[field.datatype], (field.count,) if field.count > 1 else ())
                for field in message.fields
            ],
            "offsets": [field.offset for field in message.fields],
            "itemsize": message.point_step,
        }
    )
    shape = message.height, message.width
    strides = message.row_step, message.point_step  # rows may be padded
    table = np.ndarray(shape, point, message.data, 0, strides).ravel()
    columns = [table[name] for name in table.dtype.names or ()]
    return column_points([field.name for field in message.fields], columns)
