"""A part of an image against a backbone that was built for the part alone, from its own rays,
without a ring.
"""

import pytest
import torch
from tiny_backbones import NAMES, PUBLISHED, rays

from r2flow.backbones import BACKBONES, Backbone
from r2flow.base.errors import InputError
from r2flow.lidar.region import Region
from tests.conftest import tiny_options

SHAPE = (16, 64)
RAYS = rays(*SHAPE)
PARTS = [Region(SHAPE, 4, 8, 16, 24), Region(SHAPE, 0, 16, 48, 32), Region(SHAPE, 8, 8, 0, 64)]
CROPPABLE = [name for name, kind in BACKBONES._entries.items() if kind.croppable]


def backbone(name: str, rays: torch.Tensor = RAYS, **options) -> Backbone:
    model = BACKBONES.build({**tiny_options(name), **options}, rays).eval().requires_grad_(False)
    torch.manual_seed(1)
    for parameter in model.parameters():  # nothing at zero, or there would be nothing to see
        parameter.copy_(0.3 * torch.randn_like(parameter))
    return model


X, T = torch.randn(2, 2, *SHAPE), torch.tensor([0.2, 0.9])


@pytest.mark.parametrize("name", PUBLISHED)
@pytest.mark.parametrize("part", PARTS, ids=str)
def test_a_part_is_the_backbone_of_its_own_rays(name, part):
    # of positions whose shapes do not depend on the image's
    options = {"position": "none", "detail": [2, 8]} if name == "hdit" else {"position": "polar"}
    whole, own = (
        backbone(name, **options),
        backbone(name, part.crop(RAYS), ring=part.width == 64, **options),
    )
    weights = {key: value for key, value in whole.state_dict().items() if key != "coords"}
    own.load_state_dict({**weights, "coords": own.coords})
    with torch.no_grad():
        torch.testing.assert_close(
            whole.cropped(part.rows, part.columns)(T, part.crop(X)), own(T, part.crop(X))
        )


@pytest.mark.parametrize("name", CROPPABLE)
@pytest.mark.parametrize("part", [*PARTS, Region(SHAPE, 0, 16, 0, 64)], ids=str)
def test_a_part_has_its_own_rays_and_the_whole_is_as_before(name, part):
    whole = backbone(name)
    seen = part.widened(whole.unit)
    with torch.no_grad():
        before = whole(T, X)
        piece = whole.cropped(seen.rows, seen.columns)
        found = piece(T, seen.crop(X))
        assert torch.equal(found, before) if seen.share == 1 else found.shape == seen.crop(X).shape
        assert torch.equal(whole(T, X), before)
    assert torch.equal(piece.coords, seen.crop(whole.coords))


def test_a_learned_position_follows_the_part():
    whole, part = backbone("hdit"), PARTS[1]
    learned, own = (
        whole.spatial_pe.embedding,
        whole.cropped(part.rows, part.columns).spatial_pe.embedding,
    )
    # columns 48-63, 0-15 in fours
    assert torch.equal(own, torch.cat([learned[:, :, 12:], learned[:, :, :4]], 2))


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_weights_are_shared(name):
    whole = backbone(name)
    own = {
        parameter.data_ptr()
        for parameter in whole.cropped(PARTS[0].rows, PARTS[0].columns).parameters()
    }
    shared = {parameter.data_ptr() for parameter in whole.parameters()}
    # the position embedding is a piece of the whole one
    assert len(own - shared) == (1 if name == "hdit" else 0)


def test_units_are_patches_halved_at_every_level():
    assert backbone("hdit", patch=[2, 4]).unit == (4, 8)
    assert backbone("adm_unet").unit == backbone("efficient_unet").unit == (2, 2)
    assert BACKBONES.build({"name": "efficient_unet"}, RAYS).unit == (8, 8)


@pytest.mark.parametrize("name", [name for name in NAMES if name not in CROPPABLE])
def test_what_cannot_be_cropped_is_refused(name):
    with pytest.raises(InputError, match="cannot be evaluated on a part of its image"):
        backbone(name).cropped(torch.arange(16), torch.arange(64))
