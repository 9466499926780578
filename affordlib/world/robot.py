"""The UR10 with a parallel gripper: its model for PyBullet and its analytic kinematics.

The arm's description and meshes come from the package `example-robot-data`; the gripper, two box
fingers on prismatic joints, is merged into the same description, because a gripper held by a
constraint slips. Frames: W the table's centre, B the arm's base, T the tool (between the finger
tips, z down, y along the opening).
"""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ET
from functools import cache
from importlib import metadata
from pathlib import Path

import numpy as np
import pybullet
from ur_analytic_ik import ur10

BASE_X_M = -0.7
TOOL_LENGTH_M = 0.20
FINGER_TRAVEL_M = 0.07
ARM_JOINTS = tuple(range(6))
HOME = (0.0, -1.9, 1.6, -1.27, -np.pi / 2, 0.0)
"""Joint angles [rad] of the arm parked above its base, out of the camera's view of the table."""

_ARM_RGBA = {"shoulder_link": "0.30 0.45 0.60 1", "wrist_1_link": "0.30 0.45 0.60 1"}
_GREY, _DARK = "0.72 0.74 0.77 1", "0.25 0.27 0.30 1"


class UnreachableError(ValueError):
    """The arm cannot take the tool to a pose that was asked for."""


@cache
def _description_folder() -> Path:
    files = metadata.files("example-robot-data") or []
    for file in files:
        if file.name == "ur10_robot.urdf":
            return Path(file.locate()).resolve().parents[2]
    raise FileNotFoundError(
        "the UR10 description of the package example-robot-data was not found; "
        "install the environment again with `make setup`"
    )


def _box_link(name: str, size: str, xyz: str, mass: float, rgba: str) -> ET.Element:
    link = ET.Element("link", name=name)
    for kind in ("visual", "collision"):
        part = ET.SubElement(link, kind)
        ET.SubElement(part, "origin", xyz=xyz, rpy="0 0 0")
        ET.SubElement(ET.SubElement(part, "geometry"), "box", size=size)
        if kind == "visual":
            material = ET.SubElement(part, "material", name=f"{name}_colour")
            ET.SubElement(material, "color", rgba=rgba)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=xyz, rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=str(mass))
    ET.SubElement(
        inertial, "inertia", ixx="1e-3", iyy="1e-3", izz="1e-3", ixy="0", ixz="0", iyz="0"
    )
    return link


def _joint(name: str, kind: str, parent: str, child: str, xyz: str, rpy: str) -> ET.Element:
    joint = ET.Element("joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=xyz, rpy=rpy)
    return joint


@cache
def robot_description() -> str:
    """The URDF text of arm and gripper, with meshes as absolute paths.

    The detailed visual meshes are replaced by the collision ones (they load ten times faster) and
    the mass-less frames are dropped (PyBullet would give each a mass of 1 kg).
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

    half_pi = str(-np.pi / 2)
    root.append(_box_link("palm", "0.05 0.17 0.06", "0 0 0.04", 0.8, _DARK))
    root.append(
        _joint("palm_joint", "fixed", "wrist_3_link", "palm", "0 0.0922 0", f"{half_pi} 0 0")
    )
    for side, sign in (("left", 1), ("right", -1)):
        name = f"{side}_finger"
        root.append(_box_link(name, "0.02 0.012 0.13", f"0 {0.006 * sign} 0.135", 0.1, _DARK))
        joint = _joint(f"{name}_joint", "prismatic", "palm", name, "0 0 0", "0 0 0")
        ET.SubElement(joint, "axis", xyz=f"0 {sign} 0")
        ET.SubElement(
            joint, "limit", lower="0", upper=str(FINGER_TRAVEL_M), effort="200", velocity="0.5"
        )
        root.append(joint)
    return ET.tostring(root, encoding="unicode")


def load_robot(client: int) -> int:
    """Load arm and gripper into a PyBullet client and return the body id."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ur10_gripper.urdf"
        path.write_text(robot_description())
        return pybullet.loadURDF(
            str(path), basePosition=(BASE_X_M, 0, 0), useFixedBase=True, physicsClientId=client
        )


def finger_joints(client: int, robot: int) -> tuple[int, int]:
    """Indices of the two prismatic finger joints."""
    count = pybullet.getNumJoints(robot, physicsClientId=client)
    names = [
        pybullet.getJointInfo(robot, j, physicsClientId=client)[1].decode() for j in range(count)
    ]
    return names.index("left_finger_joint"), names.index("right_finger_joint")


def _flange_pose(xyz_W: np.ndarray, yaw_rad: float) -> np.ndarray:
    # The analytic solver's base is turned by 180° about z against the URDF's.
    c, s = -np.cos(yaw_rad), -np.sin(yaw_rad)
    pose = np.array(
        [
            [c, s, 0.0, -(xyz_W[0] - BASE_X_M)],
            [s, -c, 0.0, -xyz_W[1]],
            [0.0, 0.0, -1.0, xyz_W[2] + TOOL_LENGTH_M],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    return pose


def inverse_kinematics(xyz_W: np.ndarray, yaw_rad: float, near: np.ndarray) -> np.ndarray:
    """Joint angles (6,) [rad] that put the tool, pointing down, at a pose.

    xyz_W: finger tips in the frame of the table [m]; yaw_rad: direction of the tool's x axis;
    near: joint angles (6,) whose turn (of 2π) is kept. Of the solver's postures only the one with
    elbow up and wrist forward is taken, so that a path never flips.
    Raises UnreachableError when the arm cannot get there.
    """
    for solution in ur10.inverse_kinematics(_flange_pose(xyz_W, yaw_rad)):
        joints = np.asarray(solution)
        joints = near + (joints - near + np.pi) % (2 * np.pi) - np.pi
        if abs(joints[4] + np.pi / 2) < 0.1 and joints[2] > 0 and -np.pi < joints[1] < 0.3:
            return joints
    x, y, z = (round(float(v), 3) for v in xyz_W)
    raise UnreachableError(
        f"the arm cannot reach tool position ({x}, {y}, {z}) m; choose a place nearer to its "
        f"base at ({BASE_X_M}, 0) or another direction"
    )


def joint_path(xyz_W: np.ndarray, yaw_rad: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Joint angles (n, 6) along tool positions (n, 3) and yaws (n,), without a jump.

    Raises UnreachableError when a pose is out of reach.
    """
    joints = np.empty((len(xyz_W), 6))
    for i, (xyz, yaw) in enumerate(zip(xyz_W, yaw_rad, strict=True)):
        joints[i] = near = inverse_kinematics(xyz, yaw, near)
    return joints
