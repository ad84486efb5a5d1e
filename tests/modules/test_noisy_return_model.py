import pytest
import torch

from torchrl_rad.modules.noisy_return_model import NoisyReturnModel
from torchrl_rad.modules.normalizer import Normalizer


def make(horizon=16, width=8, multiples=(1, 2, 4), seed=0):
    torch.manual_seed(seed)
    states = Normalizer(torch.tensor([1.0, 2.0]), torch.tensor([2.0, 4.0]))
    return NoisyReturnModel(states, 1, horizon, width, multiples)


def inputs(rows=5, horizon=16):
    torch.manual_seed(1)
    return torch.randn(rows, horizon, 3), torch.rand(rows, horizon, 1) < 0.3


def test_sees_standardised_states_and_plain_actions():
    plans = torch.tensor([[1.0, 2.0, 0.5], [3.0, 10.0, -0.5]])
    assert make().normalised(plans).tolist() == [[0.0, 0.0, 0.5], [1.0, 2.0, -0.5]]


def test_unit_of_the_output():
    model, (plans, mask) = make(), inputs()
    assert model.fit_scale(torch.tensor([10.0, 14.0])) is model
    assert (float(model.mean), float(model.deviation)) == (12.0, 2.0)
    standard = model.standardised(model.normalised(plans), mask, torch.zeros(1))
    torch.testing.assert_close(model(plans, mask), 12.0 + 2.0 * standard)


@pytest.mark.parametrize("rows", [0, 1, 5])
def test_batch_of_one_equals_batch_of_many(rows):
    model, (plans, mask), time = make(), inputs(rows), torch.rand(rows)
    out = model.standardised(plans, mask, time)
    assert out.shape == (rows,)
    for row in range(rows):
        part = slice(row, row + 1)
        alone = model.standardised(plans[part], mask[part], time[part])
        torch.testing.assert_close(alone, out[part], atol=1e-5, rtol=1e-4)


def test_time_and_mask_count():
    model, (plans, mask) = make(), inputs()
    out = model.standardised(plans, mask, torch.full((1,), 0.2))
    torch.testing.assert_close(model.standardised(plans, mask, torch.full((5,), 0.2)), out)
    assert not torch.allclose(model.standardised(plans, mask, torch.full((1,), 0.9)), out)
    assert not torch.allclose(model.standardised(plans, ~mask, torch.full((1,), 0.2)), out)


@pytest.mark.parametrize("horizon, multiples", [(32, (1, 2, 4, 8)), (64, (1, 4)), (384, (1, 2))])
def test_horizons(horizon, multiples):
    model = make(horizon, multiples=multiples)
    assert model(*inputs(2, horizon)).isfinite().all()


def test_new_weights_keep_the_scale():
    model, (plans, mask) = make().fit_scale(torch.tensor([10.0, 14.0])), inputs()
    before = model(plans, mask)
    model.reset_parameters_recursive()
    assert not torch.allclose(model(plans, mask), before)
    assert float(model.mean) == 12.0 and float(model.normalizer.mean[0]) == 1.0


def test_is_saved_with_its_scale():
    model, other = make().fit_scale(torch.tensor([10.0, 14.0])), make(seed=1)
    other.load_state_dict(model.state_dict())
    assert torch.equal(other(*inputs()), model(*inputs()))


def test_what_does_not_fit():
    with pytest.raises(ValueError, match="a plan of 18 steps cannot be halved 2 times"):
        make(18)
    plans, mask = inputs(horizon=12)
    with pytest.raises(ValueError, match="the plans have 12 steps; .* was built for 16"):
        make()(plans, mask)
    with pytest.raises(ValueError, match=r"are \(5, 16, 4\); expected \[B, L, 3\]"):
        make().standardised(torch.zeros(5, 16, 4), inputs()[1], torch.zeros(1))
