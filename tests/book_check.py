"""Measure length and readability of each page of the book, and check its style.

python -m tests.book_check
"""

import base64
import re
import struct
import sys
from pathlib import Path

import nbformat
from pages import PAGES

from affordlib.results import repo_root

ROOT = repo_root()
TEXTS = {"README.md": 650, "RESULTS.md": 2300, "CONTRIBUTING.md": 2000, "data/README.md": 2000}
TEXTS |= {"notebooks/cheat_sheet.md": 500}
"""Pages of text, and their maximum number of words."""

LIMITS = {"minutes": 60, "words": 2000, "cells": 40, "tables": 3, "rows": 8}
LIMITS |= {"code": 30, "px": 900, "no alt": 0, "numbers": 0, "paragraph": 3}

PRIVATE = re.compile(
    r"\b(fores(ee\w*|aw)|promised|courses?|told|err(s|ed)|guess(es)?|yardsticks?|off by|wary|eyes?"
    r"|running mean|to the letter|literal(ly)?|fed back|broken off|cut off|nudged|touch(y|iness)"
    r"|sure(r|st)|anew|mend(s|ed)?|dearer|besides|by (it|them)sel(f|ves)|temperature|ask(s|ed|ing)?"
    r"|things?|famil(y|ies)|pursuits?|(turned|mirrored) copies|frame of the push|forecasters?)\b",
    re.IGNORECASE,
)
"""Words to replace by the field's terms; where one is meant as a name, write it as `code`."""

ABBREVIATION = re.compile(r"\b(CNP|LSTM|CNN|NLL|CKA|CRPS|AUC|ROC|EMA|MLP|FiLM|sem|TP|TN|PCA|MSE)\b")

NAME = r"^\*\*Figure.*|\[[^\]]*\]\([^)]*\)|\*\*\w\d\.\d|^\d\. |\(\d\)|\d-D|\d[σπ]|\d+ % interval"
NAME += r"|\b(19|20)\d\d\b|(?<![\d.,])0\d\b|\b([Nn]otebook|page|Figure|Table|Section)s? \d+(\.\d+)*"
NUMBER = r"(?<![\w./^–])\d+(?:[.,/]\d+)*(?: ?(?:%|°|[cm]?m\b|s\b))?"
NUMBER += rf"(?: ?(?:to|or|and|×|±|of|of the) ?−?{NUMBER})*"
"""What has digits but is no number, and a number: a range, a share or a pair counts as one."""


def prose(text: str) -> str:
    """The text of a Markdown page without code, equations, tables, pictures and comments."""
    text = re.sub(r"```.*?```|\$\$.*?\$\$|<!--.*?-->", " ", text, flags=re.DOTALL)
    text = re.sub(r"^\|.*$|!\[[^]]*\]\([^)]*\)", " ", text, flags=re.MULTILINE)
    return re.sub(r"`[^`]*`|\$[^$]*\$|\]\([^)]*\)", " ", text)


def count_words(text: str) -> int:
    return len(re.findall(r"\w[\w'’-]*", prose(text)))


def numbers_in(between: str, text: str) -> list[int]:
    """Count the numbers in each part of a text; between: what separates the parts."""
    parts = re.split(between, prose(re.sub(NAME, "", text, flags=re.MULTILINE)))
    return [len(re.findall(NUMBER, part)) for part in parts]


def markdown(notebook: nbformat.NotebookNode) -> str:
    return "\n\n".join(c.source for c in notebook.cells if c.cell_type == "markdown")


def measure(notebook: nbformat.NotebookNode) -> dict[str, int]:
    """Measure what a reader sees of a page: folded parts do not count."""
    text = re.sub("<details>.*?</details>", "", markdown(notebook), flags=re.DOTALL)
    code = [c for c in notebook.cells if c.cell_type == "code"]
    shown = [c.source for c in code if "hide-input" not in c.metadata.get("tags", [])]
    lines = [sum(bool(line.strip()) for line in source.splitlines()) for source in shown]
    rows = [t.count("\n") - 2 for t in re.findall(r"(?:^\|.*\n)+", text + "\n", re.MULTILINE)]
    widths, no_alt = [], 0
    for output in (o for cell in code for o in cell.outputs):
        data = output.get("data", {})
        if "<table" in data.get("text/html", ""):
            rows.append(data["text/html"].count("<tr") - 1)
        for kind in ("image/png", "image/svg+xml"):
            if picture := data.get(kind):
                about = output.metadata.get(kind, {})
                if kind == "image/png":
                    (width,) = struct.unpack(">I", base64.b64decode(picture[:64])[16:20])
                else:
                    width = int(re.search(r'width="(\d+)', picture)[1])
                widths.append(about.get("width", width))
                no_alt += not about.get("alt")
    words = count_words(text)
    return {
        "minutes": round(words / 150 + sum(lines) / 10 + len(widths)),
        "words": words,
        "cells": len(notebook.cells),
        "tables": len(rows),
        "rows": max(rows, default=0),
        "code": max(lines, default=0),
        "figures": len(widths),
        "px": max(widths, default=0),
        "no alt": no_alt,
        "numbers": sum(n > 1 for n in numbers_in(r"[.!?:;][*)]*\s|\n", text)),
        "paragraph": max(numbers_in(r"\n\s*\n|\n- ", text)),
    }


def anchors(path: Path) -> set[str]:
    """Anchors that links to a page may use after #, as JupyterLab or GitHub names its headings."""
    if path.suffix == ".ipynb":
        heads = re.findall(r"^#+ (.+)$", markdown(nbformat.read(path, 4)), re.MULTILINE)
        return {head.replace(" ", "-") for head in heads}
    heads = re.findall(r"^#+ (.+)$", path.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads}


def faults(path: Path, text: str) -> list[str]:
    """List dead links, private words and unexpanded abbreviations in a page's text."""
    wrong = [
        f"{match.group()!r} is not a word of the field" for match in PRIVATE.finditer(prose(text))
    ]
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        target, _, anchor = link.partition("#")
        to = path.parent / target if target else path
        if "://" not in link and not (to.exists() and (not anchor or anchor in anchors(to))):
            wrong.append(f"the link {link} is dead")
    for short in sorted(set(ABBREVIATION.findall(prose(text)))):
        if not re.search(rf"\([^)\w]*{short}\b|\b{short}\W{{0,4}}[:(]", text):
            wrong.append(f"{short} is not expanded")
    return wrong


def check() -> tuple[dict[str, dict[str, int]], list[str]]:
    """Measure every page and list the faults."""
    measures, wrong = {}, []
    for name, path in PAGES.items():
        notebook = nbformat.read(path, as_version=4)
        found = measures[name] = measure(notebook)
        most = LIMITS
        if name[0] == "A":  # an appendix may be long
            most = {k: most[k] for k in ("code", "px", "no alt", "numbers", "paragraph")}
        wrong += [f"{name}: {found[k]} {k}, at most {n}" for k, n in most.items() if found[k] > n]
        wrong += [f"{name}: cell {c.id} is empty" for c in notebook.cells if not c.source.strip()]
        wrong += [f"{name}: {fault}" for fault in faults(path, markdown(notebook))]
    for name, most_words in TEXTS.items():
        text = (ROOT / name).read_text()
        measures[name] = {"words": count_words(text)}
        if count_words(text) > most_words:
            wrong.append(f"{name}: {count_words(text)} words, at most {most_words}")
        wrong += [f"{name}: {fault}" for fault in faults(ROOT / name, text)]
    return measures, wrong


def main() -> int:
    """Print the measures and the faults."""
    measures, wrong = check()
    names = list(measures["00_start_here"])
    print(f"{'':22}", *(f"{name:>8}" for name in names))
    for page, found in measures.items():
        print(f"{page:22}", *(f"{found.get(name, '–'):>8}" for name in names))
    print("\n".join(wrong), file=sys.stderr)
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
