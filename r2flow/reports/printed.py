"""Values printed in the paper: tables I and II.

*Fast LiDAR Data Generation with Rectified Flows* (R2Flow, ICRA 2025): KITTI-360, 10,000 generated
scans of 64 x 1024 against all real ones, Euler steps, NVIDIA RTX 6000 Ada.
"""

from typing import NamedTuple

from r2flow.reports.verdict import PRINTED

# Name in `r2flow.metrics` -> (heading, factor of the printed values).
COLUMNS = {
    key: PRINTED.get(key, (key.upper(), 1.0))
    for key in ("frd", "frid", "fpd", "fpvd", "fsvd", "jsd", "mmd")
}


class Printed(NamedTuple):
    """A row of table I; the paper's flows are "1-RF", ...

    Figures are in the order of `COLUMNS`, with its factors; None: not printed.
    """

    method: str
    evaluations: int
    figures: tuple[float | None, ...]


TABLE_I = (
    Printed("Vanilla GAN, range", 1, (None, 221.89, 1258.86, 268.16, 358.28, 10.09, 7.22)),
    Printed("Vanilla GAN", 1, (2766.43, 216.45, 1367.85, 196.35, 257.98, 8.73, 5.22)),
    Printed("DUSty v1, range", 1, (None, 174.74, 102.11, 100.91, 118.23, 3.90, 2.19)),
    Printed("DUSty v1", 1, (1429.96, 194.25, 318.06, 134.24, 171.41, 5.40, 2.95)),
    Printed("DUSty v2, range", 1, (None, 140.23, 713.59, 96.69, 120.00, 5.17, 3.22)),
    Printed("DUSty v2", 1, (1132.02, 180.71, 641.12, 88.72, 106.34, 2.98, 0.87)),
    Printed("LiDARGen", 1160, (542.74, 66.45, 90.29, 43.56, 50.14, 4.04, 1.74)),
    Printed("LiDM, range", 50, (None, 9.21, 503.74, 19.45, 18.08, 17.40, 33.15)),
    Printed("LiDM + APE, range", 50, (None, 6.21, 393.18, 15.25, 15.87, 4.50, 0.89)),
    Printed("LiDM + APE, range", 200, (None, 5.75, 372.81, 14.65, 15.20, 4.30, 0.67)),
    Printed("R2DM", 256, (154.11, 3.70, 3.79, 10.90, 9.11, 2.19, 0.73)),
    Printed("1-RF", 256, (122.81, 4.18, 9.32, 16.51, 15.07, 2.16, 0.30)),
    Printed("2-RF", 256, (148.09, 8.64, 11.06, 29.08, 29.20, 2.24, 0.29)),
    Printed("LiDM + APE, range", 1, (None, 191.00, 1240.25, 138.43, 200.10, 36.14, 188.41)),
    Printed("R2DM", 1, (2981.89, 237.41, 237.40, 378.92, 458.69, 33.48, 89.14)),
    Printed("1-RF", 1, (2724.67, 254.03, 3967.51, 374.89, 398.95, 33.76, 96.90)),
    Printed("2-RF", 1, (743.97, 119.42, 27.94, 90.92, 107.72, 3.86, 1.11)),
    Printed("1-TD", 1, (336.62, 54.75, 13.08, 64.03, 70.15, 2.37, 0.35)),
    Printed("2-TD", 2, (212.08, 22.57, 11.00, 45.56, 48.98, 2.39, 0.31)),
    Printed("4-TD", 4, (187.10, 15.92, 10.92, 38.64, 40.75, 2.40, 0.31)),
)


class Architecture(NamedTuple):
    """A row of table II; `gmac`: the paper's FLOPs (G), `frd`: at 256 Euler steps."""

    gmac: float
    parameters: float
    latency_ms: float
    frd: float


TABLE_II = {
    "efficient_unet": Architecture(116.3, 31.1e6, 15.2, 151.90),
    "efficient_unet_large": Architecture(688.3, 284.6e6, 39.5, 124.49),
    "adm_unet": Architecture(265.6, 87.4e6, 24.8, 140.66),
    "adm_unet_large": Architecture(692.7, 125.5e6, 50.2, 134.22),
    "hdit": Architecture(77.8, 80.9e6, 28.8, 122.81),
}
