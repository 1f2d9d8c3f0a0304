"""The result of a check: measured values, each with the expected value and its tolerance."""

from __future__ import annotations

from typing import NamedTuple


class Comparison(NamedTuple):
    """A measured value beside the expected one.

    Attributes:
        quantity: Name of the quantity.
        measured: Measured value.
        expected: Expected value.
        tolerance: Largest absolute difference that passes.
        unit: Unit of these three values, empty for a ratio.
    """

    quantity: str
    measured: float
    expected: float
    tolerance: float
    unit: str

    @property
    def passed(self) -> bool:
        """Whether the difference is within the tolerance; NaN never passes."""
        return abs(self.measured - self.expected) <= self.tolerance

    def __str__(self) -> str:
        """Returns the comparison as one line of text."""
        bounds = f"{self.expected:.5g} ± {self.tolerance:.2g}"
        return f"{self.quantity}: {self.measured:.5g}, expected {bounds} {self.unit}".strip()


Report = list[Comparison]


class CheckFailed(AssertionError):
    """A measured value is out of tolerance.

    Attributes:
        comparison: The comparison that failed.
    """

    def __init__(self, comparison: Comparison) -> None:
        """Takes the comparison that failed."""
        super().__init__(str(comparison))
        self.comparison = comparison


def compare(
    quantity: str, measured: float, expected: float, unit: str = "", *, relative: float = 0.0, absolute: float = 0.0
) -> Comparison:
    """Compares a measured value with an expected one; the tolerance is `absolute` + `relative` · |expected|."""
    tolerance = absolute + relative * abs(expected)
    return Comparison(quantity, float(measured), float(expected), float(tolerance), unit)


def between(quantity: str, measured: float, low: float, high: float, unit: str = "") -> Comparison:
    """Compares a measured value with an interval, bounds included."""
    middle = (low + high) / 2
    return compare(quantity, measured, middle, unit, absolute=max(middle - low, high - middle))
