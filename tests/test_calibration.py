"""The similarity from which on a demonstration is trusted."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, RetrievalSampler, similarity_threshold


def walks(episodes, length=20, seed=0, shift=0.0):
    generator = torch.Generator().manual_seed(seed)
    states = torch.randn(episodes, length, 2, generator=generator).cumsum(1).reshape(-1, 2) + shift
    done = torch.zeros(episodes, length, 1, dtype=torch.bool)
    done[:, -1] = True
    following = {"reward": torch.zeros(episodes * length, 1), "done": done.reshape(-1, 1)}
    return TensorDict({"observation": states, "next": following}, [episodes * length])


def database(steps, metric="euclidean"):
    sampler = RetrievalSampler(metric, k=3, threshold=0.0)
    made = ExpertDatabase(LazyTensorStorage(len(steps)), sampler=sampler)
    made.extend(steps)
    return made


def test_by_hand():
    # one state an episode, at distances 0 1 ... 18 from the only row
    made = database(TensorDict({"observation": torch.zeros(1, 1), "episode": torch.zeros(1).long(),
                                "next": {"reward": torch.zeros(1, 1)}}, [1]))  # fmt: skip
    ids = torch.arange(19)
    held = {"observation": ids[:, None].float(), "episode": ids}
    held = TensorDict({**held, "next": {"reward": torch.zeros(19, 1)}}, [19])
    # 0.05 of 20 is the first, 0.1 the second, 0.5 the tenth; 0.04 none
    for level, distance in ((0.05, 18), (0.1, 17), (0.14, 17), (0.5, 9)):
        assert similarity_threshold(made, held, level) == pytest.approx(1 / (1 + distance))
    assert similarity_threshold(made, held, 0.04) == 0.0


@pytest.mark.parametrize("metric", ["euclidean", "cosine"])
@pytest.mark.parametrize("level", [0.05, 0.2, 0.5])
def test_new_episodes_fall_back_as_often_as_said(metric, level):
    """On average over calibrations."""
    made, shares = database(walks(60), metric), []
    for seed in range(40):
        threshold = similarity_threshold(made, walks(99, seed=1000 + seed), level, seed)
        new = walks(50, seed=5000 + seed)["observation"].reshape(50, 20, 2)
        which = torch.randint(20, (50,), generator=torch.Generator().manual_seed(seed))
        _, near = made.sampler.nearest(made.storage, new[torch.arange(50), which], 1)
        shares.append(float((near[:, 0] < threshold).double().mean()))
    assert sum(shares) / 40 == pytest.approx(level, abs=0.035)


def test_states_off_the_data_fall_back():
    made = database(walks(60))
    made.sampler.threshold = similarity_threshold(made, walks(99, seed=1), 0.05)
    found = made.retrieve(walks(20, seed=2)["observation"])["valid"].any(-1)
    away = made.retrieve(walks(20, seed=2, shift=100.0)["observation"])["valid"].any(-1)
    assert found.float().mean() > 0.85 and not away.any()


def test_the_draw_is_seeded():
    made, held = database(walks(60)), walks(30, seed=1)
    one, again, other = (similarity_threshold(made, held, 0.3, seed) for seed in (0, 0, 1))
    assert one == again != other


def test_what_cannot_be_calibrated():
    made, held = database(walks(5)), walks(3, seed=1)
    for level in (0.0, 1.0, -0.1, float("nan")):
        with pytest.raises(ValueError, match="level is"):
            similarity_threshold(made, held, level)
    with pytest.raises(ValueError, match="no episode was held out"):
        similarity_threshold(made, held[:0])
    with pytest.raises(RuntimeError, match="empty"):
        similarity_threshold(ExpertDatabase(), held)
