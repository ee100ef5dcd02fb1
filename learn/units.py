"""Numbers and times as reports write them."""

from __future__ import annotations

import math


def number(value: float) -> str:
    """Two significant digits, scientific outside 0.01..9999: 1.2e-4, 0.33, 17, 1200."""
    if value == 0:
        return "0"
    if not math.isfinite(value):
        return "∞" if value > 0 else "–"
    if 0.01 <= abs(value) < 9999.5:
        rounded = float(f"{value:.2g}")
        return f"{rounded:.0f}" if abs(rounded) >= 10 else f"{rounded:.2g}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def duration(seconds: float) -> str:
    """A time with its unit: 0.84 ms, 1.2 s, 7.5 min, 3.1 h."""
    for limit, unit, name in ((1e-3, 1e-6, "µs"), (1.0, 1e-3, "ms"), (120.0, 1.0, "s"), (7200.0, 60.0, "min")):
        if seconds < limit:
            return f"{seconds / unit:.3g} {name}"
    return f"{seconds / 3600:.3g} h"
