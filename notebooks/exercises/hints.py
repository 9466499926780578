"""Two hints for each exercise, and the explanation of its solution; no hint contains the answer."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

SOLUTIONS = Path(__file__).parents[1] / "solutions"

HINTS: dict[str, tuple[str, str]] = {
    "00.1": (
        "A stopped push ends about where the full push passes at that phase.",
        "Predict the whole effect, and take the phase at which its length passes 5 cm.",
    ),
    "00.2": (
        "Every full push of this box has about the same length; only its direction is free.",
        "Compare the goal's distance from the start with that length, to within the tolerance.",
    ),
    "01.1": (
        "Differentiate the timing with respect to t.",
        "t runs from 0 to 1 while 3.75 s pass: divide by that time, too.",
    ),
    "01.2": (
        "Add up columns: the area of a pixel times the height above it.",
        "The height is the distance of the table, the farthest pixel, minus that of the pixel.",
    ),
    "02.1": (
        "Rotate each final effect by minus the direction of its own drag.",
        "Measure from the mean of the rotated ends, not from the start.",
    ),
    "02.2": (
        "Draw the two finger tips and the circle: it touches the inner corner or edge of both.",
        "The centre is ahead of the tips by the other side of a right triangle, or by the radius.",
    ),
    "03.1": (
        "Give `Observations.of` the pair of phases and effects as `effect`, and no action.",
        "Compare the predicted x and y at the same phase; average the distances, in mm.",
    ),
    "03.2": (
        "The draw has the shape of `mean`.",
        "rng.normal takes arrays of means and of standard deviations.",
    ),
    "04.1": (
        "Both predictions need their own observations: those of the rotated arrays, and the first.",
        "A quarter turn counter-clockwise takes (x, y) to (-y, x).",
    ),
    "04.2": (
        "The 50 % interval reaches to 0.674 of σ on each side.",
        "Which value of error over σ do half of the errors not exceed?",
    ),
    "05.1": (
        "The fifth step is the fifth pose after the last one that is shown.",
        "The last two of fifteen poses begin at `start + 13`.",
    ),
    "05.2": (
        "Add the noise to what the networks see, before increments are computed.",
        "Divide the mean errors at the fifth step; the ground truth stays as it is.",
    ),
    "06.1": (
        "Where a push ends depends on how the object lies when the push begins.",
        "Ask for the direction minus the turn so far; rotate the answer by the direction.",
    ),
    "06.2": (
        "Try many directions and phases together: `effects` takes tensors.",
        "`ahead` and `left` are in the push frame: rotate them before you compare with the goal.",
    ),
    "06.3": (
        "Try the outward normals of the edges of both polygons.",
        "For each normal, subtract the largest projection of one from the smallest of the other.",
    ),
    "06.4": (
        "The gap may fall below the margin and rise again.",
        "Find the first phase at which the gap is too small, and stop before it.",
    ),
    "07.1": (
        "After each action compare what you see with `step.predicted_end_xy_m`.",
        "Keep the remaining steps while both agree; otherwise plan again from what you see.",
    ),
    "07.2": (
        "The curve crosses the height once the hand lifts; before that it only trembles.",
        "Look for the last sample below the height, and interpolate to the next one.",
    ),
    "08.1": (
        "Rotate the image by half a turn.",
        "Compare the rotated image with the image; a house differs from itself.",
    ),
    "08.2": (
        "Sort the pushes by σ, not by their error.",
        "Average the errors of the first half, in mm.",
    ),
    "09.1": (
        "The corner moves differently from the centroid when the object turns.",
        "Rotate the given centroid by each pose's yaw and add its position; then subtract.",
    ),
    "09.2": (
        "Mirrored at the x axis, x stays.",
        "All components along y change their signs; think also of the sense of rotation.",
    ),
    "10.1": (
        "At the contact the tool's centre is one radius outside, along the normal.",
        "Going back along the push by a length gains only its share along the normal.",
    ),
    "10.2": (
        "Add the price of its pushes to each chain's distance.",
        "One push costs the same in every chain: a share of the present distance.",
    ),
    "A5.1": (
        "The distance from the start is the length of the effect's x and y.",
        "For each push take the first phase at which it is at least 1 mm; then the median.",
    ),
    "A5.2": (
        "A set is stored with a hash of its contents.",
        "Compare the hashes: the bytes of the files differ with their compression.",
    ),
}


def explanation(name: str) -> str:
    """What the solution of an exercise says about itself."""
    (path,) = SOLUTIONS.glob(f"{name.partition('.')[0]}*.py")
    tree = ast.parse(path.read_text("utf-8"))
    said = {f.name: ast.get_docstring(f) for f in tree.body if isinstance(f, ast.FunctionDef)}
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        if call.args and isinstance(call.args[0], ast.Constant) and call.args[0].value == name:
            solution = getattr(call.args[1], "func", call.args[1])
            return inspect.cleandoc(said[solution.id])
    raise ValueError(f"no solution calls check({name!r}, …)")
