"""A surface moved to its photometric normals: thin faces, and what stands beside a part whose normals are wrong."""

import numpy as np
import pytest

from service.scans.fusion.holes import area_vectors
from service.scans.fusion.joined_normals import join_normals
from tests.scenes.captures import rms
from tests.service.scans.mesh_files import lattice_faces

PIXEL, COUNT, SIGMA = 2e-3, 60, 1e-3
WAVE, DEEP = 90.0, 6e-4


def height(u, v):
    return DEEP * np.sin(WAVE * u) * np.cos(WAVE * v + 1)


def normals_at(points):
    u, v = points[:, 0], points[:, 1]
    slope = np.stack([-WAVE * DEEP * np.cos(WAVE * u) * np.cos(WAVE * v + 1), WAVE * DEEP * np.sin(WAVE * u) * np.sin(WAVE * v + 1),
                      np.ones(len(points))], axis=1)
    return slope / np.linalg.norm(slope, axis=1, keepdims=True)


def degrees(points, faces):
    """By how much each face is tilted against the true normal at its middle."""
    area = area_vectors(points, faces)
    unit = area / np.linalg.norm(area, axis=1, keepdims=True)
    return np.degrees(2 * np.arcsin(np.linalg.norm(unit - normals_at(points[faces].mean(axis=1)), axis=1) / 2))


def sheet(thin):
    """A waved sheet with noise that is alike within a pixel; every other column of faces is narrower by a factor `thin`."""
    step = PIXEL / 2
    columns = np.cumsum(np.tile([step, thin * step], COUNT // 2)) - step
    u, v = (axis.ravel() for axis in np.meshgrid(columns, step * np.arange(COUNT)))
    drawn = SIGMA * np.random.default_rng(0).standard_normal((COUNT, COUNT))
    x, y = u / PIXEL, v / PIXEL
    left, low = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = x - left, y - low
    noise = (drawn[low, left] * (1 - fx) * (1 - fy) + drawn[low, left + 1] * fx * (1 - fy)
             + drawn[low + 1, left] * (1 - fx) * fy + drawn[low + 1, left + 1] * fx * fy)
    return np.stack([u, v, height(u, v) + noise], axis=1), lattice_faces(COUNT, COUNT)


def seen(points, seed=1):
    """Photometric normals with noise of half a degree."""
    given = normals_at(points) + np.radians(0.5) * np.random.default_rng(seed).standard_normal(points.shape)
    return given / np.linalg.norm(given, axis=1, keepdims=True)


@pytest.mark.parametrize("thin", [0.01, 0.003])
def test_thin_faces_are_not_turned_over(thin):
    points, faces = sheet(thin)
    found = join_normals(points, faces, np.full(len(points), SIGMA), seen(points), np.full(len(points), np.radians(0.5)), pixel_m=PIXEL)
    size = np.linalg.norm(area_vectors(points, faces), axis=1)
    narrow = size < 0.1 * size.max()
    assert 0.4 < narrow.mean() < 0.6
    before, after = degrees(points, faces), degrees(found.points, faces)
    assert rms(before[narrow]) > 10
    assert rms(after[~narrow]) < 1.0  # the noise of normals, half a degree in each of two directions
    assert rms(after[narrow]) < 1.0
    assert (area_vectors(found.points, faces)[:, 2] > 0).all()


def test_a_part_with_wrong_normals_moves_with_what_is_beside_it():
    """Normals are 60° wrong in a square: its depth stays but for a smooth motion, and faces around it are no worse than by their depth."""
    points, faces = sheet(1.0)
    given = seen(points)
    middle = points.mean(axis=0)[:2]
    off = np.abs(points[:, :2] - middle).max(axis=1)
    wrong = off < 3 * PIXEL
    given[wrong] = [np.sin(np.radians(60)), 0, np.cos(np.radians(60))]
    found = join_normals(points, faces, np.full(len(points), SIGMA), given, np.full(len(points), np.radians(0.5)), pixel_m=PIXEL)
    before, after = degrees(points, faces), degrees(found.points, faces)
    inside = wrong[faces].all(axis=1)
    rim = wrong[faces].any(axis=1) & ~inside
    assert found.contradicted >= np.count_nonzero(wrong)
    assert rms(after[inside]) < 1.1 * rms(before[inside]) and rms(after[rim]) < 0.9 * rms(before[rim])  # 1.03, 0.79
    assert rms(after[(off > 6 * PIXEL)[faces].all(axis=1)]) < 1.0
    assert (np.abs(found.moved) <= np.float32(4 * SIGMA)).all()
