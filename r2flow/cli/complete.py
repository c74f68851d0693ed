"""`r2flow complete`."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Argument, Option

from r2flow.base.devices import choose_device
from r2flow.base.errors import InputError, check
from r2flow.base.files import check_folder
from r2flow.cli.app import app
from r2flow.cli.options import (
    SETS,
    BatchOption,
    ColumnsOption,
    DeviceOption,
    LabelIdsOption,
    OutOption,
    SamplerOptions,
    ScaleChoice,
    SeedOption,
    SizeOption,
    TopicOption,
    grouped,
    print_model,
)

if TYPE_CHECKING:
    from r2flow.data.described import Described
    from r2flow.data.partial import PartialScan
    from r2flow.model.checkpoint import Checkpoint


@dataclass(frozen=True)
class _PartialOptions:
    """The scans to complete: their sensor, what is known of them, and the sensor of the completed
    scans.
    """

    source: Annotated[
        str | None,
        Option(
            "--from",
            help="Sensor of the scans, name or YAML file. Default: detected from the scans.",
        ),
    ] = None
    to: Annotated[
        str | None,
        Option(
            help="Sensor of the completed scans, name or YAML file. Default: the model's; of "
            "densify, their own view where it sees more."
        ),
    ] = None
    size: SizeOption = None
    mask: Annotated[
        str | None,
        Option(
            help="Use a part of the scan: rows:4, random:0.5, points:0.1, sector:-30,30, FILE.npy."
        ),
    ] = None
    fill_gaps: Annotated[
        bool,
        Option(
            "--fill-gaps", help="Treat rays without a return as unmeasured, as in a thinned scan."
        ),
    ] = False
    hide: Annotated[
        list[str] | None,
        Option(
            help="Channels to draw anew: label, reflectance, or range, which leaves labels alone."
        ),
    ] = None
    reflectance_scale: ScaleChoice = None
    columns: ColumnsOption = None
    label_ids: LabelIdsOption = None
    scans: Annotated[
        int | None,
        Option(min=1, help="Maximum number of scans per folder, evenly spread. Default: all."),
    ] = None

    topic: TopicOption = None
    other_topics: Annotated[
        bool, Option("--other-topics", help="Of a recording: keep its other topics, unchanged.")
    ] = False

    @property
    def settings(self) -> dict[str, Any]:
        """What answers depend on, of the scans."""
        return {
            "from": self.source,
            "reflectance_scale": self.reflectance_scale,
            "columns": self.columns,
            "fill_gaps": self.fill_gaps,
        }

    def model(self, name: str, device: str) -> "Checkpoint":
        """The model, for another sensor if one is named."""
        from r2flow.lidar.sensors import named_sensor
        from r2flow.model.checkpoint import load_checkpoint

        model = load_checkpoint(name, choose_device(device))
        if self.to or self.size:
            model = model.through(named_sensor(self.to or model.sensor, self.size))
        return model

    def open(
        self, name: str, device: str, what: "Sequence[Described]"
    ) -> "tuple[Checkpoint, list[PartialScan], list[str]]":
        """The model, the scans as it takes them, and remarks on their sensor."""
        model = self.model(name, device)
        return model.open_partial(
            what,
            self.source,
            keep_beams=model.keeps_beams,
            scale=self.reflectance_scale,
            most=self.scans,
            columns=self.columns,
            label_ids=self.label_ids,
        )


@app.command(
    rich_help_panel="Draw",
    epilog="Example: r2flow complete scan.pcd --from vlp16 --num 8 --out dense",
)
@grouped
def complete(
    what: Annotated[
        list[str],
        Argument(
            metavar="SCANS",
            help=f"Scan files, range images (.npy), or {SETS}; or a recording (.mcap, .db3, .bag).",
        ),
    ],
    out: OutOption,
    part: _PartialOptions,
    how: SamplerOptions,
    checkpoint: Annotated[
        str | None,
        Option(
            "--checkpoint",
            "-c",
            help="A checkpoint file, a run folder or a model. Default: densify; street for sectors "
            "without rays or a --sampler for flows from noise.",
        ),
    ] = None,
    precision: Annotated[
        Literal["32-true", "bf16-mixed"] | None,
        Option(
            help="Precision of the network. Default: bf16-mixed for densify on a CPU with "
            "bfloat16, else 32-true."
        ),
    ] = None,
    num: Annotated[int, Option(min=1, help="Completions per scan.")] = 1,
    max_error: Annotated[
        float | None,
        Option(
            min=0.001,
            metavar="METRES",
            help="Keep added points whose true range is within it in 68 %. Default: all.",
        ),
    ] = None,
    seed: SeedOption = 0,
    batch_size: BatchOption = 1,
    pictures: Annotated[
        int, Option(min=0, help="Number of scans to show in pictures and a 3-D page.")
    ] = 8,
    device: DeviceOption = "auto",
) -> None:
    """Complete scans: more beams, filled gaps, hidden parts.

    Files have the format of the input, or .ply if it cannot be written. The same command resumes an
    interrupted run. A recording becomes another, as --out dense.mcap.
    """
    from r2flow.data.described import describe
    from r2flow.lidar.bags import is_recording
    from r2flow.lidar.known import mask_identity, parse_mask
    from r2flow.lidar.labels import SEMANTIC_KITTI, label_list
    from r2flow.model.completion import completing, usual_precision
    from r2flow.model.shipped import DEFAULT, DENSIFY
    from r2flow.reports.answer_counts import LITTLE, more_rows
    from r2flow.reports.answer_rays import Job, lack_sectors
    from r2flow.reports.answers import write_completed
    from r2flow.reports.outputs import recipe_of
    from r2flow.reports.recordings import complete_recording

    if any(map(is_recording, what)):
        alone = len(what) == 1 and num == 1 and not (part.mask or part.hide or part.scans)
        check(alone, "a recording is completed alone, without --num, --mask, --hide and --scans.")
        model = part.model(checkpoint or DENSIFY, device)
        check(not model.encoding.labels, "no labels are written into a recording: unpack it first.")
        if checkpoint is None:
            print_model(DENSIFY)
        precision = precision or usual_precision(model.generator)
        settings = {**part.settings, "precision": precision, "max_error": max_error}
        check_folder(out.parent)
        sampler = completing(model.generator, **how.fields)
        recipe = recipe_of(model, seed, sampler, completion={**settings})
        completer = model.completer(settings.pop("from"), sampler=sampler, **settings)

        new = complete_recording(
            Path(what[0]),
            out,
            part.topic,
            part.other_topics,
            lambda cloud, number: completer.completed(cloud, number, seed, what[0]),
            recipe,
        )
        with suppress(InputError):  # of a recording whose clouds were completed before
            if new < LITTLE * prod(completer.sensor.shape):
                own = model.chosen or completer.sensor != model.sensor
                print(f"hardly a new point: see {more_rows(completer.sensor, own)}")
        return
    check_folder(out)
    job = Job(
        num,
        seed,
        parse_mask(part.mask) if part.mask else None,
        part.fill_gaps,
        frozenset(part.hide or ()),
        batch_size,
        pictures,
        label_ids=label_list(part.label_ids or SEMANTIC_KITTI),
        max_error=max_error,
    )
    jumps = how.fields.get("name", "jump") in ("jump", "transport")
    name = checkpoint or (DENSIFY if jumps else DEFAULT)
    described = [describe(one) for one in what]
    model, scans, remarks = part.open(name, device, described)
    if checkpoint is None:
        for_densify = part.to or part.size or how.sampler
        if name == DENSIFY and not for_densify and lack_sectors(scans, job):
            name = DEFAULT
            model, scans, remarks = part.open(name, device, described)
        print_model(name)
    channels = model.encoding.slices
    for channel in job.hide:
        check(
            channel in channels,
            f"the model has the channels {', '.join(channels)}, not {channel}.",
        )
    job = replace(job, precision=precision or usual_precision(model.generator))
    sampler = completing(model.generator, several=num > 1, **how.fields)
    if not model.encoding.reflectance:
        remarks.append("the model is of range alone: answers have no reflectance")
    if remarks:
        print(*remarks, sep="\n")
    about = {"mask": part.mask and mask_identity(part.mask), **part.settings}
    print(*write_completed(model, scans, out, job, sampler, about), sep="\n")
