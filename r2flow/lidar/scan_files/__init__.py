"""Scan files: KITTI .bin, nuScenes .pcd.bin, PCD, PLY, NPY, tables, LAS, published samples and
PandaSet.

All are read, as `Cloud` with every field or as `Points`; all but the last two are written.

points = read_points("000000.bin")
write_points("000000.ply", points.xyz, points.reflectance)
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy import ndarray

from r2flow.base.errors import IN_MEMORY, InputError, check, naming, warn_odd
from r2flow.base.files import atomic_write, reading, reading_errors
from r2flow.lidar.scan_files import clouds, pandaset, samples, tables
from r2flow.lidar.scan_files.cloud import Cloud
from r2flow.lidar.scan_files.points import FARTHEST, Points, check_columns, warn_of_unused
from r2flow.lidar.scan_files.points import NoPointsError as NoPointsError
from r2flow.lidar.scan_files.tables import KEPT, state_of

_ROWS = (".pcd.bin", ".bin")  # rows of float32; the one that ends with the other first
TABLE_ENDINGS = (".pkl.gz", ".pkl")  # PandaSet's frames, and other files of its folders
_READERS = (
    clouds.READERS
    | tables.READERS
    | samples.READERS
    | dict.fromkeys(TABLE_ENDINGS, pandaset.read_frame)
)
# Endings of formats that are not read, with advice on conversion.
ELSEWHERE = {
    TABLE_ENDINGS: "is read if it is PandaSet's: data=pandaset, in a verb pandaset:FOLDER",
    (".mcap", ".db3", ".bag"): (
        "holds many scans: r2flow unpack {path} --out FOLDER writes them, and r2flow complete "
        "takes it by itself"
    ),
    (".pcap", ".pcapng", ".osf"): (
        "holds packets, which the maker's tool turns into scans (Ouster: ouster-cli source {path} "
        "save scan.csv, a file a scan; Velodyne: VeloView, Save As CSV; Hesai, RoboSense: their "
        "ROS driver and r2flow unpack)"
    ),
    (".e57", ".pts", ".ptx", ".rcp", ".fls"): "is read by CloudCompare, which saves .ply",
    (".npz", ".h5", ".hdf5", ".zarr", ".mat", ".tfrecord"): (
        "holds arrays: write x, y, z, intensity of each scan by numpy.save"
    ),
    (".lvx", ".lvx2", ".lvx3"): "is of a Livox, which has no beams; r2flow needs a spinning LiDAR",
    (".gz", ".bz2", ".xz", ".zst", ".zstd", ".zip", ".tar"): "is compressed: unpack it",
}
_PLAIN = (".bin", ".pcd", ".ply", ".npy")  # that `write_points` writes
_WRITERS: dict[str, Callable[[IO[bytes], Cloud], None]] = {
    ".pcd.bin": tables.write_rows,
    ".bin": tables.write_rows,
    ".pcd": clouds.write_pcd,
    ".ply": clouds.write_ply,
    ".npy": tables.write_npy,
    **dict.fromkeys((".csv", ".xyz", ".txt"), tables.write_text),
    ".feather": partial(tables.write_arrow, ending=".feather"),
    ".parquet": partial(tables.write_arrow, ending=".parquet"),
    ".las": partial(tables.write_las, compressed=False),
    ".laz": partial(tables.write_las, compressed=True),
}
WRITTEN = tuple(_WRITERS)
_SCAN_ENDINGS = (*_ROWS, *_READERS)
LOOSE_ENDINGS = (".csv", ".txt", ".pth")  # also used for other files than scans
FIRM_ENDINGS = tuple(
    ending for ending in _SCAN_ENDINGS if ending not in LOOSE_ENDINGS + TABLE_ENDINGS
)

FARTHEST_RAY = 400.0  # metres; no spinning LiDAR measures farther
LARGEST_FILE = 1 << 30  # bytes: 67 million points, hundreds of scans; more exhausts the memory


def read_points(path: str | Path, columns: Sequence[str] | None = None) -> Points:
    """The points of a scan file, in the order of the file.

    The ending is the format. .bin: KITTI's float32 rows x y z reflectance. .pcd.bin: nuScenes' x y
    z intensity ring. .pcd, .ply, .las, .feather, .parquet: fields x y z and, where present,
    intensity (or reflectance, reflectivity, remission, i) and ring (or channel), of any type.
    .npy: (N, 3) or (N, 4), or named fields. .csv, .xyz, .txt: three or four columns, or columns
    named in the first line. .pth: samples of the published R2Flow and R2DM code. .pkl.gz, .pkl: a
    frame of PandaSet (`pandaset.read_frame`). LAS, Arrow tables and compressed PCDs need the extra
    `formats`.

    Args:
        columns: Names of the columns of a .bin, .npy or text file without names: x, y, z and, where
            present, intensity and ring; others are ignored. None: the default of the format. Of
            a file with names: fields to rename, as `intensities=reflectance`, `_` to ignore one.

    Returns:
        xyz float32 (N, 3) in metres, reflectance float32 (N,) as stored or None, ring uint16 (N,)
        or None. Rows that are not finite are dropped and counted.

    Raises:
        NoPointsError: The file is intact, but has no point.
        InputError: The file is missing, of an unknown format, damaged, without a finite point, or
            holds values that no LiDAR measures. The message names the file.
    """
    return replace(points_of(Path(path), read_cloud(path, columns)), cloud=None)


def read_cloud(path: str | Path, columns: Sequence[str] | None = None) -> Cloud:
    """All fields of a scan file, as stored; `columns` and errors as of `read_points`."""
    path = Path(path)
    check_columns(columns)
    cloud = _read_cloud(path, columns and tuple(columns), state_of(path))
    if cloud.named or not beside(path).is_file():
        return cloud
    with reading_errors(path):
        return _with_beside(path, cloud)


@lru_cache(KEPT)
def _read_cloud(path: Path, columns: Sequence[str] | None, state: tuple[int, ...]) -> Cloud:
    ending = scan_ending(path.name)
    if not ending and path.exists():
        known = ", ".join(_SCAN_ENDINGS)
        other = f"has no ending of a scan file; known: {known}. Convert or rename it"
        raise InputError(f"{path} {conversion_of(path) or other}.")
    raw = ending in _ROWS
    with reading(path, LARGEST_FILE, "scan file", least=0 if raw else 1):
        if raw:
            return tables.read_rows(path, columns)
        cloud = _READERS[ending](path)
        if cloud.named:
            return cloud.renamed(columns)
        names = tuple(tables.column_names(len(cloud.columns), columns))
        return replace(cloud, names=names)


def beside(path: Path) -> Path:
    """The file of the fields that the rows of a scan file without names cannot hold."""
    return path.with_name(path.name.removesuffix(scan_ending(path.name)) + ".fields.npz")


def _with_beside(path: Path, cloud: Cloud) -> Cloud:
    """The cloud with the fields in the file beside it."""
    with np.load(beside(path)) as stored:
        fields = {name: stored[name] for name in stored.files}
    whole = all(column.shape[:1] == (len(cloud),) for column in fields.values())
    check(whole, f"{beside(path)} is not of its {len(cloud)} points: move it elsewhere.")
    return cloud.with_fields(fields)


def points_of(path: Path, cloud: Cloud) -> Points:
    """The points of a cloud, with it; errors and warnings name the path."""
    ending = scan_ending(path.name)
    with reading_errors(path):
        points = cloud.points(raw=ending in _ROWS)
        if cloud.named:
            warn_of_unused(path, cloud.meanings, cloud.columns, points)
    if points.dropped:
        kind = f"points that are NaN, infinite or beyond {FARTHEST:g} m are dropped"
        warn_odd(path, kind, points.dropped)
    return points


def points_in_memory(rows: ndarray) -> Points:
    """The points of an array (N, 3 or 4): x, y, z and reflectance, as `read_points` of a file."""
    return points_of(Path(IN_MEMORY), Cloud.of(rows))


def conversion_of(path: str | Path) -> str | None:
    """Advice on how a file of a format that is not read becomes scans; None for other files."""
    for endings, advice in ELSEWHERE.items():
        if str(path).lower().endswith(endings):
            return advice.format(path=path)
    return None


def points_beside(path: Path) -> Path:
    """The file of points next to a range image that r2flow has written; else the path."""
    if path.suffix.lower() == ".npy" and (path.parent / "manifest.json").is_file():
        for ending in (".bin", ".pcd", ".ply"):
            if path.with_suffix(ending).is_file():
                return path.with_suffix(ending)
    return path


def read_range_image(path: str | Path) -> ndarray | None:
    """The range image in a .npy of floats (2 or 1, H, W), or in a sample of the published code,
    float32; None for any other array.

    Values that are not finite become 0, a ray without return; so do, with a warning, ranges that no
    LiDAR measures.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending == ".pth":
        with reading(path, LARGEST_FILE, "sample"):
            array = samples.read_image(path)
    elif ending == ".npy":
        array = read_numbers(path)
    else:
        return None
    if array.ndim != 3 or array.dtype.kind != "f" or not array.size:
        return None
    channels, rows, columns = array.shape
    if channels > 2 or rows > 4 >= columns > 2:  # the latter are points in order, (1, N, 4)
        return None
    with np.errstate(over="ignore"):  # float32 overflow is infinite: no return
        image = np.nan_to_num(array.astype(np.float32), copy=False, posinf=0, neginf=0)
    ranges = image[0]
    wrong = (ranges < 0) | (ranges > FARTHEST_RAY)
    count = int(np.count_nonzero(wrong))
    found = ranges[wrong]
    # one value alone, as -1, stands for no return, however many have none
    if count and (found != found[0]).any() and 2 * count > np.count_nonzero(ranges):
        raise InputError(
            f"{path}: most of its ranges are below 0 or above {FARTHEST_RAY:g} m, from "
            f"{found.min():.3g} to {found.max():.3g}. Are these millimetres, or a scan in model "
            "space? Give metres."
        )
    if count:
        kind = (
            f"ranges below 0 or above {FARTHEST_RAY:g} m are taken as no return; ranges are metres"
        )
        warn_odd(path, kind, count)
        image[:, wrong] = 0
    return image


def read_numbers(path: str | Path) -> ndarray:
    """The array of numbers in a .npy, of any shape and type, read without unpickling; read-only."""
    with reading(Path(path), LARGEST_FILE, ".npy file"):
        return tables.read_array(Path(path))


def write_points(
    path: str | Path,
    xyz: ndarray,
    reflectance: ndarray | None = None,
    ring: ndarray | None = None,
) -> None:
    """Write a scan in metres as little-endian float32, atomically; the ending is the format.

    They are .bin, .pcd or .ply (binary), or .npy. Missing folders are created, an existing file is
    replaced. `ring`, each point's beam, is only for .ply.
    """
    path = Path(path)
    ending = scan_ending(path.name)
    check(
        ending in _PLAIN and (ending != ".bin" or reflectance is not None),
        f"{path}: scans are written as {', '.join(_PLAIN)}; .bin only with a reflectance.",
    )
    fields = {**dict(zip("xyz", xyz.T, strict=True)), "intensity": reflectance, "ring": ring}
    with np.errstate(over="ignore"):  # float32 overflow is infinite
        columns = {name: v.astype("<f4") for name, v in fields.items() if v is not None}
    finite = all(np.isfinite(column).all() for column in columns.values())
    assert finite, "a coordinate or reflectance is NaN or infinite"
    write_cloud(path, Cloud(tuple(columns), tuple(columns.values()), held=len(columns)))


def write_cloud(path: Path, cloud: Cloud) -> None:
    """Write all fields of a cloud with their types, atomically; the ending is the format.

    PCD and PLY are binary and little-endian. Rows without names (.bin, .npy, text) hold what they
    held when they were read; other fields go into the file `beside` them.

    Raises:
        InputError: A field has a type or a name that the format cannot hold, or two have one name.
    """
    ending = scan_ending(path.name)
    with naming(path):
        check(ending in WRITTEN, f"scans are written as {', '.join(WRITTEN)}.")
        if ending in (".pcd", ".ply"):  # these name their fields
            cloud = replace(cloud, held=None)
        if not cloud.named and len(cloud.columns) > (cloud.held or 0):
            others = slice(cloud.held, None)
            fields: Any = dict(zip(cloud.names[others], cloud.columns[others], strict=True))
            with atomic_write(beside(path)) as file:
                np.savez_compressed(file, **fields)
        with atomic_write(path) as file:
            _WRITERS[ending](file, cloud)


def scan_ending(name: str) -> str:
    """The ending of a scan file's name in lower case, such as `.pcd.bin`; empty for others."""
    return next((ending for ending in _SCAN_ENDINGS if name.lower().endswith(ending)), "")
