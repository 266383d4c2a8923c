"""Lesson 03: modules in combination, hierarchical and feedback."""

from __future__ import annotations

from typing import Any

import numpy as np

from cmc import plants
from cmc.fast import budget
from cmc.lessons.linear_loop import flow, growth, largest_real_part
from cmc.theory.auxiliary import AuxiliarySpace, decompose, inverse
from cmc.theory.certificates import loop_jacobian
from cmc.theory.combinations import (
    Possibility,
    feedback,
    feedback_gain,
    possible_combinations,
    real_block_form,
)
from cmc.theory.differential import F, F_without_integral
from cmc.theory.margins import symmetric_bound
from cmc.theory.spectrum import Array

KINDS = ("general", "hierarchical", "feedback")
SELF = np.array([[[-1.0, 1.2], [-0.8, -0.4]], [[-0.6, 0.9], [-1.1, -0.8]]])
"""Self-feedback of two modules, (module, 2, 2) [1/s]; both contract in the identity metric."""
SHEARS = (0.0, 0.4, 0.8)
"""Shears of T_y in `coupling_products`."""
COUPLING = np.array([[0.6, 1.0], [0.9, 0.4]])
"""What module 2 does to module 1 at unit strength, (2, 2) [1/s]."""


def combined(strength: float, kind: str) -> Array:
    """Two modules (delta_1, delta_2) coupled with a strength, (4, 4) [1/s].

    Raises:
        ValueError: if the kind is not "general", "hierarchical" or "feedback".
    """
    into_1 = strength * COUPLING
    back = {"general": into_1, "hierarchical": 0.0 * into_1, "feedback": -into_1.T}
    if kind not in back:
        raise ValueError(f"wanted a kind among {', '.join(KINDS)}, got {kind!r}")
    return np.block([[SELF[0], into_1], [back[kind], SELF[1]]])


def two_modules(strength: float, kind: str) -> dict[str, Any]:
    """Distances of both modules after a unit nudge of each, and the eigenvalues of the whole."""
    M, t = combined(strength, kind), np.linspace(0.0, 12.0, 300)
    start = np.array([0.7, 0.1, 0.1, 0.7])
    d = flow(M, start, t).reshape(len(t), 2, 2)
    sizes = np.linalg.norm(d, axis=-1)
    worst, bound = float(largest_real_part(M)), float(symmetric_bound(M))
    return {
        "t": t,
        "module_1": np.minimum(sizes[:, 0], 1e6) + 1e-12,
        "module_2": np.minimum(sizes[:, 1], 1e6) + 1e-12,
        "eig": np.linalg.eigvals(M).astype(complex),
        "M": M,
        "worst": worst,
        "text": f"largest real part {worst:.2f} 1/s, growth of a distance at most {bound:.2f} 1/s",
    }


def cascade(strength: float, modules: int = 4) -> dict[str, Any]:
    """Size of each module's difference in a hierarchy: module n is free, module i hears i + 1..n.

    Every module has rate 1/s by itself; the differences start at one in module n, zero elsewhere.
    """
    J = -np.eye(modules) + strength * np.diag(np.ones(modules - 1), 1)
    t = np.linspace(0.0, 14.0, 280)
    start = np.zeros(modules)
    start[-1] = 1.0
    sizes = np.abs(flow(J, start, t))
    return {
        "t": t,
        "sizes": np.where(sizes > 0.0, sizes, np.nan),
        "bars": np.round(sizes[:, ::-1, None], 2),
        "free": sizes[:, -1],
        "driven": sizes[:, :-1],
        "growth": growth(J, t),
        "text": f"largest on the way {sizes.max():.2f}, at the end {sizes[-1].max():.1e}",
    }


def spiral() -> tuple[Array, Array]:
    """Jacobians of the plant "spiral", whose eigenvalues are a complex pair."""
    plant = plants.get("spiral")
    return plant.f_y([0, 0], [0, 0]), plant.f_u([0, 0], [0, 0])


def coupling_products(number: int = 400) -> tuple[Array, Array, float]:
    """A_12 A_21 of the spiral for T_y = shear x rotation: angles (rad), (3, number), and -w^2."""
    f_y, _ = spiral()
    angle = np.linspace(0.0, np.pi, number)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    products = []
    for shear in SHEARS:
        A = AuxiliarySpace.from_transforms(
            np.array([[1.0, shear], [0.0, 1.0]]) @ turn, np.eye(2), f_y, np.eye(2)
        ).Lambda
        products.append(A[:, 0, 1] * A[:, 1, 0])
    w = float(np.abs(np.linalg.eigvals(f_y).imag).max())
    return angle, np.array(products), -w * w


def energy() -> dict[str, Any]:
    """The policy form on the spiral: V = |dz|^2 - dI^T Pi_2 dI for constant slopes, and |dz|^2."""
    f_y, f_u = spiral()
    space, p, q = feedback(f_y, f_u), np.array([-0.5, -0.2]), np.array([-4.0, -1.0])
    t = np.linspace(0.0, 10.0, 400)
    x = flow(loop_jacobian(space.Lambda, space.R, p, q), np.array([1.0, -0.5, 0.3, 0.2]), t)
    part = (x[:, :2] ** 2).sum(-1)
    return {"t": t, "V": part - (q * x[:, 2:] ** 2).sum(-1), "part": part}


def tanh_verdicts(number: int | None = None, seed: int = 0) -> dict[str, Array]:
    """Largest real parts [1/s] over random spirals, tanh policies and states, each (number,).

    `frozen`: F of the block form with the slopes of the moment, T_a held. `true_block`: the same
    loop with T_a moving with the state. `true_policy`: the policy form, whose T_a is constant.
    Both true ones are Jacobians of (y, int z) by central differences.
    """
    rng, number = np.random.default_rng(seed), number or budget(400, 150)
    out = np.empty((3, number))
    for k in range(number):
        f_y, f_u, W, x = _random_case(rng)
        T_y, Lambda = real_block_form(f_y)
        case = (f_y, f_u, W, T_y, Lambda, inverse(T_y @ f_u))
        slopes = _slopes(W, np.stack([T_y @ x[:2], x[2:]], axis=-1))
        out[0, k] = largest_real_part(F(feedback(f_y, f_u, slopes), slopes))
        out[1, k] = largest_real_part(_true_jacobian(x, True, *case))
        out[2, k] = largest_real_part(_true_jacobian(x, False, *case))
    return {"frozen": out[0], "true_block": out[1], "true_policy": out[2]}


def _true_jacobian(x: Array, moving: bool, *case: Array) -> Array:
    """Jacobian of the loop in (y, int z) by central differences, (4, 4)."""
    steps = 1e-6 * np.eye(4)
    sides = [_closed_loop(x + d, moving, *case) - _closed_loop(x - d, moving, *case) for d in steps]
    return np.stack(sides, axis=-1) / 2e-6


def _random_case(rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    s, w = -rng.uniform(0.05, 0.5), rng.uniform(0.5, 5.0)
    V = np.eye(2) + 0.4 * rng.normal(size=(2, 2))
    f_y = V @ np.array([[s, w], [-w, s]]) @ np.linalg.inv(V)
    f_u = np.eye(2) + 0.4 * rng.normal(size=(2, 2))
    return f_y, f_u, rng.uniform(0.5, 3.0, (2, 2)), rng.normal(size=4)


def _slopes(W: Array, s: Array) -> Array:
    """Slopes of a_i = -tanh(W_i s_i) - 0.05 (s_1i + s_2i)."""
    return -W * (1.0 - np.tanh((W * s).sum(-1)) ** 2)[:, None] - 0.05


def _closed_loop(
    x: Array, moving: bool, f_y: Array, f_u: Array, W: Array, T_y: Array, Lambda: Array, inv: Array
) -> Array:
    s = np.stack([T_y @ x[:2], x[2:]], axis=-1)
    a = -np.tanh((W * s).sum(-1)) - 0.05 * s.sum(-1)
    T_a = inv @ feedback_gain(Lambda, _slopes(W, s)) if moving else inv
    return np.concatenate([f_y @ x[:2] + f_u @ T_a @ a, s[:, 0]])


def without_integral() -> tuple[Array, Array]:
    """Eigenvalues with int z unused: of F in (z, a), (4,), and of z alone, (2,) [1/s]."""
    plant = plants.get("coupled_lags")
    space = decompose(plant.f_y([0, 0], [0, 0]), plant.f_u([0, 0], [0, 0]))
    slopes = np.array([[-1.0, 0.0], [-0.5, 0.0]])
    whole, alone = F(space, slopes), F_without_integral(space, slopes)
    return np.sort(np.linalg.eigvals(whole).real), np.sort(np.linalg.eigvals(alone).real)


def answers() -> dict[str, tuple[Possibility, ...]]:
    """Which combinations exist for four plants."""
    cases = {name: plants.get(name) for name in ("coupled_lags", "spiral", "unstable_mode")}
    cases["defective"] = plants.LinearPlant([[-1.0, 1.0], [0.0, -1.0]], np.eye(2))
    zero = np.zeros(2)
    return {
        k: possible_combinations(p.f_y(zero, zero), p.f_u(zero, zero)) for k, p in cases.items()
    }


def answers_table() -> str:
    """The same as a table in Markdown: a row a plant, a column a combination."""
    found = answers()
    names = [p.name for p in next(iter(found.values()))]
    rows = [f"| plant | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for plant, list_ in found.items():
        cells = " | ".join("yes" if p.possible else "no" for p in list_)
        rows.append(f"| {plant} | {cells} |")
    return "\n".join(rows)
