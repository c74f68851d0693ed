"""How scans become images by default: by a model, by their manifest, or by their beams."""

import logging
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

from r2flow.base.errors import InputError, check
from r2flow.base.registry import construct
from r2flow.data.described import Described, Spec, describe
from r2flow.data.options import FOLDER, PartOptions
from r2flow.data.reading import Reading
from r2flow.data.sensor_checks import a_few, mismatch_of, readable
from r2flow.lidar.estimation import estimate_sensor
from r2flow.lidar.matching import in_words
from r2flow.lidar.sensors import SENSORS, Sensor, named_sensor

_log = logging.getLogger(__name__)


def reading_for(
    scans: Sequence[Spec],
    model: Any = None,
    sensor: Sensor | str | None = None,
    size: tuple[int, int] | None = None,
    estimate_scale: bool = False,
    estimate_beams: bool = False,
    **fields: Any,
) -> Reading:
    """How scans become images: `fields` first, then the model's training scans, the scans'
    manifest, the defaults.

    The default sensor is hdl64e, or the built-in sensor whose beams plain scan files have.

    Args:
        scans: Names of scans, as for `describe`.
        model: The checkpoint that the scans are for: another sensor or size than its own is
            refused.
        estimate_scale: Leave None for plain scan files whose sensor does not tell it: an estimate.
        estimate_beams: Estimate the sensor of plain scan files that no built-in sensor fits.
        fields: Of `Reading`; None: the default.
    """
    described = [describe(spec) for spec in scans]
    stored = next((one.stored for one in described if one.stored), None)
    first = described[0] if described else None
    default = SENSORS[first.kind.sensor if first else "hdl64e"]
    reading = _reading_of(model) if model else stored or Reading(default)
    if fields.get("columns"):
        fields["columns"] = tuple(fields["columns"])
    fields = {key: value for key, value in fields.items() if value is not None}
    reading = replace(reading, **fields)
    if first and not (model or stored or sensor):
        sensor = _detected(first, reading, estimate_beams)
    target = named_sensor(sensor or reading.sensor, size)
    if model is None:
        reading = replace(reading, sensor=target)
    elif not target.same_image(model.sensor):
        raise InputError(
            f"the flow's images are of {model.sensor}, not of {target}; leave --sensor and --size "
            "out."
        )
    scale = fields.get("reflectance_scale")
    if scale is not None:
        check(0 < scale < math.inf, f"reflectance_scale must be above 0, found {scale!r}.")
        return reading
    if first is None:
        return reading
    trained = reading.reflectance_scale  # 1: also of scans that were scaled before the training
    scale = trained if model and trained != 1 else reading.sensor.reflectance_scale
    if not estimate_scale or stored or first.options.name != FOLDER:
        scale = first.scale(scale)
    return replace(reading, reflectance_scale=scale)


def _detected(scans: Described, reading: Reading, estimate: bool) -> Sensor | str | None:
    """The sensor of plain scan files whose beams are not those of `reading.sensor`: the nearest
    built-in one, or with `estimate` their own if that does not fit.
    """
    mismatch = mismatch_of(scans, reading) if scans.options.name == FOLDER else None
    if mismatch is None:
        return None
    name = mismatch.name if mismatch.sure else None
    fits = name and mismatch_of(scans, replace(reading, sensor=SENSORS[name])) is None
    if estimate and not fits:
        with suppress(InputError):
            points = readable(a_few(scans.paths), reading.columns)
            sensor = estimate_sensor([*points.values()], "estimated").sensor
            _log.warning(
                "%s: no built-in sensor fits; read by its own %s; --sensor names another",
                scans.label,
                in_words(sensor.elevations),
            )
            return sensor
    if name:
        _log.warning(
            "%s: read as scans of %s, whose beams are nearest; --sensor names another",
            scans.label,
            name,
        )
    return name


def _reading_of(model: Any) -> Reading:
    """How a model's training scans became images; for a mixture, the fields on which all parts
    agree.
    """
    data = model.config.data
    parts = [construct("data.parts", PartOptions, part) for part in data.parts or ()]
    first, *others = [part.reading_fields for part in parts or [data]]
    agreed = {
        key: first[key]
        for key in ("projection", "convention", "reflectance_scale")
        if key in first and all(other.get(key) == first[key] for other in others)
    }
    return Reading(model.sensor, **agreed)
