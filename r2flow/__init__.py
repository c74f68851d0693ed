"""R2Flow: rectified flows that generate LiDAR scans, range and reflectance.

Notation everywhere: `t = 0` is noise and `t = 1` is data; `x_0 ~ N(0, I)`, `x_1` a scan,
`x_t = (1 - t) x_0 + t x_1`, target `u_t = x_1 - x_0`, estimate `v_t = v(t, x_t)`.
"""

__version__ = "0.2.0"
