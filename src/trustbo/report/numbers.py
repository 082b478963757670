"""Numbers and words as text."""

import math

MINUS, NONE = "\N{MINUS SIGN}", "\N{EN DASH}"


def number(value: float, decimals: int | None = None) -> str:
    """Format a number with `decimals` decimals; by default to about three significant digits.

    NaN is a dash; the minus is a minus sign, not a hyphen.
    """
    if not math.isfinite(value):
        return NONE if math.isnan(value) else f"{'' if value > 0 else MINUS}\N{INFINITY}"
    if decimals is None:
        if value != 0.0 and abs(value) < 1e-3:
            return f"{value:.1e}".replace("-", MINUS)
        decimals = (
            3 if abs(value) < 1.0 else 2 if abs(value) < 10.0 else 1 if abs(value) < 100 else 0
        )
    text = f"{value:.{decimals}f}"
    return text.replace("-", MINUS) if float(text) else text.lstrip("-")


def decimals_for(spread: float) -> int:
    """Return the number of decimals that shows a spread, such as an sd, to two digits; 0 to 6."""
    if not math.isfinite(spread) or spread <= 0.0:
        return 3
    return min(max(1 - math.floor(math.log10(spread)), 0), 6)


def counted(n: int, noun: str) -> str:
    """Format a count: "1 mission", "2 missions"."""
    return f"{n} {noun}{'' if n == 1 else 's'}"
