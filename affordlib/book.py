"""The book as web pages that need no network: every notebook, as it is committed, and the README.

    python -m affordlib.book runs/html

Equations become pictures (SVG) that carry their TeX as text; links between notebooks become links
between pages, and files that are linked to are copied along.
"""

from __future__ import annotations

import argparse
import logging
import os
import re
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

import nbformat
import ziamath
from jinja2 import pass_context
from nbconvert.exporters import HTMLExporter
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath

from affordlib.commands import command
from affordlib.paths import repo_root, resolve_out_dir
from affordlib.profiles import notebook_paths, read_notebook
from affordlib.results import write_text_atomically
from affordlib.workbook import WIDGET

BESIDE = {
    "RESULTS.md": "results.html",
    "data/README.md": "data.html",
    "CONTRIBUTING.md": "contributing.html",
    "THIRD_PARTY_NOTICES.md": "notices.html",
}
"""Pages besides the README and the notebooks."""

ziamath.config.svg2 = False  # paths alone: SVG 2 would name its glyphs, in every equation alike
TEMPLATES = Path(__file__).parent / "templates"
LINKED = "linked"
"""The folder of what pages link to; nbconvert takes "files/" away from links."""

MARKER = ".book"
"""A file by which a folder is known to be a book, and may be replaced."""

EQUATION_PX = 17


@dataclass(frozen=True)
class Page:
    """One page: its source, relative to the repository, its file in the book, and its title."""

    source: PurePosixPath
    html: str
    title: str
    notebook: nbformat.NotebookNode


class Book:
    """The pages in order; `build` writes them into a folder."""

    def __init__(self, root: Path | None = None) -> None:
        self.root = root or repo_root()
        self.pages = [self._from_markdown("README.md", "index.html")]
        for name, path in notebook_paths(self.root / "notebooks").items():
            notebook = read_notebook(path)
            source = PurePosixPath("notebooks") / path.name
            self.pages.append(Page(source, f"{name}.html", _title(notebook), notebook))
        self.pages += [self._from_markdown(source, html) for source, html in BESIDE.items()]
        self.htmls = {page.source: page.html for page in self.pages}
        self.linked: set[PurePosixPath] = set()

    def _from_markdown(self, source: str, html: str) -> Page:
        text = (self.root / source).read_text(encoding="utf-8")
        notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_markdown_cell(text)])
        return Page(PurePosixPath(source), html, _title(notebook), notebook)

    def build(self, folder: Path) -> None:
        """Write all pages, and the files they link to, into a folder, in place of an earlier book.

        Raises FileExistsError, and changes nothing, where the folder holds anything else.
        """
        if folder.exists() and not (folder / MARKER).is_file() and any(folder.iterdir()):
            raise FileExistsError(
                f"{folder} holds other files than a book; give a new folder, or empty this one"
            )
        making = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
        before = making.with_suffix(".before")
        making.mkdir(parents=True)
        try:
            write_text_atomically(making / MARKER, "")
            exporter = _Exporter(self)
            for page in self.pages:
                write_text_atomically(making / page.html, exporter.page(page))
            shutil.copy(TEMPLATES / "book" / "book.css", making / "book.css")
            for path in sorted(self.linked):
                target = making / LINKED / path
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(self.root / path, target)
            if folder.exists():
                folder.replace(before)
            making.replace(folder)
            shutil.rmtree(before, ignore_errors=True)
        finally:
            shutil.rmtree(making, ignore_errors=True)

    def address(self, page: Page, url: str) -> str:
        """Where a link of a page leads in the book."""
        path, hash_, anchor = url.partition("#")
        if not path or re.match(r"[a-z]+:", url):
            return url
        target = PurePosixPath(os.path.normpath(page.source.parent / path))
        if target in self.htmls:
            return self.htmls[target] + hash_ + anchor
        if not (self.root / target).is_file():
            raise FileNotFoundError(f"{page.source} links to {url}, which is no file of the book")
        self.linked.add(target)
        return f"{LINKED}/{target}"


class _Exporter(HTMLExporter):
    """nbconvert's pages in our template, with equations, links of the book, and no scripts."""

    def __init__(self, book: Book) -> None:
        log = logging.getLogger(__name__)
        log.setLevel(logging.ERROR)  # figures have no alternative text; the prose tells of them
        super().__init__(template_name="book", extra_template_basedirs=[str(TEMPLATES)], log=log)
        self.book, self.here = book, book.pages[0]

    def page(self, page: Page) -> str:
        self.here = page
        pages, at = self.book.pages, self.book.pages.index(page)
        around = {
            "pages": pages,
            "here": page,
            "before": pages[at - 1] if at else None,
            "after": pages[at + 1] if at + 1 < len(pages) else None,
        }
        notebook = nbformat.from_dict(page.notebook)
        notebook.metadata["title"] = page.title
        for cell in notebook.cells:
            for output in cell.get("outputs", []):
                output.get("data", {}).pop(WIDGET, None)  # without a kernel, its picture
        return self.from_notebook_node(notebook, {"book": around})[0]

    @pass_context
    def markdown2html(self, context: object, source: str) -> str:
        """Markdown as HTML, equations and links as the book has them."""
        return MarkdownWithMath(renderer=_Renderer(self.book, self.here)).render(source)


class _Renderer(IPythonRenderer):
    def __init__(self, book: Book, page: Page) -> None:
        super().__init__(escape=False, anchor_link_text="", exclude_anchor_links=True)
        self.book, self.page = book, page

    def link(self, text: str, url: str, title: str | None = None) -> str:
        return super().link(text, self.book.address(self.page, url), title)

    def image(self, text: str, url: str, title: str | None = None) -> str:
        return super().image(text, self.book.address(self.page, url), title)

    def inline_math(self, body: str) -> str:
        return _equation(body, inline=True)

    def block_math(self, body: str) -> str:
        tag = re.search(r"\\tag\{([^}]*)\}", body)
        body = body.replace(tag[0], "") if tag else body
        number = f"<span>({tag[1]})</span>" if tag else ""
        return f'<div class="book-equation">{_equation(body.strip())}{number}</div>'


def _equation(tex: str, inline: bool = False) -> str:
    """An equation as SVG in units of the text around it, standing on its line."""
    drawn = ziamath.Latex(tex, size=EQUATION_PX, inline=inline)
    svg = drawn.svgxml()
    below = float(svg.get("viewBox").split()[1]) + float(svg.get("height"))
    for name in ("width", "height"):
        svg.set(name, f"{float(svg.get(name)) / EQUATION_PX:.3f}em")
    svg.set("style", f"vertical-align: {-below / EQUATION_PX:.3f}em")
    svg.set("fill", "currentColor")
    svg.set("role", "img")
    svg.set("aria-label", tex)
    return ElementTree.tostring(svg, encoding="unicode")


def _title(notebook: nbformat.NotebookNode) -> str:
    return notebook.cells[0].source.splitlines()[0].lstrip("# ").strip()


@command(OSError)
def main(argv: list[str] | None = None) -> int:
    """Write the book as web pages."""
    parser = argparse.ArgumentParser(prog="python -m affordlib.book", description=main.__doc__)
    parser.add_argument("folder", nargs="?", default="runs/html", help="default: runs/html")
    folder = resolve_out_dir(parser.parse_args(argv).folder)
    Book().build(folder)
    print(f"The book begins at {os.path.relpath(folder / 'index.html')}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
