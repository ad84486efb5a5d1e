"""V for sparse rewards: TorchRL's implicit Q-learning on recorded steps."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import IQLLoss

from torchrl_rad.modules.normalizer import Normalizer

__all__ = ["make_value_loss", "state_values"]

ROWS = 65_536  # states of a call


class _Critic(nn.Module):
    def __init__(self, normalizer: Normalizer, action_dim: int, sizes: list[int]):
        super().__init__()
        self.normalizer = normalizer
        self.net = _mlp(len(normalizer.mean) + action_dim, 1, sizes)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        return self.net(torch.cat([self.normalizer(state), action], -1))


def _mlp(width: int, out: int, sizes: list[int]) -> MLP:
    norm: dict[str, Any] = {"norm_class": nn.LayerNorm, "norm_kwargs": [{"normalized_shape": n}
                            for n in sizes]}  # fmt: skip
    return MLP(width, out, num_cells=sizes, activation_class=nn.Mish, **norm)


def make_value_loss(
    normalizer: Normalizer,
    action_dim: int,
    gamma: float = 0.99,
    expectile: float = 0.7,
    temperature: float = 3.0,
    width: int = 256,
) -> IQLLoss:
    r"""IQL (Kostrikov et al., 2022), of which RAD takes V for :math:`C(\tau)`.

    It reads steps: ``observation`` [*B, S], ``action`` [*B, A], ``("next", "observation")``,
    ``("next", "reward")`` and ``("next", "terminated")`` [*B, 1]; an episode that was only cut goes
    on behind its end.

    Args:
        normalizer (Normalizer): of states.
        action_dim (int): A.
        gamma (float, optional): discount. Defaults to ``0.99``.
        expectile (float, optional): how far V lies above the mean of Q over recorded actions.
            Defaults to ``0.7``.
        temperature (float, optional): of the actor, which nobody asks. Defaults to ``3.0``.
        width (int, optional): of two hidden layers. Defaults to ``256``.

    Examples:
        >>> loss = make_value_loss(Normalizer.identity(3), action_dim=2)
        >>> steps = TensorDict({"observation": torch.zeros(5, 3), "action": torch.zeros(5, 2),
        ...     "next": {"observation": torch.zeros(5, 3), "reward": torch.zeros(5, 1),
        ...         "done": torch.zeros(5, 1).bool(), "terminated": torch.zeros(5, 1).bool()}}, [5])
        >>> sorted(key for key in loss(steps).keys() if key.startswith("loss"))
        ['loss_actor', 'loss_qvalue', 'loss_value']
    """
    sizes, states = [width, width], len(normalizer.mean)
    parameters = nn.Sequential(
        normalizer, _mlp(states, 2 * action_dim, sizes), NormalParamExtractor()
    )
    actor = ProbabilisticActor(
        TensorDictModule(parameters, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"safe_tanh": True},
        return_log_prob=False,
    )
    loss = IQLLoss(
        actor,
        ValueOperator(_Critic(normalizer, action_dim, sizes), ["observation", "action"]),
        ValueOperator(nn.Sequential(normalizer, _mlp(states, 1, sizes)), ["observation"]),
        temperature=temperature,
        expectile=expectile,
    )
    loss.make_value_estimator(gamma=gamma)
    return loss


@torch.no_grad()
def state_values(loss: IQLLoss, states: Tensor) -> Tensor:
    """V of states [N, S], raw units: float32 [N]."""
    with loss.value_network_params.to_module(loss.value_network):
        parts = [
            loss.value_network(TensorDict({"observation": part}, part.shape[:1]))["state_value"]
            for part in states.split(ROWS)
        ]
    return torch.cat(parts).squeeze(-1)
