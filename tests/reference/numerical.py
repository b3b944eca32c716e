"""Numerical derivatives in float64. Imports nothing of ours."""


def slopes(function, at, step=1e-6):
    """Return the derivatives of a function of several arrays by each of them, by central differences."""
    found = []
    for place in range(len(at)):
        above, below = (function(*(value + sign * step * (place == other) for other, value in enumerate(at))) for sign in (1, -1))
        found.append((above - below) / (2 * step))
    return found
