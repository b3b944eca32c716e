"""Whatever a camera hands over, no decoder returns what is no number."""

import numpy as np
import pytest

from kernels.structured.unwrap import unwrap_jointly
from stage.patterns.kary import kary_patterns
from stage.patterns.phase import phase_patterns
from tests.kernels.structured import test_kary, test_phase, test_ramp, test_robust_phase, test_stripes
from tests.scenes.patterns import NOISE, frames_of

PHASES, LEVELS, STRIPES = phase_patterns("column", (16, 18, 21), 4), kary_patterns(1280, "column", base=3), test_stripes.patterns_of("gray")


def phases(stack, device):
    wrapped = test_phase.wrapped_of(stack, PHASES, device)
    return *wrapped[:4], *unwrap_jointly(wrapped, extent=1280)


def ratio(stack, device, second):
    return test_ramp.decode_ramp(frames_of(stack, device), up=test_ramp.UP, black=test_ramp.BLACK, extent=1280, noise=NOISE, **second)


DECODERS = {"phase": (len(PHASES), phases), "micro": (len(test_robust_phase.MICRO), test_robust_phase.micro),
            "modulated": (len(test_robust_phase.MODULATED), test_robust_phase.modulated),
            "levels": (len(LEVELS), lambda stack, device: test_kary.decode(stack, LEVELS, device)),
            "stripes": (len(STRIPES), lambda stack, device: test_stripes.decode(stack, STRIPES, device)),
            "two ramps": (4, lambda stack, device: ratio(stack, device, {"down": test_ramp.DOWN})),
            "ramp and white": (4, lambda stack, device: ratio(stack, device, {"white": test_ramp.WHITE}))}


@pytest.mark.parametrize("name", DECODERS)
def test_nothing_is_nan_whatever_the_input(name, device):
    frames, decode = DECODERS[name]
    stack = np.random.default_rng(7).choice([np.nan, np.inf, -np.inf, -1, 0, 1e-7, 1, 65504], size=(frames, 4000),
                                            p=[0.02, 0.02, 0.02, 0.04, 0.3, 0.2, 0.3, 0.1])
    for array in decode(stack, device):
        assert np.isfinite(array if isinstance(array, np.ndarray) else array.numpy()).all()
