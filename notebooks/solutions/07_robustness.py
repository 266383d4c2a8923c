"""Solutions of the exercises of lesson 07."""

import numpy as np
from scipy.linalg import expm


def my_disturbance(t, J, B, row, end):
    """Along B^T e^(J^T (end - t)) row^T, which is how d(t) enters row xi(end)."""
    weight = row @ expm(J * (end - t)) @ B
    return weight / np.linalg.norm(weight)


def my_edge(radius, top):
    """A grid finds the first cell that crosses 1, bisection the place in it."""
    grid = np.linspace(0, top, 601)[1:]
    first = next(k for k, p in enumerate(grid) if radius(p) >= 1)
    low, high = (grid[first - 1] if first else 0.0), grid[first]
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if radius(middle) >= 1 else (middle, high)
    return high


def my_integral(ahead, integral, z, wanted, limit, p, q):
    """Back-calculation: the integral that makes the command equal to its limit."""
    if abs(wanted) <= limit:
        return ahead
    return -(np.sign(wanted) * limit + p * z) / q
