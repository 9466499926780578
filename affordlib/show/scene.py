"""The robot in 3-D, to turn and zoom: arm, hand, object, goal, prediction and obstacles, by k3d.

Without a kernel, a page plays what was recorded by k3d's script, which `make html` adds.
"""

import base64
import io
import json
from collections.abc import Iterator, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any
from uuid import uuid4

import ipywidgets as widgets
import numpy as np
from matplotlib.colors import to_hex
from PIL import Image
from scipy.spatial.transform import RigidTransform, Rotation

from affordlib.geometry import circle, extruded
from affordlib.planning.free_space import corners_of
from affordlib.show.plots import GOAL, PREDICTION, TRUTH
from affordlib.types import TABLE_X_M, TABLE_Y_M, Goal, Plan
from affordlib.world import BASE_X_M, LyingCylinder, Sphere, Tabletop, TabletopObject
from affordlib.world.camera import SCENERY
from affordlib.world.objects import mesh
from affordlib.world.trajectory import STEP_S

EVERY, TICKS = 16, 2
"""Simulation steps between two recorded poses, and ticks of the time line: k3d moves in between."""

TICK_MS = round(1000 * EVERY * STEP_S / TICKS)

_COARSER = """const { renderer } = K3DInstance.getWorld(), gl = renderer.getContext();
const about = gl.getExtension("WEBGL_debug_renderer_info");
const name = about ? gl.getParameter(about.UNMASKED_RENDERER_WEBGL) : "";
if (/SwiftShader|llvmpipe|Basic Render/.test(name)) renderer.setPixelRatio(0.6);"""
"""Without a GPU, fewer pixels, so that the robot moves more smoothly."""

_WOOD, _STONE = "#ede6d9", "#8c735f"
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_SCRIPT = Path(__file__).with_name("scene.js")


class Scene(widgets.VBox):
    """A view of a world and its object, drawn by k3d, 400 pixels high, with a time line.

    As the world's `on_step` it records the motion; `play` shows what was recorded since `place`, in
    real time. Call `place` when there is another object.
    """

    def __init__(self, world: Tabletop) -> None:
        import k3d  # a quarter of a second that only a scene needs

        self.world, self._mesh = world, k3d.mesh
        self.name = f"scene_{uuid4().hex}"
        code = f"(globalThis.affordlib ??= {{}}).{self.name} = K3DInstance;{_COARSER}"
        plain = {"grid_visible": False, "camera_auto_fit": False, "menu_visibility": False}
        plain |= {"background_color": 0xF4F6F8, "axes_helper": 0.0, "lighting": 1.8}
        fast = {"antialias": 1, "logarithmic_depth_buffer": False}  # twice, without a GPU
        self.plot = k3d.plot(height=400, additional_js_code=code, **plain, **fast)
        self.plot.layout.width = "100%"
        self.plot.camera = [0.84, -0.88, 0.62, -0.24, 0.02, 0.24, 0.0, 0.0, 1.0]  # at, to, upwards
        table = [(x, y) for x in TABLE_X_M for y in TABLE_Y_M]
        self._add(extruded(np.array(table), -0.1, 0.0), _WOOD)
        for half, at, rgb in SCENERY:
            self._add(_box(2 * np.array(half)), to_hex(rgb), at)
        base, *links = _arm(world)
        self._add(*base, (BASE_X_M, 0.0, 0.0))
        self._links = [self._add(*link) for link in links]
        self._object, self._last = None, np.ones(7)
        self._marks: list[Any] = []
        self.player = widgets.Play(interval=TICK_MS, max=0)
        looks = {"layout": {"flex": "1", "min_width": "0"}, "style": {"description_width": "auto"}}
        time = widgets.IntSlider(max=0, readout=False, description="time", **looks)
        speed = widgets.Dropdown(options={"1×": 1, "½×": 2, "¼×": 4}, layout={"width": "5em"})
        widgets.dlink((self.player, "max"), (time, "max"))
        for one, name in ((self.player, "value"), (time, "value"), (self.plot, "time")):
            # Each window's own: sent on, two windows would set each other's back without end.
            one.add_traits(**{name: deepcopy(one.traits()[name]).tag(echo_update=False)})
        widgets.jslink((self.player, "value"), (time, "value"))
        widgets.jslink((self.player, "value"), (self.plot, "time"))
        speed.observe(lambda c: setattr(self.player, "interval", TICK_MS * c["new"]), "value")
        self.place()
        layout = {"flex": "1 1 420px", "max_width": "700px", "min_width": "0"}
        super().__init__([self.plot, widgets.HBox([self.player, time, speed])], layout=layout)

    def place(self) -> None:
        """Show the world's present object and obstacles, and begin a recording."""
        if self._object is not None:
            self.plot -= self._object
        self._object = self._add(_solid(self.world.obj), TRUTH)
        self.begin()
        self.mark()
        self.stop()

    def begin(self) -> None:
        """Begin a recording."""
        self._frames, self._steps = [self.poses()], 0

    def mark(
        self, goal: Goal | None = None, plan: Plan | None = None, from_rad: float | None = None
    ) -> None:
        """Show obstacles, and goal and predicted final pose of a plan, in place of earlier ones.

        from_rad: yaw to which the goal's turn is relative, by default the present one.
        """
        for old in self._marks:
            self.plot -= old
        obj, self._marks = self.world.obj, []
        for one in self.world.obstacles.all:
            self._marks.append(self._add(extruded(corners_of(one), 0.0, one.height_m), _STONE))
        yaw = self.world.object_pose()[2]
        start = yaw if from_rad is None else from_rad
        if plan is not None and plan.steps:
            yaw += plan.steps[-1].predicted_turn_rad
            at = (*plan.predicted_end_xy_m, obj.height_m / 2)
            self._marks.append(self._add(_solid(obj), PREDICTION, at, yaw, opacity=0.4))
        if goal is not None:
            yaw = yaw if goal.turn_rad is None else start + goal.turn_rad
            sheet = extruded(1.3 * obj.footprint_m, 0.0, 0.003)
            at = *goal.xy_m, goal.height_m or 0.0
            self._marks.append(self._add(sheet, GOAL, at, yaw))

    def __call__(self, world: Tabletop) -> None:
        """Record the world's present poses, every few steps."""
        self._steps += 1
        if self._steps % EVERY == 0:
            self._frames.append(self.poses())

    def play(self) -> None:
        """Play what was recorded."""
        self.stop()
        self.player.value = 0
        self.player.playing = len(self._frames) > 1

    def stop(self) -> None:
        """Put what was recorded on the time line, and show its end."""
        frames = np.array(self._frames)
        turns = Rotation.from_quat(frames[..., 3:])
        shown = np.float32(RigidTransform.from_components(frames[..., :3], turns).as_matrix())
        # 11 bits of each mantissa are half a millimetre at 1 m, and pages of half the size.
        shown = (shown.view(np.int32) & -8192).view(np.float32)
        self.player.playing, self.player.max = False, TICKS * (len(shown) - 1)
        self.player.value = self.player.max  # before the bodies, which k3d makes again at this time
        for k, part in enumerate(self.bodies):
            part.model_matrix = {str(TICKS * t): frame[k] for t, frame in enumerate(shown)}

    @property
    def bodies(self) -> list[Any]:
        """What moves: the arm's parts and the object, in the order of `poses`."""
        return [*self._links, self._object]

    def poses(self) -> np.ndarray:
        """Where the bodies are: position [m] and quaternion, (n, 7)."""
        client, robot = self.world.client, self.world.arm.robot
        states = client.getLinkStates(robot, list(range(len(self._links))))
        now = np.array([*((*s[4], *s[5]) for s in states), self.world.object_state()])
        now[:, 3:] *= np.where((now * self._last)[:, 3:].sum(axis=1) < 0, -1, 1)[:, None]
        self._last = now  # of the two quaternions of a turn, the one next to the last
        return now

    def _add(
        self, points: Any, color: str, xyz: Any = (0, 0, 0), yaw_rad: float = 0, opacity: float = 1
    ) -> Any:
        """Add a body at a pose: the convex hull of points (n, 3), or triangles (n, 3, 3)."""
        points = np.asarray(points, dtype=float)
        if points.ndim == 2:
            points = np.array(mesh([points])["vertices"]).reshape(-1, 3, 3)
        corners, indices = np.unique(points.reshape(-1, 3), axis=0, return_inverse=True)
        at = RigidTransform.from_components(xyz, Rotation.from_euler("z", yaw_rad)).as_matrix()
        options = {"color": int(color[1:], 16), "opacity": opacity, "model_matrix": np.float32(at)}
        body = self._mesh(np.float32(corners), np.uint32(indices).reshape(-1, 3), **options)
        self.plot += body
        return body

    def _repr_mimebundle_(self, **kwargs: object) -> Any:
        """The view, and for a page without a kernel what was recorded, drawn by k3d's script."""
        bundle = super()._repr_mimebundle_(**kwargs)
        data = base64.b64encode(self.plot.get_binary_snapshot()).decode()
        about = json.dumps({"last": self.player.max, "height": self.plot.height})
        script = f"{_SCRIPT.read_text()}(document.currentScript.parentElement, {about}, '{data}')"
        picture = io.BytesIO()
        Image.fromarray(self.world.picture(640, 400)).save(picture, "jpeg", quality=70)
        still = base64.b64encode(picture.getvalue()).decode()
        image = f'<img alt="The robot and its table" src="data:image/jpeg;base64,{still}">'
        html = f"<div>{image}<script>{script}</script></div>"
        return bundle | {"text/html": html, "text/plain": type(self).__name__}


def _arm(world: Tabletop) -> Iterator[tuple[np.ndarray, str]]:
    """Points or triangles of the arm's base and of each link, and their colours."""
    for _, _, _, size, file, at, _, rgba in world.client.getVisualShapeData(world.arm.robot):
        points = _box(size) + at
        if file:
            points = np.frombuffer(Path(file.decode()).read_bytes()[84:], _STL)["corners"]
        yield points, to_hex(rgba)


def _box(size_m: Sequence[float]) -> np.ndarray:
    return (np.array(list(np.ndindex(2, 2, 2))) - 0.5) * size_m


def _solid(obj: TabletopObject) -> np.ndarray:
    """Points (n, 3) whose convex hull is the object, around its centre."""
    half = obj.height_m / 2
    if isinstance(obj, Sphere):
        levels = half * np.cos(np.linspace(0, np.pi / 2, 9))
        return np.vstack([extruded(circle(np.sqrt(half**2 - z**2), 48), -z, z) for z in levels])
    if isinstance(obj, LyingCylinder):
        return extruded(circle(half, 48), -obj.length / 2, obj.length / 2)[:, [2, 0, 1]]
    return extruded(obj.footprint_m, -half, half)
