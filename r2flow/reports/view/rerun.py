"""Panels as a recording for the viewer of rerun.io; needs the extra `rerun`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from r2flow.errors import require
from r2flow.files import atomic_write
from r2flow.lidar.projection import image_to_points
from r2flow.reports.pictures import RANGES, colour_table
from r2flow.reports.view.panels import Panel


def write_rerun(path: Path, panels: Sequence[Panel]) -> Path:
    """Write an .rrd: for each panel a cloud, coloured by range, and its range in metres as a depth image.

    Frames of a panel are times of the timeline `frame`.

    Raises:
        InputError: rerun is not installed, or the file cannot be written.
    """
    require("an .rrd", "rerun", "rerun")
    import rerun as rr

    recording = rr.RecordingStream("r2flow")
    stream = rr.binary_stream(recording)
    low, high = np.log(RANGES)
    for panel in panels:
        for frame, image in enumerate(panel.images):
            if len(panel.images) > 1:
                recording.set_time("frame", sequence=frame)
            points, _ = image_to_points(image, panel.rays)
            r = np.linalg.norm(points, axis=1).clip(*RANGES)
            colours = colour_table("range")[np.rint(255 * (np.log(r) - low) / (high - low)).astype(int)]
            recording.log([panel.caption, "points"], rr.Points3D(points, colors=colours, radii=0.03))
            recording.log([panel.caption, "range"], rr.DepthImage(image[0], meter=1.0))
    with atomic_write(path) as file:
        file.write(stream.read() or b"")
    return path
