"""Muon: orthogonal steps for matrices, AdamW's for all else."""

import copy

import pytest
import torch
from torch import nn

from r2flow.stages.muon import Muon, is_hidden_matrix, orthogonalised

RATE, MOMENTUM = 0.05, 0.9
ADAMW = {"lr": 1e-2, "betas": (0.9, 0.99), "weight_decay": 0.1}


def network() -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(nn.Conv2d(2, 16, 3), nn.Conv2d(16, 32, 3), nn.Flatten(), nn.Linear(32, 12), nn.Linear(12, 2))


def gradients(model: nn.Module, seed: int) -> None:
    rng = torch.Generator().manual_seed(seed)
    for p in model.parameters():
        p.grad = torch.randn(p.shape, generator=rng)


@pytest.mark.parametrize("shape", [(24, 24), (64, 16), (16, 200)])
def test_singular_values_come_near_one_and_directions_stay(shape):
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    u, _, v = torch.linalg.svd(matrix.double(), full_matrices=False)
    found = orthogonalised(matrix).double()
    in_its_directions = u.T @ found @ v.T
    values = in_its_directions.diagonal()
    # five steps of the polynomial leave [0.68, 1.14] for values above 1e-2 of the largest; bfloat16 adds its rounding
    assert values.min() > 0.6
    assert values.max() < 1.2
    assert (in_its_directions - values.diag()).abs().max() < 0.05


def test_the_size_of_a_gradient_does_not_matter():
    matrix = torch.randn(16, 24, generator=torch.Generator().manual_seed(1))
    assert torch.allclose(orthogonalised(1024 * matrix), orthogonalised(matrix), atol=0.02)
    assert not orthogonalised(torch.zeros(16, 24)).any()


def test_matrices_between_hidden_layers_are_learned_so():
    hidden = {name for name, p in network().named_parameters() if is_hidden_matrix(p)}
    assert hidden == {"1.weight", "3.weight"}


def test_all_other_weights_are_adamw_s():
    model, other = network(), network()
    ours = Muon(model.parameters(), RATE, MOMENTUM, **ADAMW)
    theirs = torch.optim.AdamW([p for p in other.parameters() if not is_hidden_matrix(p)], **ADAMW)
    for seed in range(3):
        gradients(model, seed), gradients(other, seed)
        ours.step(), theirs.step()
    for p, q in zip(model.parameters(), other.parameters(), strict=True):
        assert torch.equal(p, q) != is_hidden_matrix(p)


def test_a_step_of_a_matrix_is_the_equation():
    model = network()
    ours = Muon(model.parameters(), RATE, MOMENTUM, **ADAMW)
    matrix = model[1].weight
    expected, average = matrix.detach().clone().flatten(1), torch.zeros(32, 144)
    for seed in range(2):
        gradients(model, seed)
        g = matrix.grad.flatten(1)
        average = MOMENTUM * average + (1 - MOMENTUM) * g
        step = orthogonalised((1 - MOMENTUM) * g + MOMENTUM * average)
        expected = expected * (1 - RATE * 0.1) - RATE * step  # 32 rows, 144 columns: sqrt(max(1, .)) = 1
        ours.step()
    assert torch.allclose(matrix.flatten(1), expected, atol=1e-5)


def test_it_goes_on_from_its_state_bit_for_bit():
    model = network()
    ours = Muon(model.parameters(), RATE, **ADAMW)
    gradients(model, 0), ours.step()
    later = copy.deepcopy(model)
    resumed = Muon(later.parameters(), RATE, **ADAMW)
    resumed.load_state_dict(copy.deepcopy(ours.state_dict()))
    for net, optimizer in ((model, ours), (later, resumed)):
        gradients(net, 1), optimizer.step()
    assert all(torch.equal(p, q) for p, q in zip(model.parameters(), later.parameters(), strict=True))


def test_a_closure_clears_the_gradients_of_all_weights():
    """Lightning hands the whole of a step over as a closure; gradients of earlier steps must not stay."""
    model, other = network(), network()
    ours, theirs = (Muon(net.parameters(), RATE, **ADAMW) for net in (model, other))
    rng = torch.Generator().manual_seed(0)
    for x in torch.randn(3, 2, 2, 5, 5, generator=rng):

        def closure(x: torch.Tensor = x) -> float:
            ours.zero_grad()
            loss = model(x).square().sum()
            loss.backward()
            return float(loss.detach())

        ours.step(closure)
        other.zero_grad()
        other(x).square().sum().backward()
        theirs.step()
    assert all(torch.equal(p, q) for p, q in zip(model.parameters(), other.parameters(), strict=True))


def test_a_schedule_moves_both_rates():
    ours = Muon(network().parameters(), RATE, **ADAMW)
    schedule = torch.optim.lr_scheduler.LambdaLR(ours, lambda step: 0.5)
    assert schedule.get_last_lr() == [0.5 * ADAMW["lr"], 0.5 * RATE]
