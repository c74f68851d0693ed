"""Base class of backbones: fields on images of one shape with stored rays, for one time or two."""

from typing import Any, Literal

import torch
from torch import Tensor, nn

from r2flow.backbones.layers import ExactBuffers, at_least_float32
from r2flow.base.errors import InputError
from r2flow.base.registry import Positive, Size

_Prediction = Literal["velocity", "data", "noise"]


class Backbone(ExactBuffers):
    """A field v(t, x) on images, or the mean velocity u(x, t, s) of a flow from time t to time s.

    X_{t->s}(x) = x + (s - t) u(x, t, s), and u(x, t, t) = v(t, x) (Geng et al. 2025, "Mean flows
    for one-step generative modeling", with the sign of s - t).

    A subclass implements `velocity` and passes the options below on as `**common`; layers with
    times as input are `ExactLinear`, since times stay float32. A class declares its capabilities:

    - unit: The rows and columns of the image are multiples of the unit.
    - follow_rays: Computes unsaved buffers from `coords`; called by the constructor and whenever
      `coords` is loaded.
    - takes_second_time: The class supports `second_time=True`: it then has an `interval_embedding`
      of s - t, created after all other layers, whose last layer is zero, and `velocity` takes s
      (see `condition`).
    - any_size: It takes images of any number of rows and columns.
    - radius: Rows above and below a ray that its field depends on; None: all.
    - learns_directions: It learns a vector per direction: scans must not be rotated in training.

    Its modules may have a method `macs` (`r2flow.reports.backbones.count_macs`).
    `model.compile(dynamic=True)` compiles it to a graph without breaks for batches of two or more
    images, and another for single images.

    Args:
        rays: Elevation and azimuth of every pixel in radians, (2, H, W).
        in_channels: Channels C of the image plus those of the condition concatenated to it.
        out_channels: Channels C' of the output; None: C.
        second_time: Whether the network takes s.
        prediction: What the network predicts: `velocity`, or `data` or `noise`, from which the
            velocity is computed by `_reparametrise`.
        data_std: Standard deviation of the data, for `precondition`; None: no preconditioning.
    """

    takes_second_time = False
    any_size = False
    radius: int | None = None
    learns_directions = False
    coords: Tensor
    interval_embedding: nn.Module

    def __init__(
        self,
        rays: Tensor,
        unit: Size = (1, 1),
        /,
        in_channels: int = 2,
        out_channels: int | None = None,
        second_time: bool = False,
        prediction: _Prediction = "velocity",
        data_std: Positive | None = None,
    ) -> None:
        super().__init__()
        self.unit = unit
        self.second_time = second_time
        self.prediction = prediction
        self.data_std = data_std
        self.in_channels = in_channels
        self.out_channels = out_channels or in_channels
        name = type(self).__name__
        if data_std is not None and prediction != "velocity":
            raise InputError(
                "backbone.data_std has its own prediction: leave it or backbone.prediction out."
            )
        if second_time and not self.takes_second_time:
            raise InputError(
                f"{name} takes no second time: choose a backbone that does, such as hdit, or "
                "distill the flow (stage=distill)."
            )
        for dimension, size, step in zip(("height", "width"), rays.shape[1:], unit, strict=True):
            if size % step:
                raise InputError(
                    f"{dimension} {size} cannot be used by {name} with these options: it must be a "
                    f"multiple of {step}, such as {size // step * step + step}."
                )
        # torch 2.6's `get_default_device` does not see `with torch.device(...)`
        self.coords = nn.Buffer(rays[None].to(torch.empty(0).device, torch.float32, copy=True))
        self.register_load_state_dict_post_hook(_follow_loaded_rays)

    def forward(self, t: Tensor | float, x: Tensor, s: Tensor | float | None = None) -> Tensor:
        """v(t, x), or u(x, t, s) with a second time, (B, C', H, W) in the dtype of x.

        x, (B, C, H, W), is the image and its condition; times are scalars or (B,), and s None means
        s = t.
        """
        t = _times(t, x)
        s = None if s is None else _times(s, x)
        if self.data_std is None and self.prediction == "velocity":
            return self._velocity(t, x, s).to(x.dtype)
        image = at_least_float32(x[:, : self.out_channels])
        if self.data_std is None:
            skip, out = _reparametrise(t, self.prediction)
            inner = x
        else:
            into, skip, out = precondition(t, self.data_std)
            inner = torch.cat([into * image, x[:, self.out_channels :]], dim=1)
        return (skip * image + out * self._velocity(t, inner, s)).to(x.dtype)

    def _velocity(self, t: Tensor, x: Tensor, s: Tensor | None) -> Tensor:
        y = x.to(next(self.parameters(), x).dtype)
        v = self.velocity(t, y, s) if self.second_time else self.velocity(t, y)
        # not len(x), which torch.export would take for a constant
        expected = (x.shape[0], self.out_channels, *x.shape[2:])
        if v.shape != expected:  # one channel or one image would broadcast in the loss
            raise InputError(
                f"a {type(self).__name__} must give images of {expected}, found {tuple(v.shape)}."
            )
        return v

    @property
    def parametrised(self) -> str:
        """How the velocity is computed from what the network predicts, in words."""
        scaled = "" if self.data_std is None else f", data_std={self.data_std}"
        return f"prediction={self.prediction}{scaled}"

    def refuse_parametrised(self, what: str) -> None:
        """Refuse options that make a velocity of the output, for a model that learns another."""
        if self.parametrised != "prediction=velocity":
            raise InputError(
                f"a {what} predicts no velocity: leave backbone.prediction and data_std out, found "
                f"{self.parametrised}."
            )

    def velocity(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        """The field for t of shape (B,), or (1,) for the whole batch, in float32 or better.

        Only networks with a second time get s, of the same dtype, (B,) or (1,); None: s = t.
        """
        raise NotImplementedError

    def condition(self, time_embedding: nn.Module, t: Tensor, s: Tensor | None) -> Tensor:
        """The condition time_embedding(t) + e(s - t) - e(0), (B or 1, K), by `interval_embedding`
        e.

        The difference is zero at initialisation, and always for s = t: u(x, t, t) = v(t, x).
        """
        c = time_embedding(t)
        if s is None:
            return c
        e = self.interval_embedding(torch.cat([s - t, (s - t)[:1] * 0]))
        return c + (e[:-1] - e[-1:])

    def follow_rays(self) -> None:
        """Recompute buffers that derive from `coords`."""


def precondition(t: Tensor, data_std: float) -> tuple[Tensor, Tensor, Tensor]:
    """Factors of a network F that predicts the residual of a linear estimate of the velocity:

        v(t, x) = skip(t) x + out(t) F(t, into(t) x)

    For x_1 ~ N(0, s^2) and x_t = t x_1 + (1 - t) x_0, of variance V = t^2 s^2 + (1 - t)^2, the best
    linear estimate is E[v | x_t] = skip x_t with skip = (t s^2 - (1 - t)) / V, and its residual
    variance out^2 = Var[v | x_t] = s^2 / V. With into = V^(-1/2), input and output of F have unit
    variance at every t (Karras et al. 2022, "Elucidating the design space of diffusion-based
    generative models", table 1, for the straight path). At t = 0 F need not copy noise.

    t is (B,) or (1,), and s is data_std; into, skip and out are (B or 1, 1, 1, 1) each.
    """
    t = t[:, None, None, None]
    variance = (t * data_std).square() + (1 - t).square()
    into = variance.rsqrt()
    return into, (t * data_std**2 - (1 - t)) / variance, data_std * into


def _reparametrise(t: Tensor, prediction: _Prediction) -> tuple[Tensor, Tensor]:
    """Factors of a network F that predicts x_1 (`data`) or x_0 (`noise`), (B or 1, 1, 1, 1) each:

        v(t, x) = skip(t) x + out(t) F(t, x)
        data:  v = (F - x) / max(1 - t, 0.05)
        noise: v = (x - F) / max(t, 0.05)

    The loss stays that of the velocity (Li and He 2025, "Back to basics: let denoising generative
    models denoise"). t is (B,) or (1,).
    """
    t = t[:, None, None, None]
    if prediction == "noise":
        factor = 1 / t.clamp(min=0.05)
        return factor, -factor
    factor = 1 / (1 - t).clamp(min=0.05)
    return -factor, factor


def _follow_loaded_rays(backbone: Backbone, _keys: Any) -> None:
    backbone.follow_rays()


def _times(times: Tensor | float, x: Tensor) -> Tensor:
    return at_least_float32(torch.as_tensor(times, device=x.device)).reshape(-1)
