"""The auxiliary decomposition against plain `numpy.linalg` eig and qr, and the control rate.

Both sides return T_y, T_a, Lambda, R; ours also validates its input, sorts, fixes signs and refuses
complex, defective and singular systems. `numpy_eig_qr` is the two calls alone, nothing around them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks import best
from cmc.theory.auxiliary import decompose
from cmc.theory.tracking import Tracker


def plain(f_y: np.ndarray, f_u: np.ndarray) -> tuple[np.ndarray, ...]:
    """The explicit solution in five lines of numpy, without any check."""
    eigenvalues, V = np.linalg.eig(f_y)
    T_y = np.linalg.inv(V)
    Q, R_qr = np.linalg.qr(np.swapaxes(T_y @ f_u, -1, -2)[..., ::-1])
    return T_y, Q[..., ::-1], eigenvalues, np.swapaxes(R_qr, -1, -2)[..., ::-1, ::-1]


def systems(n: int, number: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(n)
    V = np.eye(n) + 0.3 * rng.normal(size=(number, n, n))
    f_y = V @ (-rng.uniform(0.5, 9.0, (number, n, 1)) * np.linalg.inv(V))
    return f_y, rng.normal(size=(number, n, n))


def measure(f_y: np.ndarray, f_u: np.ndarray, number: int) -> dict[str, float]:
    tracker = Tracker()
    calls = {
        "ours": lambda: decompose(f_y, f_u),
        "plain": lambda: plain(f_y, f_u),
        "two calls": lambda: (np.linalg.eig(f_y), np.linalg.qr(f_u)),
    }
    if f_y.ndim == 2:
        calls["tracked"] = lambda: tracker.update(f_y, f_u)
    return best(calls, number)


def run() -> Iterator[dict]:
    for n, number, loops in ((2, 1, 2000), (2, 100_000, 1), (6, 1, 500)):
        f_y, f_u = systems(n, number)
        cost = measure(f_y[0], f_u[0], loops) if number == 1 else measure(f_y, f_u, loops)
        row = {
            "name": f"decompose, {number} of {n}x{n}",
            "ratio": round(cost["plain"] / cost["ours"], 2),
            "ratio_numpy_eig_qr": round(cost["two calls"] / cost["ours"], 2),
            "microseconds": round(1e6 * cost["ours"], 2),
        }
        if number == 1:
            row |= {"rate_hz": round(1.0 / cost["ours"])}
            row |= {"tracked_rate_hz": round(1.0 / cost["tracked"])}
        yield row
