"""Limits of sums of squared errors, which are distributed as chi-squared where noise alone makes them."""

SIGNAL_Z = 4.75
"""Standard normal quantile of the signal test: one pixel in a million without signal is taken to have one."""


def quantile(freedom: int, z: float) -> float:
    """Return a quantile of the chi-squared distribution, by Wilson and Hilferty's approximation (PNAS 1931): error below 3 % here."""
    a = 2 / (9 * freedom)
    return float(freedom * (1 - a + z * a**0.5) ** 3)


def signal_limits(frequencies: int) -> list[float]:
    """Return the least sums of evidence that noise alone does not reach, over 1, 2, … frequencies."""
    return [quantile(2 * used, SIGNAL_Z) for used in range(1, frequencies + 1)]
