"""Count the lines of package, experiments and tests, and check them against their budgets.

python -m tests.size
"""

import ast
import io
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LINES = {"affordlib": 11787, "experiments": 6332, "tests": 7782}
"""Maximum number of lines: lower it with every cut. The aim is 9,650, 6,000 and 7,800."""

FILES, CODE = 60, 7493
"""Maxima for affordlib: files, and lines of Python that are code. The aim is 6,700 of these."""

NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
NO_CODE |= {tokenize.ENDMARKER}


def code_lines(text: str) -> int:
    """Lines of Python that are no docstring, comment or blank."""
    lines, docstrings = set(), set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            docstrings.update(range(node.lineno, node.end_lineno + 1))
    return len(lines - docstrings)


def main() -> int:
    """Count, and say what is above its budget."""
    over = []
    for folder, most in LINES.items():
        files = [p for p in (ROOT / folder).rglob("*") if p.suffix in (".py", ".js", ".css")]
        texts = [path.read_text() for path in files if path.suffix == ".py"]
        n, code = sum(p.read_text().count("\n") for p in files), sum(map(code_lines, texts))
        print(f"{folder:12} {n:6} lines in {len(files):3} files, {code:6} of code")
        over += [f"{folder} has more than {most} lines"] * (n > most)
        if folder == "affordlib":
            over += [f"{folder} has more than {FILES} files"] * (len(files) > FILES)
            over += [f"{folder} has more than {CODE} lines of code"] * (code > CODE)
    print("\n".join(over), file=sys.stderr)
    return bool(over)


if __name__ == "__main__":
    sys.exit(main())
