"""Pictures and 3-D pages of completed scans."""

from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from r2flow.lidar.known import Ray
from r2flow.lidar.labels import semantic_ids
from r2flow.lidar.sensors import Sensor
from r2flow.reports.answer_rays import Answered
from r2flow.reports.figures import save_figure
from r2flow.reports.pictures import contact_sheet, trust_ids
from r2flow.reports.view import Panel, write_viewer

if TYPE_CHECKING:
    from r2flow.reports.answer_errors import Compared

_MOST = 4  # answers of a picture


def draw_answers(
    sensor: Sensor, answered: Answered, out: Path, compared: "Compared | None" = None
) -> None:
    """Write `NAME.png` and `NAME.html` with your scan and up to four answers, and if a part was
    hidden the best interpolation, the truth, and both errors.

    Points are coloured by their predicted error too, or by the labels of a labelled model. Without
    reflectance in the scan, none is drawn.
    """
    rays = sensor.rays()
    name, known, completed = answered.scan.name, answered.known, answered.completed
    answers = completed.images.numpy()[:_MOST]
    names = ["your scan", *(f"completed, answer {i}" for i in range(len(answers)))]
    if len(answers) == 1:
        names[1] = "completed"
    images = [known.image, *answers]
    title = name
    if compared:
        from r2flow.reports.answer_errors import in_words  # slow

        images += [compared.interpolation, compared.truth]
        names += [f"interpolation: {compared.name}", "true"]
        title += f", {in_words([compared])}"
    ids: list[np.ndarray | None] = [None] * len(images)
    kinds = [""] * len(images)  # of the classes
    if answers.shape[1] > 2:
        ids = [semantic_ids(image[2]) if len(image) > 2 else None for image in images]
        given = known.image[2:].any(0)
        shares = [(given & (r > 0)).sum() / max((r > 0).sum(), 1) for r in answers[:, 0]]
        found = [f"class, {share:.0%} given" if share else "class, found" for share in shares]
        kinds[: 1 + len(answers)] = ["class, given" if given.any() else "", *found]
    unmeasured = known.state == Ray.UNKNOWN
    errors = [np.where(unmeasured, np.nan, 0), *completed.error(0.68)[0, : len(answers)].numpy()]
    images = [image[: min(len(known.image), 2)] for image in images]
    panels = [
        Panel(
            ", ".join(filter(None, caption)),
            image[None],
            rays,
            None if one is None else one[None],
            errors=None if error is None else error[None],
        )
        for caption, image, one, error in zip_longest(
            zip(names, kinds, strict=True), images, ids, errors
        )
    ]
    write_viewer(out / f"{name}.html", panels, title)
    if completed.densities and answers.shape[1] < 3 and np.any(errors[1:]):
        ids[1 : len(errors)] = map(trust_ids, answers, errors[1:])
    figure = contact_sheet(images, rays, names, unmeasured, ids, kinds)
    save_figure(figure, out / f"{name}.png")
