"""Make the page on which a reader plans without a kernel: `python -m experiments.try_it`.

The page holds everything that it needs, and opens by a double-click. Objects, their effect maps and
the arm's reachability come from the package; planning and drawing are `affordlib/show/table.js`.
"""

import json
from pathlib import Path

from affordlib import show
from affordlib.planning import Skills
from affordlib.results import repo_root, write_atomically
from affordlib.show.table_data import object_data, table_data
from affordlib.world import Cuboid, LyingCylinder, Prism, Sphere, Tabletop, UprightCylinder

PAGE = repo_root() / "figures" / "try_it.html"
OBJECTS = {
    "box": Cuboid(0.07, 0.05, 0.05),
    "cube": Cuboid(0.05, 0.05, 0.05),
    "tin": UprightCylinder(0.06, 0.06),
    "roller": LyingCylinder(0.07, 0.05),
    "ball": Sphere(0.06),
    "triangle": Prism(((0.04, 0.0), (-0.02, 0.035), (-0.02, -0.035)), 0.05),
    "wedge": Prism(((-0.05, -0.02), (0.05, -0.02), (0.05, 0.0), (-0.05, 0.03)), 0.04),
    "slab": Cuboid(0.14, 0.03, 0.04),
}
UNKNOWN = {"triangle", "wedge", "slab"}
"""Shapes that the network of pushes was not trained on."""


def data() -> dict[str, object]:
    """Everything that the page knows, in JSON's types."""
    skills, objects = Skills.load(), []
    with Tabletop() as world:
        for name, obj in OBJECTS.items():
            world.place(obj, (0.0, 0.0), 0.0)
            about = {"name": name, "known": name not in UNKNOWN}
            objects.append(about | object_data(obj, skills.effects(world.depth_image())))
    return table_data(skills) | {"objects": objects}


def page(known: dict[str, object]) -> str:
    """The whole page, around data that `data` makes."""
    here, package = Path(__file__).parent, Path(show.__file__).parent
    parts = {"data": json.dumps(known, separators=(",", ":")).replace("<", "\\u003c")}
    for folder, names in ((package, ("table.css", "table.js")), (here, ("page.css", "page.js"))):
        parts |= {name: (folder / name).read_text().strip() for name in names}
    text = (here / "page.html").read_text()
    for name, part in parts.items():
        text = text.replace(f"{{{name}}}", part, 1)
    return text


def main() -> None:
    """Write the page."""
    write_atomically(PAGE, page(data()), b"<!doctype html>")
    print(f"{PAGE.relative_to(repo_root())}: {PAGE.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
