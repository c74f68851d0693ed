"""Neighbourhood attention on an azimuth ring: each token attends to a window around it.

Azimuth is periodic, so every window is centred. At the top and bottom the window is shifted inside,
start = clamp(i - half, 0, H - rows), and keeps its number of rows. On a ring narrower than the
window, a token appears in it repeatedly, as in the published models.

Backends, with equal values and gradients:
    tiles    blocks of queries and the keys around them: plain matrix products, on all devices
    flex     flex_attention: CUDA

"auto" is flex for CUDA tensors that its kernels support, outside torch.compile; else tiles.
"""

import functools
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from r2flow.backbones.layers import rows_at_once
from r2flow.base.errors import InputError
from r2flow.base.registry import Registry, Size

# limit of torch.compile's graphs of flex_attention; three levels exceed its default of 8
_GRAPHS = 64
# Queries, with 6 x 16 keys: smaller tiles copy more keys, larger tiles compute more masked
# products.
_TILE = (4, 8)


def neighbourhood_attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    window: Size,
    wrap: bool = True,
    backend: str = "auto",
) -> Tensor:
    """softmax_{j in window(i)}(q_i . k_j) v_j for N heads of D channels, (B, H, W, N, D) as q, k,
    v.

    The logits are not scaled: q and k must be scaled.

    Args:
        window: Rows and columns, both odd; at most the rows (and without wrap the columns) of the
            map.
        wrap: Whether the columns are a ring; if not, windows are shifted inside in both directions.
        backend: A name in `BACKENDS`, or "auto" (above).
    """
    rows = _Axis(q.shape[1], window[0], wrap=False)
    columns = _Axis(q.shape[2], window[1], wrap=wrap)
    if backend == "auto":
        supported = q.is_cuda and q.dtype != torch.float64 and q.shape[-1] >= 16
        once = columns.span <= columns.size and not torch.compiler.is_compiling()
        flex = supported and once and importlib.util.find_spec("triton")
        backend = "flex" if flex else "tiles"
    return BACKENDS[backend](q, k, v, rows, columns)


@dataclass(frozen=True)
class _Axis:
    """An axis of the map: each of `size` tokens attends to `asked` tokens, or to all if fewer."""

    size: int
    asked: int
    wrap: bool

    @property
    def span(self) -> int:
        return self.asked if self.wrap else min(self.asked, self.size)

    def starts(self, tokens: Tensor) -> Tensor:
        """First position of each token's window; on a ring modulo `size`."""
        first = tokens - self.asked // 2
        return first if self.wrap else first.clamp(0, self.size - self.span)

    def keys(self, tile: int, device: torch.device) -> Tensor:
        """Positions of the each tile's keys, (tiles, keys); modulo the size on a ring."""
        length = tile + self.span - 1
        starts = torch.arange(0, self.size, tile, device=device) - self.asked // 2
        if not self.wrap:
            length = min(length, self.size)
            starts = starts.clamp(0, self.size - length)
        return starts[:, None] + torch.arange(length, device=device)

    def sees(self, tile: int, keys: Tensor) -> Tensor:
        """Whether each key of a tile is in each query's window, (tiles or 1, tile, keys)."""
        if self.wrap:
            keys = keys[:1]  # all tiles of a ring are alike
        queries = torch.arange(len(keys) * tile, device=keys.device)
        if not self.wrap:
            queries = queries.clamp(max=self.size - 1)  # later queries are padding, and cropped
        starts = self.starts(queries).view(-1, tile, 1)
        return (starts <= keys[:, None]) & (keys[:, None] < starts + self.span)


def _tiles(q: Tensor, k: Tensor, v: Tensor, rows: _Axis, columns: _Axis) -> Tensor:
    plan = _tile_plan.__wrapped__ if torch.compiler.is_compiling() else _tile_plan
    tile_h, tile_w, keys, mask = plan(rows, columns, q.dtype, q.device)
    below = -rows.size % tile_h
    right = -columns.size % tile_w
    if below or right:
        q = F.pad(q, (0, 0, 0, 0, 0, right, 0, below))
    # (B, tiles_h, tiles_w, tile_h, tile_w, N, D)
    tiles = q.unflatten(2, (-1, tile_w)).unflatten(1, (-1, tile_h)).transpose(2, 3)
    band = -(-rows_at_once(q) // tile_h)
    out = []
    for top in range(0, len(keys), band):
        part = slice(top, top + band)
        asked = tiles[:, part]
        seen = mask[part].expand(q.shape[0], -1, -1, -1, -1, -1).flatten(0, 2)
        attended = _attend(
            asked.flatten(3, 4).flatten(0, 2), _halo(k, keys[part]), _halo(v, keys[part]), seen
        )
        attended = attended.view(*asked.shape[:-1], -1)
        out.append(attended.transpose(2, 3).flatten(3, 4).flatten(1, 2))
    return torch.cat(out, dim=1)[:, : rows.size, : columns.size]


def _attend(q: Tensor, k: Tensor, v: Tensor, mask: Tensor) -> Tensor:
    """Attention for q (T, queries, N, D), k and v (T, keys, N, D) and a mask that is added."""
    q, k, v = (x.transpose(1, 2) for x in (q, k, v))
    if q.is_cpu and q.dtype == torch.bfloat16 and torch.is_grad_enabled():
        # Twice as fast as the backward pass of the fused function.
        out = torch.softmax((q @ k.mT).add_(mask), dim=-1) @ v
    else:
        out = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, scale=1.0)
    return out.transpose(1, 2)


def _halo(x: Tensor, keys: Tensor) -> Tensor:
    """Keys of tiles by their positions (tiles_h, tiles_w, keys): (B tiles, keys, N, D)."""
    found = x.flatten(1, 2).index_select(1, keys.flatten())
    return found.unflatten(1, (-1, keys.shape[2])).flatten(0, 1)


@functools.lru_cache(maxsize=64)
def _tile_plan(
    rows: _Axis, columns: _Axis, dtype: torch.dtype, device: torch.device
) -> tuple[int, int, Tensor, Tensor]:
    """Rows and columns of a tile, positions of the tiles' keys (tiles_h, tiles_w, keys) in the
    flattened map, and 0 for keys in the query's window, else -inf, (tiles_h, tiles_w, 1, queries,
    keys).
    """
    tile_h = min(_TILE[0], rows.size)
    tile_w = min(_TILE[1], columns.size)
    with torch.inference_mode(False):
        keys_h = rows.keys(tile_h, device)
        keys_w = columns.keys(tile_w, device)
        seen_h = rows.sees(tile_h, keys_h)
        seen_w = columns.sees(tile_w, keys_w)
        seen = seen_h[:, None, :, None, :, None] & seen_w[:, None, :, None]
        seen = seen.flatten(4, 5).flatten(2, 3).unsqueeze(2)
        mask = torch.zeros(seen.shape, dtype=dtype, device=device)
        mask = mask.masked_fill_(~seen, -torch.inf).repeat(1, len(keys_w) // seen.shape[1], 1, 1, 1)
        keys_w = keys_w % columns.size
        keys = keys_h[:, None, :, None] * columns.size + keys_w[:, None]
    return tile_h, tile_w, keys.flatten(2), mask


@functools.cache
def _compiled_flex() -> Callable[..., Tensor]:
    from torch._functorch import config as functorch
    from torch.nn.attention.flex_attention import flex_attention

    # Else backward passes may not keep the graph, which `mmps` runs twice.
    functorch.donated_buffer = False
    # A graph per level, dtype and mode; beyond the limit, the eager implementation would store all
    # scores. The limit has another name in torch 2.6.
    config = torch._dynamo.config
    limit = "recompile_limit" if hasattr(config, "recompile_limit") else "cache_size_limit"
    setattr(config, limit, max(_GRAPHS, getattr(config, limit)))
    return torch.compile(flex_attention)


@functools.lru_cache(maxsize=64)
def _flex_mask(rows: _Axis, columns: _Axis, device: torch.device):  # type: ignore[no-untyped-def]
    from torch.nn.attention.flex_attention import create_block_mask

    width = columns.size

    def sees(batch: Tensor, head: Tensor, query: Tensor, key: Tensor) -> Tensor:
        down = (key // width - rows.starts(query // width)) % rows.size
        across = (key % width - columns.starts(query % width)) % width
        return (down < rows.span) & (across < columns.span)

    tokens = rows.size * width
    with torch.inference_mode(False):
        # The compiled function does not store all pairs of tokens: 17 bytes each, 4.6 GB at 64 x
        # 1024.
        create = torch.compile(create_block_mask) if device.type == "cuda" else create_block_mask
        return create(sees, None, None, tokens, tokens, device=str(device))


def _flex(q: Tensor, k: Tensor, v: Tensor, rows: _Axis, columns: _Axis) -> Tensor:
    if not q.is_cuda or columns.span > columns.size:
        raise InputError(
            "attention backend 'flex' has kernels for CUDA only, and needs as many columns as its "
            f"window, found {columns.size} columns on {q.device.type}: use 'auto' or 'tiles'."
        )
    q, k, v = (x.flatten(1, 2).transpose(1, 2) for x in (q, k, v))
    out = _compiled_flex()(q, k, v, block_mask=_flex_mask(rows, columns, q.device), scale=1.0)
    return out.transpose(1, 2).unflatten(1, (rows.size, columns.size))


BACKENDS: Registry[Callable[..., Tensor]] = Registry("attention backend", tiles=_tiles, flex=_flex)
