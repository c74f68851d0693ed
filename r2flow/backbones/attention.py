"""Neighbourhood attention on an azimuth ring: each token attends to a window around it.

Azimuth is periodic, so every window is centred. At the top and bottom the window is shifted inside,
start = clamp(i - half, 0, H - rows), and keeps its number of rows. On a ring narrower than the window, a token appears
in it repeatedly, as in the published models.

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
from r2flow.errors import InputError
from r2flow.registry import Registry


def neighbourhood_attention(
    q: Tensor, k: Tensor, v: Tensor, window: tuple[int, int], wrap: bool = True, backend: str = "auto"
) -> Tensor:
    """softmax_{j in window(i)}(q_i . k_j) v_j for N heads of D channels, (B, H, W, N, D) as q, k and v.

    The logits are not scaled: q and k must be scaled.

    Args:
        window: Rows and columns, both odd; at most the rows (and without wrap the columns) of the map.
        wrap: Whether the columns are a ring; if not, windows are shifted inside in both directions.
        backend: A name in `BACKENDS`, or "auto" (above).
    """
    assert window[0] % 2 == window[1] % 2 == 1, window
    rows = _Axis(q.shape[1], window[0], wrap=False)
    columns = _Axis(q.shape[2], window[1], wrap=wrap)
    if backend == "auto":
        supported = q.is_cuda and q.dtype != torch.float64 and q.shape[-1] >= 16 and columns.span <= columns.size
        flex = supported and not torch.compiler.is_compiling() and importlib.util.find_spec("triton")
        backend = "flex" if flex else "tiles"
    return BACKENDS[backend](q, k, v, rows, columns)


@dataclass(frozen=True)
class _Axis:
    """An axis of the map: `size` tokens, each of which attends to `asked` tokens, or to all if there are fewer."""

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


GRAPHS = 64  # limit of torch.compile's graphs of flex_attention; three levels exceed its default of 8
TILE = (4, 8)  # queries, with 6 x 16 keys: smaller tiles copy more keys, larger tiles compute more masked products


def _tiles(q: Tensor, k: Tensor, v: Tensor, rows: _Axis, columns: _Axis) -> Tensor:
    tile_h, tile_w = min(TILE[0], rows.size), min(TILE[1], columns.size)
    padding = -rows.size % tile_h, -columns.size % tile_w
    if any(padding):
        q = F.pad(q, (0, 0, 0, 0, 0, padding[1], 0, padding[0]))
    keys_h, keys_w = _tile_keys(rows, tile_h, q.device), _tile_keys(columns, tile_w, q.device)
    mask = _tile_mask(_tile_sees(rows, tile_h, keys_h), _tile_sees(columns, tile_w, keys_w), q.dtype)
    keys_w = keys_w % columns.size
    band = -(-rows_at_once(q) // tile_h)
    out = []
    for top in range(0, len(mask), band):
        band_of_q = q[:, top * tile_h : (top + band) * tile_h]
        band_of_q = band_of_q.unflatten(2, (-1, tile_w)).unflatten(1, (-1, tile_h)).permute(0, 1, 3, 5, 2, 4, 6)
        tiles_of_k, tiles_of_v = (_halo(x, keys_h[top : top + band], keys_w) for x in (k, v))
        logits = band_of_q.flatten(4, 5) @ tiles_of_k.mT  # (B, tiles_h, tiles_w, N, queries, keys)
        weights = torch.softmax(logits.add_(mask[top : top + band]), dim=-1)
        attended = (weights @ tiles_of_v).unflatten(4, (tile_h, tile_w)).permute(0, 1, 4, 2, 5, 3, 6)
        out.append(attended.flatten(3, 4).flatten(1, 2))
    return torch.cat(out, dim=1)[:, : rows.size, : columns.size]


def _halo(x: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Keys of tiles, by rows (tiles_h, keys_h) and columns (tiles_w, keys_w): (B, tiles_h, tiles_w, N, keys, D)."""
    for dim, positions in ((1, rows), (3, columns)):
        x = x.index_select(dim, positions.flatten()).unflatten(dim, positions.shape)
    return x.permute(0, 1, 3, 5, 2, 4, 6).flatten(4, 5)


def _tile_keys(axis: _Axis, tile: int, device: torch.device) -> Tensor:
    """Positions of the keys of each tile's queries, (tiles, keys); modulo the size on a ring."""
    length = tile + axis.span - 1 if axis.wrap else min(tile + axis.span - 1, axis.size)
    starts = torch.arange(0, axis.size, tile, device=device) - axis.asked // 2
    if not axis.wrap:
        starts = starts.clamp(0, axis.size - length)
    return starts[:, None] + torch.arange(length, device=device)


def _tile_mask(seen_h: Tensor, seen_w: Tensor, dtype: torch.dtype) -> Tensor:
    """0 if the key is in the query's window, else -inf, (tiles_h, tiles_w or 1, 1, queries, keys)."""
    seen = seen_h[:, None, :, None, :, None] & seen_w[None, :, None, :, None, :]
    seen = seen.flatten(4, 5).flatten(2, 3).unsqueeze(2)
    return torch.zeros(seen.shape, dtype=dtype, device=seen.device).masked_fill_(~seen, -torch.inf)


def _tile_sees(axis: _Axis, tile: int, keys: Tensor) -> Tensor:
    """Whether each key of a tile is in each query's window, (tiles or 1, tile, keys), by position on the ring."""
    if axis.wrap:
        keys = keys[:1]
    queries = torch.arange(len(keys) * tile, device=keys.device)
    if not axis.wrap:
        queries = queries.clamp(max=axis.size - 1)  # later queries are padding, and cropped
    starts = axis.starts(queries).view(-1, tile, 1)
    return (starts <= keys[:, None]) & (keys[:, None] < starts + axis.span)


@functools.cache
def _compiled_flex() -> Callable[..., Tensor]:
    from torch._functorch import config as functorch
    from torch.nn.attention.flex_attention import flex_attention

    functorch.donated_buffer = False  # else backward passes may not keep the graph, which `mmps` runs twice
    # A graph per level, dtype and mode; beyond the limit, the eager implementation would store all scores.
    config = torch._dynamo.config
    limit = "recompile_limit" if hasattr(config, "recompile_limit") else "cache_size_limit"  # name in torch 2.6
    setattr(config, limit, max(GRAPHS, getattr(config, limit)))
    return torch.compile(flex_attention)


@functools.lru_cache(maxsize=64)
def _flex_mask(rows: _Axis, columns: _Axis, device: torch.device):  # type: ignore[no-untyped-def]
    from torch.nn.attention.flex_attention import create_block_mask

    def sees(batch: Tensor, head: Tensor, query: Tensor, key: Tensor) -> Tensor:
        inside = torch.ones_like(query, dtype=torch.bool)
        places = (query // columns.size, key // columns.size), (query % columns.size, key % columns.size)
        for axis, (i, j) in zip((rows, columns), places, strict=True):
            inside = inside & ((j - axis.starts(i)) % axis.size < axis.span)
        return inside

    tokens = rows.size * columns.size
    with torch.inference_mode(False):
        # The compiled function does not store all pairs of tokens: 17 bytes each, 4.6 GB at 64 x 1024.
        create = torch.compile(create_block_mask) if device.type == "cuda" else create_block_mask
        return create(sees, None, None, tokens, tokens, device=str(device))


def _flex(q: Tensor, k: Tensor, v: Tensor, rows: _Axis, columns: _Axis) -> Tensor:
    if q.device.type != "cuda":
        raise InputError(
            f"attention backend 'flex' has kernels for CUDA only, and this tensor is on {q.device.type}: "
            "use 'auto' or 'tiles'."
        )
    if columns.span > columns.size:
        raise InputError(
            f"attention backend 'flex' cannot see a token twice, and {columns.size} columns are fewer than "
            f"the window's {columns.span}: use 'auto' or 'tiles'."
        )
    q, k, v = (x.flatten(1, 2).transpose(1, 2) for x in (q, k, v))
    out = _compiled_flex()(q, k, v, block_mask=_flex_mask(rows, columns, q.device), scale=1.0)
    return out.transpose(1, 2).unflatten(1, (rows.size, columns.size))


BACKENDS: Registry[Callable[..., Tensor]] = Registry("attention backend", tiles=_tiles, flex=_flex)
