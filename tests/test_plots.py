"""Pictures: that they are there, of their size, and show what they should."""

from __future__ import annotations

import builtins

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, RetrievalSampler, maze_task
from torchrl_rad.plots import (
    GOAL,
    PATH,
    PLAN,
    TARGET,
    WALL,
    plot_curves,
    plot_followed,
    plot_growth,
    plot_targets,
)
from torchrl_rad.policy import build_policy

matplotlib = pytest.importorskip("matplotlib")
DPI = 130
PLANNER = {"horizon": 9, "jumps": [4, 1], "width": 16, "heads": 2, "blocks": 1, "steps": 1}
BACKBONE = {"state_dim": 4, "action_dim": 2, "planner": PLANNER}
TASK = maze_task("umaze")


def picture(path):
    """RGB bytes [height, width, 3]."""
    return (matplotlib.image.imread(path)[..., :3] * 255).round().astype(np.uint8)


def count(image, colour, within=0):
    """Number of pixels of a colour."""
    wanted = (255 * np.array(matplotlib.colors.to_rgb(colour))).round()
    return int((np.abs(image - wanted).max(-1) <= within).sum())


def colours(image):
    return len(np.unique(image.reshape(-1, 3), axis=0))


# curves


def rows(names, steps=20):
    return [{"step": 10.0 * i, **dict.fromkeys(names, 1 / i)} for i in range(1, steps + 1)]


def test_curves(tmp_path):
    names = ["planner/loss_denoising", "estimator/loss_step", "estimator/step_error"]
    plot_curves(rows(names), tmp_path / "curves.png")
    image = picture(tmp_path / "curves.png")
    # one panel an objective, each 3.2 x 2.8 inches
    assert image.shape == (round(2.8 * DPI), round(2 * 3.2 * DPI), 3)
    assert count(image, "C0") > 200  # a line of each panel
    assert count(image, "C1") > 100  # the second one of "estimator"
    assert count(image, "C2") == 0
    left, right = image[:, : image.shape[1] // 2], image[:, image.shape[1] // 2 :]
    assert sorted(count(half, "C1") > 0 for half in (left, right)) == [False, True]


def test_curves_show_their_values(tmp_path):
    falling, rising = rows(["a/loss"]), rows(["a/loss"])
    for row in rising:
        row["a/loss"] = 1 / row["a/loss"]
    halves = []
    for name, logged in (("falling", falling), ("rising", rising)):
        plot_curves(logged, tmp_path / f"{name}.png")
        line = np.argwhere((picture(tmp_path / f"{name}.png") == _rgb("C0")).all(-1))
        line = line[line[:, 0] > DPI]  # below the legend
        left = line[line[:, 1] < np.median(line[:, 1])]
        right = line[line[:, 1] > np.median(line[:, 1])]
        halves.append(left[:, 0].mean() < right[:, 0].mean())  # pixels count downwards
    assert halves == [True, False]


def _rgb(colour):
    return (255 * np.array(matplotlib.colors.to_rgb(colour))).round().astype(np.uint8)


def test_curves_of_one_row_with_nan(tmp_path):
    plot_curves([{"step": 10.0, "a/loss": float("nan")}], tmp_path / "curves.png")
    assert picture(tmp_path / "curves.png").shape == (round(2.8 * DPI), round(3.2 * DPI), 3)


@pytest.mark.parametrize("nothing", [[], [{"step": 10.0}]])
def test_nothing_logged(tmp_path, nothing):
    with pytest.raises(ValueError, match="nothing was logged, so there are no curves to draw"):
        plot_curves(nothing, tmp_path / "curves.png")


# targets


def episodes(found=True, paid=True, count=3, length=24):
    """Rows that drive from the lower to the upper left of the U."""
    way = torch.tensor(
        [[-1.0, -1.0], [0.0, -1.0], [1.0, -1.0], [1.0, 1.0], [0.0, 1.0], [-1.0, 1.0]]
    )
    place = torch.linspace(0, 5, length)
    low = place.floor().long().clamp_max(4)
    xy = way[low] + (place - low)[:, None] * (way[low + 1] - way[low])
    state = torch.cat([xy, torch.zeros(length, 2)], -1).expand(count, length, 4)
    reward = (xy - way[-1]).norm(dim=-1) <= 0.5 if paid else torch.zeros(length)
    done = torch.zeros(count, length, 1, dtype=torch.bool)
    done[:, -1] = True
    steps = {
        "observation": state.clone(),
        "next": {
            "observation": state.clone(),
            "reward": reward.float().expand(count, length).unsqueeze(-1).clone(),
            "done": done,
        },
    }
    if found is not None:
        target = torch.tensor([0.0, -0.5, 0.0, 0.0]).expand(count, length, 4)
        steps["target"], steps["found"] = target, torch.full((count, length, 1), found)
    return TensorDict(steps, [count, length])


@pytest.fixture(scope="module")
def policy():
    driven = episodes()
    end = {"reward": driven["next", "reward"][0], "done": driven["next", "done"][0]}
    sampler = RetrievalSampler("euclidean", dims=[0, 1], k=3, threshold=0.5)
    database = ExpertDatabase(LazyTensorStorage(50), sampler=sampler)
    database.extend(TensorDict({"observation": driven["observation"][0], "next": end}, [24]))
    torch.manual_seed(0)
    about = {**BACKBONE, "target": {"rule": "followed", "ahead": 4}, "estimator": {"width": 8}}
    return build_policy(about, database)


@pytest.fixture(scope="module")
def backbone():
    torch.manual_seed(0)
    return build_policy(BACKBONE)


def drawn(path, driven, policies):
    plot_targets(TASK, driven, policies, {name: f"{name}: 1" for name in driven}, path)
    return picture(path)


def test_targets_of_backbone_and_policy(tmp_path, policy, backbone):
    driven = {"backbone": episodes(None), "followed": episodes()}
    policies = {"backbone": backbone, "followed": policy}
    image = drawn(tmp_path / "targets.png", driven, policies)
    assert image.shape == (round((4.2 + 0.9) * DPI), round(2 * 4.2 * DPI), 3)
    assert colours(image) > 50
    middle = image.shape[1] // 2
    left, right = image[: int(0.9 * len(image)), :middle], image[: int(0.9 * len(image)), middle:]
    for half in (left, right):
        assert count(half, WALL) > 10_000
        assert count(half, PLAN) > 20
    # targets lie on one spot, so that their colour is full there
    assert count(right, TARGET, within=12) > 3
    assert count(left, TARGET, within=12) == 0


def test_targets_of_the_backbone_alone(tmp_path, backbone):
    image = drawn(tmp_path / "targets.png", {"a": episodes(None)}, {"a": backbone})
    assert image.shape == (round((4.2 + 0.9) * DPI), round(4.2 * DPI), 3)
    assert count(image, PLAN) > 20
    assert count(image, TARGET, within=12) == 0


@pytest.mark.parametrize("found, paid", [(False, True), (False, False), (True, False)])
def test_nothing_found_or_never_arrived(tmp_path, policy, found, paid):
    image = drawn(tmp_path / "targets.png", {"a": episodes(found, paid)}, {"a": policy})
    assert (count(image[: int(0.9 * len(image))], TARGET, within=12) > 3) is found
    assert colours(image) > 50


def test_other_goal(tmp_path, backbone):
    shades = []
    for name, cell in (("own", None), ("other", (3, 1))):
        path = tmp_path / f"{name}.png"
        plot_targets(TASK, {"a": episodes(None)}, {"a": backbone}, {"a": "a"}, path, cell)
        image = picture(path)
        # a quarter of the goal's colour over white
        blend = 0.25 * np.array(matplotlib.colors.to_rgb(GOAL)) + 0.75
        place = np.argwhere(np.abs(image - 255 * blend).max(-1) <= 2)
        place = place[place[:, 0] < 0.9 * len(image)]
        shades.append(place.mean(0)[0] / len(image))
    assert shades[0] < 0.45 < 0.5 < shades[1]  # (1, 1) is above, (3, 1) below


@pytest.mark.parametrize("name", ["medium", "large"])
def test_other_mazes(tmp_path, backbone, name):
    task = maze_task(name)
    path = tmp_path / "targets.png"
    plot_targets(task, {"a": episodes(None)}, {"a": backbone}, {"a": "a"}, path)
    rows, columns = {"medium": (8, 8), "large": (9, 12)}[name]
    assert picture(path).shape == (int((4.2 * rows / columns + 0.9) * DPI), round(4.2 * DPI), 3)


def test_figures_are_closed(tmp_path, backbone):
    from matplotlib import pyplot

    before = pyplot.get_fignums()
    drawn(tmp_path / "targets.png", {"a": episodes(None)}, {"a": backbone})
    plot_curves(rows(["a/loss"]), tmp_path / "curves.png")
    assert pyplot.get_fignums() == before


@pytest.mark.parametrize("draw", ["curves", "targets"])
def test_without_matplotlib(tmp_path, monkeypatch, backbone, draw):
    original = builtins.__import__

    def absent(name, *args, **kwargs):
        if name.split(".")[0] == "matplotlib":
            raise ImportError("No module named 'matplotlib'")
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(ImportError) as caught:
        if draw == "curves":
            plot_curves(rows(["a/loss"]), tmp_path / "curves.png")
        else:
            plot_targets(TASK, {"a": episodes(None)}, {"a": backbone}, {"a": "a"}, tmp_path / "t")
    assert 'plots need matplotlib: pip install "torchrl_rad[recipes]"' in str(caught.value)
    assert list(tmp_path.iterdir()) == []


# what was followed


def rounds(count, **last):
    figures = {"demonstrations": 3, "scores": [1.0, 2.0, 4.0], "pruned": False}
    made = [{**figures, "seen": 10 * number} for number in range(count)]
    return [*made[:-1], {**made[-1], **last}]


@pytest.mark.parametrize(
    "runs",
    [
        {3: rounds(4)},
        {3: rounds(4, pruned=True), 9: rounds(2)},
        {1: rounds(1), 2: rounds(1, scores=[1.0])},
    ],
)
def test_growth(tmp_path, runs):
    plot_growth(runs, tmp_path / "growth.png")
    assert (tmp_path / "growth.png").stat().st_size > 5000


def test_followed_demonstrations(tmp_path):
    # UMaze: along the bottom, up the right side; the path drives beside it, and falls back once
    way = torch.stack([torch.linspace(-1, 1, 30), torch.full((30,), -1.0)], -1)
    states = torch.cat([way, torch.zeros(30, 2)], -1)
    done = torch.zeros(30, 1, dtype=torch.bool)
    done[-1] = True
    steps = {"observation": states, "next": {"reward": done.float(), "done": done}}
    database = ExpertDatabase(LazyTensorStorage(40), sampler=RetrievalSampler("euclidean"))
    database.extend(TensorDict(steps, [30]))
    source = torch.stack([torch.zeros(30), torch.arange(30.0)], -1).long()
    found = torch.ones(30, 1, dtype=torch.bool)
    found[3], source[3] = False, -1
    driven = {
        "observation": states + torch.tensor([0.0, 0.2, 0.0, 0.0]),
        "found": found,
        "target_source": source,
        "next": {"done": done, "reward": done.float()},
    }
    for name in ("similarity", "target_return", "target_offset", "target_step"):
        driven[name] = torch.zeros(30, 1, dtype=torch.int64)
    plot_followed(TASK, TensorDict(driven, [30])[None], database, 0, tmp_path / "followed.png")
    image = picture(tmp_path / "followed.png")
    assert count(image, TARGET, 2) > 100 and count(image, PATH, 2) > 100
    assert count(image, WALL) > 10_000 and count(image, PLAN, 60) > 50


if __name__ == "__main__":
    raise SystemExit(pytest.main([__file__]))
