"""Files in OGBench's layout."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_rad.data import data_report
from torchrl_rad.data.ogbench import load_ogbench


@pytest.fixture
def path(tmp_path):
    return tmp_path / "antmaze-medium-stitch-v0.npz"


def antmaze(lengths=(4, 3, 2), **changes):
    """Trajectories of these numbers of rows."""
    rng, count = np.random.default_rng(0), sum(lengths)
    qpos, qvel = rng.normal(size=(count, 15)), rng.normal(size=(count, 14))
    last = np.zeros(count, bool)
    last[np.cumsum(lengths) - 1] = True
    arrays = {
        "observations": np.concatenate([qpos, qvel], -1).astype(np.float32),
        "actions": rng.uniform(-1, 1, (count, 8)).astype(np.float32),
        "terminals": last,
        "qpos": qpos.astype(np.float32),
        "qvel": qvel.astype(np.float32),
    }
    return {key: value for key, value in {**arrays, **changes}.items() if value is not None}


def test_values(path):
    arrays = antmaze()
    np.savez_compressed(path, **arrays)
    td = load_ogbench(path, infos=("qpos", "qvel"))
    now, following = [0, 1, 2, 4, 5, 7], [1, 2, 3, 5, 6, 8]
    assert data_report(td).ok
    assert td["episode"].tolist() == [0, 0, 0, 1, 1, 2]
    np.testing.assert_array_equal(td["observation"], arrays["observations"][now])
    np.testing.assert_array_equal(td["action"], arrays["actions"][now])
    np.testing.assert_array_equal(td["next", "observation"], arrays["observations"][following])
    np.testing.assert_array_equal(td["info", "qpos"], arrays["qpos"][now])
    np.testing.assert_array_equal(td["info", "qvel"], arrays["qvel"][now])
    assert td["next", "truncated"].flatten().tolist() == [False, False, True, False, True, True]
    assert torch.equal(td["next", "done"], td["next", "truncated"])
    assert not td["next", "terminated"].any() and not td["next", "reward"].any()


def test_agrees_with_ogbench(path):
    ogbench = pytest.importorskip("ogbench")
    np.savez_compressed(path, **antmaze())
    np.savez_compressed(path.with_name(f"{path.stem}-val.npz"), **antmaze((3,)))
    train, validation = ogbench.make_env_and_datasets(
        path.stem, dataset_path=str(path), dataset_only=True
    )
    td = load_ogbench(path)
    np.testing.assert_array_equal(td["observation"], train["observations"])
    np.testing.assert_array_equal(td["action"], train["actions"])
    np.testing.assert_array_equal(td["next", "observation"], train["next_observations"])
    np.testing.assert_array_equal(td["next", "done"].squeeze(-1), train["terminals"] == 1)
    assert len(load_ogbench(path.with_name(f"{path.stem}-val.npz"))) == len(validation["actions"])


def test_missing_arrays(path):
    np.savez(path, **antmaze(terminals=None))
    with pytest.raises(KeyError, match="lacks .'terminals'.; it has .'actions'"):
        load_ogbench(path)
    np.savez(path, **antmaze(qpos=None))
    assert len(load_ogbench(path)) == 6
    with pytest.raises(KeyError, match="qpos"):
        load_ogbench(path, infos=("qpos",))


def test_objects_are_not_read(path):
    np.savez(path, **antmaze(actions=np.array([{"run": "this"}] * 9, dtype=object)))
    with pytest.raises(TypeError, match="'actions' holds Python objects"):
        load_ogbench(path)


def test_lengths_that_differ(path):
    arrays = antmaze()
    np.savez(path, **{**arrays, "actions": arrays["actions"][:8]})
    with pytest.raises(ValueError, match="'actions' has 8 rows where the observations have 9"):
        load_ogbench(path)


def test_last_trajectory_without_an_end(path):
    np.savez(path, **{key: value[:-1] for key, value in antmaze().items()})
    with pytest.raises(ValueError, match="the last trajectory has no end"):
        load_ogbench(path)


@pytest.mark.parametrize("lengths", [(1, 3), (3, 1), (2, 1, 3)])
def test_trajectory_of_one_row(path, lengths):
    np.savez(path, **antmaze(lengths))
    row = np.cumsum(lengths)[lengths.index(1)] - 1
    with pytest.raises(ValueError, match=f"ends in row {row} has 1 row"):
        load_ogbench(path)


@pytest.mark.parametrize("entry", ["observations", "actions", "qvel"])
def test_not_finite_is_named(path, entry):
    arrays = antmaze()
    arrays[entry][5, 0] = np.nan
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match="NaN or Inf .* episode 1 step 1"):
        load_ogbench(path, infos=("qvel",))


def test_an_action_that_was_never_taken_does_not_matter(path):
    arrays = antmaze()
    arrays["actions"][3] = np.nan
    np.savez(path, **arrays)
    assert len(load_ogbench(path)) == 6


def test_no_file(path):
    with pytest.raises(FileNotFoundError, match="there is no file"):
        load_ogbench(path)


def test_not_an_npz_file(path):
    path.write_bytes(b"<html>not found</html>")
    with pytest.raises(ValueError, match="is no whole npz file"):
        load_ogbench(path)


def test_cut_and_damaged_files(path):
    np.savez_compressed(path, **antmaze((300, 200)))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="is no whole npz file"):
        load_ogbench(path)
    damaged = bytearray(whole)
    damaged[2000:3000] = bytes(1000)
    path.write_bytes(damaged)
    with pytest.raises(ValueError, match="'observations' is damaged"):
        load_ogbench(path)
