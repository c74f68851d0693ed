"""Scan files: KITTI .bin, nuScenes .pcd.bin, PCD, PLY, NPY, tables, LAS are read; .bin, PCD, PLY, NPY are written.

    points = read_points("000000.bin")
    write_points("000000.ply", points.xyz, points.reflectance)

The readers are our own: plyfile is under the GPL and allocates whatever a header declares, pypcd4 returns half a scan
from half a file, and the bindings to LZF need a compiler.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np

from r2flow.errors import InputError
from r2flow.files import atomic_write, refuse_unreadable
from r2flow.lidar.scan_files.arrays import (
    Columns,
    named_already,
    read_array,
    read_image,
    read_kitti,
    read_npy,
    read_nuscenes,
)
from r2flow.lidar.scan_files.fields import check_columns
from r2flow.lidar.scan_files.pcd import read_pcd, write_pcd
from r2flow.lidar.scan_files.ply import PLY_NAMES, read_ply, write_ply
from r2flow.lidar.scan_files.points import NoPointsError, Points
from r2flow.lidar.scan_files.tables import read_arrow, read_las, read_npz, read_text

__all__ = [
    "ELSEWHERE",
    "FIRM_ENDINGS",
    "LOOSE_ENDINGS",
    "SCAN_ENDINGS",
    "NoPointsError",
    "Points",
    "read_numbers",
    "read_points",
    "read_range_image",
    "write_points",
]


def _naming(reader: Callable[[Path], Points]) -> Callable[[Path, Columns], Points]:
    """A reader of files that always name their columns."""

    def read(path: Path, columns: Columns) -> Points:
        if columns is not None:
            raise named_already(path)
        return reader(path)

    return read


_READERS: dict[str, Callable[[Path, Columns], Points]] = {
    ".pcd.bin": read_nuscenes,  # before ".bin", which it ends with
    ".bin": read_kitti,
    ".pcd": _naming(read_pcd),
    ".ply": _naming(read_ply),
    ".npy": read_npy,
    ".npz": read_npz,
    ".csv": read_text,
    ".xyz": read_text,
    ".txt": read_text,
    ".feather": read_arrow,
    ".parquet": read_arrow,
    ".las": read_las,
    ".laz": read_las,
}
# What is not read, and what turns it into files that are.
ELSEWHERE = {
    **dict.fromkeys((".mcap", ".db3", ".bag"), "holds many scans: r2flow unpack {path} --out FOLDER writes them"),
    **dict.fromkeys(
        (".pcap", ".pcapng"),
        "holds packets, which the maker's tool turns into scans (Ouster: ouster-cli source {path} save scan.ply; "
        "Velodyne: VeloView, Save As CSV; Hesai, RoboSense: their ROS driver and r2flow unpack)",
    ),
    **dict.fromkeys((".e57", ".pts", ".ptx", ".rcp", ".fls"), "is read by CloudCompare, which saves it as .ply"),
    **dict.fromkeys((".h5", ".hdf5", ".zarr", ".mat", ".pkl"), "holds arrays: write x, y, z, intensity by numpy.savez"),
    ".tfrecord": "is read by Waymo's own tools: write x, y, z, intensity by numpy.savez",
    **dict.fromkeys(
        (".lvx", ".lvx2", ".lvx3"),
        "is of a Livox, whose scan never repeats: it has no beams, and so no rows of a range image; r2flow needs a "
        "spinning LiDAR",
    ),
}

_WRITERS: dict[str, Callable[[IO[bytes], np.ndarray], object]] = {
    ".bin": lambda file, table: file.write(table.tobytes()),
    ".pcd": write_pcd,
    ".ply": write_ply,
    ".npy": np.save,
}

SCAN_ENDINGS = tuple(_READERS)
LOOSE_ENDINGS = (".csv", ".txt", ".npz")  # which other things than scans have too
FIRM_ENDINGS = tuple(ending for ending in SCAN_ENDINGS if ending not in LOOSE_ENDINGS)

LARGEST_FILE = 1 << 30  # bytes: 67 million points, hundreds of scans; reading more exhausts the memory


def read_points(path: str | Path, columns: Sequence[str] | None = None) -> Points:
    """The points of one scan file, in the file's order; rows that are not finite are dropped and counted.

    The ending tells the format. .bin: KITTI's float32 rows x y z reflectance. .pcd.bin: nuScenes' x y z intensity ring.
    .pcd, .ply, .las, .laz, .feather, .parquet: fields x y z and, where present, intensity (or reflectance,
    reflectivity, remission, i) and ring, of any type. .npy, .npz: float (N, 3) or (N, 4), or named fields. .csv, .xyz,
    .txt: three or four columns, or columns named in the first line. LAS needs laspy, Arrow tables pyarrow.

    Args:
        columns: What each column of a .bin, .npy, .npz or text file without names holds: x, y, z and, where present,
            intensity and ring; any other name is passed over. The usual ones if left out.

    Returns:
        xyz float32 (N, 3) in metres, reflectance float32 (N,) as stored or None, ring uint16 (N,) or None.

    Raises:
        NoPointsError: the file is whole, and has no point.
        InputError: the file is missing, of an unknown format, damaged, without a finite point, or holds values that no
            LiDAR measures. The message names the file.
    """
    path = Path(path)
    check_columns(columns)
    reader = _READERS[_ending(path, _READERS)]
    try:
        if reader in (read_kitti, read_nuscenes) and path.is_file() and path.stat().st_size == 0:
            raise NoPointsError(f"{path} is empty (0 bytes): rows of floats without one; fetch or write it again.")
        refuse_unreadable(path, LARGEST_FILE, "scan file")
        return reader(path, columns)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from None


def read_range_image(path: str | Path) -> np.ndarray | None:
    """The range image in a .npy of floats (2 or 1, H, W), float32, what is not finite as 0; None where it is no .npy.

    None, too, where a .npy is of another shape or type: it may hold points. Nothing is unpickled, and no more memory is
    taken than the file has bytes.

    Raises:
        InputError: the file is missing, no regular file or damaged.
    """
    path = Path(path)
    if path.suffix.lower() != ".npy":
        return None
    try:
        refuse_unreadable(path, LARGEST_FILE, "range image")
        return read_image(path)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from None


def read_numbers(path: str | Path) -> np.ndarray:
    """The array of numbers in a .npy, of any shape and type. Nothing is unpickled.

    Raises:
        InputError: the file is missing, no regular file, damaged, or holds objects.
    """
    path = Path(path)
    try:
        refuse_unreadable(path, LARGEST_FILE, ".npy file")
        with path.open("rb") as file:
            return read_array(path, file, None)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from None


def write_points(
    path: str | Path, xyz: np.ndarray, reflectance: np.ndarray | None = None, ring: np.ndarray | None = None
) -> None:
    """Write one scan as little-endian float32, whole or not at all.

    Args:
        path: The file, its format told by the ending: .bin, .pcd or .ply (binary), or .npy. Its folder is made when
            missing, an existing file is replaced.
        xyz: Points in metres, (N, 3), sensor frame.
        reflectance: (N,), or None for none.
        ring: Number of each point's beam, (N,), or None; for a .ply.

    Raises:
        InputError: an unknown format, a .bin without reflectance, shapes that do not fit, values that are not finite in
            float32, or a path that cannot be written.
    """
    path = Path(path)
    ending = _ending(path, _WRITERS)
    if ending == ".bin" and reflectance is None:
        raise InputError(f"{path}: KITTI's .bin needs a reflectance; give one, or choose .ply, .pcd or .npy.")
    table = _table(path, xyz, reflectance)
    write = _WRITERS[ending]
    if ring is not None:
        if ending != ".ply" or np.shape(ring) != (len(table),):
            raise InputError(f"{path}: ring numbers, one for each point, are written as .ply alone.")
        table = np.column_stack([table, ring]).astype("<f4")
        write = partial(write_ply, names=(*PLY_NAMES[: table.shape[1] - 1], "ring"))
    try:
        with atomic_write(path) as file:
            write(file, table)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}.") from None


def scan_ending(name: str) -> str:
    """The ending of a scan file's name, in lower case, `.pcd.bin` as one; empty where it is none."""
    return next((ending for ending in SCAN_ENDINGS if name.lower().endswith(ending)), "")


def _ending(path: Path, known: Iterable[str]) -> str:
    name = path.name.lower()
    ending = scan_ending(name)
    if not ending:
        for other, advice in ELSEWHERE.items():
            if name.endswith(other):
                raise InputError(f"{path} {advice.format(path=path)}.")
        raise InputError(f"{path} has no ending of a scan file; known: {', '.join(known)}. Convert or rename it.")
    if ending not in known:
        raise InputError(f"{path}: {ending} is read but not written; choose one of {', '.join(known)}.")
    return ending


def _table(path: Path, xyz: np.ndarray, reflectance: np.ndarray | None) -> np.ndarray:
    """x y z and, when given, reflectance: little-endian float32, (N, 3) or (N, 4)."""
    shape = np.shape(xyz)
    if len(shape) != 2 or shape[1] != 3:
        raise InputError(f"{path}: xyz must have the shape (N, 3), found {shape}.")
    if reflectance is not None and np.shape(reflectance) != shape[:1]:
        raise InputError(f"{path}: reflectance must have the shape {shape[:1]}, found {np.shape(reflectance)}.")
    columns = [xyz] if reflectance is None else [xyz, reflectance]
    with np.errstate(over="ignore"):  # beyond float32 is infinite, and refused
        table = np.column_stack(columns).astype("<f4")
    if not np.isfinite(table).all():
        raise InputError(f"{path}: a coordinate or reflectance is NaN or infinite; drop such points first.")
    return table
