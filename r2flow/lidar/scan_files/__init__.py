"""Scan files: KITTI .bin, nuScenes .pcd.bin, PCD, PLY, NPY, tables, LAS are read; .bin, PCD, PLY, NPY are written.

points = read_points("000000.bin")
write_points("000000.ply", points.xyz, points.reflectance)
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from r2flow.errors import InputError, check, warn_odd
from r2flow.files import atomic_write, reading
from r2flow.lidar.scan_files import clouds, tables
from r2flow.lidar.scan_files.points import FARTHEST, Points, check_columns, check_xyz, column_points
from r2flow.lidar.scan_files.points import NoPointsError as NoPointsError
from r2flow.lidar.scan_files.tables import read_array, read_rows, usual_names

_ROWS = (".pcd.bin", ".bin")  # rows of float32; the one that ends with the other first
_READERS = clouds.READERS | tables.READERS
# Formats that are not supported, with advice on conversion.
ELSEWHERE = {
    **dict.fromkeys((".mcap", ".db3", ".bag"), "holds many scans: r2flow unpack {path} --out FOLDER writes them"),
    **dict.fromkeys(
        (".pcap", ".pcapng"),
        "holds packets, which the maker's tool turns into scans (Ouster: ouster-cli source {path} save scan.ply; "
        "Velodyne: VeloView, Save As CSV; Hesai, RoboSense: their ROS driver and r2flow unpack)",
    ),
    **dict.fromkeys((".laz", ".e57", ".pts", ".ptx", ".rcp", ".fls"), "is read by CloudCompare, which saves .ply"),
    **dict.fromkeys((".h5", ".hdf5", ".zarr", ".mat", ".pkl"), "holds arrays: write x, y, z, intensity by numpy.savez"),
    ".tfrecord": "is read by Waymo's own tools: write x, y, z, intensity by numpy.savez",
    **dict.fromkeys((".lvx", ".lvx2", ".lvx3"), "is of a Livox, which has no beams; r2flow needs a spinning LiDAR"),
    **dict.fromkeys((".gz", ".bz2", ".xz", ".zst", ".zip", ".tar"), "is compressed: unpack it"),
}
WRITTEN = (".bin", ".pcd", ".ply", ".npy")
SCAN_ENDINGS = (*_ROWS, *_READERS)
LOOSE_ENDINGS = (".csv", ".txt", ".npz")  # also used for other files than scans
FIRM_ENDINGS = tuple(ending for ending in SCAN_ENDINGS if ending not in LOOSE_ENDINGS)

FARTHEST_RAY = 400.0  # metres; no spinning LiDAR measures farther
LARGEST_FILE = 1 << 30  # bytes: 67 million points, hundreds of scans; reading more exhausts the memory


def read_points(path: str | Path, columns: Sequence[str] | None = None) -> Points:
    """The points of a scan file, in the order of the file; rows that are not finite are dropped and counted.

    The ending is the format. .bin: KITTI's float32 rows x y z reflectance. .pcd.bin: nuScenes' x y z intensity ring.
    .pcd, .ply, .las, .feather, .parquet: fields x y z and, where present, intensity (or reflectance,
    reflectivity, remission, i) and ring, of any type. .npy, .npz: (N, 3) or (N, 4), or named fields. .csv, .xyz, .txt:
    three or four columns, or columns named in the first line. LAS needs laspy, Arrow tables pyarrow.

    Args:
        columns: Names of the columns of a .bin, .npy, .npz or text file without names: x, y, z and, where present,
            intensity and ring; columns with other names are ignored. None: the default of the format.

    Returns:
        xyz float32 (N, 3) in metres, reflectance float32 (N,) as stored or None, ring uint16 (N,) or None.

    Raises:
        NoPointsError: the file is intact, but has no point.
        InputError: the file is missing, of an unknown format, damaged, without a finite point, or holds values that no
            LiDAR measures. The message names the file.
    """
    path = Path(path)
    check_columns(columns)
    ending = scan_ending(path.name)
    if not ending and path.exists():
        unknown = f"has no ending of a scan file; known: {', '.join(SCAN_ENDINGS)}. Convert or rename it"
        advice = next((advice for other, advice in ELSEWHERE.items() if path.name.lower().endswith(other)), unknown)
        raise InputError(f"{path} {advice.format(path=path)}.")
    if ending == ".pcd.bin" and columns is None:
        columns = ("x", "y", "z", "intensity", "ring")
    raw = ending in _ROWS
    with reading(path, LARGEST_FILE, "scan file", least=0 if raw else 1):
        names, arrays = (None, read_rows(path, columns)) if raw else _READERS[ending](path)
        check(names is None or columns is None, "it names its columns: leave --columns (data.reading.columns) out.")
        points = column_points(names or usual_names(len(arrays), columns), arrays, raw)
    if points.dropped:
        warn_odd(path, f"points that are NaN, infinite or beyond {FARTHEST:g} m are dropped", points.dropped)
    return points


def points_beside(path: Path) -> Path:
    """The file of points next to a range image of the same name, if there is one; else the path itself."""
    others = (path.with_suffix(ending) for ending in WRITTEN if ending != ".npy" and path.suffix.lower() == ".npy")
    return next((other for other in others if other.is_file()), path)


def read_range_image(path: str | Path) -> np.ndarray | None:
    """The range image in a .npy of floats (2 or 1, H, W), float32; None for any other array.

    Values that are not finite become 0, a ray without return; so do, with a warning, ranges that no LiDAR measures.
    """
    if Path(path).suffix.lower() != ".npy":
        return None
    array = read_numbers(path)
    shape = array.shape if array.ndim == 3 and array.dtype.kind == "f" and array.size else (0,)
    if shape[0] not in (1, 2) or shape[1] > 4 >= shape[2] > 2:  # the latter are points in order, (1, N, 4)
        return None
    with np.errstate(over="ignore"):  # float32 overflow is infinite: no return
        image = np.nan_to_num(array.astype(np.float32), copy=False, nan=0.0, posinf=0.0, neginf=0.0)
    wrong = (image[0] < 0) | (image[0] > FARTHEST_RAY)
    if wrong.any():
        if 2 * wrong.sum() > np.count_nonzero(image[0]):
            ends = f"from {image[0][wrong].min():.3g} to {image[0][wrong].max():.3g}"
            raise InputError(
                f"{path}: most of its ranges are below 0 or above {FARTHEST_RAY:g} m, {ends}. Are these millimetres, "
                "or a scan in model space? Give metres."
            )
        kind = f"ranges below 0 or above {FARTHEST_RAY:g} m are taken as no return; ranges are metres"
        warn_odd(Path(path), kind, int(wrong.sum()))
        image[:, wrong] = 0
    return image


def read_numbers(path: str | Path) -> np.ndarray:
    """The array of numbers in a .npy, of any shape and type, read without unpickling."""
    path = Path(path)
    with reading(path, LARGEST_FILE, ".npy file"), path.open("rb") as file:
        return read_array(file, path.stat().st_size)


def write_points(
    path: str | Path, xyz: np.ndarray, reflectance: np.ndarray | None = None, ring: np.ndarray | None = None
) -> None:
    """Write a scan in metres as little-endian float32, atomically: .bin, .pcd or .ply (binary), or .npy, by its ending.

    Missing folders are created, an existing file is replaced. `ring`, each point's beam, is only for .ply.
    """
    check_xyz(xyz)
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in WRITTEN or scan_ending(path.name) != ending or (ending == ".bin" and reflectance is None):
        raise InputError(f"{path}: scans are written as {', '.join(WRITTEN)}, and as .bin only with a reflectance.")
    assert ring is None or ending == ".ply"
    columns = {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], "intensity": reflectance, "ring": ring}
    given = {name: column for name, column in columns.items() if column is not None}
    with np.errstate(over="ignore"):  # float32 overflow is infinite
        table = np.column_stack([*given.values()]).astype("<f4")
    assert np.isfinite(table).all(), "a coordinate or reflectance is NaN or infinite"
    with atomic_write(path) as file:
        if ending == ".npy":
            np.save(file, table)
        elif ending == ".bin":
            file.write(table.tobytes())
        else:
            clouds.WRITERS[ending](file, table, tuple(given))


def scan_ending(name: str) -> str:
    """The ending of a scan file's name in lower case, including `.pcd.bin`; empty for other files."""
    return next((ending for ending in SCAN_ENDINGS if name.lower().endswith(ending)), "")
