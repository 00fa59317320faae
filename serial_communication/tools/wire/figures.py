"""Figures of many values."""
from typing import Sequence


def percentile(values: Sequence[float], percent: float) -> float:
    """The smallest of the values that `percent` % of them do not exceed; nan without any."""
    if not values:
        return float('nan')
    ordered = sorted(values)
    rank = -(-len(ordered) * percent // 100)       # rounded up
    return ordered[max(0, int(rank) - 1)]
