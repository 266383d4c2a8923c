"""Another plant in the plant cell of lessons 05 and 07: figures of that plant, or a refusal."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest
from lesson import run
from scipy.linalg import expm

PLANTS = {
    "three": (
        [[-2.0, 1.0, 0.0], [0.5, -1.0, 0.3], [0.0, 0.2, -0.5]],
        [[1.0, 2.0, 0.0], [1.5, 1.0, 0.3], [0.2, 0.1, 1.0]],
    ),
    "complex": ([[-0.6, 3.0], [-2.0, -0.2]], [[1.0, 0.3], [-0.5, 1.2]]),
    "unstable": ([[-1.0, 3.0], [0.5, -1.0]], [[0.5, -1.5], [-1.0, 1.5]]),
    "defective": ([[-1.0, 1.0], [0.0, -1.0]], [[1.0, 0.2], [0.3, 1.0]]),
}
"""f_y and f_u of each, 1/s."""
EVERY = pytest.mark.parametrize("name", PLANTS)


@cache
def answer(number: str, name: str):
    f_y, f_u = PLANTS[name]
    source = f"plant = plants.LinearPlant({f_y}, {f_u})\ny_star = np.zeros(plant.n)"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CMC_FAST", "1")
        return run(number, plant=source)


def arrays(name):
    return tuple(np.array(m) for m in PLANTS[name])


def numbers(text, words):
    """The numbers behind `words` in the one printed line that contains them."""
    (line,) = [line for line in text.splitlines() if words in line]
    return [float(x) for x in re.findall(r"-?\d+\.?\d*(?:e[-+]\d+)?", line.split(words)[1])]


def largest(M):
    return np.linalg.eigvals(M).real.max()


def loop(A, B, p, q):
    n = len(A)
    return np.block([[A + B @ np.diag(p), B @ np.diag(q)], [np.eye(n), np.zeros((n, n))]])


@EVERY
def test_05_verdicts_are_those_of_the_plant(name):
    lesson, (f_y, f_u) = answer("05", name), arrays(name)
    space = lesson.space
    build = {"complex": "feedback", "defective": "schur"}.get(name, "decompose")
    assert f"T_y and T_a come from {build}" in lesson.text
    assert ("Refused: decompose" in lesson.text) == (build != "decompose")
    index = np.linalg.det(f_u) / np.prod(np.diag(f_u))
    assert numbers(lesson.text, "(product of its diagonal)")[0] == pytest.approx(index, rel=0.01)
    sign = -np.sign(np.diag(f_u))
    for p in (0.1, 1.0, 10.0):
        wanted = largest(loop(f_y, f_u, sign * p, sign * p / 2))
        assert space["growth"](space["spaces"]["identity transforms"], p) == pytest.approx(wanted)
    L, R, h = space["Lambda"], space["R"], space["tau"] / 2
    assert np.abs(np.linalg.eigvals(f_y).real - L).min() < 1e-6
    p_edge = L / R / np.tanh(L * h / 2)  # without an integral, (1 + phi) / G
    held = expm(h * np.array([[L, R], [0.0, 0.0]]))[0]
    assert held[0] - held[1] * p_edge == pytest.approx(-1.0)
    assert space["error"] < 0.02  # measured by running, against the formula
    found, interval = space["certify"](space["networks"], space["linear"]), space["interval"]
    if build == "decompose" and found:
        for q in (0.25, 1.0):  # what is certified decays at the corners of the interval
            p = -space["signs"] * interval[1][0]
            T_y, T_a = space["space"].T_y, space["space"].T_a
            J = loop(T_y @ f_y @ np.linalg.inv(T_y), T_y @ f_u @ T_a, -p, space["signs"] * q)
            assert largest(J) < 0
    assert ("no certificate for this interval" in lesson.text) == (not space["verdict"])


@EVERY
def test_07_promises_and_edges_are_those_of_the_plant(name):
    lesson, (f_y, f_u) = answer("07", name), arrays(name)
    space, n = lesson.space, len(f_y)
    T_y, T_a = space["space"].T_y, space["space"].T_a
    slopes = space["corner_slopes"][-1]
    L, R = T_y @ f_y @ np.linalg.inv(T_y), T_y @ f_u @ T_a
    J = loop(L, R, *(space["signs"] * slopes.T))
    assert min(np.abs(J - K).max() for K in space["corners"]) < 1e-9
    # a constant disturbance at rest, in the plant's own coordinates: y' = 0 and int z answers
    assert space["constant"] < 1e-9
    # no promise lies below what a sine can do at this corner
    c = np.concatenate([np.linalg.inv(T_y)[0], np.zeros(n)])
    B = np.vstack([T_y, np.zeros((n, n))])
    for w in (0.3, 1.0, 3.0):
        gain = np.linalg.norm(c @ np.linalg.solve(1j * w * np.eye(2 * n) - J, B))
        assert gain / np.sqrt(2) < min(list(space["ladder"].values())[:5])
        assert gain / np.sqrt(2) < space["exact"] * 1.02
    values = list(space["ladder"].values())
    assert values[0] > values[1]
    assert values[2:5] == sorted(values[2:5], reverse=True)  # one metric: ball, ellipsoid; shaped
    assert (space["caused"] < min(values[:5])).all()
    eigenvalue, h = -space["speed"], space["h"]
    assert np.abs(np.abs(np.linalg.eigvals(f_y).real) - space["speed"]).min() < 1e-6
    step = space["late_step"](1.0, 0.0, 0.0)
    held = expm(h * np.array([[eigenvalue, space["gain"]], [0.0, 0.0]]))[0]
    assert step[0, 0] == pytest.approx(held[0] - held[1])
