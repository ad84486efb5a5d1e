"""Training several objectives side by side, each with its own optimiser, resumable to the bit."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.nn.utils import clip_grad_norm_
from torch.optim.lr_scheduler import LambdaLR
from torchrl.checkpoint import GlobalRNGState
from torchrl.objectives import SoftUpdate
from torchrl.objectives.common import LossModule
from tqdm import tqdm

from torchrl_rad.checkpoint import Checkpointer
from torchrl_rad.graphs import in_graph
from torchrl_rad.parallel import (
    drawing_for,
    mean_over_processes,
    share_of_batch,
    wait_for_all,
    wanted_by_any,
)

__all__ = ["Interrupted", "Meter", "Objective", "train"]

CLIP = 1.0  # largest norm of a gradient


class Interrupted(KeyboardInterrupt):
    """Training stopped early on request; ``args[0]`` is the last step done, and it is saved.

    Examples:
        >>> Interrupted(3).args
        (3,)
    """


@dataclass
class Objective:
    """One loss and how it is optimised; objectives share no gradients (RAD, "Model Learning").

    Args:
        loss (LossModule): its outputs ``loss_*`` are summed and minimised, the others are logged.
        prepare (callable): windows [B, H] -> what the loss reads.
        lr (float): of AdamW, after a linear warm-up, falling to 0 along a cosine.
        steps (int): length of the training.
        warmup (int, optional): steps of the warm-up. Defaults to ``50``.
        weight_decay (float, optional): Defaults to ``1e-5``.
        ema (float, optional): decay of the target parameters; None if the loss has none.
        bf16 (bool, optional): compute the loss under bfloat16 autocast. Defaults to ``False``.
        graphs (bool, optional): a step runs as one CUDA graph, and whether a loss is finite is
            asked where it is logged. Without a GPU it changes nothing else. Defaults to ``False``.

    Raises:
        ValueError: ``steps`` is below 1.

    Examples:
        >>> from torchrl_rad import Normalizer, StepEstimationLoss, StepEstimator, draw_step_pairs
        >>> from tensordict import TensorDict
        >>> loss = StepEstimationLoss(StepEstimator(Normalizer.identity(2), horizon=9))
        >>> objective = Objective(
        ...     loss, lambda windows: draw_step_pairs(windows["observation"]), lr=1e-3, steps=10)
        >>> sorted(objective.update(TensorDict({"observation": torch.randn(8, 9, 2)}, [8])))
        ['loss_step', 'step_error']
    """

    loss: LossModule
    prepare: Callable[[TensorDictBase], TensorDictBase]
    lr: float
    steps: int
    warmup: int = 50
    weight_decay: float = 1e-5
    ema: float | None = None
    bf16: bool = False
    graphs: bool = False

    def __post_init__(self):
        if self.steps < 1:
            raise ValueError(f"steps is {self.steps}; expected 1 or more.")
        parameters = list(self.loss.parameters())
        on_gpu = self.graphs and parameters[0].is_cuda  # there the rate has to be a tensor
        self.optimizer = torch.optim.AdamW(
            parameters,
            lr=torch.tensor(self.lr, device=parameters[0].device) if on_gpu else self.lr,
            weight_decay=self.weight_decay,
            fused=True,
            capturable=on_gpu,
        )
        self.scheduler = LambdaLR(self.optimizer, self._rate)
        self.updater = None if self.ema is None else SoftUpdate(self.loss, eps=self.ema)
        self.module: nn.Module = self.loss  # what is called: the loss, or its data-parallel wrapper
        self.step = in_graph(self._step) if self.graphs else self._step

    def distribute(self) -> None:
        """Averages gradients over the processes of the group from now on."""
        self.module = DistributedDataParallel(
            _Outputs(self.loss),
            forward_sync_buffers=False,  # target parameters are buffers, the same ones everywhere
            find_unused_parameters=getattr(self.loss, "partial", False),
        )

    def _rate(self, step: int) -> float:
        warm = min(1.0, (step + 1) / max(1, self.warmup))
        return warm * 0.5 * (1.0 + math.cos(math.pi * min(1.0, step / self.steps)))

    def update(self, windows: TensorDictBase) -> dict[str, Tensor]:
        """One step of the optimiser; gives the loss's outputs, detached.

        Raises:
            FloatingPointError: the loss is NaN or Inf.
        """
        out = self.step(self.prepare(windows))
        self.scheduler.step()
        return dict(out.items())

    def check(self, values: Mapping[str, Tensor | float]) -> None:
        """Raises FloatingPointError if a loss is NaN or Inf."""
        total = sum(float(value) for key, value in values.items() if key.startswith("loss_"))
        if not math.isfinite(total):
            raise FloatingPointError(f"{type(self.loss).__name__} gave {total}.")

    def _step(self, batch: TensorDictBase) -> TensorDict:
        """All that a graph can hold: gradients, the optimiser's step and the averaged weights."""
        device = next(self.loss.parameters()).device.type
        with torch.autocast(device, torch.bfloat16, self.bf16):
            out = self.module(batch)
        values = {key: value.detach() for key, value in out.items()}
        if not self.graphs:  # there it would wait for the GPU
            self.check(values)
        self.optimizer.zero_grad()
        sum(out[key] for key in out.keys() if key.startswith("loss_")).backward()
        clip_grad_norm_(self.loss.parameters(), CLIP)
        self.optimizer.step()
        if self.updater is not None:
            self.updater.step()
        return TensorDict(values)

    def components(self, name: str) -> dict[str, Any]:
        """What a checkpoint holds of it."""
        return {
            f"{name}.loss": self.loss,
            f"{name}.optimizer": self.optimizer,
            f"{name}.scheduler": self.scheduler,
        }


class _Outputs(nn.Module):
    """A loss whose outputs come as a dict."""

    def __init__(self, loss: LossModule):
        super().__init__()
        self.loss = loss

    def forward(self, batch: TensorDictBase) -> dict[str, Tensor]:
        return dict(self.loss(batch).items())


class Meter:
    """Means of named values since the last call of :meth:`read`.

    Examples:
        >>> meter = Meter()
        >>> meter.add({"loss": torch.tensor(1.0)})
        >>> meter.add({"loss": torch.tensor(2.0)})
        >>> meter.read()
        {'loss': 1.5}
    """

    def __init__(self) -> None:
        self.sums: dict[str, Any] = {}
        self.count = 0

    def add(self, values: Mapping[str, Tensor]) -> None:
        """Adds one value of each name; those on a GPU stay there: to read one waits for it."""
        for key, value in values.items():
            number = value.double() if value.is_cuda else float(value)
            self.sums[key] = self.sums.get(key, 0.0) + number
        self.count += 1

    def means(self) -> dict[str, float]:
        """The means so far."""
        return {key: float(total) / self.count for key, total in self.sums.items()}

    def read(self) -> dict[str, float]:
        """The means, and begins anew."""
        means = self.means()
        self.sums, self.count = {}, 0
        return means

    def state_dict(self) -> dict[str, Any]:
        return {
            "sums": {key: float(total) for key, total in self.sums.items()},
            "count": self.count,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.sums, self.count = dict(state["sums"]), state["count"]


def train(
    objectives: Mapping[str, Objective],
    sample: Callable[[], TensorDictBase],
    steps: int,
    checkpointer: Checkpointer,
    save_interval: int,
    log_interval: int,
    log: Callable[[int, dict[str, float]], None],
    meta: Mapping[str, Any],
    resume: bool = False,
    begun: Callable[[int], None] | None = None,
    progress: bool = True,
) -> int:
    """Trains all objectives on the same windows, saving at intervals, on Ctrl-C and on SIGTERM.

    A resumed training draws the same batches and noise as one that was never interrupted: on a CPU
    the losses are equal to the bit. In a process group each process draws the same batch and takes
    its share of it, gradients are averaged, and the first process logs and saves: losses are those
    of one process but for rounding, and a checkpoint goes on with any number of processes.

    Args:
        objectives (mapping): by name.
        sample (callable): draws a batch of windows [B, H] with torch's global generator.
        steps (int): length of the training.
        checkpointer (Checkpointer): where it is saved.
        save_interval (int): steps between checkpoints.
        log_interval (int): steps over which logged values are means.
        log (callable): gets the step and the means.
        meta (mapping): what the run is, checked when it is resumed.
        resume (bool, optional): go on from the newest checkpoint. Defaults to ``False``.
        begun (callable, optional): gets the step at which it begins, before the first is done.
        progress (bool, optional): show a bar with losses and time left. Defaults to ``True``.

    Returns:
        The step at which it began: 0, or that of the checkpoint.

    Raises:
        CheckpointError: the checkpoint is damaged or of another run, or cannot be saved.
        FloatingPointError: a loss is NaN or Inf; the message names it and the step.
        Interrupted: it was asked to stop; what was done is saved.
        ValueError: an interval is below 1, or a batch has no equal parts for the processes.
    """
    for interval, value in (("save_interval", save_interval), ("log_interval", log_interval)):
        if value < 1:
            raise ValueError(f"{interval} is {value}; expected 1 or more.")
    meter = Meter()
    parts: dict[str, Any] = {"meter": meter, "rng": GlobalRNGState()}
    for name, objective in objectives.items():
        parts.update(objective.components(name))
    latest = checkpointer.latest() if resume else None
    begin = 0 if latest is None else checkpointer.load(latest, parts, meta)["step"]
    share = share_of_batch()
    writes = share.rank == 0
    if share.world > 1:
        for objective in objectives.values():
            objective.distribute()
    if begun is not None and writes:
        begun(begin)
    hidden = not (progress and writes)
    bar = tqdm(total=steps, initial=begin, desc="training", unit="step", disable=hidden)
    with bar, drawing_for(share), _stop_requests() as stop:
        for step in range(begin + 1, steps + 1):
            windows = share.of(sample())
            device = windows.device or "cpu"
            meter.add(_update_all(objectives, windows, step))
            stopped = wanted_by_any(stop.requested, device)
            saves = step % save_interval == 0 or step == steps or stopped
            if saves or step % log_interval == 0:
                _check_graphs(objectives, meter, step)
            if step % log_interval == 0 or step == steps:
                means = mean_over_processes(meter.read(), device)
                if writes:
                    log(step, means)
                bar.set_postfix_str(_short(means))
            bar.update()
            if saves and writes:
                checkpointer.save(step, parts, meta)
            if stopped:
                wait_for_all()  # until it is saved
                raise Interrupted(step)
    wait_for_all()
    return begin


def _update_all(objectives, windows: TensorDictBase, step: int) -> dict[str, Tensor]:
    values = {}
    for name, objective in objectives.items():
        with _named(name, step):
            out = objective.update(windows)
        values.update({f"{name}/{key}": value for key, value in out.items()})
    return values


def _check_graphs(objectives, meter: Meter, step: int) -> None:
    """Raises FloatingPointError if a loss since the last log, not looked at then, is not finite."""
    for name, objective in objectives.items():
        if not objective.graphs:
            continue
        own = {k: value for k, value in meter.means().items() if k.startswith(f"{name}/")}
        with _named(name, step):
            objective.check({key.removeprefix(f"{name}/"): value for key, value in own.items()})


@contextmanager
def _named(name: str, step: int) -> Iterator[None]:
    """Says of a FloatingPointError whose it is."""
    try:
        yield
    except FloatingPointError as error:
        raise FloatingPointError(
            f"objective {name!r} at step {step}: {error} Resume from the last checkpoint with "
            "a lower learning rate, or look at the data report."
        ) from error


def _short(means: Mapping[str, float]) -> str:
    losses = {key: value for key, value in means.items() if "/loss" in key}
    return " ".join(f"{key.split('/')[0]}={value:.3g}" for key, value in losses.items())


class _Stop:
    requested = False


@contextmanager
def _stop_requests() -> Iterator[_Stop]:
    """Turns the first SIGINT or SIGTERM into a request; a second SIGINT stops at once."""
    stop = _Stop()

    def ask(number, frame):
        if stop.requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        stop.requested = True

    try:
        before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # not the main thread: whoever started it stops it
        before = {}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
