"""Checkpoints under kills, full disks, damage and foreign runs."""

from __future__ import annotations

import builtins
import errno
import os
import pickle
import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictParams
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.checkpoint import GlobalRNGState
from torchrl.objectives import SoftUpdate
from torchrl.objectives.common import LossModule

from torchrl_rad import _files
from torchrl_rad._states import load_state, save_state
from torchrl_rad.checkpoint import (
    Checkpointer,
    CheckpointError,
    latest_checkpoint,
    load_checkpoint,
    load_tensors,
    load_weights,
    save_tensors,
    save_weights,
    staged_folder,
    state_digest,
    verify_manifest,
    write_atomic,
    write_json,
    write_manifest,
)

TASK = {"task": "pointmaze-umaze", "normalizer": "ab12"}


class Regression(LossModule):
    """A loss with target parameters, as the planners' losses have."""

    network: TensorDictModule
    network_params: TensorDictParams
    target_network_params: TensorDictParams

    def __init__(self):
        super().__init__()
        hidden = [nn.BatchNorm1d(8), nn.ReLU(), nn.Dropout(0.2)]
        net = nn.Sequential(nn.Linear(3, 8), *hidden, nn.Linear(8, 1))
        net = TensorDictModule(net, in_keys=["x"], out_keys=["y"])
        self.convert_to_functional(net, "network", create_target_params=True)

    def forward(self, data: TensorDict) -> TensorDict:
        with self.network_params.to_module(self.network):
            y = self.network(data.select("x"))["y"]
        return TensorDict({"loss": (y - data["x"].sum(-1, True)).square().mean()})

    forward.in_keys = ["x"]


class Run:
    """A small training whose every step draws from all random generators."""

    def __init__(self, optimizer=torch.optim.AdamW, amsgrad: bool = False):
        torch.manual_seed(0)
        self.loss = Regression()
        self.target = SoftUpdate(self.loss, eps=0.9)
        params = list(self.loss.network_params.values(True, True))
        self.optimizer = optimizer(params, 1e-2, amsgrad=amsgrad)
        self.scheduler = torch.optim.lr_scheduler.OneCycleLR(self.optimizer, 0.1, total_steps=50)
        self.generator = torch.Generator().manual_seed(1)
        self.numpy = np.random.default_rng(2)
        self.parts = {
            "loss": self.loss,
            "optimizer": self.optimizer,
            "scheduler": self.scheduler,
            "generator": self.generator,
            "numpy": self.numpy,
            "rng": GlobalRNGState(),
        }

    def steps(self, count: int) -> list[float]:
        losses = []
        for _ in range(count):
            shift = random.random() + np.random.rand() + self.numpy.random()
            x = torch.randn(16, 3, generator=self.generator) + shift
            loss = self.loss(TensorDict({"x": x}, [16]))["loss"]
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
            self.scheduler.step()
            self.target.step()
            losses.append(loss.item())
        return losses


class Box:
    """Holds any state."""

    def __init__(self, state=None):
        self.state = state

    def state_dict(self):
        return self.state

    def load_state_dict(self, state):
        self.state = state


def box(value: float) -> dict[str, Box]:
    return {"net": Box({"w": torch.full((50,), value)}), "count": Box({"n": value})}


def assert_same(one, other) -> None:
    assert type(one) is type(other)
    if isinstance(one, torch.Tensor):
        assert one.dtype == other.dtype and one.shape == other.shape
        raw = [t.contiguous().reshape(-1).view(torch.uint8) for t in (one, other)]
        assert torch.equal(*raw)
    elif isinstance(one, dict):
        assert list(one) == list(other)
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        for pair in zip(one, other, strict=True):
            assert_same(*pair)
    else:
        assert one == other or (one != one and other != other)


# --- what is saved comes back, bit for bit


@pytest.mark.parametrize(
    ("optimizer", "amsgrad"), [(torch.optim.Adam, True), (torch.optim.AdamW, False)]
)
def test_resumed_equals_uninterrupted(tmp_path, optimizer, amsgrad):
    random.seed(0)
    np.random.seed(0)
    run = Run(optimizer, amsgrad)
    run.steps(5)
    path = Checkpointer(tmp_path).save(5, run.parts, TASK)
    expected = run.steps(5)
    state = {name: part.state_dict() for name, part in list(run.parts.items())[:3]}

    random.seed(9)
    np.random.seed(9)
    other = Run(optimizer, amsgrad)
    other.steps(2)  # another history, which must leave no trace
    assert Checkpointer(tmp_path).load(None, other.parts, TASK) == {**TASK, "step": 5}
    assert other.steps(5) == expected
    for name, value in state.items():
        assert_same(dict(other.parts[name].state_dict()), dict(value))
    assert latest_checkpoint(tmp_path) == path


def test_every_kind_of_value(tmp_path):
    shared = torch.arange(6.0)
    state = {
        "moments": {0: {"step": torch.tensor(3.0), "m": torch.randn(2, 3).bfloat16()}, 7: {}},
        "types": [torch.tensor(True), torch.tensor(2**60), torch.ones(3).half(), torch.ones(0, 4)],
        "more": (torch.randn(2, dtype=torch.float64), torch.zeros(2, dtype=torch.complex64)),
        "special": torch.tensor([float("nan"), -0.0, float("inf"), 1e-45]),
        "shared": [shared, shared[2:4], shared.view(2, 3).T, nn.Parameter(shared)],
        "plain": [None, True, 1, 0.1, -0.0, float("inf"), "text é", 2**127, (), [], {}],
        "a.b": torch.zeros(1),
        "a": {"b": torch.ones(1)},
    }
    save_state(tmp_path, "box", Box(state))
    back = load_state(tmp_path, "box")
    state["shared"][3] = state["shared"][3].data
    assert_same(back, state)
    assert np.copysign(1, back["plain"][4]) == -1
    back["shared"][0].add_(1)  # the tensors own their memory
    assert torch.equal(back["shared"][1], shared[2:4])


@pytest.mark.parametrize(
    "value", [object(), {"f": print}, {("a",): 1}, {"x": torch.eye(2).to_sparse()}]
)
def test_unknown_values_are_refused(tmp_path, value):
    checkpointer = Checkpointer(tmp_path)
    with pytest.raises(TypeError, match="cannot be saved|can be saved"):
        checkpointer.save(1, {"box": Box(value)})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["meta", "manifest", "../x", "a/b", "", ".tmp"])
def test_names_that_are_no_file_names(tmp_path, name):
    with pytest.raises(ValueError, match="component name"):
        Checkpointer(tmp_path).save(1, {name: Box({})})
    with pytest.raises(ValueError, match="negative"):
        Checkpointer(tmp_path).save(-1, {})


def test_no_pickle(tmp_path, monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("unpickling")

    run = Run()
    run.steps(1)
    for name in ("load", "save"):
        monkeypatch.setattr(torch, name, refuse)
    for name in ("load", "loads", "dump", "dumps", "Pickler", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    checkpointer = Checkpointer(tmp_path)
    checkpointer.save(1, run.parts)
    checkpointer.load(None, run.parts)
    names = {path.suffix for path in tmp_path.rglob("*") if path.is_file()}
    assert names == {".json", ".safetensors"}


# --- rotation


def test_rotation_keeps_the_last_saved(tmp_path):
    checkpointer = Checkpointer(tmp_path, keep=2)
    assert checkpointer.latest() is None
    with pytest.raises(CheckpointError, match="no checkpoint"):
        checkpointer.load(None, {})
    for step in (10, 20, 30, 20, 20):  # after 30 the run went back
        path = checkpointer.save(step, box(step))
        assert checkpointer.latest() == path
    assert {p.name for p in tmp_path.iterdir()} == {"step-00000020-0004", "step-00000020-0005"}
    with pytest.raises(ValueError, match="keep=0"):
        Checkpointer(tmp_path, keep=0)


def test_some_components_only(tmp_path):
    checkpointer = Checkpointer(tmp_path)
    path = checkpointer.save(1, box(1.0))
    net = Box()
    load_checkpoint(path, {"net": net})
    assert torch.equal(net.state["w"], torch.ones(50))
    with pytest.raises(CheckpointError, match=r"not \['ema'\]"):
        checkpointer.load(path, {"ema": net})
    checkpointer.save(2, {"net": nn.Linear(2, 2)})
    with pytest.raises(CheckpointError, match="'net' in .* does not fit this run"):
        checkpointer.load(None, {"net": nn.Linear(3, 2)})


def test_stale_stages_and_incomplete_folders(tmp_path):
    checkpointer = Checkpointer(tmp_path)
    path = checkpointer.save(1, box(1.0))
    (tmp_path / ".tmp-step-00000002-0002-ff").mkdir()
    (tmp_path / ".tmp-step-00000002-0002-ff" / "net.json").write_text("{")
    (tmp_path / "step-00000003-0003").mkdir()
    (tmp_path / "step-notes.txt").touch()
    assert latest_checkpoint(tmp_path) == path
    checkpointer = Checkpointer(tmp_path)
    assert not list(tmp_path.glob(".tmp-*"))
    last = checkpointer.save(4, box(4.0))
    assert last.name == "step-00000004-0004"
    assert sorted(p.name for p in tmp_path.iterdir()) == [path.name, last.name, "step-notes.txt"]


def test_removal_that_fails_is_a_warning(tmp_path, monkeypatch):
    checkpointer = Checkpointer(tmp_path, keep=1)
    checkpointer.save(1, box(1.0))

    def refuse(path):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(_files.shutil, "rmtree", refuse)
    with pytest.warns(UserWarning, match="could not be removed: Permission denied"):
        path = checkpointer.save(2, box(2.0))
    assert checkpointer.latest() == path


# --- damage and foreign runs


def damages(data: bytes):
    for eighth in range(8):
        at = len(data) * eighth // 8
        yield f"bit at {at}", data[:at] + bytes([data[at] ^ (1 << eighth)]) + data[at + 1 :]
        yield f"cut at {at}", data[:at]
    yield "longer", data + b"\n"


def test_damage_is_refused(tmp_path):
    checkpointer = Checkpointer(tmp_path)
    older = checkpointer.save(1, box(1.0), TASK)
    newest = checkpointer.save(2, box(2.0), TASK)
    for path in sorted(newest.iterdir()):
        data = path.read_bytes()
        for how, damaged in damages(data):
            if (path.name, how) == ("manifest.json", "longer"):
                continue  # a line feed after JSON is no damage
            path.write_bytes(damaged)
            with pytest.raises(CheckpointError, match=f"{path.name}.*(damaged|cut short|foreign)"):
                load_checkpoint(newest, box(0.0))
        with pytest.raises(CheckpointError, match="load it by its path") as raised:
            path.write_bytes(data[:-1] + b"!")
            checkpointer.latest()
        assert str(older) in str(raised.value)
        path.unlink()
        with pytest.raises(CheckpointError, match=f"{path.name} is missing"):
            load_checkpoint(newest, box(0.0))
        path.write_bytes(data)
    assert checkpointer.latest() == newest
    for folder in (older, newest):
        (folder / "net.safetensors").write_bytes(b"")
    with pytest.raises(CheckpointError, match="No older checkpoint"):
        checkpointer.latest()


def test_damage_loads_nothing(tmp_path):
    path = Checkpointer(tmp_path).save(1, box(1.0))
    (path / "count.json").write_text("5")
    parts = box(0.0)
    with pytest.raises(CheckpointError):
        load_checkpoint(path, parts)
    assert parts["net"].state["w"].sum() == 0


@pytest.mark.parametrize("content", ["[]", '{"dict": 3}', '{"tensor": "x"}', "{}", "[" * 10**5])
def test_whole_files_that_make_no_sense(tmp_path, content):
    path = Checkpointer(tmp_path).save(1, box(1.0))
    (path / "net.json").write_text(content if content != "[]" else '{"dict": [[1]]}')
    write_manifest(path)
    with pytest.raises(CheckpointError, match="net.json"):
        load_checkpoint(path, box(0.0))
    (path / "net.safetensors").write_text(content)
    write_manifest(path)
    with pytest.raises(CheckpointError, match="net.safetensors is damaged: it is not safetensors"):
        load_checkpoint(path, box(0.0))


@pytest.mark.parametrize(
    ("key", "value"), [("task", "kitchen-mixed"), ("normalizer", "cd34"), ("database", "ee")]
)
def test_foreign_checkpoint(tmp_path, key, value):
    checkpointer = Checkpointer(tmp_path)
    checkpointer.save(1, box(1.0), {**TASK, "jumps": (32, 8, 1)})
    checkpointer.load(None, box(0.0), {**TASK, "jumps": (32, 8, 1)})
    with pytest.raises(CheckpointError, match=f"{key} .*this run is {key} '{value}'"):
        checkpointer.load(None, box(0.0), {**TASK, key: value})


# --- disks that are full, folders that cannot be written


class FullFile:
    """Writes half of what it is given and fails, as a file on a full disk."""

    def __init__(self, file):
        self.file = file

    def __enter__(self):
        return self

    def __exit__(self, *args):
        self.file.close()

    def write(self, data):
        self.file.write(data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")


class Faults:
    """Makes the n-th call of those that write fail."""

    def __init__(self, monkeypatch, n: int, write: bool):
        self.left, self.fired, self.write = n, False, write
        for name in ("fsync", "replace", "open", "mkdir"):
            monkeypatch.setattr(os, name, self.wrap(getattr(os, name)))
        monkeypatch.setattr(_files, "open", self.wrap(builtins.open, opens=True), raising=False)

    def wrap(self, function, opens=False):
        def call(*args, **kwargs):
            self.left -= 1
            if self.left != 0:
                return function(*args, **kwargs)
            self.fired = True
            if opens and self.write and args[1] == "xb":
                return FullFile(function(*args, **kwargs))
            raise OSError(errno.ENOSPC, "No space left on device")

        return call


@pytest.mark.parametrize("write", [False, True], ids=["call", "half-written"])
def test_fault_at_every_call(tmp_path, write):
    for n in range(1, 300):
        folder = tmp_path / str(n)
        checkpointer = Checkpointer(folder)
        first = checkpointer.save(1, box(1.0), TASK)
        failure = None
        with pytest.MonkeyPatch.context() as monkeypatch:
            faults = Faults(monkeypatch, n, write)
            try:
                checkpointer.save(2, box(2.0), TASK)
            except CheckpointError as error:
                failure = error
        parts = box(0.0)
        step = checkpointer.load(None, parts, TASK)["step"]
        assert parts["count"].state == {"n": float(step)}
        assert parts["net"].state["w"].eq(step).all()
        assert not list(folder.glob(".tmp-*")) and verify_manifest(first)
        if not faults.fired:
            break
        assert failure is not None and "the disk is full" in str(failure)
        assert str(folder) in str(failure) and "is intact" in str(failure)
        # the next save, with space again, is an ordinary one
        assert checkpointer.save(3, box(3.0)) == checkpointer.latest()
    assert 20 < n < 299


def test_first_save_on_a_full_disk(tmp_path, monkeypatch):
    checkpointer = Checkpointer(tmp_path)
    Faults(monkeypatch, 3, True)
    with pytest.raises(CheckpointError, match="there is no earlier one"):
        checkpointer.save(1, box(1.0))
    assert list(tmp_path.iterdir()) == []


def test_a_write_the_system_refuses(tmp_path):
    checkpointer = Checkpointer(tmp_path)
    path = checkpointer.save(1, box(1.0))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    large = {"net": Box({"w": torch.zeros(100_000)})}
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(CheckpointError, match="File too large.*is intact"):
            checkpointer.save(2, large)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert checkpointer.latest() == path and list(tmp_path.iterdir()) == [path]


def test_interrupt_leaves_no_stage(tmp_path, monkeypatch):
    checkpointer = Checkpointer(tmp_path)
    path = checkpointer.save(1, box(1.0))

    def interrupt(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        checkpointer.save(2, box(2.0))
    assert list(tmp_path.iterdir()) == [path]


def test_a_reader_sees_whole_checkpoints_only(tmp_path, monkeypatch):
    checkpointer = Checkpointer(tmp_path, keep=1)
    seen, real = set(), {"fsync": os.fsync, "replace": os.replace}

    def spy(name):
        def call(*args):
            for path in tmp_path.glob("step-*"):
                verify_manifest(path)
                seen.add(path.name)
            return real[name](*args)

        return call

    for name in real:
        monkeypatch.setattr(os, name, spy(name))
    for step in (1, 2, 3):
        checkpointer.save(step, box(step))
    assert len(seen) == 3


def test_unwritable_folder_is_told_at_once(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(CheckpointError, match=r"cannot be written to .*file/run: Not a directory"):
        Checkpointer(tmp_path / "file" / "run")
    if os.geteuid() != 0:
        (tmp_path / "locked").mkdir(mode=0o500)
        with pytest.raises(CheckpointError, match="locked: Permission denied"):
            Checkpointer(tmp_path / "locked")


def test_folder_that_vanishes(tmp_path):
    checkpointer = Checkpointer(tmp_path / "run")
    (tmp_path / "run").rmdir()
    (tmp_path / "run").touch()
    with pytest.raises(CheckpointError, match="checkpoint of step 1 not saved in .*run"):
        checkpointer.save(1, box(1.0))


# --- kills

SAVES = """
import sys, types
root, folder = sys.argv[1:]
package = types.ModuleType("torchrl_rad")  # the rest of the library is not needed here
package.__path__ = [root + "/torchrl_rad"]
sys.modules["torchrl_rad"] = package
import torch
from torchrl_rad.checkpoint import Checkpointer
class Box:
    def state_dict(self):
        return {"w": torch.full((20_000,), float(step)), "step": step}
checkpointer = Checkpointer(folder)
for step in range(1, 10**6):
    checkpointer.save(step, {"one": Box(), "two": Box()})
    print(step, flush=True)
"""


def test_kill_at_any_instant(tmp_path):
    root = str(Path(_files.__file__).parents[1])
    pause, last = random.Random(0), 0
    for _ in range(3):
        command = [sys.executable, "-c", SAVES, root, str(tmp_path)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None and process.stdout.readline()
        time.sleep(pause.random() * 0.3)
        process.send_signal(signal.SIGKILL)
        said = process.stdout.read().split()
        process.wait()
        parts = {"one": Box(), "two": Box()}
        path = latest_checkpoint(tmp_path)
        assert path is not None
        step = load_checkpoint(path, parts)["step"]
        assert step >= (int(said[-1]) if said else 1)  # what was reported as saved is there
        for part in parts.values():
            assert part.state["step"] == step and part.state["w"].eq(step).all()
        number = int(path.name[-4:])
        assert number > last
        last = number
    Checkpointer(tmp_path)
    assert not list(tmp_path.glob(".tmp-*"))


# --- weights, digests and the files below them


def test_weights(tmp_path):
    net = nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2))
    save_weights(tmp_path, "net", net)
    (tmp_path / "database").mkdir()
    write_json(tmp_path / "database" / "rows.json", [1])
    write_manifest(tmp_path)
    assert sorted(verify_manifest(tmp_path)) == ["database/rows.json", "net.safetensors"]
    other = nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2))
    load_weights(tmp_path, "net", other)
    assert_same(dict(other.state_dict()), dict(net.state_dict()))
    with pytest.raises(CheckpointError, match="does not fit this module, .*: Missing key.* 1 more"):
        load_weights(tmp_path, "net", nn.Linear(3, 2))
    with pytest.raises(CheckpointError, match="other.safetensors is not listed"):
        load_weights(tmp_path, "other", net)
    save_weights(tmp_path, "net", nn.Linear(3, 2))
    with pytest.raises(CheckpointError, match="net.safetensors is"):
        load_weights(tmp_path, "net", nn.Linear(3, 2))
    (tmp_path / "database" / "rows.json").unlink()
    with pytest.raises(CheckpointError, match="rows.json is missing"):
        verify_manifest(tmp_path, ["database/rows.json"])


def test_state_digest():
    state = {"mean": torch.arange(4.0), "deviation": torch.ones(4)}
    digest = state_digest(state)
    assert digest == state_digest(dict(reversed(state.items())))
    assert digest == state_digest(nn.ParameterDict(state).state_dict())
    others = [
        {"mean": torch.arange(4.0)},
        {**state, "mean": torch.arange(4.0).view(2, 2)},
        {**state, "mean": torch.arange(4.0).double()},
        {**state, "mean": torch.arange(4.0) + 1e-6},
        {"deviation": state["mean"], "mean": state["deviation"]},
        {**state, "gamma": 0.99},
        {**state, "gamma": 0.98},
        {**state, "empty": torch.zeros(0, 3)},
        {**state, "scalar": torch.tensor(1.0, dtype=torch.bfloat16)},
        {**state, "scalar": torch.tensor(1 + 1j)},
    ]
    assert len({digest, *map(state_digest, others)}) == len(others) + 1


def test_write_atomic_keeps_the_old_file(tmp_path):
    path = tmp_path / "notes"
    write_atomic(path, "old")
    for n in range(1, 20):
        with pytest.MonkeyPatch.context() as monkeypatch:
            faults = Faults(monkeypatch, n, write=n % 2 == 1)
            try:
                write_atomic(path, "new")
            except OSError:
                pass
        assert path.read_text() in ("old", "new") and list(tmp_path.iterdir()) == [path]
        if not faults.fired:
            break
    assert path.read_text() == "new"


def test_staged_folder_never_overwrites(tmp_path):
    with pytest.raises(FileExistsError), staged_folder(tmp_path):
        pass
    with pytest.raises(ZeroDivisionError), staged_folder(tmp_path / "new") as stage:
        (stage / "half").touch()
        _ = 1 / 0
    assert list(tmp_path.iterdir()) == []


def test_network_drives_without_fsync_of_folders(tmp_path, monkeypatch):
    real = os.fsync

    def fsync(handle):
        if os.path.isdir(f"/proc/self/fd/{handle}"):
            raise OSError(errno.EINVAL, "Invalid argument")
        real(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    checkpointer = Checkpointer(tmp_path)
    assert checkpointer.save(1, box(1.0)) == checkpointer.latest()


def test_load_tensors_to_a_device(tmp_path):
    save_tensors(tmp_path / "w", {"w": torch.ones(2)})
    assert load_tensors(tmp_path / "w", "meta")["w"].is_meta
    with pytest.raises(FileNotFoundError):
        load_tensors(tmp_path / "none")
    with pytest.raises(TypeError, match="cannot hold"):
        save_tensors(tmp_path / "w", {"w": torch.zeros(2, dtype=torch.complex128)})
