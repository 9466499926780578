"""Parameters as they are given: types, literals of the command line, cells of a notebook."""

import nbformat
import pytest

from affordlib.profiles import WorkbookError, default_parameters, fitting, literal


@pytest.mark.parametrize(
    ("value", "default", "expected"),
    [
        (1, 0.5, 1.0),
        (2, 3, 2),
        ([1], [0.5], [1.0]),
        ([], ["a"], []),
        ("x", None, "x"),
        (1, None, 1),
    ],
)
def test_values_take_the_type_of_their_default(value, default, expected):
    fitted = fitting("p", value, default)
    assert fitted == expected
    assert type(fitted) is type(expected)


@pytest.mark.parametrize(
    ("text", "default", "value"),
    [
        ("3", 1, 3),
        ("1e-3", 0.1, 0.001),
        ("true", False, True),
        ("12", "a", "12"),
        ("astar", "a", "astar"),
        ("[astar, gradient]", [], ["astar", "gradient"]),
        ('["astar"]', [], ["astar"]),
        ("null", None, None),
    ],
)
def test_the_command_line_needs_no_quotes(text, default, value):
    assert literal(text, default) == value


@pytest.mark.parametrize(
    ("source", "named"),
    [
        ("seed = 0\nout_dir = 'x'\nn = 2 * seed", "plain literals"),
        ("seed = 0\nimport os\nout_dir = 'x'", "plain literals"),
        ("seed = 0", "has no parameter 'out_dir'"),
    ],
)
def test_parameters_are_plain_literals(source, named):
    cell = nbformat.v4.new_code_cell(source, metadata={"tags": ["parameters"]})
    with pytest.raises(WorkbookError, match=named):
        default_parameters(nbformat.v4.new_notebook(cells=[cell]), "01_first")
