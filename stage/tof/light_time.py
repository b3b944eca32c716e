"""The speed of light, and the range that belongs to a delay or a phase."""

import math
from typing import TypeVar

import numpy as np

Time = TypeVar("Time", float, np.ndarray)

SPEED_OF_LIGHT = 299_792_458.0
"""The speed of light in vacuum in metres a second (SI, exact)."""


def delay_s(path_m: float) -> float:
    """Return the seconds that light takes along a path, one way."""
    return path_m / SPEED_OF_LIGHT


def range_of_delay_m(time_s: Time) -> Time:
    """Return the range from the time of flight there and back: d = c·t/2."""
    return SPEED_OF_LIGHT * time_s / 2


def range_of_phase_m(phase_rad: float, modulation_hz: float) -> float:
    """Return the range from the phase of modulated light that went there and back: d = c·φ / (4πf).

    The 4π contains the way back; halving the result again, as some course notes do, is wrong by a factor of two.
    """
    return SPEED_OF_LIGHT * phase_rad / (4 * math.pi * modulation_hz)


def toothed_wheel_speed_m_s(distance_m: float, teeth: int, turns_per_s: float) -> float:
    """Return the speed of light from a toothed wheel, when the light that left through a gap meets the next tooth on its return.

    The wheel moves by half a tooth's pitch, 1 / (2 · teeth) of a turn, while light goes there and back: c = 4 · distance · teeth · turns.

    Source:
        Fizeau, "Sur une expérience relative à la vitesse de propagation de la lumière", Comptes Rendus 29, 1849.
    """
    return 4 * distance_m * teeth * turns_per_s
