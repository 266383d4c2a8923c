"""Exercises of lesson 06: gains and a hold for two rates, a verdict for every gain, better data."""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt

import numpy as np
from scipy.linalg import expm

from cmc.exercises import check, expect, expect_close
from cmc.theory.identification import fit_latent


def _step(K_p: float, K_d: float, g: float, dt: float) -> np.ndarray:
    """Held step of e'' = -(K_p + g K_1) e - (K_d + g K_2) e', small root, (2, 2)."""
    K1, K2 = K_p, 2 * K_p / (K_d + sqrt(K_d**2 - 4 * K_p))
    held = np.zeros((3, 3))
    held[0, 1] = held[1, 2] = dt
    hold = expm(held)  # of (e, e', e'')
    return hold[:2, :2] - np.outer(hold[:2, 2], [K_p + g * K1, K_d + g * K2])


@check("06-design")
def design(answer: Callable[[float, float, float], tuple[float, float, float]]) -> None:
    """Judge `my_design(slow, fast, g)`: gains with these rates, and the largest smooth dt."""
    for slow, fast, g in ((2.0, 20.0, 3.0), (5.0, 20.0, 0.0), (1.0, 8.0, 10.0)):
        found = answer(slow, fast, g)
        expect(np.shape(found) == (3,), "return three numbers, K_p, K_d, dt")
        K_p, K_d, dt = (float(v) for v in found)
        poles = np.sort(np.roots([1.0, K_d, K_p]).real)
        swapped = np.isclose(K_p, slow + fast) and np.isclose(K_d, slow * fast)
        expect(not swapped, "K_p is the product of the rates and K_d their sum, not the reverse")
        expect_close(poles, [-fast, -slow], f"the poles for rates {slow:g} and {fast:g}")
        for share in (1.0, 1.05):
            smallest = np.linalg.eigvals(_step(K_p, K_d, g, share * dt)).real.min()
            smooth = smallest >= -1e-9
            if share == 1.0:
                expect(smooth, f"dt = {dt:.4g} s is too long: an eigenvalue is {smallest:.3g}")
            else:
                expect(not smooth, f"dt = {dt:.4g} s can be longer still; where is det(step) zero?")


@check("06-verdict")
def verdict(answer: Callable[[float, float, float, float], str]) -> None:
    """Judge `my_verdict(K_p, K_d, g, dt)`: settles, alternates or diverges, by the eigenvalues."""
    for K_p, K_d in ((40.0, 20.0), (20.0, 30.0)):
        for g in (0.0, 20.0, 60.0):
            for dt in (0.002, 0.02, 0.045, 0.08):
                values = np.linalg.eigvals(_step(K_p, K_d, g, dt))
                wanted = "diverges" if np.abs(values).max() >= 1 else "settles"
                if wanted == "settles" and values.real.min() < 0:
                    wanted = "alternates"
                found = answer(K_p, K_d, g, dt)
                values = np.round(np.sort(values.real), 3)
                expect(
                    found == wanted,
                    f"K_p = {K_p:g}, K_d = {K_d:g}, g = {g:g}, dt = {dt:g}: {wanted!r} (eigenvalues"
                    f" {values[0]}, {values[1]}), yours {found!r}; the level alone does not tell",
                )


@check("06-commands")
def commands(answer: Callable[[int], np.ndarray]) -> None:
    """Judge `my_commands(count)`: commands in [-3, 3] that tell f_u better than uniform ones."""
    f_y, f_u = np.array([[-2.0, 1.0], [0.5, -1.0]]), np.array([[1.0, 2.0], [1.5, 1.0]])
    rate = np.zeros((4, 4))
    rate[:2] = np.column_stack([f_y, f_u])
    step = expm(0.05 * rate)[:2]

    def error(u: np.ndarray, seed: int) -> float:
        rng = np.random.default_rng(seed)
        y = rng.normal(size=u.shape)
        after = np.column_stack([y, u]) @ step.T + 0.01 * rng.normal(size=u.shape)
        return float(np.abs(fit_latent(y, u, after, 0.05).f_u - f_u).max())

    for count in (40, 200):
        u = np.asarray(answer(count), dtype=float)
        expect(u.shape == (count, 2), f"wanted shape ({count}, 2), got {u.shape}")
        expect(np.abs(u).max() <= 3.0 + 1e-12, f"|u| goes up to {np.abs(u).max():.3g}, beyond 3")
        condition = np.linalg.cond(np.column_stack([u, np.ones(count)]))
        hint = "the columns (or a column and the constant 1) look alike: no fit tells them apart"
        expect(condition < 1e6, hint)
        uniform = [np.random.default_rng(1000 + k).uniform(-3, 3, u.shape) for k in range(30)]
        mine = np.mean([error(u, k) for k in range(30)])
        ratio = mine / np.mean([error(v, k) for k, v in enumerate(uniform)])
        expect(ratio <= 0.7, f"with {count} commands the error is {ratio:.2f} of the random ones'")
