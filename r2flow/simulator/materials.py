"""Materials and their reflectance.

Reflectance is as a calibrated HDL-64E reports it: nearly constant for a rough wall from 3 to 20
metres.
"""

import numpy as np

from r2flow.simulator.tables import TABLES

MATERIALS: dict[str, list[float]] = TABLES["materials"]
INDEX = {name: k for k, name in enumerate(MATERIALS)}
# of all materials
ALBEDO, _, TEXTURE, GLOSS, SWALLOW, DEPTH = np.array([*MATERIALS.values()], np.float32).T
