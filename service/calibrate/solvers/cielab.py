"""Colours by CIE: XYZ, CIELAB, chromatic adaptation, and the colour difference CIEDE2000.

Source: CIE 15:2004 (CIELAB); Lam, "Metamerism and colour constancy", PhD thesis, University of Bradford, 1985 (the adaptation that ICC
    profiles and ACES use); Sharma, Wu and Dalal, "The CIEDE2000 color-difference formula: implementation notes, supplementary test data,
    and mathematical observations", Color Research and Application 30(1), 2005.
"""

import numpy as np

from stage.colour.colour import rgb_matrix
from stage.formats.camera_raw import XYZ_FROM_REC709

WHITES = {"D50": np.array([0.9642, 1.0, 0.8249]), "D65": XYZ_FROM_REC709.sum(axis=1)}
"""XYZ of the white of each illuminant for the observer of 2 degrees: that of ICC profiles, and that of Rec.709."""
CONES_FROM_XYZ = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
KNEE = 6 / 29
"""The cube root of XYZ over white below which CIELAB is linear."""


def lab_from_xyz(xyz: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Return CIELAB [..., 3] of XYZ [..., 3] under a white, whose Y is 1."""
    t = xyz / white
    root = np.where(t > KNEE**3, np.cbrt(t), t / (3 * KNEE**2) + 4 / 29)
    return np.stack([116 * root[..., 1] - 16, 500 * (root[..., 0] - root[..., 1]), 200 * (root[..., 1] - root[..., 2])], axis=-1)


def xyz_from_lab(lab: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Return XYZ [..., 3] of CIELAB [..., 3] under a white, whose Y is 1."""
    middle = (lab[..., 0] + 16) / 116
    root = np.stack([middle + lab[..., 1] / 500, middle, middle - lab[..., 2] / 200], axis=-1)
    return np.asarray(np.where(root > KNEE, root**3, 3 * KNEE**2 * (root - 4 / 29)) * white)


def adaptation(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the matrix [3, 3] from XYZ under one white to XYZ that look alike under another."""
    gains = (CONES_FROM_XYZ @ target) / (CONES_FROM_XYZ @ source)
    return np.linalg.inv(CONES_FROM_XYZ) @ np.diag(gains) @ CONES_FROM_XYZ


def xyz_from_linear(space: str) -> np.ndarray:
    """Return the matrix [3, 3] from the values of a scene-linear space, whose white is (1, 1, 1), to XYZ under D50."""
    return adaptation(WHITES["D65"], WHITES["D50"]) @ XYZ_FROM_REC709 @ rgb_matrix(space, "lin_rec709_scene").astype(np.float64)


def delta_e_2000(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the difference CIEDE2000 [...] of colours in CIELAB, [..., 3] each."""
    lightness, chroma = (first[..., 0] + second[..., 0]) / 2, [np.hypot(lab[..., 1], lab[..., 2]) for lab in (first, second)]
    seventh = ((chroma[0] + chroma[1]) / 2) ** 7
    stretch = 1 + 0.5 * (1 - np.sqrt(seventh / (seventh + 25.0**7)))
    chroma = [np.hypot(stretch * lab[..., 1], lab[..., 2]) for lab in (first, second)]
    hue = [np.degrees(np.arctan2(lab[..., 2], stretch * lab[..., 1])) % 360 for lab in (first, second)]
    coloured = chroma[0] * chroma[1] > 0
    turn = np.where(coloured, (hue[1] - hue[0] + 180) % 360 - 180, 0.0)
    turn = np.where(turn == -180, 180.0, turn)
    mean_hue = np.where(coloured, hue[0] + turn / 2, hue[0] + hue[1])
    mean_chroma = (chroma[0] + chroma[1]) / 2
    weight = sum(factor * np.cos(np.radians(times * mean_hue - shift)) for factor, times, shift in
                 ((-0.17, 1, 30), (0.24, 2, 0), (0.32, 3, -6), (-0.20, 4, 63))) + 1
    off = (lightness - 50) ** 2
    seventh = mean_chroma**7
    rotation = -2 * np.sqrt(seventh / (seventh + 25.0**7)) * np.sin(np.radians(60 * np.exp(-((((mean_hue % 360) - 275) / 25) ** 2))))
    by_lightness = (second[..., 0] - first[..., 0]) / (1 + 0.015 * off / np.sqrt(20 + off))
    by_chroma = (chroma[1] - chroma[0]) / (1 + 0.045 * mean_chroma)
    by_hue = 2 * np.sqrt(chroma[0] * chroma[1]) * np.sin(np.radians(turn / 2)) / (1 + 0.015 * mean_chroma * weight)
    return np.asarray(np.sqrt(by_lightness**2 + by_chroma**2 + by_hue**2 + rotation * by_chroma * by_hue))
