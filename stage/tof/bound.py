"""The Cramér-Rao bound of the range from a photon histogram, with which a pulsed camera is planned and a decoder is judged."""

from dataclasses import replace

import numpy as np

from stage.tof.light_time import SPEED_OF_LIGHT
from stage.tof.simulate import HistogramCamera, TofScene, histograms

MEDIAN_PER_SIGMA = 0.674490
"""The median of the absolute error over its standard deviation, for a normal error."""


def range_bound_m(scene: TofScene, camera: HistogramCamera) -> np.ndarray:
    """Return the least standard deviation that an unbiased estimate of the range of each pixel can have.

    With λ the mean of each bin, t the time of the return and s its photons, σ² ≥ 1/(F_tt - F_ts²/F_ss), F_xy = Σ λ_x·λ_y·w over the bins;
    w is 1/λ for Poisson counts. Without background and with fine bins that is σ ≥ (c/2)·pulse_sigma_s/√s. When each of N pulses
    counts one photon at most, a is the part of the pulses without an earlier photon, and w is a/(N·(e^(λ/N) - 1)).

    Args:
        scene: range, albedo and cosine; the bound is that of the first return, when the second return is known, and that of half the
            path of light where the source is not at the camera.
        camera: bins, pulse, photons, background (which is known) and pulses.

    Returns:
        [rows, cols] float64 metres; infinite where the histogram contains no light of the return.

    Source:
        Bar-David, "Communication under the Poisson regime", IEEE Trans. Information Theory 15(1), 1969; Kay, "Fundamentals of
        Statistical Signal Processing: Estimation Theory", 1993, section 3.7 (an unknown that is not asked for).
    """
    mean = histograms(scene, replace(camera, pulses=None))
    edges = camera.start_s + camera.bin_s * np.arange(camera.bins + 1)
    half_path, signal = scene.returns(camera.signal_photons)[0]
    away = (edges - 2 * half_path[..., None] / SPEED_OF_LIGHT) / camera.pulse_sigma_s
    by_time = -signal[..., None] * np.diff(np.exp(-0.5 * away**2), axis=-1) / (camera.pulse_sigma_s * (2 * np.pi) ** 0.5)
    only = histograms(replace(scene, second_part=0.0), replace(camera, pulses=None, background=0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        if camera.pulses is None:
            weight = 1 / mean
        else:
            live = np.exp(-(np.cumsum(mean, axis=-1) - mean) / camera.pulses)
            weight = live / (camera.pulses * np.expm1(mean / camera.pulses))
        weight = np.where(mean > 0, weight, 0)
        tt, ts, ss = ((a * b * weight).sum(axis=-1) for a, b in ((by_time, by_time), (by_time, only), (only, only)))
        sigma_s = 1 / np.sqrt(np.maximum(tt - np.where(ss > 0, ts**2 / ss, 0), 0))
    return 0.5 * SPEED_OF_LIGHT * sigma_s
