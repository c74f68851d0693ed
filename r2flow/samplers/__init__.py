"""Registry of samplers. A sampler is a frozen dataclass that runs a generator.

    build_sampler({"name": "adams3", "steps": 16})
    build_sampler("jump", steps=2)

To add a sampler, derive a dataclass from `Sampler` and call `SAMPLERS.add(name, cls)`. Every solver
in `r2flow.flow.solvers.SOLVERS` is also a sampler.
"""

import re
from collections.abc import Iterator
from functools import partial
from typing import Any

from r2flow.base.errors import InputError
from r2flow.base.registry import Config, Options, Registry, lazy
from r2flow.flow.solvers import SOLVERS, default_grid
from r2flow.samplers.base import Condition, Generated, Noise, OnGrid, Progress, Sampler, _plain
from r2flow.samplers.maps import Jump, Refine, Renoise, Transport
from r2flow.samplers.ode import Adaptive, FixedSteps, ODESampler, TorchDiffEq
from r2flow.samplers.posterior import MMPS, Posterior, Repaint, Replace
from r2flow.samplers.stochastic import SDE

__all__ = [
    "MMPS", "SAMPLERS", "SDE", "Adaptive", "Condition", "FixedSteps", "Generated", "Jump",
    "Noise", "ODESampler", "OnGrid", "Posterior", "Progress", "Refine", "Renoise", "Repaint",
    "Replace", "Sampler", "TorchDiffEq", "Transport", "build_sampler", "parse_sampler",
    "split_samplers",
]  # fmt: skip


class _Samplers(Registry[Any]):
    """The registered samplers and, by their names, all solvers."""

    def __getitem__(self, name: str) -> Any:
        if name not in SOLVERS or name in self._entries:
            return super().__getitem__(name)
        if SOLVERS[name].adapts:
            return partial(Adaptive, method=name)
        return partial(FixedSteps, method=name, grid=default_grid(name))

    def __contains__(self, name: object) -> bool:
        return name in SOLVERS or super().__contains__(name)

    def __iter__(self) -> Iterator[str]:
        return iter([*SOLVERS, *self._entries])


SAMPLERS = _Samplers(
    "sampler",
    torchdiffeq=TorchDiffEq,
    sde=SDE,
    jump=Jump,
    renoise=Renoise,
    refine=Refine,
    transport=Transport,
    replace=Replace,
    repaint=Repaint,
    mmps=MMPS,
    ddpm=lazy("r2flow.systems.diffusion.generator:DDPM"),
    ddim=lazy("r2flow.systems.diffusion.generator:DDIM"),
    latent_ddim=lazy("r2flow.systems.latent.generator:LatentDDIM"),
    langevin=lazy("r2flow.systems.score.generator:Langevin"),
    direct=lazy("r2flow.systems.gan.generator:Direct"),
)


def parse_sampler(text: str) -> Config:
    """Parse `NAME[:FIELD=VALUE]...`, as `sde:steps=16:grid=power:2`, into name and fields."""
    from omegaconf import OmegaConf

    decimal = re.sub(r"=0+(?=\d+(?::|$))", "=", text)  # YAML's 010 is eight
    name, *fields = re.split(r":(?=\w+=)", decimal)
    try:
        return {"name": name, **OmegaConf.to_object(OmegaConf.from_dotlist(fields))}  # type: ignore[dict-item]
    except Exception as error:  # of YAML, or of an interpolation
        raise InputError(f"a sampler's fields cannot be read: {text!r}.") from error


def split_samplers(text: str) -> list[str]:
    """Split texts of samplers at commas, except those in a list of times."""
    return re.split(r",(?![^\[]*\])", text)


def build_sampler(options: str | Options, **fields: Any) -> Sampler:
    """Build a sampler from name and fields, or from a text; a grid of times gives `steps`."""
    if isinstance(options, str):
        options = parse_sampler(options)
    return SAMPLERS.build(_plain({**options, **fields}))
