import re
from html.parser import HTMLParser
from urllib.parse import unquote

import pytest
from lab_pages import CHROMIUM, FLAGS, PICTURES

from affordlib.book import BESIDE, MARKER, Book, main
from affordlib.paths import repo_root
from affordlib.profiles import notebook_paths

pytestmark = pytest.mark.slow
OUTSIDE = re.compile(r"^(?:https?:)?//")


class Tags(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("book") / "html"
    folder.mkdir()
    for name in (MARKER, "of_yesterday.html"):
        (folder / name).write_text("")
    Book().build(folder)
    return folder


@pytest.fixture(scope="module")
def pages(folder):
    return {path.name: Tags(path.read_text(encoding="utf-8")) for path in folder.glob("*.html")}


def test_every_notebook_has_a_page_and_nothing_else_is_left(folder, pages):
    notebooks = {f"{name}.html" for name in notebook_paths(repo_root() / "notebooks")}
    assert notebooks | {"index.html", *BESIDE.values()} == {*pages}
    assert [path.name for path in folder.parent.iterdir()] == ["html"]


def test_a_page_loads_nothing_from_elsewhere_and_runs_nothing(pages):
    for name, page in pages.items():
        for tag, attributes in page.found:
            assert tag not in {"script", "iframe"}, name
            if tag != "a":
                for key in ("src", "href"):
                    assert not OUTSIDE.match(attributes.get(key) or ""), (name, attributes)


def test_styles_load_nothing_from_elsewhere(folder):
    for path in [*folder.glob("*.html"), folder / "book.css"]:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"@import|url\(\s*['\"]?(?:https?:)?//", text), path.name


def test_every_link_and_picture_is_there(folder, pages):
    seen = 0
    for name, page in pages.items():
        for tag, attributes in page.found:
            link = attributes.get("href" if tag in {"a", "link"} else "src")
            if not link or re.match(r"(?:https?|mailto|data):|#", link):
                continue
            assert (folder / unquote(link.partition("#")[0])).is_file(), (name, link)
            seen += 1
    assert seen > 100


def test_one_can_walk_through_the_book(folder, pages):
    name, walked = "index.html", []
    while name:
        walked.append(name)
        ahead = [a["href"] for _, a in pages[name].found if a.get("rel") == "next"]
        (current,) = (a["href"] for _, a in pages[name].found if "aria-current" in a)
        assert current == name
        name = ahead[0] if ahead else None
    assert walked[0] == "index.html"
    assert sorted(walked) == sorted(pages)


def test_equations_are_drawn_and_none_is_left_as_tex(folder, pages):
    text = (folder / "03_affordance_cnp.html").read_text(encoding="utf-8")
    drawn = [a for tag, a in pages["03_affordance_cnp.html"].found if a.get("role") == "img"]
    assert sum("r_{mrg}" in a["aria-label"] for a in drawn) >= 2
    assert "<span>(4, 5)</span>" in text
    for name in pages:
        prose = re.findall(
            r'<div class="jp-RenderedHTMLCommon jp-RenderedMarkdown.*?</div>\s*</div>',
            (folder / name).read_text(encoding="utf-8"),
            re.S,
        )
        assert prose, name
        for piece in prose:
            assert not re.search(r"\$[^$<]*\\[a-z]+[^$<]*\$", piece), (name, piece[:200])


def test_a_link_to_nothing_is_refused():
    book = Book()
    with pytest.raises(FileNotFoundError, match=r"README\.md links to no/where\.md"):
        book.address(book.pages[0], "no/where.md")


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
def test_it_looks_right_in_a_browser_without_any_request_outside(folder):
    from playwright.sync_api import sync_playwright

    PICTURES.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": 1280, "height": 1000})
        asked, failed, said = [], [], []
        page.on("request", lambda request: asked.append(request.url))
        page.on("requestfailed", lambda request: failed.append(request.url))
        page.on("pageerror", lambda error: said.append(str(error)))
        for name in ("index", "00_start_here", "03_affordance_cnp"):
            page.goto((folder / f"{name}.html").as_uri())
            page.screenshot(path=PICTURES / f"book_{name}.png")
            images = page.locator("img").evaluate_all("all => all.map((i) => i.naturalWidth)")
            assert all(images), f"{name}: {images}"
            wide = page.evaluate("document.documentElement.scrollWidth - window.innerWidth")
            assert wide <= 0, f"{name} is {wide} pixels wider than the window"
        assert page.locator("svg").count() > 10  # the equations of 03
        page.set_viewport_size({"width": 400, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth") <= 400
        browser.close()
    assert (failed, said) == ([], [])
    assert {url.split(":")[0] for url in asked} <= {"file", "data"}


def test_a_folder_of_other_files_is_left_alone(tmp_path, capsys):
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="holds other files than a book"):
        Book().build(tmp_path)
    assert main([str(tmp_path)]) == 1
    assert "book: " in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["precious.txt"]
    assert (tmp_path / "precious.txt").read_text() == "mine"
