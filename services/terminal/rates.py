"""Success rates as text."""

from __future__ import annotations

from services.trials.success import Rate


def rate_text(rate: Rate, *, digits: int = 1) -> str:
    """Rate and Wilson interval in percent, such as `67.0 (39.1 to 86.2)`.

    Args:
        rate: the rate.
        digits: decimal places.
    """
    return f"{percent_text(rate.rate, digits)} ({interval_text(rate.wilson95, digits)})"


def interval_text(interval: tuple[float, float], digits: int = 1) -> str:
    """Both ends of an interval in percent, such as `39.1 to 86.2`."""
    low, high = interval
    return f"{percent_text(low, digits)} to {percent_text(high, digits)}"


def percent_text(fraction: float, digits: int = 1) -> str:
    """A fraction in percent, such as `67.0`."""
    return f"{100 * fraction:.{digits}f}"


def difference_text(difference: float, interval: tuple[float, float]) -> str:
    """A difference of rates and its interval in points, such as `+8.0 (-1.5 to +17.2)`."""
    low, high = interval
    return f"{100 * difference:+.1f} ({100 * low:+.1f} to {100 * high:+.1f})"
