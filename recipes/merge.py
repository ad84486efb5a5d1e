"""Makes one table of several runs of a task, one seed each.

python recipes/merge.py outputs/pointmaze-umaze/*
"""

from __future__ import annotations

import argparse
import sys

from torchrl_rad.checkpoint import CheckpointError
from torchrl_rad.results import format_table, merge_results


def main() -> None:
    """Reads the command line; errors that a user can mend end in one line."""
    parser = argparse.ArgumentParser(description="One table of several runs of a task.")
    parser.add_argument("folders", nargs="+", help="run folders with a results.json")
    try:
        print(format_table(merge_results(parser.parse_args().folders)))
    except CheckpointError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
