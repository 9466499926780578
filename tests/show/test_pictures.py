import os

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from affordlib.planning import execute_plan, plan_astar
from affordlib.show import plot_footprint, plot_outcome, plot_table
from affordlib.types import Goal
from affordlib.world import Cuboid
from tests.problems import problem_of
from tests.waiting import printed


def test_a_footprint_is_drawn_where_the_object_is(world, trained):
    figure, ax = plt.subplots()
    plot_footprint(plot_table(ax), Cuboid(0.06, 0.04, 0.05), (0.1, -0.05), np.pi / 2)
    outline = ax.lines[-1].get_xydata()
    np.testing.assert_allclose(np.ptp(outline, axis=0), [4.0, 6.0], atol=1e-9)
    np.testing.assert_allclose(outline[:-1].mean(axis=0), [10.0, -5.0], atol=1e-9)
    world.place(Cuboid(0.06, 0.05, 0.05))
    problem = problem_of(trained, world.depth_image(), (0.0, 0.0), Goal((0.12, 0.0)))
    outcome = execute_plan(world, plan_astar(problem))
    assert "mm from the goal" in plot_outcome(ax, outcome, world.obj).get_title(loc="left")
    last = [line.get_xydata()[:-1] for line in ax.lines if len(line.get_xydata()) == 5][-1]
    np.testing.assert_allclose(last.mean(axis=0), 100 * np.array(outcome.end_pose[:2]), atol=1e-9)
    plt.close(figure)


def test_the_configuration_of_a_reader_changes_no_figure(tmp_path):
    (tmp_path / "matplotlibrc").write_text(
        "text.usetex: True\nfont.family: fantasy\naxes.grid: False\nfigure.figsize: 2, 2\n"
        "axes.facecolor: black\nsavefig.bbox: tight\naxes.prop_cycle: cycler('color', ['red'])\n"
    )
    code = (
        "import matplotlib.pyplot as plt\nfrom affordlib.show import save_figure, plot_table\n"
        "from pathlib import Path\nfigure, ax = plt.subplots()\nplot_table(ax)\n"
        "ax.set_title('50 % of $x_1$')\nax.plot([1, 2])\n"
        "print(save_figure(figure, Path('{}'), 'one'))"
    )
    drawn = []
    for name, own in (("own", {"MATPLOTLIBRC": str(tmp_path)}), ("plain", {})):
        environment = os.environ | {"MPLBACKEND": "agg"} | own
        path = printed(code.format(tmp_path / name), env=environment).strip()
        drawn.append(np.asarray(Image.open(path)))
    np.testing.assert_array_equal(*drawn)
