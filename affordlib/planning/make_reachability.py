"""`python -m affordlib.planning.make_reachability`: learn the shipped reachability again."""

from __future__ import annotations

import sys

from affordlib.interactions import open_interactions
from affordlib.paths import repo_root
from affordlib.planning.reachability import SHIPPED, learn_reachability


def main() -> int:
    """Learn from the shipped set `reach` and replace the shipped weights."""
    learn_reachability(open_interactions("reach")).save(repo_root() / SHIPPED)
    print(SHIPPED)
    return 0


if __name__ == "__main__":
    sys.exit(main())
