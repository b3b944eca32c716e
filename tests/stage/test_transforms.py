"""Pixel centres, rigid transforms and rotations, against their definitions in closed form."""

import numpy as np
import pytest

from stage.transforms import pixel_centres, rigid_fault, rotation_about, rotation_about_y


def test_pixel_centre_of_row_r_column_c_is_half_past():
    u, v = pixel_centres(3, 2)
    assert u.shape == v.shape == (2, 3)
    assert (u[1, 2], v[1, 2]) == (2.5, 1.5)
    assert (u[0, 0], v[0, 0]) == (0.5, 0.5)


def test_rotation_about_y_is_positive_from_z_towards_x():
    assert np.allclose(rotation_about_y(90) @ (0, 0, 1), (1, 0, 0))
    assert np.allclose(rotation_about_y(90) @ (1, 0, 0), (0, 0, -1))
    assert np.allclose(rotation_about_y(37) @ (0, 1, 0), (0, 1, 0))
    assert np.allclose(rotation_about_y(20) @ rotation_about_y(-20), np.eye(3))


def rigid(rotation=None, translation=(0, 0, 0)):
    matrix = np.eye(4)
    matrix[:3, :3] = np.eye(3) if rotation is None else rotation
    matrix[:3, 3] = translation
    return matrix


def test_rigid_transforms_pass():
    assert rigid_fault(rigid()) is None
    assert rigid_fault(rigid(rotation_about_y(33), (1, 2, 3))) is None
    assert rigid_fault(np.round(rigid(rotation_about_y(33)), 5)) is None  # as typed from a printout


@pytest.mark.parametrize(("matrix", "words"), [
    (rigid(2 * np.eye(3)), "not a rotation"),
    (rigid(np.diag([1, 1, -1])), "mirrors"),
    (rigid(translation=(np.nan, 0, 0)), "not finite"),
    (rigid().T + np.eye(4, k=-3), "last row"),
])
def test_what_is_not_rigid_is_named(matrix, words):
    assert words in rigid_fault(matrix)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, -200.0])
def test_any_axis_turns_by_the_right_hand(degrees):
    assert np.allclose(rotation_about((0.0, 1.0, 0.0), degrees), rotation_about_y(degrees))
    axis = np.array([0.48, -0.6, 0.64])
    turned = rotation_about((0.48, -0.6, 0.64), degrees)
    assert np.allclose(turned @ turned.T, np.eye(3)) and np.allclose(turned @ axis, axis)
    across = np.array([0.8, 0.0, -0.6])
    expected = np.cos(np.radians(degrees)) * across + np.sin(np.radians(degrees)) * np.cross(axis, across)
    assert np.allclose(turned @ across, expected)
