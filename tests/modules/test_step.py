import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.step import StepEstimator


class Fixed(torch.nn.Module):
    """Gives the same scores for every pair."""

    def __init__(self, scores):
        super().__init__()
        self.scores = torch.tensor(scores)

    def forward(self, x):
        return self.scores.expand(*x.shape[:-1], -1)


def fixed(scores, **kwargs):
    estimator = StepEstimator(Normalizer.identity(2), horizon=len(scores) + 1, width=8, **kwargs)
    estimator.net = Fixed(scores)
    return estimator


def pairs(*shape, width=2):
    torch.manual_seed(0)
    state, target = torch.randn(2, *shape, width)
    return TensorDict({"observation": state, "target": target}, shape)


def log(*probabilities):
    return torch.tensor(probabilities).log().tolist()


@pytest.mark.parametrize(
    "probabilities, mode, median, mean",
    [
        # classes mean 1, 2, 3, 4 steps
        ((0.4, 0.2, 0.1, 0.3), 1, 2, 2),  # mean 2.3
        ((0.1, 0.1, 0.1, 0.7), 4, 4, 3),  # mean 3.4
        ((0.3, 0.1, 0.2, 0.4), 4, 3, 3),  # mean 2.7
        ((0.97, 0.01, 0.01, 0.01), 1, 1, 1),
    ],
)
@pytest.mark.parametrize("activation", ["softmax", "sigmoid"])
def test_estimates_by_hand(probabilities, mode, median, mean, activation):
    scores = log(*probabilities)
    if activation == "sigmoid":  # the inverse of the sigmoid
        scores = torch.tensor(probabilities).logit().tolist()
    for estimate, expected in (("mode", mode), ("median", median), ("mean", mean)):
        estimator = fixed(scores, activation=activation, estimate=estimate)
        step = estimator(pairs(3))["target_step"]
        assert step.tolist() == [[expected]] * 3 and step.dtype == torch.int64


def test_sigmoids_are_weighted_by_their_sum():
    # sigmoids 0.9, 0.9, 0.9, 0.3: mean (0.9 * 6 + 0.3 * 4) / 3 = 2.2
    scores = torch.tensor([0.9, 0.9, 0.9, 0.3]).logit().tolist()
    assert fixed(scores, activation="sigmoid", estimate="mean")(pairs())["target_step"] == 2


@pytest.mark.parametrize("estimate", ["mode", "median", "mean"])
@pytest.mark.parametrize("activation", ["softmax", "sigmoid"])
@pytest.mark.parametrize("scores", [[-1e4, -2e4, -1e4 - 1], [1e4, 2e4, 0.0], [0.0, 0.0, 0.0]])
def test_extreme_scores_stay_in_range(estimate, activation, scores):
    step = fixed(scores, activation=activation, estimate=estimate)(pairs(2))["target_step"]
    assert ((step >= 1) & (step <= 3)).all()


def test_no_sigmoid_is_left_and_the_mean_is_still_the_likely_class():
    # sigmoid(-200) underflows to 0 in float32
    step = fixed([-400.0, -200.0, -400.0], activation="sigmoid", estimate="mean")(pairs())
    assert step["target_step"] == 2


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 100),
    horizon=st.integers(2, 20),
    estimate=st.sampled_from(["mode", "median", "mean"]),
    activation=st.sampled_from(["softmax", "sigmoid"]),
)
def test_steps_are_in_range_for_any_weights(seed, horizon, estimate, activation):
    torch.manual_seed(seed)
    estimator = StepEstimator(
        Normalizer.identity(2), horizon, width=8, estimate=estimate, activation=activation
    )
    step = estimator(pairs(20).apply(lambda x: 100 * x))["target_step"]
    assert ((step >= 1) & (step <= horizon - 1)).all()


def test_recorded_hands_the_offset_on_and_needs_no_network():
    estimator = fixed([0.0] * 8, estimate="recorded")
    assert estimator.in_keys == ["observation", "target", "target_offset"]
    estimator.net = None
    td = pairs(4)
    td["target_offset"] = torch.tensor([[0], [1], [8], [50]])
    assert estimator(td)["target_step"].tolist() == [[1], [1], [8], [8]]


def test_recorded_without_an_offset():
    with pytest.raises(KeyError, match="'target_offset' is missing .*sixth out_key"):
        fixed([0.0] * 8, estimate="recorded")(pairs(4))


def test_random_steps_are_uniform():
    estimator = StepEstimator(Normalizer.identity(2), horizon=9, estimate="random")
    torch.manual_seed(0)
    steps = estimator(TensorDict({name: torch.zeros(8000, 2) for name in ("observation", "target")},
                                 [8000]))["target_step"]  # fmt: skip
    count = steps[:, 0].bincount(minlength=9)
    assert len(count) == 9 and count[0] == 0 and (count[1:] - 1000).abs().max() < 150


def test_logits_on_demand():
    keys = ["target_step", "step_logits"]
    td = fixed([0.0, 1.0, 2.0], out_keys=keys)(pairs(2, 3))
    assert td["step_logits"].shape == (2, 3, 3) and td["target_step"].shape == (2, 3, 1)
    td = pairs(4)
    td["target_offset"] = torch.full((4, 1), 2)
    fixed([0.0, 1.0, 2.0], estimate="recorded", out_keys=keys)(td)
    assert td["target_step"].tolist() == [[2]] * 4
    assert td["step_logits"].tolist() == [[0.0, 1.0, 2.0]] * 4


@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (0,)])
def test_batch_shapes_and_rows_alone(shape):
    torch.manual_seed(0)
    estimator = StepEstimator(Normalizer.identity(2), 9, width=8, out_keys=["step", "logits"])
    td = estimator(pairs(*shape))
    assert td["step"].shape == (*shape, 1) and td["logits"].shape == (*shape, 8)
    if shape == (3,):
        for row in range(3):
            alone = estimator(pairs(3)[row : row + 1])["logits"]
            torch.testing.assert_close(alone, td["logits"][row : row + 1])


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_state_with_nan_gives_a_step_in_range(bad):
    torch.manual_seed(0)
    estimator = StepEstimator(Normalizer.identity(2), 9, width=8, out_keys=["step", "logits"])
    td, clean = pairs(3), pairs(3)
    td["observation"][1] = bad
    clean["observation"][1] = 0.0
    assert torch.equal(estimator(td)["logits"], estimator(clean)["logits"])
    assert ((td["step"] >= 1) & (td["step"] <= 8)).all()


def test_nested_keys_and_dispatch():
    torch.manual_seed(0)
    estimator = StepEstimator(
        Normalizer.identity(2), 9, width=8, in_keys=[("a", "s"), "g"], out_keys=[("o", "i")]
    )
    td = pairs(3)
    nested = TensorDict({"a": {"s": td["observation"]}, "g": td["target"]}, [3])
    step = estimator(nested)["o", "i"]
    assert torch.equal(estimator(a_s=td["observation"], g=td["target"]), step)


def test_float64_states_are_taken():
    estimator = StepEstimator(Normalizer.identity(2), 9, width=8)
    assert torch.equal(
        estimator(pairs(3).double())["target_step"], estimator(pairs(3))["target_step"]
    )


def test_sees_both_states_standardised():
    normalizer = Normalizer(torch.tensor([1.0]), torch.tensor([2.0]))
    estimator, seen = StepEstimator(normalizer, 9, width=8), []
    estimator.net.register_forward_pre_hook(lambda module, args: seen.append(args[0]))
    estimator(TensorDict({"observation": torch.tensor([3.0]), "target": torch.tensor([-1.0])}))
    assert seen[0].tolist() == [1.0, -1.0]


def test_state_dict_round_trip():
    td, saved = pairs(50), StepEstimator(Normalizer.of(torch.randn(9, 2)), 9, width=8)
    other = StepEstimator(Normalizer.identity(2), 9, width=8)
    other.load_state_dict(saved.state_dict())
    assert torch.equal(other(td.copy())["target_step"], saved(td)["target_step"])


@pytest.mark.parametrize("missing", ["observation", "target"])
def test_missing_key(missing):
    with pytest.raises(KeyError, match=f"'{missing}' is missing in the tensordict"):
        StepEstimator(Normalizer.identity(2), 9, width=8)(pairs(3).exclude(missing))


def test_wrong_width():
    with pytest.raises(ValueError, match=r"'observation' is \(3, 5\); expected states of 2"):
        StepEstimator(Normalizer.identity(2), 9, width=8)(pairs(3, width=5))


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"horizon": 1}, "horizon is 1; a step estimate needs 2 or more"),
        ({"activation": "tanh"}, "activation is 'tanh'; expected 'softmax' or 'sigmoid'"),
        (
            {"estimate": "best"},
            "estimate is 'best'; expected one of",
        ),
    ],
)
def test_bad_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        StepEstimator(Normalizer.identity(2), **{"horizon": 9, **kwargs})
