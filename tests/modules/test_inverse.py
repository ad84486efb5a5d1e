import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.objectives import BCLoss

from torchrl_rad.modules.inverse import InverseDynamics, inverse_dynamics_actor
from torchrl_rad.modules.normalizer import Normalizer


def make(bound=1.0, seed=0):
    torch.manual_seed(seed)
    states = Normalizer(torch.tensor([1.0, -2.0]), torch.tensor([2.0, 0.5]))
    difference = Normalizer(torch.zeros(2), torch.tensor([0.1, 0.2]))
    return InverseDynamics(states, difference, action_dim=3, width=16, bound=bound)


@settings(max_examples=30, deadline=None)
@given(bound=st.sampled_from([0.5, 1.0, 3.0]), scale=st.sampled_from([0.1, 1e3, 1e30]))
def test_actions_stay_within_the_bound(bound, scale):
    net = make(bound)
    state, following = scale * torch.randn(2, 20, 2)
    actions = net(state, following)
    assert actions.shape == (20, 3) and actions.isfinite().all()
    assert (actions.abs() <= bound).all()


def test_large_changes_reach_the_bound():
    net = make(bound=2.0)
    assert net(torch.zeros(50, 2), 1e6 * torch.randn(50, 2)).abs().max() == 2.0


def test_sees_state_and_change_standardised():
    net, seen = make(), []
    net.net.register_forward_pre_hook(lambda module, args: seen.append(args[0]))
    net(torch.tensor([[3.0, -2.0]]), torch.tensor([[3.2, -2.4]]))
    torch.testing.assert_close(seen[0], torch.tensor([[1.0, 0.0, 2.0, -2.0]]), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_batch_shapes(shape):
    assert make()(torch.randn(*shape, 2), torch.randn(*shape, 2)).shape == (*shape, 3)


def test_actor_reads_and_writes_the_keys_given():
    net = make()
    actor = inverse_dynamics_actor(net, in_keys=["s", ("n", "s")], out_keys=[("out", "a")])
    td = TensorDict({"s": torch.randn(4, 2), "n": {"s": torch.randn(4, 2)}}, [4])
    torch.testing.assert_close(actor(td)["out", "a"], net(td["s"], td["n", "s"]))


def test_bc_loss_trains_it():
    torch.manual_seed(0)
    actor = inverse_dynamics_actor(make())
    td = TensorDict(
        {"observation": torch.randn(32, 2), "next": {"observation": torch.randn(32, 2)}}, [32]
    )
    td["action"] = make(seed=5)(td["observation"], td["next", "observation"]).detach()
    loss = BCLoss(actor)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        value = loss(td)["loss_bc"]
        value.backward()
        optimizer.step()
        losses.append(float(value.detach()))
    assert losses[-1] < 0.2 * losses[0]
    trained = actor(td.select("observation", ("next", "observation")))["action"]
    assert torch.allclose(trained, td["action"], atol=0.6)
