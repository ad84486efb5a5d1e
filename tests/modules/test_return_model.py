import pytest
import torch

from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.return_model import ReturnModel


def make():
    torch.manual_seed(0)
    return ReturnModel(Normalizer(torch.tensor([1.0, 2.0]), torch.tensor([2.0, 4.0])), 3, width=16)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3), (0,)])
def test_batch_shapes(shape):
    assert make()(torch.randn(*shape, 3, 2)).shape == shape


def test_batch_of_one_equals_batch_of_many():
    model, states = make(), torch.randn(5, 3, 2)
    each = torch.stack([model(row) for row in states])
    torch.testing.assert_close(model(states), each)


def test_sees_standardised_states():
    model, seen = make(), []
    model.net.register_forward_pre_hook(lambda module, args: seen.append(args[0]))
    model(torch.tensor([[1.0, 2.0], [3.0, 2.0], [1.0, 10.0]]))
    assert seen[0].tolist() == [0.0, 0.0, 1.0, 0.0, 0.0, 2.0]


def test_unit_of_the_output():
    model, states = make(), torch.randn(5, 3, 2)
    before = model(states)
    assert model.fit_scale(torch.tensor([10.0, 14.0])) is model
    assert (float(model.mean), float(model.deviation)) == (12.0, 2.0)
    torch.testing.assert_close(model(states), 12.0 + 2.0 * before)
    torch.testing.assert_close(model.standardised(states), before)


def test_equal_returns_give_a_usable_unit():
    for returns in (torch.tensor([3.0]), torch.full((4,), 3.0)):
        model = make().fit_scale(returns)
        assert float(model.mean) == 3.0 and float(model.deviation) > 0


@pytest.mark.parametrize("returns", [torch.zeros(0), torch.tensor([1.0, torch.nan])])
def test_bad_returns(returns):
    with pytest.raises(ValueError, match="expected finite returns"):
        make().fit_scale(returns)


def test_scale_is_saved():
    model, other = make().fit_scale(torch.tensor([10.0, 14.0])), make()
    other.load_state_dict(model.state_dict())
    states = torch.randn(5, 3, 2)
    assert torch.equal(other(states), model(states))
