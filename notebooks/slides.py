"""Ten figures of the book with their captions, for those who teach: `make slides`.

They are taken from the committed pages, and written to `figures/slides` with an index.
"""

import base64
import json
import re

from pages import PAGES, ROOT

FIGURES = ("0.4", "1.3", "3.1", "3.2", "4.5", "5.2", "6.1", "6.4", "6.7", "10.2")
FOLDER = ROOT / "figures" / "slides"


def figures() -> dict[str, tuple[bytes, str]]:
    """Return picture (PNG) and caption of each figure, by its number."""
    found, picture = {}, None
    for path in PAGES.values():
        for cell in json.loads(path.read_text("utf-8"))["cells"]:
            for output in cell.get("outputs", []):
                picture = output.get("data", {}).get("image/png", picture)
            for caption in re.findall(r"^\*\*Figure .*$", "".join(cell["source"]), re.MULTILINE):
                number = caption.split("Figure ")[1].partition("*")[0].rstrip(".")
                found[number] = base64.b64decode("".join(picture)), caption
    return {number: found[number] for number in FIGURES}


def main() -> None:
    """Write the pictures, and an index with the captions."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    lines = ["# Ten figures, with captions"]
    for number, (picture, caption) in figures().items():
        (FOLDER / f"figure_{number}.png").write_bytes(picture)
        lines += [f"![Figure {number}](figure_{number}.png)", caption]
    (FOLDER / "README.md").write_text("\n\n".join(lines) + "\n", "utf-8")
    print(f"{len(FIGURES)} figures: {FOLDER.relative_to(ROOT)}/README.md")


if __name__ == "__main__":
    main()
