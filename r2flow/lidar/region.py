"""Regions of an image: an azimuth sector, a block of rows."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from r2flow.base.errors import InputError

# Degrees next to a sector that `r2flow sample` generates and crops. With the demo's 1-RF, the
# distance of a 90-degree sector from the whole scan in model space is 0.065 without margin, 0.015
# with this margin, 0.006 with 45 degrees.
MARGIN = 11.25


@dataclass(frozen=True)
class Region:
    """A rectangle of an image whose columns cover a full turn."""

    shape: tuple[int, int]  # rows and columns (H, W) of the whole image
    top: int
    height: int
    left: int
    width: int  # number of columns, which wrap around from the last to column 0
    margin: int = 0  # columns on either side that are generated and cropped

    @property
    def rows(self) -> Tensor:
        """Numbers of the rows, (height,)."""
        return torch.arange(self.top, self.top + self.height, device="cpu")

    @property
    def columns(self) -> Tensor:
        """Numbers of the columns, (width,)."""
        return torch.arange(self.left, self.left + self.width, device="cpu") % self.shape[1]

    @property
    def share(self) -> float:
        """Share of the image's pixels."""
        return self.height * self.width / math.prod(self.shape)

    def crop(self, image: Tensor) -> Tensor:
        """Crop an image, (..., H, W), to (..., height, width)."""
        return image[..., self.rows[:, None], self.columns]

    def place(self, part: Tensor) -> Tensor:
        """Insert a part, (..., height, width), into an image of zeros, (..., H, W)."""
        image = part.new_zeros(*part.shape[:-2], *self.shape)
        image[..., self.rows[:, None], self.columns] = part
        return image

    def widened(self, unit: tuple[int, int]) -> "Region":
        """The smallest region of whole units that contains this one and its margin.

        A unit is (rows, columns) and divides the image.
        """
        columns = self.shape[1]
        top, height = _outward(self.top, self.height, unit[0])
        left, width = _outward(self.left - self.margin, self.width + 2 * self.margin, unit[1])
        if width >= columns:  # both ends may lie in one unit
            return Region(self.shape, top, height, 0, columns)
        return Region(self.shape, top, height, left % columns, width)

    def __str__(self) -> str:
        last_row = self.top + self.height - 1
        return f"rows {self.top}-{last_row}, columns {self.left}-{self.columns[-1]}"


def _outward(first: int, count: int, unit: int) -> tuple[int, int]:
    begin = first // unit * unit
    end = math.ceil((first + count) / unit) * unit
    return begin, end - begin


def region(
    shape: tuple[int, int],
    sector: tuple[float, float] | None = None,
    rows: tuple[int, int] | None = None,
    margin: float = 0.0,
) -> Region:
    """The pixels of an azimuth sector and a block of rows of an image of shape (H, W).

    None stands for all. Pixels partly inside are included.

    Args:
        sector: Degrees, counter-clockwise: (-45, 45) is the quarter ahead, (135, -135) the quarter
            behind; ends a full turn apart are the full turn.
        rows: First and last, 0 at the top.
        margin: Degrees on either side that are generated and cropped, because a crop changes the
            generated scan near its edges.

    Raises:
        InputError: The rows are not of the image, or the sector is narrower than a column.
    """
    height, width = shape
    first, last = rows or (0, height - 1)
    if not 0 <= first <= last < height:
        raise InputError(f"rows must be FIRST-LAST within 0-{height - 1}, found {first}-{last}.")
    left = 0
    count = width
    if sector is not None:
        left, count = _columns(width, sector)
    return Region(shape, first, last - first + 1, left, count, math.ceil(margin / 360 * width))


def _columns(width: int, sector: tuple[float, float]) -> tuple[int, int]:
    """The first column that a sector touches, and their number."""
    begin, end = sector
    turn = 360.0 if end - begin >= 360 else (end - begin) % 360 or 360.0
    inside = max(abs(begin), abs(end)) <= 360 and begin != end
    if not inside or not turn * width >= 360 * (1 - 1e-9):  # also NaN
        raise InputError(
            f"the sector {begin:.15g},{end:.15g} is narrower than a column, {360 / width:g} "
            "degrees, or not within -360 to 360 degrees; -180,180 is the full turn."
        )
    fuzz = 1e-9 * width  # rounding must not add a pixel if the sector ends between two
    left = math.floor((180 - (begin + turn)) / 360 * width + fuzz)
    right = math.ceil((180 - begin) / 360 * width - fuzz)
    if right - left >= width:
        return 0, width
    return left % width, right - left
