"""The UR10 with a parallel gripper: its model for PyBullet and its analytic kinematics.

Its description comes from the package `example-robot-data`. The gripper, two box fingers on
prismatic joints, is part of the URDF because a gripper attached by a constraint slips. The
screwdriver is a vertical shaft with a flat blade along x, the rod a thin vertical shaft. Frame W is
at the table's centre, frame T between the finger tips or at the tip of blade or rod, with z down
and y along the opening.
"""

import math
import tempfile
import xml.etree.ElementTree as ET
from functools import cache
from importlib import metadata
from pathlib import Path

import numpy as np
from pybullet_utils.bullet_client import BulletClient
from ur_analytic_ik import ur10

from affordlib.types import UnreachableError

BASE_X_M = -0.7
TOOL_LENGTH_M, FINGER_TRAVEL_M, SHAFT_LENGTH_M = 0.20, 0.07, 0.26
BLADE_LENGTH_M, BLADE_THICKNESS_M, ROD_WIDTH_M = 0.05, 0.002, 0.003
TOOL_OFFSETS_M = {
    "gripper": (0.0, TOOL_LENGTH_M),
    "screwdriver": (BLADE_LENGTH_M, SHAFT_LENGTH_M),
    "rod": (0.0, SHAFT_LENGTH_M),
}
"""Offset [m] of the tool's tip from the flange along the tool's x and z axes."""
REACH_M = (0.17, 1.26)
"""Smallest and largest distance [m] from the base that a vertical tool reaches at all heights up to
`HOVER_M`; neither yaw nor azimuth matters, as the wrist turns freely."""
HOME = np.array([0.0, -1.9, 1.6, -1.27, -np.pi / 2, 0.0])
"""Joint angles [rad] of the arm parked above its base, out of the camera's view of the table."""

_ARM_RGBA = {"shoulder_link": "0.30 0.45 0.60 1", "wrist_1_link": "0.30 0.45 0.60 1"}
_GREY, _DARK, _RED = "0.72 0.74 0.77 1", "0.25 0.27 0.30 1", "0.75 0.25 0.15 1"


def _box(
    name: str, size: str, centre: str, mass_kg: float, rgba: str, *joint: str, axis: str = ""
) -> str:
    """Return the URDF of a box on a joint (parent, xyz, rpy), prismatic if an axis is given."""
    parent, xyz, rpy = joint
    shape = f'<origin xyz="{centre}"/><geometry><box size="{size}"/></geometry>'
    limit = f'<limit lower="0" upper="{FINGER_TRAVEL_M}" effort="200" velocity="0.5"/>'
    return f"""
    <link name="{name}">
      <visual>{shape}<material name="{name}_colour"><color rgba="{rgba}"/></material></visual>
      <collision>{shape}</collision>
      <inertial>
        <origin xyz="{centre}"/><mass value="{mass_kg}"/>
        <inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/>
      </inertial>
    </link>
    <joint name="{name}_joint" type="{"prismatic" if axis else "fixed"}">
      <parent link="{parent}"/><child link="{name}"/><origin xyz="{xyz}" rpy="{rpy}"/>
      {f'<axis xyz="{axis}"/>{limit}' if axis else ""}
    </joint>"""


def _gripper(tool: str) -> str:
    """Return the URDF of palm and fingers, and of the screwdriver or the rod if it is the tool."""
    flange, none = ("wrist_3_link", "0 0.0922 0", f"{-np.pi / 2} 0 0"), "0 0 0"
    boxes = [_box("palm", "0.05 0.17 0.06", "0 0 0.04", 0.8, _DARK, *flange)]
    for side, y in (("left", 1), ("right", -1)):
        finger = f"{side}_finger", "0.02 0.012 0.13", f"0 {0.006 * y} 0.135", 0.1, _DARK
        boxes.append(_box(*finger, "palm", none, none, axis=f"0 {y} 0"))
    if tool != "gripper":
        name, width = ("shaft", 0.01) if tool == "screwdriver" else ("rod", ROD_WIDTH_M)
        shaft = f"{width} {width} {SHAFT_LENGTH_M - 0.1}", f"0 0 {(0.1 + SHAFT_LENGTH_M) / 2}"
        boxes.append(_box(name, *shaft, 0.05, _RED, "palm", none, none))
    if tool == "screwdriver":
        blade = f"{BLADE_LENGTH_M} 0.012 {BLADE_THICKNESS_M}", f"{BLADE_LENGTH_M / 2} 0 0"
        boxes.append(_box("blade", *blade, 0.02, _RED, "shaft", f"0 0 {SHAFT_LENGTH_M}", none))
    return f"<robot>{''.join(boxes)}</robot>"


@cache
def robot_description(tool: str = "gripper") -> str:
    """Return the URDF text of arm and tool with collision meshes only, which load 10 times faster.

    Massless frames are removed, because PyBullet would give each of them a mass of 1 kg.
    """
    package = metadata.distribution("example-robot-data")
    folder = Path(package.locate_file("cmeel.prefix/share/example-robot-data/robots"))
    root = ET.parse(folder / "ur_description" / "urdf" / "ur10_robot.urdf").getroot()
    dropped = {"ee_link", "base", "tool0", "world"}
    for element in list(root):
        ends = [element.get("name")] + [e.get("link") for e in element.findall("*[@link]")]
        if element.tag not in ("link", "joint") or dropped & set(ends):
            root.remove(element)
    for link in root.findall("link"):
        collision_mesh = link.find("collision/geometry/mesh").get("filename")
        path = collision_mesh.replace("package://example-robot-data/robots", str(folder))
        for mesh in link.iter("mesh"):
            mesh.set("filename", path)
        material = ET.SubElement(link.find("visual"), "material", name=f"{link.get('name')}_colour")
        ET.SubElement(material, "color", rgba=_ARM_RGBA.get(link.get("name"), _GREY))
    root.extend(ET.fromstring(_gripper(tool)))
    return ET.tostring(root, encoding="unicode")


def load_robot(client: BulletClient, tool: str = "gripper") -> int:
    """Load the arm with a tool into a PyBullet client and return the body id."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ur10.urdf"
        path.write_text(robot_description(tool))
        return client.loadURDF(str(path), basePosition=(BASE_X_M, 0, 0), useFixedBase=True)


def _flange_pose(
    xyz_W: np.ndarray, yaw_rad: float, pitch_rad: float, offsets_m: tuple[float, float]
) -> np.ndarray:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    x_axis = np.array([c * cp, s * cp, -sp])
    z_axis = np.array([-c * sp, -s * sp, -cp])
    x, y, z = xyz_W - offsets_m[0] * x_axis - offsets_m[1] * z_axis
    # The base frame of the analytic solver is rotated by 180° about z relative to the URDF's.
    turned = np.column_stack([x_axis, (s, -c, 0.0), z_axis, (x - BASE_X_M, y, z)])
    return np.vstack([turned * [[-1.0], [-1.0], [1.0]], (0.0, 0.0, 0.0, 1.0)])


def inverse_kinematics(
    xyz_W: np.ndarray,
    yaw_rad: float,
    near: np.ndarray,
    pitch_rad: float = 0.0,
    tool: str = "gripper",
) -> np.ndarray:
    """Compute the joint angles (6,) [rad] that move the tool to a pose.

    xyz_W: position of the tool's tip [m]; yaw_rad, pitch_rad: direction of its x axis, and its
    angle below the horizontal; near: joint angles (6,) to which the solution is nearest modulo 2π.
    The elbow is up. The wrist points forward for a vertical tool; otherwise the solution nearest to
    `near` is used, so that a path never flips. Raises UnreachableError if there is no solution.
    """
    best, least, hanging = None, 1.0, pitch_rad == 0.0
    flange = _flange_pose(xyz_W, yaw_rad, pitch_rad, TOOL_OFFSETS_M[tool])
    for joints in ur10.inverse_kinematics(flange):
        if hanging and abs(math.remainder(joints[4] + math.pi / 2, 2 * math.pi)) >= 0.1:
            continue
        joints = near + (joints - near + np.pi) % (2 * np.pi) - np.pi
        if joints[2] <= 0 or not -np.pi < joints[1] < 0.3:
            continue
        if hanging:
            return joints
        if (jump := np.abs(joints - near).max()) < least:
            best, least = joints, jump
    if best is not None:
        return best
    x, y, z = (round(float(v), 3) for v in xyz_W)
    raise UnreachableError(
        f"the arm cannot reach tool position ({x}, {y}, {z}) m; choose a position nearer to its "
        f"base at ({BASE_X_M}, 0) or another direction"
    )


def joint_path(poses_W: np.ndarray, near: np.ndarray, tool: str = "gripper") -> np.ndarray:
    """Compute continuous joint angles (n, 6) along tool poses (n, 6), as those of `Segment`.

    Raises UnreachableError if a pose is out of reach.
    """
    joints = np.empty((len(poses_W), 6))
    last = None
    for i, pose in enumerate(poses_W.tolist()):
        x, y, z, yaw, _, pitch = pose
        if (x, y, z, yaw, pitch) != last:
            last = x, y, z, yaw, pitch
            near = inverse_kinematics(np.array([x, y, z]), yaw, near, pitch, tool)
        joints[i] = near
    return joints
