"""The UR10 with a parallel gripper: its model for PyBullet and its analytic kinematics.

Its description comes from the package `example-robot-data`; the gripper, two box fingers on
prismatic joints, is merged into it, because one held by a constraint slips. The screwdriver is a
shaft straight down with a flat blade along x, the rod a thin one. W is the frame of the table's
centre, T of the tool: between the finger tips or at the tip of blade or rod, z down and y along the
opening.
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
TOOL_LENGTH_M = 0.20
FINGER_TRAVEL_M = 0.07
SHAFT_LENGTH_M = 0.26
BLADE_LENGTH_M = 0.05
BLADE_THICKNESS_M = 0.002
ROD_WIDTH_M = 0.003
TOOL_OFFSETS_M = {
    "gripper": (0.0, TOOL_LENGTH_M),
    "screwdriver": (BLADE_LENGTH_M, SHAFT_LENGTH_M),
    "rod": (0.0, SHAFT_LENGTH_M),
}
"""How far the tool's point lies from the flange along the tool's x and z axes."""
REACH_M = (0.17, 1.26)
"""How near to its base and how far from it a hanging tool gets, up to hovering height; the wrist
turns freely, so neither yaw nor azimuth matters."""
ARM_JOINTS = tuple(range(6))
HOME = (0.0, -1.9, 1.6, -1.27, -np.pi / 2, 0.0)
"""Joint angles [rad] of the arm parked above its base, out of the camera's view of the table."""

_ARM_RGBA = {"shoulder_link": "0.30 0.45 0.60 1", "wrist_1_link": "0.30 0.45 0.60 1"}
_GREY, _DARK, _RED = "0.72 0.74 0.77 1", "0.25 0.27 0.30 1", "0.75 0.25 0.15 1"


def _description_folder() -> Path:
    for file in metadata.files("example-robot-data") or []:
        if file.name == "ur10_robot.urdf":
            return Path(file.locate()).resolve().parents[2]
    raise FileNotFoundError("example-robot-data has no UR10 description; run `make setup` again")


def _box(
    name: str, size: str, centre: str, mass_kg: float, rgba: str, *joint: str, axis: str = ""
) -> str:
    """A box in URDF, held by a joint (parent, xyz, rpy), which slides along an axis if given."""
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
    """Palm and fingers in URDF, and the screwdriver if it is the tool."""
    flange, none = ("wrist_3_link", "0 0.0922 0", f"{-np.pi / 2} 0 0"), "0 0 0"
    boxes = [_box("palm", "0.05 0.17 0.06", "0 0 0.04", 0.8, _DARK, *flange)]
    for side, y in (("left", 1), ("right", -1)):
        finger = f"{side}_finger", "0.02 0.012 0.13", f"0 {0.006 * y} 0.135", 0.1, _DARK
        boxes.append(_box(*finger, "palm", none, none, axis=f"0 {y} 0"))
    if tool == "screwdriver":
        shaft = f"0.01 0.01 {SHAFT_LENGTH_M - 0.1}", f"0 0 {(0.1 + SHAFT_LENGTH_M) / 2}"
        blade = f"{BLADE_LENGTH_M} 0.012 {BLADE_THICKNESS_M}", f"{BLADE_LENGTH_M / 2} 0 0"
        boxes.append(_box("shaft", *shaft, 0.05, _RED, "palm", none, none))
        boxes.append(_box("blade", *blade, 0.02, _RED, "shaft", f"0 0 {SHAFT_LENGTH_M}", none))
    if tool == "rod":
        rod = f"{ROD_WIDTH_M} {ROD_WIDTH_M} {SHAFT_LENGTH_M - 0.1}"
        boxes.append(
            _box("rod", rod, f"0 0 {(0.1 + SHAFT_LENGTH_M) / 2}", 0.05, _RED, "palm", none, none)
        )
    return f"<robot>{''.join(boxes)}</robot>"


@cache
def robot_description(tool: str = "gripper") -> str:
    """The URDF text of arm and tool, with the collision meshes alone, which load ten times faster.

    Mass-less frames are dropped: PyBullet would give each a mass of 1 kg.
    """
    folder = _description_folder()
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


def links(client: BulletClient, robot: int) -> dict[str, int]:
    """Index of each link, and of the joint that moves it, by the link's name."""
    count = range(client.getNumJoints(robot))
    return {client.getJointInfo(robot, k)[12].decode(): k for k in count}


def _flange_pose(
    xyz_W: np.ndarray, yaw_rad: float, pitch_rad: float, offsets_m: tuple[float, float]
) -> np.ndarray:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    x_axis = np.array([c * cp, s * cp, -sp])
    z_axis = np.array([-c * sp, -s * sp, -cp])
    x, y, z = xyz_W - offsets_m[0] * x_axis - offsets_m[1] * z_axis
    # The analytic solver's base is turned by 180° about z against the URDF's.
    turned = np.column_stack([x_axis, (s, -c, 0.0), z_axis, (x - BASE_X_M, y, z)])
    return np.vstack([turned * [[-1.0], [-1.0], [1.0]], (0.0, 0.0, 0.0, 1.0)])


def inverse_kinematics(
    xyz_W: np.ndarray,
    yaw_rad: float,
    near: np.ndarray,
    pitch_rad: float = 0.0,
    tool: str = "gripper",
) -> np.ndarray:
    """Joint angles (6,) [rad] that put the tool at a pose.

    xyz_W: the tool's point on the table [m]; yaw_rad, pitch_rad: direction of its x axis, and how
    far it dips; near: joint angles (6,) whose turn (of 2π) is kept. Taken is a posture with the
    elbow up, wrist forward where the tool hangs, else the nearest: a path never flips.
    Raises UnreachableError when the arm cannot get there.
    """
    best, least = None, 1.0
    hanging = pitch_rad == 0.0
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
        f"the arm cannot reach tool position ({x}, {y}, {z}) m; choose a place nearer to its "
        f"base at ({BASE_X_M}, 0) or another direction"
    )


def joint_path(poses_W: np.ndarray, near: np.ndarray, tool: str = "gripper") -> np.ndarray:
    """Joint angles (n, 6) along poses (n, 5) of the tool, x, y, z, yaw and pitch, without a jump.

    Raises UnreachableError when a pose is out of reach.
    """
    joints = np.empty((len(poses_W), 6))
    last = None
    for i, pose in enumerate(poses_W.tolist()):
        if pose != last:
            x, y, z, yaw, pitch = last = pose
            near = inverse_kinematics(np.array([x, y, z]), yaw, near, pitch, tool)
        joints[i] = near
    return joints
