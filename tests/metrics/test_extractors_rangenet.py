import math

import pytest
import torch

from r2flow.errors import InputError
from r2flow.lidar.sensors import SENSORS
from r2flow.metrics.extractors.rangenet import RangeNet21, RangeNet53, translate
from r2flow.metrics.scans import Scans
from tests.metrics.conftest import untrained
from tests.reference import load_case

SMALL = SENSORS["hdl64e"].resized(16, 32)


@pytest.fixture(scope="module")
def case(shared):
    return load_case(shared, "feat_rangenet21.pt")


@pytest.fixture(scope="module")
def network():
    return untrained(RangeNet21)


def scans(num: int = 3, channels: int = 2) -> Scans:
    images = torch.rand(num, channels, *SMALL.shape)
    images[:, 0] = images[:, 0] * 50 + 1
    return Scans(images * (torch.rand(num, 1, *SMALL.shape) > 0.2), SMALL)


@torch.inference_mode()
def test_rangenet21_is_the_reference(case):
    network = RangeNet21(
        num_classes=case["cfg"]["num_classes"], mean=tuple(case["mean"]), std=tuple(case["std"])
    ).eval()
    network.load_state_dict(case["state_dict"], strict=True)

    def close(found, expected):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)

    x = network.normalise(case["img"])
    close(x, case["pre"])
    maps = network(x)
    close(maps[:1], case["penultimate_b0"])
    close(maps.mean((2, 3)), case["penultimate_mean"])
    close(maps.mean((2, 3)), case["glob"])
    close(network.head(maps[:1]), case["logits_b0"])
    close(network.pool(maps), case["depth"])
    with torch.device("meta"):
        network = RangeNet53()
    close(network.pool(maps), case["subsample"])


def test_the_published_depth_is_bands_of_rows(network):
    maps = torch.arange(64.0).view(1, 1, 64, 1).expand(1, 2, 64, 32) * torch.tensor([1.0, -1.0]).view(1, 2, 1, 1)
    rows = torch.arange(16.0) * 4 + 1.5  # mean of rows 4 i .. 4 i + 3
    torch.testing.assert_close(network.pool(maps), torch.cat([rows, -rows])[None])


def release(layers: int) -> set[str]:
    """Parameters of the original release's three files, written down from its layers."""
    norm = [f"{{}}.{part}" for part in ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")]
    names = ["conv1.weight", *(n.format("bn1") for n in norm), "1.weight", "1.bias"]

    def residual(at: str) -> list[str]:
        return [f"{at}.conv{i}.weight" for i in (1, 2)] + [n.format(f"{at}.bn{i}") for i in (1, 2) for n in norm]

    for level, blocks in enumerate({21: (1, 1, 2, 2, 1), 53: (1, 2, 8, 8, 4)}[layers], start=1):
        names += [f"enc{level}.conv.weight", *(n.format(f"enc{level}.bn") for n in norm)]
        for block in range(blocks):
            names += residual(f"enc{level}.residual_{block}")
        names += [f"dec{level}.upconv.weight", f"dec{level}.upconv.bias", *(n.format(f"dec{level}.bn") for n in norm)]
        names += residual(f"dec{level}.residual")
    return set(names)


@pytest.mark.parametrize(("cls", "parts"), [(RangeNet21, 21), (RangeNet53, 53)])
def test_names_of_the_original_release_are_ours(cls, parts):
    with torch.device("meta"):
        ours = set(cls(num_classes=20).state_dict())
    theirs = release(parts)
    assert {translate(name) for name in theirs} == ours
    assert len(theirs) == len(ours)
    assert {translate(name) for name in ours} == ours


def test_names_that_are_translated_mean_the_same():
    assert translate("conv1.weight") == "stem.0.weight"
    assert translate("enc4.residual_7.bn2.bias") == "enc4.residual_blocks.7.residual.1.1.bias"
    assert translate("dec3.upconv.bias") == "dec3.conv.0.bias"
    assert translate("decoder.dec3.residual.conv1.weight") == "dec3.residual_blocks.0.residual.0.0.weight"
    assert translate("1.bias") == "head.1.bias"


def test_weights_bring_their_normalisation_and_their_classes(network):
    tensors = {name: tensor for name, tensor in network.state_dict().items() if not name.startswith("head")}
    config = {"dataset": {"sensor": {"img_means": [1, 2, 3, 4, 5], "img_stds": [2, 2, 2, 4, 5]}}}
    loaded = RangeNet21.from_tensors(tensors, config)
    assert loaded.head is None
    image = torch.tensor([3.0, 4.0, 3.0, 0.0]).view(1, 4, 1, 1)
    assert loaded.normalise(image).flatten().tolist() == [1, 1, 0, -1]
    assert not loaded.normalise(image * 0).any()  # no return
    with pytest.raises(InputError, match="4 finite img_means"):
        RangeNet21.from_tensors(
            tensors, {"dataset": {"sensor": {"img_means": [1, 2, 3, math.nan], "img_stds": [1] * 4}}}
        )
    with pytest.raises(InputError, match="4 finite img_means and img_stds"):
        RangeNet21.from_tensors(tensors, {"dataset": {"sensor": {"img_means": [1], "img_stds": "x"}}})
    with pytest.raises(InputError, match="not the weights of rangenet21.*stem.0.weight"):
        RangeNet21.from_tensors({name: t for name, t in tensors.items() if name != "stem.0.weight"}, {})


@pytest.mark.parametrize("size", [(16, 40), (12, 32)])
def test_sizes_that_the_network_cannot_take_name_the_option(network, size):
    with pytest.raises(InputError, match="--size"):
        network.features(Scans(torch.ones(1, 1, *size), SENSORS["hdl64e"].resized(*size)))
