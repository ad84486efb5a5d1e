"""Training that is interrupted in every way and goes on to the bit."""

from __future__ import annotations

import math
import os
import signal
import threading

import pytest
import torch
from tensordict import TensorDict, TensorDictParams
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives.common import LossModule

from torchrl_rad import Normalizer, StepEstimationLoss, StepEstimator, draw_step_pairs
from torchrl_rad.checkpoint import Checkpointer, CheckpointError
from torchrl_rad.runs import MetricsLog
from torchrl_rad.training import CLIP, Interrupted, Meter, Objective, train

STEPS, SAVE, LOG = 9, 3, 2
META = {"task": "toy", "normalizer": "ab12"}
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Toy(LossModule):
    """A noisy regression of x's sum, with target parameters; ``scale`` multiplies the loss."""

    network: TensorDictModule
    network_params: TensorDictParams
    target_network_params: TensorDictParams

    def __init__(self, width: int = 2, hidden: bool = True, noise: float = 0.1, scale: float = 1.0):
        super().__init__()
        layers = [nn.Linear(width, 4), nn.Dropout(0.2), nn.Linear(4, 1)] if hidden else []
        net = nn.Sequential(*layers) if hidden else nn.Linear(width, 1, bias=False)
        net = TensorDictModule(net, in_keys=["x"], out_keys=["y"])
        self.convert_to_functional(net, "network", create_target_params=True)
        self.noise, self.scale = noise, scale

    def forward(self, data: TensorDict) -> TensorDict:
        with self.network_params.to_module(self.network):
            y = self.network(data.select("x"))["y"]
        goal = data["x"].sum(-1, keepdim=True) + self.noise * torch.randn(len(data), 1)
        loss = self.scale * (y - goal).square().mean()
        return TensorDict({"loss_toy": loss, "size": y.detach().abs().mean()})

    forward.in_keys = ["x"]


def prepare(windows):
    return TensorDict({"x": windows["observation"][:, 0]}, [len(windows)])


def make_objectives() -> dict[str, Objective]:
    torch.manual_seed(0)
    estimator = StepEstimator(Normalizer.identity(2), horizon=5, width=8)
    steps = StepEstimationLoss(estimator)
    return {
        "toy": Objective(Toy(), prepare, lr=1e-2, steps=STEPS, warmup=3, ema=0.9),
        "estimator": Objective(
            steps, lambda windows: draw_step_pairs(windows["observation"]), lr=1e-3, steps=STEPS
        ),
    }


def draw():
    return TensorDict({"observation": torch.randn(4, 5, 2).cumsum(1)}, [4])


class Attempt:
    """One process's worth of training in a folder; ``trouble`` happens in the draw of a step."""

    def __init__(self, folder, trouble=None, at=None, resume=False, **options):
        self.log = MetricsLog(folder / "metrics.csv")
        self.checkpointer = Checkpointer(folder / "checkpoints")
        latest = self.checkpointer.latest() if resume else None
        self.log.rewind(0 if latest is None else int(latest.name.split("-")[1]))
        self.objectives = make_objectives()
        self.trouble, self.at, self.drawn = trouble, at, 0
        torch.manual_seed(1)
        arguments = {"save_interval": SAVE, "log_interval": LOG, "meta": META, **options}
        self.run = lambda: train(
            self.objectives,
            self.sample,
            STEPS,
            self.checkpointer,
            log=self.log.write,
            resume=resume,
            progress=False,
            **arguments,
        )

    def sample(self):
        self.drawn += 1
        if self.drawn == self.at:
            self.trouble()
        return draw()

    def state(self):
        return {
            f"{name}.{key}": value.clone()
            for name, objective in self.objectives.items()
            for key, value in objective.loss.state_dict().items()
            if isinstance(value, torch.Tensor)
        }


def assert_equal(state, other):
    assert state.keys() == other.keys()
    for key, value in state.items():
        assert torch.equal(value, other[key]), key


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The training that nothing interrupts: its metrics as text and its weights."""
    attempt = Attempt(tmp_path_factory.mktemp("whole"))
    assert attempt.run() == 0
    return attempt.log.path.read_text(), attempt.state()


def crash():
    raise RuntimeError("pulled plug")


def kill(number):
    return lambda: os.kill(os.getpid(), number)


# interruptions


def test_uninterrupted(whole):
    text, _ = whole
    lines = text.splitlines()
    assert lines[0] == "step,toy/loss_toy,toy/size,estimator/loss_step,estimator/step_error"
    assert [line.split(",")[0] for line in lines[1:]] == ["2", "4", "6", "8", "9"]


@pytest.mark.parametrize("at", [1, 3, 4, 5, 6, 7, 9])
def test_exception(tmp_path, whole, at):
    with pytest.raises(RuntimeError, match="pulled plug"):
        Attempt(tmp_path, crash, at).run()
    again = Attempt(tmp_path, resume=True)
    begin = again.run()
    assert begin == SAVE * ((at - 1) // SAVE)  # at most one interval is lost
    assert again.drawn == STEPS - begin
    assert again.log.path.read_text() == whole[0]
    assert_equal(again.state(), whole[1])


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize("at", [1, 3, 5, 9])
def test_signal(tmp_path, whole, number, at):
    before = [signal.getsignal(known) for known in SIGNALS]
    attempt = Attempt(tmp_path, kill(number), at)
    with pytest.raises(Interrupted) as caught:
        attempt.run()
    assert caught.value.args == (at,)  # the step is finished and saved: nothing is lost
    assert isinstance(caught.value, KeyboardInterrupt)
    assert attempt.checkpointer.latest().name.startswith(f"step-{at:08d}")
    assert [signal.getsignal(known) for known in SIGNALS] == before
    again = Attempt(tmp_path, resume=True)
    assert again.run() == at
    assert again.log.path.read_text() == whole[0]
    assert_equal(again.state(), whole[1])


def test_interrupted_again_and_again(tmp_path, whole):
    for trouble in (crash, kill(signal.SIGTERM), crash, kill(signal.SIGINT)):
        with pytest.raises((RuntimeError, Interrupted)):
            Attempt(tmp_path, trouble, 2, resume=True).run()
    again = Attempt(tmp_path, resume=True)
    assert again.run() == 5  # 0, 2 (saved), 3 (its interval's end), 5 (saved)
    assert again.log.path.read_text() == whole[0]
    assert_equal(again.state(), whole[1])


def test_second_interrupt_stops_at_once(tmp_path):
    def twice():
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    attempt = Attempt(tmp_path, twice, 2)
    with pytest.raises(KeyboardInterrupt) as caught:
        attempt.run()
    assert not isinstance(caught.value, Interrupted)
    assert attempt.checkpointer.latest() is None
    assert signal.getsignal(signal.SIGINT) is before


def test_second_terminate_still_saves(tmp_path):
    def twice():
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)

    attempt = Attempt(tmp_path, twice, 2)
    with pytest.raises(Interrupted):
        attempt.run()
    assert attempt.checkpointer.latest() is not None


def test_trains_outside_the_main_thread(tmp_path, whole):
    attempt, begun = Attempt(tmp_path), []
    thread = threading.Thread(target=lambda: begun.append(attempt.run()))
    thread.start()
    thread.join()
    assert begun == [0]
    assert attempt.log.path.read_text() == whole[0]


def test_resume_of_a_finished_training_does_nothing(tmp_path, whole):
    Attempt(tmp_path).run()
    again = Attempt(tmp_path, resume=True)
    assert again.run() == STEPS
    assert again.drawn == 0
    assert_equal(again.state(), whole[1])
    assert again.log.path.read_text() == whole[0]


def test_resume_without_a_checkpoint_begins(tmp_path, whole):
    attempt = Attempt(tmp_path, resume=True)
    assert attempt.run() == 0
    assert attempt.log.path.read_text() == whole[0]


@pytest.mark.parametrize("key, value", [("task", "other"), ("normalizer", "cd34")])
def test_checkpoint_of_another_run(tmp_path, key, value):
    Attempt(tmp_path).run()
    other = Attempt(tmp_path, resume=True, meta={**META, key: value})
    with pytest.raises(CheckpointError) as caught:
        other.run()
    assert f"is a checkpoint of {key} {META[key]!r}, this run is {key} {value!r}" in str(
        caught.value
    )
    assert other.drawn == 0


def test_damaged_checkpoint(tmp_path):
    attempt = Attempt(tmp_path)
    attempt.run()
    weights = attempt.checkpointer.latest() / "toy.loss.safetensors"
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"toy\.loss\.safetensors is damaged: its sha256"):
        Checkpointer(tmp_path / "checkpoints").latest()
    with pytest.raises(CheckpointError, match="damaged"):
        train(
            make_objectives(), draw, STEPS, attempt.checkpointer, SAVE, LOG,
            attempt.log.write, META, resume=True, progress=False,
        )  # fmt: skip


def test_full_disk_leaves_the_older_checkpoint(tmp_path, whole, monkeypatch):
    attempt = Attempt(tmp_path)
    save, calls = os.fsync, []

    def full(handle):
        if len(calls) > 100:
            raise OSError(28, "No space left on device")
        calls.append(handle)
        save(handle)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CheckpointError, match="the disk is full; the previous one, .* is intact"):
        attempt.run()
    monkeypatch.undo()
    again = Attempt(tmp_path, resume=True)
    assert again.run() % SAVE == 0
    assert_equal(again.state(), whole[1])


# the loop


def test_not_a_number_names_objective_and_step(tmp_path):
    attempt = Attempt(tmp_path)
    original = attempt.sample

    def spoiled():
        windows = original()
        if attempt.drawn == 4:
            windows["observation"][0, 0, 0] = torch.nan
        return windows

    attempt.sample = spoiled
    with pytest.raises(FloatingPointError) as caught:
        attempt.run()
    assert "objective 'toy' at step 4: Toy gave nan." in str(caught.value)
    assert "Resume from the last checkpoint with a lower learning rate" in str(caught.value)
    assert attempt.checkpointer.latest().name.startswith("step-00000003")
    assert all(value.isfinite().all() for value in attempt.state().values())


def test_infinite_loss(tmp_path):
    objective = Objective(Toy(scale=math.inf), prepare, lr=1e-2, steps=3)
    with pytest.raises(FloatingPointError, match="Toy gave inf"):
        objective.update(draw())


@pytest.mark.parametrize("name", ["save_interval", "log_interval"])
def test_interval_below_one(tmp_path, name):
    with pytest.raises(ValueError, match=f"{name} is 0; expected 1 or more"):
        Attempt(tmp_path, **{name: 0}).run()


def test_logs_means_over_the_interval(tmp_path, whole):
    each = Attempt(tmp_path, log_interval=1)
    each.run()
    singles = each.log.rows()
    pairs = MetricsLog(tmp_path / "whole.csv")
    pairs.path.write_text(whole[0])
    for row in pairs.rows():
        steps = [int(row["step"]) - 1, int(row["step"])] if row["step"] < STEPS else [STEPS]
        for key in ("toy/loss_toy", "estimator/step_error"):
            values = [single[key] for single in singles if single["step"] in steps]
            assert row[key] == pytest.approx(sum(values) / len(values), rel=1e-12)


def test_progress_bar_shows_losses(tmp_path, capsys):
    checkpointer = Checkpointer(tmp_path)
    train(make_objectives(), draw, STEPS, checkpointer, SAVE, LOG, lambda *_: None, META)
    shown = capsys.readouterr().err
    assert "training: 100%" in shown
    assert "9/9" in shown
    assert "toy=" in shown and "estimator=" in shown
    assert "size=" not in shown  # losses only


# the meter


def test_meter():
    meter = Meter()
    for loss, error in ((1.0, 10.0), (2.0, 20.0), (6.0, 60.0)):
        meter.add({"loss": torch.tensor(loss), "error": torch.tensor(error)})
    assert meter.read() == {"loss": 3.0, "error": 30.0}
    assert meter.read() == {}
    meter.add({"loss": torch.tensor(4.0)})
    assert meter.read() == {"loss": 4.0}


def test_meter_goes_on_from_its_state():
    meter, other = Meter(), Meter()
    meter.add({"loss": torch.tensor(1.0)})
    other.load_state_dict(meter.state_dict())
    other.add({"loss": torch.tensor(3.0)})
    assert other.read() == {"loss": 2.0}
    assert meter.read() == {"loss": 1.0}


# one objective


def test_learning_rate_by_hand():
    objective = Objective(Toy(), prepare, lr=0.4, steps=4, warmup=2)
    rates = [objective.scheduler.get_last_lr()[0]]
    for _ in range(4):
        objective.update(draw())
        rates.append(objective.scheduler.get_last_lr()[0])
    half = math.sqrt(0.5)
    # warm-up 1/2, 1, 1, ... times the cosine from 0 to pi in four steps
    expected = [0.4 * 0.5, 0.4 * (1 + half) / 2, 0.4 * 0.5, 0.4 * (1 - half) / 2, 0.0]
    assert rates == pytest.approx(expected, abs=1e-12)


def test_learning_rate_stays_at_0_after_the_end():
    objective = Objective(Toy(), prepare, lr=0.4, steps=2, warmup=0)
    for _ in range(4):
        objective.update(draw())
    assert objective.scheduler.get_last_lr() == [0.0]


def test_steps_below_one():
    with pytest.raises(ValueError, match="steps is 0; expected 1 or more"):
        Objective(Toy(), prepare, lr=0.4, steps=0)


def first_step(scale=1.0):
    """A linear toy at w = (0.5, -1) after one update, and what its gradient was."""
    loss = Toy(hidden=False, noise=0.0, scale=scale)
    objective = Objective(loss, prepare, lr=0.1, steps=10, warmup=2, weight_decay=0.01, ema=0.75)
    with torch.no_grad():
        loss.network_params["module", "weight"].copy_(torch.tensor([[0.5, -1.0]]))
        loss.target_network_params["module", "weight"].copy_(torch.tensor([[0.5, -1.0]]))
    x = torch.tensor([[1.0, 2.0], [0.0, 1.0]])
    out = objective.update(TensorDict({"observation": x[:, None]}, [2]))
    return objective, out


def test_first_step_by_hand():
    # y = (-1.5, -1), goals (3, 1): errors (-4.5, -2), loss (20.25 + 4) / 2
    objective, out = first_step()
    assert out["loss_toy"].item() == pytest.approx(12.125)
    assert not out["loss_toy"].requires_grad
    # gradient mean of 2 e x = (-4.5, -11); AdamW's first step is lr against its sign, and the
    # weights decay by lr x 0.01; lr is 0.1 x 1/2 in the warm-up
    weight = objective.loss.network_params["module", "weight"].data
    expected = torch.tensor([[0.5 * (1 - 0.0005) + 0.05, -1.0 * (1 - 0.0005) + 0.05]])
    torch.testing.assert_close(weight, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("scale, norm", [(1.0, CLIP), (1e-3, 1e-3 * math.hypot(4.5, 11.0))])
def test_gradient_is_clipped(scale, norm):
    objective, _ = first_step(scale)
    (gradient,) = [p.grad for p in objective.loss.parameters() if p.grad is not None]
    assert gradient.norm().item() == pytest.approx(norm, rel=1e-4)
    direction = -torch.tensor([[4.5, 11.0]]) / math.hypot(4.5, 11.0)
    torch.testing.assert_close(gradient / gradient.norm(), direction)


def test_average_of_weights_by_hand():
    objective, _ = first_step()
    live = objective.loss.network_params["module", "weight"].data
    average = objective.loss.target_network_params["module", "weight"].data
    expected = 0.75 * torch.tensor([[0.5, -1.0]]) + 0.25 * live
    torch.testing.assert_close(average, expected)
    for _ in range(3):
        objective.update(draw())
        expected = 0.75 * expected + 0.25 * live
    torch.testing.assert_close(average, expected)


def test_no_average_unless_asked_for():
    loss = Toy()
    before = loss.target_network_params.clone()
    objective = Objective(loss, prepare, lr=0.1, steps=3)
    objective.update(draw())
    assert objective.updater is None
    assert (loss.target_network_params == before).all()


def test_objectives_share_no_gradients():
    objectives = make_objectives()
    objectives["toy"].update(draw())
    others = list(objectives["estimator"].loss.parameters())
    assert others
    assert all(parameter.grad is None for parameter in others)


def test_objectives_do_not_change_each_other(tmp_path):
    def noiseless():
        torch.manual_seed(0)
        loss = Toy(hidden=False, noise=0.0)
        return Objective(loss, prepare, lr=1e-2, steps=STEPS, ema=0.9)

    alone, beside = noiseless(), noiseless()
    batches = [draw() for _ in range(STEPS)]
    for name, objectives in (
        ("alone", {"toy": alone}),
        ("beside", {"toy": beside, "estimator": make_objectives()["estimator"]}),
    ):
        drawn = iter(batches)
        train(
            objectives, lambda drawn=drawn: next(drawn), STEPS, Checkpointer(tmp_path / name),
            SAVE, LOG, lambda *_: None, META, progress=False,
        )  # fmt: skip
    assert (alone.loss.network_params == beside.loss.network_params).all()
    assert (alone.loss.target_network_params == beside.loss.target_network_params).all()


@pytest.mark.parametrize("bf16", [False, True])
def test_autocast(bf16):
    seen = []

    class Watching(Toy):
        def forward(self, data):
            seen.append((torch.is_autocast_enabled("cpu"), (data["x"] @ data["x"].T).dtype))
            return super().forward(data)

        forward.in_keys = ["x"]

    objective = Objective(Watching(), prepare, lr=0.1, steps=3, bf16=bf16)
    objective.update(draw())
    assert seen == [(bf16, torch.bfloat16 if bf16 else torch.float32)]
    assert not torch.is_autocast_enabled("cpu")
    assert all(p.dtype == torch.float32 for p in objective.loss.parameters())


if __name__ == "__main__":
    raise SystemExit(pytest.main([__file__]))
