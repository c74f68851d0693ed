"""A part of an image against a backbone that was built for the part alone, from its own rays, without a ring."""

import pytest
import torch
from torch import nn

from r2flow.backbones import BACKBONES, build_backbone
from r2flow.backbones.crop import cropped, unit_of
from r2flow.errors import InputError
from r2flow.lidar.region import Region
from r2flow.lidar.sensors import SENSORS

RAYS = SENSORS["hdl64e"].resized(16, 64).rays()
SMALL = {
    "hdit": {"base_channels": 8, "depths": [1, 1], "num_heads": [1, 2], "time_channels": 16, "patch": [2, 4]},
    "adm_unet": {"base_channels": 8, "channel_multiplier": [1, 2], "num_residual_blocks": [1, 1], "num_heads": 2},
    "efficient_unet": {"base_channels": 8, "channel_multiplier": [1, 2], "num_residual_blocks": [1, 1], "num_heads": 2},
}
PARTS = [Region((16, 64), 4, 8, 16, 24), Region((16, 64), 0, 16, 48, 32), Region((16, 64), 8, 8, 0, 64)]


def backbone(name: str, rays: torch.Tensor = RAYS, **options):
    model = build_backbone({"name": name, **SMALL[name], **options}, rays, 2).eval().requires_grad_(False)
    torch.manual_seed(1)
    for parameter in model.parameters():  # nothing at zero, or there would be nothing to see
        parameter.copy_(0.3 * torch.randn_like(parameter))
    return model


X, T = torch.randn(2, 2, 16, 64), torch.tensor([0.2, 0.9])


@pytest.mark.parametrize("name", list(BACKBONES))
@pytest.mark.parametrize("part", PARTS, ids=str)
def test_a_part_is_the_backbone_of_its_own_rays(name, part):
    position = "none" if name == "hdit" else "polar"  # whose shapes do not depend on the image's
    whole = backbone(name, position=position)
    own = backbone(name, part.crop(RAYS), position=position, ring=part.width == 64)
    weights = {key: value for key, value in whole.state_dict().items() if key != "coords"}
    own.load_state_dict({**weights, "coords": own.coords})
    with torch.no_grad():
        torch.testing.assert_close(cropped(whole, part.rows, part.columns)(T, part.crop(X)), own(T, part.crop(X)))


@pytest.mark.parametrize("name", list(BACKBONES))
def test_the_part_that_is_all_is_the_backbone_itself(name):
    whole = backbone(name)
    with torch.no_grad():
        assert torch.equal(cropped(whole, torch.arange(16), torch.arange(64))(T, X), whole(T, X))


@pytest.mark.parametrize("name", list(BACKBONES))
def test_what_is_derived_from_the_rays_follows_the_part(name):
    whole, part = backbone(name), PARTS[1]
    piece = cropped(whole, part.rows, part.columns)
    assert torch.equal(piece.coords, part.crop(whole.coords))
    if name == "hdit":
        table, own = whole.get_buffer("table_0"), piece.get_buffer("table_0")
        assert torch.equal(own, torch.cat([table[:, :, 12:], table[:, :, :4]], 2))  # columns 48-63, 0-15 in fours
        embedding = whole.spatial_pe.embedding
        assert torch.equal(piece.spatial_pe.embedding, torch.cat([embedding[:, :, 12:], embedding[:, :, :4]], 2))
    else:
        assert torch.equal(piece.features, part.crop(whole.features))


@pytest.mark.parametrize("name", list(BACKBONES))
def test_the_weights_are_shared_and_the_whole_is_as_before(name):
    whole = backbone(name)
    with torch.no_grad():
        before = whole(T, X)
        piece = cropped(whole, PARTS[0].rows, PARTS[0].columns)
        piece(T, PARTS[0].crop(X))
        assert torch.equal(whole(T, X), before)
    own = {parameter.data_ptr() for parameter in piece.parameters()}
    shared = {parameter.data_ptr() for parameter in whole.parameters()}
    assert len(own - shared) == (1 if name == "hdit" else 0)  # the position embedding is a piece of the whole one


def test_units_are_patches_halved_at_every_level():
    assert unit_of(backbone("hdit")) == (4, 8)
    assert unit_of(backbone("adm_unet")) == unit_of(backbone("efficient_unet")) == (2, 2)
    assert unit_of(build_backbone({"name": "efficient_unet"}, RAYS, 2)) == (8, 8)


def test_what_cannot_be_cut_is_refused():
    with pytest.raises(InputError, match="a Linear cannot be evaluated on a part of its image"):
        unit_of(nn.Linear(2, 2))
    with pytest.raises(InputError, match="not whole units of 8"):
        cropped(backbone("hdit"), torch.arange(16), torch.arange(4, 20))
