"""Colours by their standards."""

import numpy as np

AP1_TO_REC709 = np.array([[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]])
"""ACEScg to linear Rec.709 with Bradford adaptation, five digits, as ACES and its CTL publish it."""


def srgb_to_linear(encoded):
    """IEC 61966-2-1."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear):
    """The inverse: negative values stay on the straight part, those above 1 on the curve."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def srgb(linear):
    """Display values of linear ones, clipped at black and white."""
    return linear_to_srgb(np.clip(linear, 0, 1))


AWG4_TO_ACES = np.array([[0.750957362824734, 0.144422786709757, 0.104619850465509],
                         [0.000821837079380, 1.007397584885003, -0.008219421964384],
                         [-0.000499952143533, -0.000854177231437, 1.001354129374970]])
"""ARRI Wide Gamut 4 to ACES2065-1 with CAT02 adaptation, as ARRI's input transform in ACES publishes it."""
ACES_TO_ACESCG = np.array([[1.4514393161, -0.2365107469, -0.2149285693], [-0.0765537734, 1.1762296998, -0.0996759264],
                           [0.0083161484, -0.0060324498, 0.9977163014]])
"""ACES2065-1 to ACEScg (S-2014-004)."""
ACES_TO_REC709 = np.array([[2.52168619, -1.13413099, -0.38755520], [-0.27647991, 1.37271909, -0.09623917],
                           [-0.01537806, -0.15297534, 1.16835340]])
"""ACES2065-1 to linear Rec.709 with Bradford adaptation."""


def logc4_to_linear(encoded):
    """ARRI LogC4 Logarithmic Color Space, specification of 2022, equation 2."""
    a, b, c = (2**18 - 16) / 117.45, (1023 - 95) / 1023, 95 / 1023
    s = 7 * np.log(2) * 2 ** (7 - 14 * c / b) / (a * b)
    t = (2 ** (14 * (-c / b) + 6) - 64) / a
    return np.where(encoded >= 0, (2 ** (14 * (encoded - c) / b + 6) - 64) / a, encoded * s + t)


def slog3_to_linear(encoded):
    """Sony, Technical Summary for S-Gamut3.Cine/S-Log3 and S-Gamut3/S-Log3."""
    code = encoded * 1023
    return np.where(code >= 171.2102946929, 10 ** ((code - 420) / 261.5) * (0.18 + 0.01) - 0.01,
                    (code - 95) * 0.01125 / (171.2102946929 - 95))
