"""Statistics."""
from typing import Sequence


def percentile(values: Sequence[float], percent: float) -> float:
    """Return the least value that `percent` % of the values do not exceed; NaN without any."""
    if not values:
        return float('nan')
    ordered = sorted(values)
    rank = -(-len(ordered) * percent // 100)       # rounded up
    return ordered[max(0, int(rank) - 1)]
