"""Plans and training steps that a CUDA graph can hold.

A GPU is not needed to see whether they wait for one: on fake tensors of a GPU each read of a value
raises. What needs one is marked.
"""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from tensordict import TensorDict
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode

from torchrl_rad import (
    DenoisingLoss,
    DiffuserPlanner,
    InverseDynamics,
    Normalizer,
    StepEstimationLoss,
    StepEstimator,
    draw_step_pairs,
)
from torchrl_rad.checkpoint import Checkpointer
from torchrl_rad.graphs import CapturedPlan, in_graph
from torchrl_rad.modules.diffuser_lite import DiffuserLitePlanner
from torchrl_rad.modules.noisy_return_model import NoisyReturnModel
from torchrl_rad.modules.planner import Pin
from torchrl_rad.modules.return_model import ReturnModel
from torchrl_rad.objectives.sequence import SequenceDenoisingLoss
from torchrl_rad.training import Objective, train

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
HORIZON, JUMPS, DIM = 9, (4, 1), 3


def lite(**options):
    states = Normalizer.identity(DIM)
    inverse = InverseDynamics(states, states, 2)
    options = {"width": 16, "heads": 2, "candidates": 4, "condition": 0.9, **options}
    tokens = ReturnModel(states, tokens=3) if options["candidates"] > 1 else None
    return DiffuserLitePlanner(
        states, inverse, HORIZON, JUMPS, return_model=tokens, relative=True, **options
    )


def diffuser(**options):
    states = Normalizer.identity(DIM)
    model = NoisyReturnModel(states, action_dim=2, horizon=8, width=8)
    return DiffuserPlanner(states, 2, horizon=8, width=8, return_model=model, candidates=2)


PLANNERS = {"lite": lite, "diffuser": diffuser}


def weighted(planner):
    torch.manual_seed(0)
    for parameter in planner.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return planner


def rows(count=3):
    step = torch.full((count, 1), 4)
    return TensorDict(
        {
            "observation": torch.randn(count, DIM),
            "target": torch.randn(count, DIM),
            "found": torch.ones(count, 1, dtype=torch.bool),
            "target_step": step,
            "target_index": torch.full_like(step, -1),
        },
        [count],
    )


# nothing waits for the GPU


@pytest.mark.parametrize("kind", PLANNERS)
def test_a_plan_reads_no_value(kind):
    with FakeTensorMode(), torch.device("cuda"):
        planner = PLANNERS[kind]()
        planner.guide_scale = 0.0  # gradients ask for the context of a true GPU
        out = planner(rows())
        assert out["plan"].device.type == "cuda" and out["plan"].shape[0] == 3
        with pytest.raises(DataDependentOutputException):  # it would have been noticed
            out["plan"].sum().item()


@pytest.mark.parametrize("kind", PLANNERS)
def test_a_loss_reads_no_value(kind):
    with FakeTensorMode(), torch.device("cuda"):
        planner = PLANNERS[kind]()
        steps = planner.horizon
        windows = TensorDict(
            {
                "observation": torch.randn(4, steps, DIM),
                "action": torch.randn(4, steps, 2),
                "return_to_go": torch.randn(4, steps),
            },
            [4],
        )
        loss = (DenoisingLoss if kind == "lite" else SequenceDenoisingLoss)(planner)
        assert loss(windows)["loss_denoising"].device.type == "cuda"


# the same as without


@pytest.mark.parametrize("kind", PLANNERS)
def test_captured_plans_are_the_plans(kind):
    planner, given = weighted(PLANNERS[kind]()), rows()
    captured = copy.deepcopy(planner).capture()
    for _ in range(4):  # a graph is recorded at the second call
        torch.manual_seed(1)
        expected = planner(given.clone())
        torch.manual_seed(1)
        came = captured(given.clone())
        assert torch.equal(came["plan"], expected["plan"])
        assert torch.equal(came["action"], expected["action"])


def test_graphs_are_of_a_number_of_rows_and_of_what_is_pinned():
    planner = weighted(lite()).capture()
    planner(rows(3)), planner(rows(2)), planner(rows(3))
    assert len(planner._captured.graphs) == 2
    planner.plan = planner.plan  # an attribute of its own: still one owner
    planner.noise = "seeded"
    planner(rows(5))  # noise of a generator of its own is not captured
    assert len(planner._captured.graphs) == 2


def test_copies_have_no_graphs():
    planner = weighted(lite()).capture()
    planner(rows())
    for other in (copy.deepcopy(planner), pickle.loads(pickle.dumps(planner))):
        assert other._captured.graphs == {}
        assert other(rows())["plan"].isfinite().all()
    shallow = copy.copy(planner)
    shallow.candidates = 1
    torch.manual_seed(0)
    came = shallow(rows())["plan"]
    shallow._captured = None
    torch.manual_seed(0)
    assert torch.equal(came, shallow(rows())["plan"])


def test_pins_come_as_what_they_were():
    seen = []

    def plan(state, pins):
        seen.append([type(pin) for pin in pins])
        return state[:, None]

    pin = Pin(torch.zeros(2, dtype=torch.int64), torch.zeros(2, 1), torch.ones(2).bool())
    CapturedPlan()(plan, torch.ones(2, 1), [None, pin, (torch.ones(2),)])
    assert seen == [[type(None), Pin, tuple]]


# training


def objective(graphs, scale=1.0):
    torch.manual_seed(0)
    loss = StepEstimationLoss(StepEstimator(Normalizer.identity(2), horizon=5, width=8))

    def prepare(windows):
        return draw_step_pairs(scale * windows["observation"], horizon=5)

    return Objective(loss, prepare, lr=1e-2, steps=6, graphs=graphs)


def sample():
    return TensorDict({"observation": torch.randn(8, 9, 2)}, [8])


def trained(path, graphs, scale=1.0, save=3, log=2):
    made, logged = objective(graphs, scale), []
    torch.manual_seed(1)
    train(
        {"estimator": made}, sample, 6, Checkpointer(path), save, log,
        lambda step, means: logged.append((step, means)), {}, progress=False,
    )  # fmt: skip
    return logged, made.loss.state_dict()


def test_a_training_in_graphs_is_the_training(tmp_path):
    plain, graphs = trained(tmp_path / "a", False), trained(tmp_path / "b", True)
    assert plain[0] == graphs[0] and len(plain[0]) == 3
    assert all(torch.equal(plain[1][key], graphs[1][key]) for key in plain[1])


def test_without_reading_each_loss_a_bad_one_is_found_before_it_is_saved(tmp_path):
    with pytest.raises(FloatingPointError, match="'estimator' at step 3: StepEstimationLoss gave"):
        trained(tmp_path, True, scale=math.nan, save=3, log=5)
    assert Checkpointer(tmp_path).latest() is None


def test_function():
    doubled = in_graph(lambda td: TensorDict({"y": 2 * td["x"]}))
    for value in (1.0, 2.0, 3.0, 4.0):
        assert float(doubled(TensorDict({"x": torch.tensor(value)}))["y"]) == 2 * value


@needs_gpu
@pytest.mark.parametrize("kind", PLANNERS)
def test_plans_of_graphs_on_a_gpu(kind):
    planner = weighted(PLANNERS[kind]()).to("cuda")
    planner.noise = "zero"
    captured, expected = copy.deepcopy(planner).capture(), planner
    for _ in range(5):
        given = rows().to("cuda")
        came = captured(given.clone())["plan"]
        assert torch.allclose(came, expected(given.clone())["plan"], atol=1e-4)


@needs_gpu
def test_a_training_in_graphs_on_a_gpu():
    losses = []
    for graphs in (False, True):
        torch.manual_seed(0)
        loss = StepEstimationLoss(StepEstimator(Normalizer.identity(2), horizon=5, width=8))
        made = Objective(loss.to("cuda"), lambda td: td, lr=1e-2, steps=10, graphs=graphs)
        torch.manual_seed(1)
        batches = [draw_step_pairs(torch.randn(8, 5, 2), horizon=5).to("cuda") for _ in range(10)]
        losses.append([float(made.update(batch)["loss_step"]) for batch in batches])
    assert losses[1] == pytest.approx(losses[0], rel=1e-4)
