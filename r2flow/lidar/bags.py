"""Point clouds in recordings of ROS: ROS 2 bags (.mcap, .db3 or their folder) and ROS 1 bags (.bag), by rosbags.

Types that a recording defines itself are not used, since they would become code: messages are read by the standard's
definition of a PointCloud2.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from r2flow.errors import InputError
from r2flow.lidar.scan_files.fields import PointField, column_points, find_roles
from r2flow.lidar.scan_files.points import Points
from r2flow.lidar.scan_files.tables import INSTALL

REINDEX = "ros2 bag reindex FOLDER"
CLOUD = "sensor_msgs/msg/PointCloud2"
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # of a PointField's datatype


def read_bag(path: Path, topic: str | None = None) -> Iterator[tuple[int, Points | InputError]]:
    """Time in nanoseconds and points of each PointCloud2 of a topic, in the order of recording.

    A message that is no scan comes as what is wrong with it.

    Args:
        topic: Its name; may be left out where there is one topic of point clouds.

    Raises:
        InputError: rosbags is not installed, the recording cannot be read, or it has no such topic.
    """
    with _opened(path) as (reader, deserialize):
        chosen = _choose(path, list(reader.connections), topic)
        for connection, stamp, data in reader.messages(connections=chosen):
            try:
                yield stamp, cloud_points(f"{path} at {stamp}", deserialize(data, connection.msgtype))
            except InputError as error:
                yield stamp, error


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(f"{path}: recordings of ROS need rosbags: {INSTALL}.") from None
    if not (path.is_dir() or path.is_file()):
        raise InputError(f"{path} is not a recording: give a .mcap, .db3 or .bag file, or the folder of a ROS 2 bag.")
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise InputError(f"{path} is no ROS 2 bag (no metadata.yaml); give the .mcap in it, or for a .db3 {REINDEX}.")
    if path.suffix.lower() == ".bag" and path.is_file():
        store = get_typestore(Stores.ROS1_NOETIC)
        kind: Any = Reader1
        deserialize = store.deserialize_ros1
    else:
        store = get_typestore(Stores.ROS2_HUMBLE)
        kind, deserialize = Reader2, store.deserialize_cdr
        if path.suffix.lower() == ".db3" and path.is_file():  # a part of a bag, whose folder says its topics
            path = path.parent
            if not (path / "metadata.yaml").is_file():
                raise InputError(f"{path} has no metadata.yaml, which says what its .db3 holds; make it: {REINDEX}.")
    try:
        with kind(path) as reader:
            yield reader, deserialize
    except InputError:
        raise
    except Exception as error:  # rosbags and the stores below it raise many kinds on damaged files
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path} is not a readable recording ({reason[:160]}). Is it damaged?") from None


def _choose(path: Path, connections: list[Any], topic: str | None) -> list[Any]:
    clouds = [one for one in connections if one.msgtype == CLOUD]
    known = sorted({one.topic for one in clouds})
    if not known:
        types = {one.msgtype for one in connections}
        if any("livox" in name.lower() for name in types):
            raise InputError(
                f"{path} is of a Livox, whose scan never repeats: it has no beams, and so no rows of a range image; "
                "r2flow needs a spinning LiDAR."
            )
        packets = [name for name in types if "packet" in name.lower() or "velodynescan" in name.lower()]
        advice = "; it holds packets, which the sensor's ROS driver turns into clouds" if packets else ""
        raise InputError(f"{path} holds no topic of point clouds ({CLOUD}){advice}.")
    if topic is None and len(known) > 1:
        raise InputError(f"{path} holds several topics of point clouds; give one by --topic: {', '.join(known)}.")
    chosen = [one for one in clouds if one.topic == (topic or known[0])]
    if not chosen:
        raise InputError(f"{path} holds no topic {topic!r} of point clouds; known: {', '.join(known)}.")
    return chosen


def cloud_points(name: str, message: Any) -> Points:
    """The points of a PointCloud2 message, checked as those of a scan file.

    Raises:
        InputError: a message whose fields do not fit into its data, or without x, y and z.
    """
    where, order = Path(name), ">" if message.is_bigendian else "<"
    fields = [field for field in message.fields if field.datatype in TYPES]
    described = [PointField(f.name, np.dtype(order + TYPES[f.datatype]), max(f.count, 1)) for f in fields]
    roles = find_roles(where, described)
    count, step, data = message.width * message.height, message.point_step, np.asarray(message.data, dtype=np.uint8)
    ends = [fields[index].offset + described[index].nbytes for index in roles.values()]
    if step < max(ends) or message.row_step < message.width * step or data.size != message.row_step * message.height:
        raise InputError(f"{name}: a cloud of {count} points of {step} bytes does not fit into its {data.size} bytes.")
    rows = data.reshape(message.height, message.row_step)[:, : message.width * step].tobytes()
    point = np.dtype(
        {
            "names": list(roles),
            "formats": [described[index].dtype for index in roles.values()],
            "offsets": [fields[index].offset for index in roles.values()],
            "itemsize": step,
        }
    )
    table = np.frombuffer(rows, point, count)
    return column_points(where, {role: table[role] for role in roles})
