"""The data of a PointMaze task: collected here, or a Minari data set, in one form."""

from __future__ import annotations

from tensordict import TensorDictBase

from torchrl_rad.data.minari import join_stream, load_minari
from torchrl_rad.data.pointmaze import pointmaze_dataset
from torchrl_rad.envs.maze import FixedGoalMaze, MazeTask, relabel_goal

__all__ = ["maze_dataset"]


def maze_dataset(
    task: MazeTask,
    dataset: str = "collected",
    steps: int = 300_000,
    seed: int = 0,
    download: bool = True,
    progress: bool = True,
) -> TensorDictBase:
    """Recorded steps of a maze with the rewards of the task's fixed goal (D4RL's Maze2D protocol).

    Args:
        task (MazeTask): the protocol.
        dataset (str, optional): ``"collected"``: by the library itself, cached; otherwise a Minari
            id such as ``"D4RL/pointmaze/umaze-v2"``, whose episodes are joined to the recorded
            stream and cut anew at the task's time limit. Defaults to ``"collected"``.
        steps, seed (int, optional): of the collection. Default to ``300_000`` and ``0``.
        download (bool, optional): fetch a Minari set that is not here. Defaults to ``True``.
        progress (bool, optional): show a progress bar. Defaults to ``True``.

    Returns:
        Flat TensorDict [T] with ``observation`` [T, 4], ``action`` [T, 2], ``episode`` [T] and
        ``("next", ...)``, as of :func:`load_minari`.

    Raises:
        FileNotFoundError: the Minari set is not here and cannot be fetched.
        ValueError: the data set is of another environment: its states or actions have other widths.

    Examples:
        >>> import tempfile, os
        >>> from unittest import mock
        >>> from torchrl_rad import maze_task
        >>> with mock.patch.dict(os.environ, TORCHRL_RAD_CACHE=tempfile.mkdtemp()):
        ...     maze_dataset(maze_task("umaze"), steps=300, progress=False).shape
        torch.Size([300])
    """
    if dataset == "collected":
        return pointmaze_dataset(task.name, steps, seed, progress=progress)
    data = load_minari(dataset, download=download, progress=progress)
    widths = data["observation"].shape[-1], data["action"].shape[-1]
    if widths != (4, 2):
        raise ValueError(
            f"{dataset!r} has states and actions of widths {widths}; {task.env_id} has (4, 2). "
            "Name a data set of this maze, such as 'D4RL/pointmaze/umaze-v2'."
        )
    env = FixedGoalMaze(task)
    data = relabel_goal(join_stream(data, task.max_steps), env.goal)
    env.close()
    return data
