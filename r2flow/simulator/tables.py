"""Tables of the simulator: materials, kinds of places, cars, the roof of the ego vehicle."""

from pathlib import Path
from typing import Any

import yaml

TABLES: dict[str, Any] = yaml.safe_load(
    Path(__file__).with_name("tables.yaml").read_text(encoding="utf-8")
)
