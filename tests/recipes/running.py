"""Recipes as a user runs them, in this process or in one of their own."""

from __future__ import annotations

import io
import logging
import runpy
import subprocess
import sys
import warnings
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest import mock

import torch

RECIPES = Path(__file__).parents[2] / "recipes"
STEPS, SAVE = 24, 4
SMALL = (
    "threads=1",
    f"optim.gradient_steps={STEPS}",
    "network.width=32",
    "network.heads=2",
    "network.blocks=1",
    "network.step_width=32",
    "network.steps=1",
    "logger.log_interval=1",
    f"logger.save_interval={SAVE}",
    "logger.progress=false",
    "evaluation.episodes=2",
    "replay_buffer.batch_size=16",
    "replay_buffer.steps=3000",
    # the paper's rule may keep none of so few episodes
    "retrieval.paper.expert={rule: reaches_goal, args: []}",
)
POLICIES = ("backbone", "paper", "followed")


def call(name, *arguments):
    """Runs a recipe in this process: its exit code, what it prints and what it says of errors."""
    out, err = io.StringIO(), io.StringIO()
    threads, loggers = torch.get_num_threads(), [logging.getLogger(), logging.getLogger("torchrl")]
    before = [(logger, logger.level, logger.handlers[:]) for logger in loggers]
    try:
        with (
            warnings.catch_warnings(),
            mock.patch.object(sys, "argv", [str(RECIPES / name), *arguments]),
            redirect_stdout(out),
            redirect_stderr(err),
        ):
            runpy.run_path(str(RECIPES / name), run_name="__main__")
        code = 0
    except SystemExit as stop:
        code = stop.code
        if isinstance(code, str):  # as the interpreter does
            err.write(f"{code}\n")
            code = 1
    finally:
        torch.set_num_threads(threads)
        for logger, level, handlers in before:  # hydra and the recipe set them up
            logger.setLevel(level)
            logger.handlers[:] = handlers
    return code, out.getvalue(), err.getvalue()


def start(*arguments):
    """Runs the recipe in a process of its own."""
    command = [sys.executable, str(RECIPES / "dl_rad.py"), *arguments]
    return subprocess.Popen(
        command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=Path.cwd()
    )
