import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_rad.modules.normalizer import Normalizer


def test_by_hand():
    normalizer = Normalizer.of(torch.tensor([[0.0, 7.0], [2.0, 7.0], [4.0, 7.0]]))
    assert normalizer.mean.tolist() == [2.0, 7.0]
    # the population's deviation, and 1 for a constant feature
    assert normalizer.deviation.tolist() == pytest.approx([(8 / 3) ** 0.5, 1.0])
    assert normalizer(torch.tensor([2.0, 9.0])).tolist() == [0.0, 2.0]


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 1000),
    shape=st.lists(st.integers(0, 3), max_size=3),
    scale=st.sampled_from([1e-4, 1.0, 1e4]),
    shift=st.sampled_from([0.0, -3.0, 50.0]),
)
def test_round_trip_over_any_batch_shape(seed, shape, scale, shift):
    generator = torch.Generator().manual_seed(seed)
    recorded = scale * (torch.randn(20, 3, generator=generator) + shift)
    normalizer = Normalizer.of(recorded)
    states = scale * (torch.randn(*shape, 3, generator=generator) + shift)
    standard = normalizer(states)
    assert standard.shape == states.shape and standard.dtype == torch.float32
    torch.testing.assert_close(
        normalizer.inverse(standard), states, atol=1e-5 * scale * (1 + abs(shift)), rtol=1e-5
    )


def test_standardises_what_it_was_made_from():
    recorded = torch.randn(500, 3) * torch.tensor([0.1, 1.0, 20.0]) + 5
    standard = Normalizer.of(recorded)(recorded)
    torch.testing.assert_close(standard.mean(0), torch.zeros(3), atol=1e-4, rtol=0)
    torch.testing.assert_close(standard.std(0, correction=0), torch.ones(3), atol=1e-4, rtol=0)


@pytest.mark.parametrize("value", [0.0, 0.1, -1e3, 1e-30])
@pytest.mark.parametrize("rows", [1, 3, 1000])
def test_constant_feature_counts_as_deviation_one(value, rows):
    # 0.1 has no exact mean: its deviation comes out as 1e-17, which would blow other states up
    normalizer = Normalizer.of(torch.full((rows, 1), value))
    assert normalizer.deviation.tolist() == [1.0]
    assert float(normalizer(torch.tensor([value + 2.0]))) == pytest.approx(2.0, rel=1e-4)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_states_with_nan_or_inf(bad):
    states = torch.zeros(4, 2)
    states[2, 1] = bad
    with pytest.raises(ValueError, match="states with NaN or Inf give no normaliser"):
        Normalizer.of(states)


def test_identity_and_loading():
    normalizer = Normalizer.identity(2)
    states = torch.randn(3, 2)
    assert torch.equal(normalizer(states), states) and torch.equal(
        normalizer.inverse(states), states
    )
    saved = Normalizer.of(torch.randn(9, 2)).state_dict()
    normalizer.load_state_dict(saved)
    assert torch.equal(normalizer.mean, saved["mean"])
    assert list(normalizer.parameters()) == []


def test_read_takes_nested_keys_and_its_own_dtype():
    td = TensorDict({"a": {"b": torch.ones(3, 2, dtype=torch.float64)}}, [3])
    states = Normalizer.identity(2).read(td, ("a", "b"))
    assert states.dtype == torch.float32 and states.shape == (3, 2)
    assert Normalizer.identity(2).double().read(td, ("a", "b")).dtype == torch.float64


@pytest.mark.parametrize(
    "entry, error, message",
    [
        (None, KeyError, "'x' is missing in the tensordict, which holds .*other"),
        (torch.zeros(3, 4), ValueError, r"'x' is \(3, 4\); expected states of 2 entries"),
        (torch.zeros(3, 2, dtype=torch.int64), ValueError, "'x' is torch.int64 on cpu; expected"),
        (torch.zeros(3, 2, device="meta"), ValueError, "on meta; expected floating point on cpu"),
    ],
)
def test_read_names_what_is_wrong(entry, error, message):
    td = TensorDict({"other": torch.zeros(3)}, [3])
    if entry is not None:
        td["x"] = entry
    with pytest.raises(error, match=message):
        Normalizer.identity(2).read(td, "x")
