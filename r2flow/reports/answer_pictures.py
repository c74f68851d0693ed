"""Pictures and 3-D pages of completed scans."""

from pathlib import Path
from typing import TYPE_CHECKING

from r2flow.data.partial import PartialScan
from r2flow.lidar.known import Ray
from r2flow.lidar.other_sensors import Partial
from r2flow.lidar.sensors import Sensor
from r2flow.model.completion import Completed
from r2flow.reports.pictures import contact_sheet, save_figure
from r2flow.reports.view import panel_of, write_viewer

if TYPE_CHECKING:
    from r2flow.reports.answer_errors import Compared


def draw_answers(
    sensor: Sensor,
    scan: PartialScan,
    out: Path,
    given: Partial,
    completed: Completed,
    compared: "Compared | None" = None,
) -> None:
    """Write `NAME.png` and `NAME.html` with the known rays and up to four answers, and if a part
    was hidden the best interpolation, the truth, and both errors.
    """
    rays = sensor.rays()
    answers = completed.images.numpy()[:4]
    images = [given.image, *answers]
    names = ["what is known", *(f"answer {number}" for number in range(len(answers)))]
    title = scan.name
    if compared:
        from r2flow.reports.answer_errors import in_words  # slow

        images += [compared.interpolation, compared.truth]
        names += [f"interpolation: {compared.errors.name}", "true"]
        title += f", {in_words([compared.errors])}"
    panels = [panel_of(name, image[None], rays) for name, image in zip(names, images, strict=True)]
    write_viewer(out / f"{scan.name}.html", panels, title)
    figure = contact_sheet(images, rays, names, given.state == Ray.UNKNOWN)
    save_figure(figure, out / f"{scan.name}.png")
