"""Off-centre pushes of an object that is only seen."""

import math

import numpy as np
import pytest

from affordlib.geometry import cross, wrap_angle
from affordlib.planning.push_at import primitive_of, pushes_around
from affordlib.world import Cuboid
from experiments.pose_goals import PretrainedNeuralProcess, pursue

OUTLINE_M = np.array([[0.03, -0.02], [0.03, 0.02], [-0.03, 0.02], [-0.03, -0.02]])
TOOL_M = 0.0015


def test_the_middle_of_the_tool_stays_its_radius_outside():
    pushes = pushes_around(OUTLINE_M + 0.01, TOOL_M, n=50)
    np.testing.assert_allclose(pushes.outline_m, OUTLINE_M, atol=1e-12)
    for k in range(50):
        primitive = primitive_of(pushes, k, 0.0)
        x, y = np.abs(primitive.contact)
        assert max(x - 0.03, y - 0.02) == pytest.approx(TOOL_M)
        ahead = np.array([math.cos(primitive.direction), math.sin(primitive.direction)])
        assert abs(cross(ahead, pushes.direction[k])) < 1e-9
        assert math.acos(ahead @ pushes.normal[k]) <= math.radians(50) + 1e-9


def test_a_turned_object_is_pushed_alike():
    pushes, quarter = pushes_around(OUTLINE_M, TOOL_M, n=5), math.pi / 2
    for k in range(5):
        as_is, turned = (primitive_of(pushes, k, heading) for heading in (0.0, quarter))
        x, y = as_is.contact
        np.testing.assert_allclose(turned.contact, (-y, x), atol=1e-12)
        assert wrap_angle(turned.direction - as_is.direction - quarter) == pytest.approx(0)


def test_pursuit_knows_only_what_it_observes(world, monkeypatch):
    """If the simulator reports a wrong yaw, the object still reaches its goal."""
    world.place(Cuboid(0.06, 0.05, 0.05), (0.02, 0.0), 0.4, tool="rod")
    truth = world.object_pose

    def lies():
        x, y, yaw = truth()
        return x, y, yaw + 1.0

    monkeypatch.setattr(world, "object_pose", lies)
    n_pushes = list(pursue(world, PretrainedNeuralProcess(), (0.04, -0.01, 0.2)))
    x, y, yaw = truth()
    assert n_pushes[0] <= 3
    assert n_pushes[1] <= n_pushes[0] + 4
    assert math.dist((x, y), (0.04, -0.01)) < 0.003
    assert abs(yaw - 0.6) < math.radians(3)
