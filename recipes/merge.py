"""Makes one table of the runs of a sweep: seeds of a task are taken together.

python recipes/merge.py outputs/pointmaze-umaze/*
python recipes/merge.py outputs/*/*
"""

from __future__ import annotations

import argparse
import sys

from torchrl_rad.checkpoint import CheckpointError
from torchrl_rad.results import format_table, merge_sweep


def main() -> None:
    """Reads the command line; errors that a user can mend end in one line."""
    parser = argparse.ArgumentParser(description="One table of several runs.")
    parser.add_argument("folders", nargs="+", help="run folders")
    try:
        rows, failed = merge_sweep(parser.parse_args().folders)
    except CheckpointError as error:
        sys.exit(f"error: {error}")
    if rows:
        print(format_table(rows))
    if failed:
        lines = (f"  {folder}: {why}" for folder, why in failed.items())
        count = f"{len(failed)} run has" if len(failed) == 1 else f"{len(failed)} runs have"
        sys.exit("\n".join([f"{count} no results (go on with resume=<folder>):", *lines]))


if __name__ == "__main__":
    main()
