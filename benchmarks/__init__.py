"""Benchmarks: ratios measured in one run."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping


def best(
    calls: Mapping[str, Callable[[], object]], number: int = 1, repeats: int = 9
) -> dict[str, float]:
    """CPU seconds of one call of each, the best of repeats (of `number` calls) that take turns."""
    lowest = dict.fromkeys(calls, float("inf"))
    for _ in range(repeats):
        for name, call in calls.items():
            start = time.process_time()
            for _ in range(number):
                call()
            lowest[name] = min(lowest[name], (time.process_time() - start) / number)
    return lowest
