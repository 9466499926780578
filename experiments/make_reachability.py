"""`python -m experiments.make_reachability`: learn the shipped reachability again."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from affordlib.commands import command
from affordlib.interactions import open_interactions
from affordlib.paths import repo_root
from affordlib.planning.reachability import SHIPPED, learn_reachability


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Learn from the shipped set `reach` and replace the shipped weights."""
    argparse.ArgumentParser(description=main.__doc__).parse_args(argv)
    learn_reachability(open_interactions("reach")).save(repo_root() / SHIPPED)
    print(SHIPPED)
    return 0


if __name__ == "__main__":
    sys.exit(main())
