"""Axes and frames, against scipy and against what one knows of directions."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.xsens_mtig.mtdata2 import LocalFrame
from drivers.xsens_mtig.orientation import (
    apply,
    axes_of,
    device_from_axes,
    multiply,
    quaternion_of_euler,
    quaternion_of_matrix,
    to_enu,
)

AXES = ("x", "-x", "y", "-y", "z", "-z")
UNIT = {name: (-1.0 if name[0] == "-" else 1.0) * np.eye(3)["xyz".index(name[-1])] for name in AXES}
RANDOM = Rotation.random(40, random_state=3)
# Rows: what the frame's axes are in east, north, up.
FRAME_IN_ENU = {
    LocalFrame.ENU: np.eye(3),
    LocalFrame.NED: np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]], dtype=float),
    LocalFrame.NWU: np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], dtype=float),
}


def scipy_of(quaternion):
    w, x, y, z = quaternion
    return Rotation.from_quat([x, y, z, w])


def same(quaternion, rotation):
    return (scipy_of(quaternion).inv() * rotation).magnitude() < 1e-9


def wxyz(rotation):
    x, y, z, w = rotation.as_quat()
    return (w, x, y, z)


def test_products_euler_angles_and_matrices_are_those_of_scipy():
    for a, b in itertools.pairwise(RANDOM):
        assert same(multiply(wxyz(a), wxyz(b)), a * b)
        assert same(quaternion_of_matrix(a.as_matrix().ravel().tolist()), a)
        yaw, pitch, roll = a.as_euler("ZYX", degrees=True)
        assert same(quaternion_of_euler(roll, pitch, yaw), a)


@pytest.mark.parametrize("angles", [(180, 0, 0), (0, 180, 0), (0, 0, 180), (90, 0, 90), (0, 89.999, 10)])
def test_matrices_of_half_turns_are_read(angles):
    rotation = Rotation.from_euler("XYZ", angles, degrees=True)
    assert same(quaternion_of_matrix(rotation.as_matrix().ravel().tolist()), rotation)


@pytest.mark.parametrize("local", list(LocalFrame))
def test_orientation_in_every_local_frame_and_form_becomes_that_of_enu(local):
    """The device sends local from sensor; the vector that its matrix turns is known in ENU."""
    for enu_from_sensor in RANDOM:
        local_from_sensor = Rotation.from_matrix(FRAME_IN_ENU[local] @ enu_from_sensor.as_matrix())
        yaw, pitch, roll = local_from_sensor.as_euler("ZYX", degrees=True)
        orientations = (
            wxyz(local_from_sensor),
            (roll, pitch, yaw),
            tuple(local_from_sensor.as_matrix().ravel().tolist()),
        )
        for orientation in orientations:
            assert same(to_enu(local, orientation, (1.0, 0.0, 0.0, 0.0)), enu_from_sensor)


@pytest.mark.parametrize(
    ("forward", "up"), [p for p in itertools.product(AXES, AXES) if p[0][-1] != p[1][-1]]
)
def test_housings_in_any_mounting_give_forward_left_up(forward, up):
    axes = axes_of(forward, up)
    assert apply(axes, UNIT[forward]) == pytest.approx((1, 0, 0))
    assert apply(axes, UNIT[up]) == pytest.approx((0, 0, 1))
    assert apply(axes, np.cross(UNIT[up], UNIT[forward])) == pytest.approx((0, 1, 0))
    device = scipy_of(device_from_axes(axes))
    np.testing.assert_allclose(device.apply([1.0, 0.0, 0.0]), UNIT[forward], atol=1e-12)
    np.testing.assert_allclose(device.apply([0.0, 0.0, 1.0]), UNIT[up], atol=1e-12)
    enu_from_device = RANDOM[0]
    turned = to_enu(LocalFrame.ENU, wxyz(enu_from_device), device_from_axes(axes))
    assert same(turned, enu_from_device * device)


def test_one_axis_cannot_look_ahead_and_up():
    with pytest.raises(ValueError, match="same axis"):
        axes_of("x", "-x")
