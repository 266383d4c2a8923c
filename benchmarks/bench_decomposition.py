"""The auxiliary decomposition against plain `numpy.linalg` eig and qr, and the control rate.

Both sides return T_y, T_a, Lambda, R; ours also validates its input, sorts, fixes signs and refuses
complex, defective and singular systems. `numpy_eig_qr` is the two calls alone, nothing around them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from cmc.theory.auxiliary import decompose
from cmc.theory.tracking import Tracker


def plain(f_y: np.ndarray, f_u: np.ndarray) -> tuple[np.ndarray, ...]:
    """The explicit solution in five lines of numpy, without any check."""
    eigenvalues, V = np.linalg.eig(f_y)
    T_y = np.linalg.inv(V)
    Q, R_qr = np.linalg.qr(np.swapaxes(T_y @ f_u, -1, -2)[..., ::-1])
    return T_y, Q[..., ::-1], eigenvalues, np.swapaxes(R_qr, -1, -2)[..., ::-1, ::-1]


def two_calls(f_y: np.ndarray, f_u: np.ndarray) -> None:
    np.linalg.eig(f_y)
    np.linalg.qr(f_u)


def seconds(call: Callable[[], object], number: int, repeats: int = 9) -> float:
    """Best CPU time of one call."""
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        for _ in range(number):
            call()
        best = min(best, (time.process_time() - start) / number)
    return best


def systems(n: int, number: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(n)
    V = np.eye(n) + 0.3 * rng.normal(size=(number, n, n))
    f_y = V @ (-rng.uniform(0.5, 9.0, (number, n, 1)) * np.linalg.inv(V))
    return f_y, rng.normal(size=(number, n, n))


def run() -> Iterator[dict]:
    for label, n, number, loops in (("one 2x2", 2, 1, 2000), ("100000 of 2x2", 2, 100_000, 1)):
        f_y, f_u = systems(n, number)
        if number == 1:
            f_y, f_u = f_y[0], f_u[0]
        ours = seconds(lambda: decompose(f_y, f_u), loops)  # noqa: B023
        full = seconds(lambda: plain(f_y, f_u), loops)  # noqa: B023
        least = seconds(lambda: two_calls(f_y, f_u), loops)  # noqa: B023
        yield {
            "name": f"decompose {label}",
            "ratio": round(full / ours, 2),
            "ratio_numpy_eig_qr": round(least / ours, 2),
            "microseconds": round(1e6 * ours, 2),
        }
    for n in (2, 6):
        f_y, f_u = systems(n, 1)
        once = seconds(lambda: decompose(f_y[0], f_u[0]), 500)  # noqa: B023
        tracker = Tracker()
        tracked = seconds(lambda: tracker.update(f_y[0], f_u[0]), 500)  # noqa: B023
        full = seconds(lambda: plain(f_y[0], f_u[0]), 500)  # noqa: B023
        yield {
            "name": f"control rate at n = {n}",
            "ratio": round(full / once, 2),
            "rate_hz": round(1.0 / once),
            "tracked_rate_hz": round(1.0 / tracked),
        }
