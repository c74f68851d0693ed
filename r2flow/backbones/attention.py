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
    tile_h = min(_TILE[0], rows.size)
    tile_w = min(_TILE[1], columns.size)
    below = -rows.size % tile_h
    right = -columns.size % tile_w
    if below or right:
        q = F.pad(q, (0, 0, 0, 0, 0, right, 0, below))
    keys_h = rows.keys(tile_h, q.device)
    keys_w = columns.keys(tile_w, q.device)
    mask = _tile_mask(rows.sees(tile_h, keys_h), columns.sees(tile_w, keys_w), q.dtype)
    keys_w = keys_w % columns.size
    tiles = q.unflatten(2, (-1, tile_w)).unflatten(1, (-1, tile_h)).permute(0, 1, 3, 5, 2, 4, 6)
    band = -(-rows_at_once(q) // tile_h)
    out = []
    for top in range(0, len(mask), band):
        part = slice(top, top + band)
        # (B, tiles_h, tiles_w, N, queries, keys)
        logits = tiles[:, part].flatten(4, 5) @ _halo(k, keys_h[part], keys_w).mT
        weights = torch.softmax(logits.add_(mask[part]), dim=-1)
        attended = (weights @ _halo(v, keys_h[part], keys_w)).unflatten(4, (tile_h, tile_w))
        out.append(attended.permute(0, 1, 4, 2, 5, 3, 6).flatten(3, 4).flatten(1, 2))
    return torch.cat(out, dim=1)[:, : rows.size, : columns.size]


def _halo(x: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Keys of tiles by rows (tiles_h, keys_h), columns (tiles_w, keys_w): (B, ., ., N, keys, D)."""
    x = x.index_select(1, rows.flatten()).unflatten(1, rows.shape)
    x = x.index_select(3, columns.flatten()).unflatten(3, columns.shape)
    return x.permute(0, 1, 3, 5, 2, 4, 6).flatten(4, 5)


def _tile_mask(seen_h: Tensor, seen_w: Tensor, dtype: torch.dtype) -> Tensor:
    """0 for keys in the query's window, else -inf, (tiles_h, tiles_w or 1, 1, queries, keys)."""
    seen = seen_h[:, None, :, None, :, None] & seen_w[:, None, :, None]
    seen = seen.flatten(4, 5).flatten(2, 3).unsqueeze(2)
    zeros = torch.zeros(seen.shape, dtype=dtype, device=seen.device)
    return zeros.masked_fill_(~seen, -torch.inf)


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
