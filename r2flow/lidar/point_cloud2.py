"""PointCloud2, ROS's message of a point cloud: all its fields, read and written.

https://docs.ros.org/en/api/sensor_msgs/html/msg/PointCloud2.html
"""

import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray

from r2flow.base.errors import InputError, check, warn_odd
from r2flow.lidar.scan_files.cloud import Cloud

if TYPE_CHECKING:
    from r2flow.lidar.bags import Message

CLOUD = "sensor_msgs/PointCloud2"
ENCODINGS = ("cdr", "ros1")  # of messages that rosbags reads
_TYPE = "sensor_msgs/msg/PointCloud2"
_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # by datatype
_DATATYPES = {kind: datatype for datatype, kind in _KINDS.items()}
_ALIGNMENT = 4  # bytes; of the whole point, after its new fields


@dataclass(frozen=True, eq=False)
class Scan:
    """A cloud of a recording."""

    stamp: int  # header.stamp, nanoseconds since 1970
    frame: str  # header.frame_id
    cloud: Cloud
    message: Any  # as rosbags reads it
    encoding: str

    def replaced(self, cloud: Cloud) -> bytes:
        """The message with other points: its header, and its fields at their places.

        New fields follow, in their order; the list of fields has the order of offsets, rows are
        not padded, and numbers are little-endian, since readers ignore all three. The height is 1.

        Raises:
            InputError: A field has a type that a PointCloud2 cannot hold, or two have one name.
        """
        return _serialized(self.message, cloud, self.encoding)


def read_message(path: Path, message: "Message") -> Scan | InputError:
    """The cloud of a message, or why it is none; warnings name the path."""
    encoding = message.channel.encoding
    store = type_store(encoding)
    deserialize = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    try:
        stored = deserialize(message.data, _TYPE)
        cloud = cloud_of(path, stored)
    except MemoryError:
        raise
    except InputError as error:
        return InputError(f"{path} at {message.recorded}: {error}")
    except Exception as error:  # rosbags raises many kinds on damaged messages
        reason = f"{type(error).__name__}: {error}"
        return InputError(f"{path} at {message.recorded}: it is no {CLOUD} ({reason})")
    stamp = stored.header.stamp
    # ROS 1 counts them up to 2106; rosbags reads them signed.
    seconds = stamp.sec % 2**32 if encoding == "ros1" else stamp.sec
    return Scan(10**9 * seconds + stamp.nanosec, stored.header.frame_id, cloud, stored, encoding)


def written(cloud: Cloud, stamp: int, frame: str, encoding: str) -> bytes:
    """A message of a cloud, as `Scan.replaced` of one without fields.

    Raises:
        InputError: ROS cannot count the time.
    """
    types = type_store(encoding).types
    seconds, nanoseconds = divmod(stamp, 10**9)
    if encoding == "ros1":
        check(
            0 <= seconds < 2**32,
            f"the time {stamp} ns is not one of ROS 1, which counts from 1970 to 2106.",
        )
        seconds -= 2**32 * (seconds >= 2**31)  # rosbags writes them signed
    check(
        -(2**31) <= seconds < 2**31,
        f"the time {stamp} ns is not one of ROS 2, which counts from 1901 to 2038.",
    )
    time = types["builtin_interfaces/msg/Time"](seconds, nanoseconds)
    sequence = (0,) if encoding == "ros1" else ()
    header = types["std_msgs/msg/Header"](*sequence, time, frame)
    nothing = np.empty(0, np.uint8)
    message = types[_TYPE](header, 1, 0, [], False, 0, 0, nothing, True)
    return _serialized(message, cloud, encoding)


@cache
def type_store(encoding: str) -> Any:
    """rosbags' standard definitions."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)


def cloud_of(path: Path, message: Any) -> Cloud:
    """All named fields of a PointCloud2 that lie within its points; a line names the others.

    Raises:
        InputError: Its sizes contradict each other.
    """
    fields = [field for field in message.fields if _is_whole(field, message.point_step)]
    if left := [field for field in message.fields if field not in fields]:
        named = ", ".join(f"{field.name!r} (datatype {field.datatype})" for field in left)
        warn_odd(
            path,
            f"fields without a name, or not within a point, are left out: {named[:120]}",
        )
    order = ">" if message.is_bigendian else "<"
    point = np.dtype(
        {
            "names": [str(number) for number in range(len(fields))],
            "formats": [
                (order + _KINDS[field.datatype], (field.count,) if field.count > 1 else ())
                for field in fields
            ],
            "offsets": [field.offset for field in fields],
            "itemsize": message.point_step,
        }
    )
    packed = message.width * message.point_step
    # Rows may be padded. Drivers that do not pad fill in 0, the width, or the whole size.
    row_step = packed if len(message.data) == message.height * packed else message.row_step
    check(row_step >= packed, f"its row_step {row_step} is below width x point_step, {packed}.")
    size = max(message.height - 1, 0) * row_step + (packed if message.height else 0)
    found = len(message.data)
    check(found >= size, f"its data have {found:,} bytes, not {message.height * row_step:,}.")
    shape = message.height, message.width
    table = np.ndarray(shape, point, message.data, 0, (row_step, message.point_step)).ravel()
    return Cloud(
        tuple(field.name for field in fields),
        tuple(table[name] for name in table.dtype.names or ()),
    )


def _is_whole(field: Any, step: int) -> bool:
    kind = _KINDS.get(field.datatype)
    return (
        bool(field.name)
        and kind is not None
        and field.offset + int(kind[1]) * max(field.count, 1) <= step
    )


def _serialized(message: Any, cloud: Cloud, encoding: str) -> bytes:
    store = type_store(encoding)
    rows = _laid_out(cloud.array(), message)
    step = rows.dtype.itemsize
    field = store.types["sensor_msgs/msg/PointField"]
    layout: Any = rows.dtype.fields or {}
    fields = [
        field(name, offset, _DATATYPES[kind.base.str[1:]], math.prod(kind.shape))
        for name, (kind, offset, *_) in layout.items()
    ]
    finite = all(np.isfinite(rows[axis]).all() for axis in "xyz" if axis in layout)
    new = replace(
        message,
        fields=fields,
        height=1,
        width=len(rows),
        is_bigendian=False,
        point_step=step,
        row_step=step * len(rows),
        data=rows.view(np.uint8) if len(rows) else np.empty(0, np.uint8),
        is_dense=finite,
    )
    serialize = store.serialize_ros1 if encoding == "ros1" else store.serialize_cdr
    return bytes(serialize(new, _TYPE))


def _laid_out(rows: ndarray, message: Any) -> ndarray:
    """Rows whose fields have the message's offsets; others follow, aligned to their own size."""
    placed = {field.name: field.offset for field in message.fields}
    step = message.point_step
    offsets = {}
    for name in rows.dtype.names or ():
        kind = rows.dtype[name]
        code = kind.base.str[1:]
        if code not in _DATATYPES:
            raise InputError(
                f"a PointCloud2 cannot hold the field {name} of {kind}, but integers of 1, 2 and "
                "4 bytes and floats of 4 and 8."
            )
        offsets[name] = placed.get(name, -(-step // kind.base.itemsize) * kind.base.itemsize)
        step = max(step, offsets[name] + kind.itemsize)
    names = sorted(offsets, key=lambda name: offsets[name])
    layout = np.dtype(
        {
            "names": names,
            "formats": [rows.dtype[name].newbyteorder("<") for name in names],
            "offsets": [offsets[name] for name in names],
            "itemsize": -(-step // _ALIGNMENT) * _ALIGNMENT,
        }
    )
    laid = np.zeros(len(rows), layout)
    for name in names:
        laid[name] = rows[name]
    return laid
