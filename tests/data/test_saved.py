"""Saving and opening an expert database."""

import json
import os
import shutil

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyMemmapStorage, LazyTensorStorage

from torchrl_rad._files import CheckpointError, write_manifest
from torchrl_rad.data import ExpertDatabase, episode_length, reaches_goal, saved
from torchrl_rad.retrieval import RetrievalSampler


def make_steps(rewards):
    reward = torch.tensor([r for episode in rewards for r in episode], dtype=torch.float32)
    done = torch.cat([torch.arange(len(e)) == len(e) - 1 for e in rewards])
    generator = torch.Generator().manual_seed(len(reward))
    return TensorDict(
        {
            "observation": torch.randn(len(reward), 3, generator=generator),
            "pixels": torch.randint(0, 255, (len(reward), 2, 2), dtype=torch.uint8),
            "next": {"reward": reward[:, None], "done": done[:, None], "info": {"x": reward * 2}},
        },
        [len(reward)],
    )


def make_database(storage=LazyTensorStorage, expert=None):
    sampler = RetrievalSampler("euclidean", dims=[0, 2], k=3, threshold=0.1, normalize=True)
    database = ExpertDatabase(storage(50), gamma=0.9, expert=expert, sampler=sampler)
    database.extend(make_steps([[0, 0, 1], [1, 0]]))
    return database


@pytest.fixture
def folder(tmp_path):
    make_database().dumps(tmp_path / "db")
    return tmp_path / "db"


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
@pytest.mark.parametrize("memmap", [False, True])
def test_round_trip(tmp_path, storage, memmap):
    database = make_database(storage, expert=reaches_goal() & ~episode_length(9))
    database.dumps(tmp_path / "db")
    other = ExpertDatabase.loads(tmp_path / "db", memmap=memmap)
    assert other.digest() == database.digest()
    assert (other[:] == database[:]).all()
    assert other.gamma == 0.9 and other.sampler.config == database.sampler.config
    assert repr(other.expert) == repr(database.expert)
    query = torch.randn(4, 3, generator=torch.Generator().manual_seed(1))
    assert (other.retrieve(query) == database.retrieve(query)).all()
    if not memmap:
        assert type(other.storage) is storage and other.storage.max_size == 50
        assert other.extend(make_steps([[1, 1]])).tolist() == [5, 6]
        assert other[:]["episode"].tolist() == [0, 0, 0, 1, 1, 2, 2]


@pytest.mark.parametrize("name", ["a b", "umlaut-ü", "deep/er/still", ".hidden", "dot.ted"])
def test_odd_paths(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    database = make_database()
    database.dumps(name)  # relative
    assert database.path == tmp_path / name
    monkeypatch.chdir("/")
    assert ExpertDatabase.loads(str(tmp_path / name)).digest() == database.digest()
    assert len([p for p in (tmp_path / name).parent.iterdir() if p.name.startswith(".tmp")]) == 0


def test_nested_state_key(tmp_path):
    sampler = RetrievalSampler("euclidean", k=1, threshold=0.0, key=("agent", "state"))
    database = ExpertDatabase(LazyTensorStorage(5), sampler=sampler)
    steps = make_steps([[0, 1]])
    database.extend(steps.rename_key_("observation", ("agent", "state")))
    database.dumps(tmp_path / "db")
    other = ExpertDatabase.loads(tmp_path / "db")
    assert other.sampler.key == ("agent", "state") and other.digest() == database.digest()
    assert other.retrieve(steps["agent", "state"])["index"].tolist() == [[0], [1]]


def test_keyword_arguments_are_passed_on(folder):
    assert ExpertDatabase.loads(folder, batch_size=4).sample().batch_size == (4,)


def test_empty_folder_is_used(tmp_path):
    make_database().dumps(tmp_path)
    assert len(ExpertDatabase.loads(tmp_path)) == 5


def test_saved_again(folder):
    database = ExpertDatabase.loads(folder)
    database.extend(make_steps([[5]]))
    database.dumps(folder)
    assert len(ExpertDatabase.loads(folder)) == 6
    assert [p.name for p in folder.parent.iterdir()] == ["db"]


def test_saved_over_the_rows_that_it_maps(folder):
    database = ExpertDatabase.loads(folder, memmap=True)
    digest = database.digest()
    database.dumps(folder)
    assert database.digest() == digest == ExpertDatabase.loads(folder).digest()


def test_opened_rows_outlive_a_replacement(folder):
    mapped = ExpertDatabase.loads(folder, memmap=True)
    digest = mapped.digest()
    other = ExpertDatabase(LazyTensorStorage(5))
    other.extend(make_steps([[9, 9]]))
    other.dumps(folder)
    assert mapped.digest() == digest


def test_changing_a_copy_leaves_the_folder_alone(folder):
    database = ExpertDatabase.loads(folder)
    database[:]["observation"].zero_()
    assert ExpertDatabase.loads(folder)[:]["observation"].abs().sum() > 0


# refusals when saving


def test_empty_database(tmp_path):
    with pytest.raises(RuntimeError, match="empty: extend it with episodes before saving"):
        ExpertDatabase(LazyTensorStorage(5)).dumps(tmp_path / "db")
    assert not (tmp_path / "db").exists()


def test_a_folder_with_other_content_is_kept(tmp_path):
    (tmp_path / "thesis.tex").write_text("years")
    with pytest.raises(FileExistsError, match="other content"):
        make_database().dumps(tmp_path)
    with pytest.raises(FileExistsError, match="other content"):
        make_database().dumps(tmp_path / "thesis.tex")
    assert (tmp_path / "thesis.tex").read_text() == "years"


def test_failure_keeps_the_old_one(folder, monkeypatch):
    digest = ExpertDatabase.loads(folder).digest()
    database = ExpertDatabase.loads(folder)
    database.extend(make_steps([[1]]))
    before = database.path, database._saved

    def fail(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("torchrl_rad.data.saving.write_json", fail)
    with pytest.raises(OSError, match="No space left"):
        database.dumps(folder)
    assert ExpertDatabase.loads(folder).digest() == digest
    assert [p.name for p in folder.parent.iterdir()] == ["db"]
    assert (database.path, database._saved) == before


def test_full_disk_is_noticed_before_writing(folder, monkeypatch):
    usage = shutil.disk_usage(folder)._replace(free=10)
    monkeypatch.setattr(saved.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(OSError, match=r"needs \d+ bytes, the disk has 10 left"):
        make_database().dumps(folder)
    assert [p.name for p in folder.parent.iterdir()] == ["db"]
    monkeypatch.undo()
    assert len(ExpertDatabase.loads(folder)) == 5


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_unwritable_parent(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(PermissionError):
        make_database().dumps(tmp_path / "db")


# damaged folders


def files(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def test_what_a_folder_holds(folder):
    names = files(folder)
    assert {"database.json", "manifest.json", "rows/meta.json"} <= set(names)
    assert "rows/observation.memmap" in names and "rows/next/info/x.memmap" in names


def test_no_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no database: database.json is missing"):
        ExpertDatabase.loads(tmp_path / "nothing")


@pytest.mark.parametrize("memmap", [False, True])
def test_every_file_missing_or_cut(folder, memmap):
    for name in files(folder):
        path, content = folder / name, (folder / name).read_bytes()
        path.unlink()
        missing = FileNotFoundError if name == "database.json" else CheckpointError
        with pytest.raises(missing, match="missing"):
            ExpertDatabase.loads(folder, memmap=memmap)
        path.write_bytes(content[: len(content) // 2])
        with pytest.raises(CheckpointError, match="damaged|cut short"):
            ExpertDatabase.loads(folder, memmap=memmap)
        path.write_bytes(content)
    assert len(ExpertDatabase.loads(folder, memmap=memmap)) == 5


def test_every_file_with_a_wrong_byte(folder):
    for name in files(folder):
        path, content = folder / name, bytearray((folder / name).read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match="damaged"):
            ExpertDatabase.loads(folder)
        content[len(content) // 2] ^= 1
        path.write_bytes(content)


def test_memory_mapped_settings_and_layout_are_verified(folder):
    for name in ("database.json", "rows/meta.json"):
        content = (folder / name).read_text()
        (folder / name).write_text(content.replace("5", "4"))  # rows and capacity hold a 5
        with pytest.raises(CheckpointError, match="damaged"):
            ExpertDatabase.loads(folder, memmap=True)
        (folder / name).write_text(content)


def test_format_of_another_version(folder):
    config = json.loads((folder / "database.json").read_text())
    (folder / "database.json").write_text(json.dumps({**config, "format": 99}))
    write_manifest(folder)
    with pytest.raises(CheckpointError, match="has format 99, this version reads 1"):
        ExpertDatabase.loads(folder)


# a rule that cannot be saved


def short(episode):
    return len(episode) < 3


def test_plain_function_has_to_be_passed_again(tmp_path):
    database = make_database(expert=short)
    database.dumps(tmp_path / "db")
    other = ExpertDatabase.loads(tmp_path / "db")
    assert len(other) == 2 and other.digest() == database.digest()
    with pytest.raises(ValueError, match=r"'short' is a plain function.*loads\(path, expert=...\)"):
        other.extend(make_steps([[1]]))
    again = ExpertDatabase.loads(tmp_path / "db", expert=short)
    again.extend(make_steps([[1, 1, 1, 1], [1]]))
    assert len(again) == 3


if __name__ == "__main__":
    pytest.main([__file__])
