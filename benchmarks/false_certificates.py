"""Random plants and policies against `certify`: is anything certified that does not contract?

    python -m benchmarks.false_certificates 2000    # a line for each kind, and every falsehood

Each trial draws a question (`benchmarks.questions`). What holds is checked here by a loop that is
written down afresh: its Jacobian by differences at random states and slopes, and pairs of simulated
trajectories.
"""

from __future__ import annotations

import sys
import time
from collections import Counter, defaultdict
from typing import Any

import numpy as np
from scipy.linalg import expm

from benchmarks.questions import KINDS, Trial, draw
from cmc.theory.simulate import transforms_of

COLUMNS = ("asked", "skipped", "held", "false", "error", "contract", "refused")


class Truth:
    """The loop of a trial in (y, int z), written down afresh."""

    def __init__(self, trial: Trial) -> None:
        self.t, self.n = trial, trial.plant.n
        found = transforms_of(trial.plant, trial.transforms, np.zeros(self.n))
        self.spaces = lambda y: ((space := found(y)).T_y, space.T_a)
        self.T = np.array(self.spaces(np.zeros(self.n))[0])
        self.kept = slice(2 * self.n if trial.policy.integral else self.n)

    def signals(self, y):
        T, Ta = self.spaces(y)
        policy, plant = self.t.policy, self.t.plant
        R = getattr(policy, "R", None)
        if R is None:
            R = np.diagonal(T @ plant.f_u(y, held_still(plant, y)) @ Ta, axis1=-2, axis2=-1)
        return (T @ y[..., None])[..., 0], 1 / R if policy.normalise else np.sign(R), Ta

    def command(self, z, I, factor, Ta):
        s = np.stack([z, I * float(self.t.policy.integral)], axis=-1)
        return (Ta @ (-factor * self.t.policy.pi(s))[..., None])[..., 0]

    def move(self, s):
        """ds/dt, or the next sample."""
        n, h, plant = self.n, self.t.h, self.t.plant
        y, I = s[..., :n], s[..., n:]
        z, factor, Ta = self.signals(y)
        if h is None:
            return np.concatenate([plant.f(y, self.command(z, I, factor, Ta)), z], axis=-1)
        I = I + h * z
        u = self.command(z, I, factor, Ta)
        if plant.constant:
            step = expm(np.block([[plant.A, plant.B], [np.zeros((n, 2 * n))]]) * h)
            return np.concatenate([y @ step[:n, :n].T + u @ step[:n, n:].T, I], axis=-1)
        parts = 4 + int(10 * h * np.linalg.norm(plant.f_y(0 * y[0], u[0]), 2))
        for _ in range(parts):
            y = runge_kutta(lambda y: plant.f(y, u), y, h / parts)
        return np.concatenate([y, I], axis=-1)

    def states(self, rng, count):
        n, region = self.n, self.t.region
        if region is not None:
            return rng.uniform(-1, 1, (count, 2 * n)) * region.limits[1]
        size = np.broadcast_to(self.t.policy.size, (n, 2))
        y = rng.normal(size=(count, n)) * np.linalg.norm(np.linalg.inv(self.T), axis=1) * size[0, 0]
        I = rng.normal(size=(count, n)) * size[0, 1]
        return np.concatenate([y, I], axis=-1) * 10 ** rng.uniform(-2, 2, (count, 1))

    def jacobians(self, s):
        return self.differences(s)[0]

    def differences(self, s):
        """Jacobians, and how far rounding may put them off."""
        J, steps = np.empty((2, *s.shape, s.shape[-1]))
        for j in range(s.shape[-1]):
            step = np.zeros_like(s)
            step[:, j] = 1e-5 * (np.abs(s[:, j]) + 0.01 * np.abs(s[:, j]).max())
            J[:, :, j] = (self.move(s + step) - self.move(s - step)) / (2 * step[:, [j]])
            steps[:, :, j] = step[:, [j]]
        return J, 4e-16 * (np.abs(J) @ np.abs(s)[..., None]) / steps

    def unstable(self, J, rounding) -> bool:
        """Beyond what the rounding of the differences can do to an eigenvalue (Bauer and Fike)."""
        values, vectors = np.linalg.eig(J[:, self.kept, self.kept])
        slack = np.linalg.cond(vectors) * np.linalg.norm(rounding, axis=(-2, -1))
        size = values.real if self.t.h is None else np.abs(values) - 1
        return bool((size.max(-1) >= slack).any())


def held_still(plant, y):
    """The command at which f is zero: where the command acts non-linearly, R depends on it."""
    u = 0 * y
    for _ in range(1 if plant.constant else 50):
        u = u - np.linalg.solve(plant.f_u(y, u), plant.f(y, u)[..., None])[..., 0]
    return u


def runge_kutta(f, s, h):
    a = f(s)
    b = f(s + h / 2 * a)
    c = f(s + h / 2 * b)
    return s + h / 6 * (a + 2 * b + 2 * c + f(s + h * c))


def falsehood(trial: Trial, answer: Any, rng: np.random.Generator) -> str:
    """What contradicts a certificate that holds, or ""."""
    truth, h, proof = Truth(trial), trial.h, answer.evidence == "proof"
    (J, rounding), m = truth.differences(truth.states(rng, 500)), len(answer.metric)
    if truth.unstable(J, rounding):
        return "an unstable linearization"
    C = np.eye(2 * truth.n)  # to the coordinates of the metric
    if proof:
        C[: truth.n, : truth.n] = truth.T
    theta, back = np.linalg.cholesky(answer.metric).T, np.linalg.inv(C)
    inverse = np.linalg.inv(theta)
    local = theta @ (C @ J @ back)[:, :m, :m] @ inverse
    off = (np.abs(C) @ rounding @ np.abs(back))[:, :m, :m]
    off = np.linalg.norm(np.abs(theta) @ off @ np.abs(inverse), axis=(1, 2))
    if h is None:
        rates = -np.linalg.eigvalsh((local + local.swapaxes(1, 2)) / 2)[:, -1] + off
    else:
        rates = -np.log(np.maximum(np.linalg.norm(local, 2, axis=(1, 2)) - off, 1e-300)) / h
    scale = np.abs(local).max() if h is None else 1 / h
    if rates.min() < 0.999 * answer.rate - 1e-6 * scale:
        return f"rate {rates.min():.4g} where {answer.rate:.4g} 1/s is promised"
    return simulated(trial, answer, truth, C[:m], theta, rng)


def simulated(trial: Trial, answer: Any, truth: Truth, C, theta, rng) -> str:
    """Pairs of trajectories, inside the ball where there is a box or a limit."""
    h, s, m = trial.h, truth.states(rng, 8), len(C)
    limited = trial.region is not None or np.isfinite(trial.plant.u_low).any()
    if limited:
        if answer.rest is None or not np.isfinite(answer.ball):
            return ""
        x = rng.normal(size=(8, m))
        x *= 0.999 * answer.ball / np.linalg.norm(x @ theta.T, axis=1, keepdims=True)
        s = (x + answer.rest) @ np.linalg.pinv(C).T
    fast = np.abs(np.linalg.eigvals(truth.jacobians(s)[:, truth.kept, truth.kept])).max()
    step = h if h is not None else 0.1 / fast
    first = None
    for k in range(250 if trial.region is None else 120):
        x = s @ C.T
        if limited:
            away = np.linalg.norm((x - answer.rest) @ theta.T, axis=1).max()
            if away > answer.ball * (1 + 1e-6):
                return f"left the ball: {away:.4g} > {answer.ball:.4g}"
            edge = np.inf if trial.region is None or h else trial.region.limits[1][:m]
            if (np.abs(s[:, :m]) > edge * (1 + 1e-9)).any():
                return "left the box"
        distance = np.linalg.norm((x[1:] - x[:-1]) @ theta.T, axis=1)
        first = distance if first is None else first
        bound = first * np.exp(-answer.rate * step * k)
        if (distance > bound * (1 + 1e-3) + 1e-9 * first).any():
            return f"a pair is {np.max(distance / bound):.4g} times its bound apart"
        s = truth.move(s) if h is not None else runge_kutta(truth.move, s, step)
    return ""


def judge(seed: int, score: dict[str, Counter[str]]) -> None:
    """Ask one question and add what came of it to the score."""
    try:
        trial = draw(seed)
    except ImportError as error:  # without Stable-Baselines3
        score["skipped"][str(error)] += 1
        return
    kind, rng = trial.kind, np.random.default_rng([seed, 1])
    score["asked"][kind] += 1
    try:
        answer = trial.ask()
        held = answer.holds
        why = falsehood(trial, answer, rng) if held else ""
    except Exception as error:  # every kind of failure is counted
        score["error"][kind] += 1
        print(f"ERROR, seed {seed}, {kind}: {type(error).__name__}: {error}", flush=True)
        return
    if why:
        score["false"][kind] += 1
        print(f"FALSE, seed {seed}, {kind}, n = {trial.plant.n}, h = {trial.h}: {why}", flush=True)
    score["held"][kind] += held
    try:
        truth = Truth(trial)
        right = held or not truth.unstable(*truth.differences(truth.states(rng, 200)))
    except (ValueError, np.linalg.LinAlgError):  # no real transform: there is no loop to judge
        return
    score["contract"][kind] += right
    score["refused"][kind] += right and not held


def main(count: int, first: int = 0) -> None:
    """Print for each kind how many were asked, held, false, and refused though contracting."""
    score: dict[str, Counter[str]] = defaultdict(Counter)
    for done in range(1, count + 1):
        judge(first + done - 1, score)
        if done % 50 and done < count:
            continue
        print(f"{'seeds from ' + str(first):34s}" + "".join(f"{name:>9s}" for name in COLUMNS))
        for kind in [*KINDS, "all"]:
            row = [score[c].total() if kind == "all" else score[c][kind] for c in COLUMNS]
            print(f"{kind:34s}" + "".join(f"{number:9d}" for number in row))
        print(f"{done} trials, {time.process_time() / done:.2f} s of one core each", flush=True)


if __name__ == "__main__":
    main(*(int(word) for word in sys.argv[1:]))
