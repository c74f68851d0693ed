"""Materials and their reflectance.

Reflectance is as a calibrated HDL-64E reports it: nearly constant for a rough wall from 3 to 20
metres.
"""

import numpy as np

# Of each material:
# - albedo: mean reflectance at perpendicular incidence;
# - spread: standard deviation of albedo between objects;
# - texture: scale of the noise of reflectance between pixels; its standard deviation is 1.3 of it;
# - gloss: g in the incidence falloff (1 + g) c / (c + g), c the cosine; a mirror has a large g;
# - swallow: share of pulses that do not return, for any angle and distance;
# - depth: mean depth, along the ground, in metres at which pulses return from inside (leaves,
# grass).
MATERIALS = {
    "asphalt": (0.26, 0.025, 0.035, 0.03, 0.001, 0.0),
    "paving": (0.345, 0.02, 0.035, 0.03, 0.001, 0.0),
    "marking": (0.46, 0.05, 0.08, 0.03, 0.0, 0.0),
    "grass": (0.385, 0.02, 0.045, 0.01, 0.002, 0.02),
    "plaster": (0.46, 0.10, 0.05, 0.08, 0.002, 0.0),
    "brick": (0.38, 0.08, 0.08, 0.08, 0.002, 0.0),
    "glass": (0.20, 0.05, 0.08, 2.0, 0.12, 0.12),
    "pane": (0.02, 0.03, 0.05, 2.0, 0.78, 0.10),
    "paint": (0.28, 0.20, 0.06, 0.7, 0.01, 0.0),
    "dark paint": (0.00, 0.03, 0.02, 0.5, 0.04, 0.0),
    "rubber": (0.04, 0.03, 0.03, 0.3, 0.04, 0.0),
    "plastic": (0.18, 0.12, 0.05, 0.3, 0.01, 0.0),
    "metal": (0.22, 0.14, 0.08, 0.3, 0.02, 0.0),
    "retro": (0.95, 0.04, 0.05, 0.02, 0.0, 0.0),
    "leaves": (0.41, 0.05, 0.08, 0.10, 0.003, 0.04),
    "bark": (0.38, 0.06, 0.08, 0.10, 0.005, 0.0),
    "wood": (0.38, 0.10, 0.08, 0.10, 0.005, 0.0),
    "concrete": (0.38, 0.06, 0.05, 0.05, 0.002, 0.0),
    "cloth": (0.30, 0.14, 0.08, 0.15, 0.01, 0.0),
    "skin": (0.35, 0.05, 0.08, 0.15, 0.01, 0.0),
}
INDEX = {name: k for k, name in enumerate(MATERIALS)}
ALBEDO, _, TEXTURE, GLOSS, SWALLOW, DEPTH = np.array(
    [*MATERIALS.values()], np.float32
).T  # of all materials
