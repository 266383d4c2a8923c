"""Another plant in a lesson's plant cell: the lesson answers about it, or refuses in one line."""

from __future__ import annotations

import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from lesson import run
from scipy.linalg import expm

TESTS = Path(__file__).resolve().parent
Y_STAR = "\ny_star = np.zeros(plant.n)"
PLANTS = {
    "real": ([[-1.0, 0.3], [0.0, -2.0]], [[1.0, 0.2], [0.1, 1.0]]),
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
NOT_REAL = pytest.mark.parametrize("name", [name for name in PLANTS if name != "real"])


@cache
def answer(number: str, name: str):
    f_y, f_u = PLANTS[name]
    return run(number, plant=f"plant = plants.LinearPlant({f_y}, {f_u}){Y_STAR}")


def arrays(name):
    return tuple(np.array(m) for m in PLANTS[name])


def numbers(text, words):
    """The numbers in the first printed line that contains `words`."""
    line = next(line for line in text.splitlines() if words in line)
    return [float(x) for x in re.findall(r"-?\d+\.?\d*(?:e[-+]\d+)?", line.split(words)[1])]


def largest(M):
    return np.linalg.eigvals(M).real.max()


def loop(A, B, p, q):
    n = len(A)
    return np.block([[A + B @ np.diag(p), B @ np.diag(q)], [np.eye(n), np.zeros((n, n))]])


@EVERY
def test_01_rates_and_metric_are_those_of_the_plant(name):
    lesson, (f_y, _) = answer("01", name), arrays(name)
    slowest = -largest(f_y)
    assert numbers(lesson.text, "slowest eigenvalue of f_y at y_star")[0] == pytest.approx(
        slowest, abs=6e-4
    )
    h = 1e-6  # the plain rate as a derivative of the worst distance
    plain = -(np.linalg.norm(expm(f_y * h), 2) - 1) / h
    assert numbers(lesson.text, "proved in the plain distance")[0] == pytest.approx(plain, abs=1e-3)
    if name != "defective":  # t e^-t is no line
        assert numbers(lesson.text, "measured rate")[0] == pytest.approx(slowest, abs=0.05)
    assert ("Refused" in lesson.text) == (slowest <= 0)
    moved = lesson.space["pushed"](0.5)
    np.testing.assert_allclose(moved["apart"], lesson.space["calm"]["apart"], rtol=1e-4, atol=1e-4)
    J_h, M = lesson.space["lens"](2.0, 0.5)
    np.testing.assert_allclose(np.poly(J_h), np.poly(f_y), atol=1e-8)
    data = lesson.space["lean"](2.0, 0.5, 0.3)
    np.testing.assert_allclose(data["circle_t"][0], expm(0.3 * J_h)[:2, 0], atol=1e-9)
    if slowest > 0:
        assert np.linalg.eigvalsh(J_h.T @ M + M @ J_h + slowest * M).max() < 1e-8
    else:
        assert "Refused: no metric" in data["text"]


@pytest.mark.parametrize("number", ["01", "03"])
def test_one_signal_is_refused_in_one_line(number):
    plant = "plant = plants.LinearPlant([[-1.0]], [[2.0]])\ny_star = np.zeros(1)"
    text = run(number, plant=plant).text
    assert "Refused: one signal has no neighbor to part from" in text


@EVERY
def test_02_shares_are_those_of_the_plant(name):
    lesson, (f_y, f_u) = answer("02", name), arrays(name)
    space, n = lesson.space, len(f_y)
    build = {"complex": "feedback", "defective": "schur"}.get(name, "decompose")
    assert f"T_y and T_a come from {build}" in lesson.text
    assert ("Refused: decompose" in lesson.text) == (build != "decompose")
    np.testing.assert_allclose(space["T_y"] @ f_y, space["Lambda"] @ space["T_y"], atol=1e-9)
    np.testing.assert_allclose(space["T_y"] @ f_u @ space["T_a"], space["R"], atol=1e-9)
    k_p, k_i = space["k_p"][:400], space["k_i"][:400]
    sign = -np.sign(np.diag(f_u))
    worst = [largest(loop(f_y, f_u, sign * a, sign * b)) for a, b in zip(k_p, k_i, strict=True)]
    np.testing.assert_allclose(space["straight"][:400], worst, atol=1e-8)
    share = float(re.search(r"([\d.]+)% of \d+ loops decay", lesson.text)[1])
    assert share == pytest.approx(100 * np.mean(np.array(worst) < 0), abs=8)
    best = [
        largest(loop(f_y, f_u[:, space["order"]] * space["signs"], -a, -b))
        for a, b in zip(k_p[:50], k_i[:50], strict=True)
    ]
    np.testing.assert_allclose(space["swapped"][:50], best, atol=1e-8)
    assert (space["auxiliary"] < 1e-9).all()  # the right signs, above the floor: always
    assert ("Refused: this picture is a plane" in lesson.text) == (n != 2)
    if n == 2:
        J = numbers(space["warp"](1.0)["text"], "J_21 =")[0]
        assert abs(J) < 0.01 or name == "complex"
        R = space["turn"](space["right"])["R"]
        assert abs(R[1, 0]) < 1e-3
        np.testing.assert_allclose(
            abs(np.linalg.det(R)), abs(np.linalg.det(space["T_y"] @ f_u)), rtol=0.02
        )
    out = space["coordinates"](1.0, 1.0, 1.0, "straight wires")
    wanted = largest(loop(f_y, f_u, sign, sign))
    assert f"{wanted:.3f}" in out["text"]
    growth = space["leaning"](0.0)
    t = growth["t"][7]
    np.testing.assert_allclose(growth["y"][7], np.linalg.norm(expm(f_y * t), 2), rtol=1e-6)


@EVERY
def test_03_forms_are_those_of_the_plant(name):
    lesson, (f_y, _) = answer("03", name), arrays(name)
    space, n = lesson.space, len(f_y)
    if name == "defective":
        assert "This lesson goes on with the spiral." in lesson.text
        return
    np.testing.assert_allclose(space["f_y"], f_y)
    eig = np.linalg.eigvals(f_y)
    assert ("They exist: this plant has no complex pair." in lesson.text) == np.isreal(eig).all()
    if n == 2:
        gap = eig[0] - eig[1]
        found = max(p.max() for p in space["products"].values())
        assert found == pytest.approx((gap**2).real / 4, abs=2e-3)
        verdict = "no T_y makes A triangular" if name == "complex" else "a hierarchy exists"
        assert verdict in lesson.text
    else:
        assert "Refused: the figure turns a plane" in lesson.text
    stable = eig.real.max() < 0
    assert ("Refused: the form needs negative real parts" in lesson.text) == (not stable)
    F = space["F"]
    off = F + F.T
    for i in range(n):
        off[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = 0
    np.testing.assert_allclose(off, 0.0, atol=1e-8)  # skew couplings, for every plant
    assert (np.linalg.eigvalsh(F + F.T).max() < 0) == stable
    if stable:
        assert max(space["found"]["frozen"]) < 0
        assert max(space["found"]["T_a without slopes"]) < 1e-6
    assert (np.diff(space["V"]) < 1e-12).all()
    row = next(row for row in space["rows"] if row[0] == "your plant")
    assert space["head"][:4] == [
        "hierarchical",
        "schur",
        "feedback (policies)",
        "feedback (constant slopes)",
    ]
    assert row[1:5] == [
        "no" if name == "complex" else "yes",
        "no" if name == "complex" else "yes",
        "yes",
        "yes" if stable else "no",
    ]


@EVERY
def test_04_transforms_and_floors_are_those_of_the_plant(name):
    lesson, (f_y, f_u) = answer("04", name), arrays(name)
    space = lesson.space
    if name in ("complex", "defective"):
        assert lesson.text.splitlines()[1].startswith("Refused: f_y has")
        assert "go on with the coupled lags" in lesson.text
        return
    np.testing.assert_allclose(space["f_y"], f_y)
    for words in ("Lambda off its diagonal", "R below its diagonal", "T_a^T T_a against I"):
        assert numbers(lesson.text, words)[-1] < 1e-9
    eig = np.sort(np.linalg.eigvals(f_y).real)[::-1]
    np.testing.assert_allclose(np.diag(space["Lambda"]), eig, atol=1e-9)
    # |R_ii| by determinants: R = T_y f_u T_a with an orthogonal T_a
    assert np.prod(abs(np.diag(space["space"].R))) == pytest.approx(
        abs(np.linalg.det(f_u) / np.linalg.det(space["V"]))
    )
    lift = 0.8 - eig[0]
    wanted = np.maximum(eig + lift, 0) / abs(np.diag(space["space"].R))
    np.testing.assert_allclose(space["floor"], wanted, atol=1e-9)
    for factor, decays in ((0.98, False), (1.02, True)):
        assert (largest(space["loop"](factor * wanted.max())) < 0) == decays


@NOT_REAL
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


@NOT_REAL
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


@pytest.mark.parametrize("number", ["01", "02", "03", "04"])
def test_the_lesson_needs_neither_torch_nor_mujoco(number):
    """Every cell runs where both are absent."""
    code = f"""
import sys
sys.modules["torch"] = sys.modules["mujoco"] = None
sys.path.insert(0, {str(TESTS)!r})
from lesson import run
run({number!r})
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
