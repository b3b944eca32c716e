"""Gauge studies: the example of AIAG's book, variances that are known, and the F distribution."""

import numpy as np
import pytest

from service.boards.gauge_board import gauge_study

AIAG = np.array([
    [[0.29, -0.56, 1.34, 0.47, -0.80, 0.02, 0.59, -0.31, 2.26, -1.36], [0.41, -0.68, 1.17, 0.50, -0.92, -0.11, 0.75, -0.20, 1.99, -1.25],
     [0.64, -0.58, 1.27, 0.64, -0.84, -0.21, 0.66, -0.17, 2.01, -1.31]],
    [[0.08, -0.47, 1.19, 0.01, -0.56, -0.20, 0.47, -0.63, 1.80, -1.68], [0.25, -1.22, 0.94, 1.03, -1.20, 0.22, 0.55, 0.08, 2.12, -1.62],
     [0.07, -0.68, 1.34, 0.20, -1.28, 0.06, 0.83, -0.34, 2.19, -1.50]],
    [[0.04, -1.38, 0.88, 0.14, -1.46, -0.29, 0.02, -0.46, 1.77, -1.49], [-0.11, -1.13, 1.09, 0.20, -1.07, -0.67, 0.01, -0.56, 1.45, -1.77],
     [-0.15, -0.96, 0.67, 0.11, -1.45, -0.49, 0.21, -0.49, 1.87, -2.16]],
]).transpose(2, 0, 1)
"""The study of AIAG, Measurement Systems Analysis, 4th edition, figure III-B 15: [parts, operators, trials]."""


def test_the_example_of_the_book():
    """Table III-B 7 of the book: EV 0.199933, AV 0.226838, GRR 0.302373, PV 1.042327, 27.86 %, four categories."""
    study = gauge_study(AIAG)
    assert study.interaction is None  # F is 0.434, so that it is pooled
    found = study.repeatability, study.reproducibility, study.gauge, study.part
    assert found == pytest.approx((0.199933, 0.226838, 0.302373, 1.042327), abs=1e-5)
    assert study.gauge_percent == pytest.approx(27.86, abs=0.01)
    assert study.categories == 4
    assert study.tolerance_percent(8.0) == pytest.approx(100 * 6 * 0.302373 / 8, rel=1e-5)


def test_known_variances_come_back():
    """40 parts, 12 operators, 6 trials: standard deviations to 3 %, of operators and their interaction to 25 %."""
    rng = np.random.default_rng(3)
    shape = (40, 12, 6)
    values = (3.0 * rng.standard_normal(shape[0])[:, None, None] + 0.8 * rng.standard_normal(shape[1])[None, :, None]
              + 0.5 * rng.standard_normal(shape[:2])[..., None] + 0.4 * rng.standard_normal(shape))
    study = gauge_study(values)
    assert study.repeatability == pytest.approx(0.4, rel=0.05)
    assert study.interaction == pytest.approx(0.5, rel=0.1)
    assert study.reproducibility == pytest.approx(np.hypot(0.8, 0.5), rel=0.35)
    assert study.part == pytest.approx(3.0, rel=0.25)


def test_one_operator_tells_the_repeatability_alone():
    study = gauge_study(AIAG[:, :1])
    assert study.reproducibility is None and study.interaction is None
    assert study.repeatability == pytest.approx(np.sqrt(AIAG[:, 0].var(axis=1, ddof=1).mean()))
    assert study.gauge == study.repeatability


def test_too_little_is_refused():
    with pytest.raises(ValueError, match="there are 1 parts and 3 trials: two or more of each are"):
        gauge_study(AIAG[:1])
