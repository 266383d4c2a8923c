"""Random plants and policies against `certify`: is anything certified that does not contract?

    python benchmarks/false_certificates.py 2000    # one line for each kind, and every falsehood

Each trial draws a kind of question, some of them wrong on purpose (another sign of R, a coupled
policy, a slip in a Jacobian, slopes outside of what is stated, commands that act non-linearly), and
units between 1e-9 and 1e9. What holds is checked here by a loop that is written down afresh: its
Jacobian by differences at random states and slopes, and pairs of simulated trajectories.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import expm

from cmc.plants import LinearPlant, Plant
from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.certify import certify
from cmc.theory.combinations import feedback
from cmc.theory.exact import Region

KINDS = {
    "linear, real modes": 4,
    "linear, complex pairs": 3,
    "linear, own transforms": 3,
    "linear, stiff under a hold": 1,
    "wrong or scaled R": 2,
    "no integral": 1,
    "coupled policy": 1,
    "slopes outside of what is stated": 1,
    "slip in a Jacobian": 1,
    "no bypass, in a box": 1,
    "nonlinear, in a box": 3,
    "non-affine command, in a box": 2,
    "command limits": 1,
}


class Tanh:
    """pi_i = bypass_i . s_i + tanh(room_i . s_i), or with `mix` a coupled one."""

    def __init__(self, bypass: np.ndarray, room: np.ndarray, **told: Any) -> None:
        self.bypass, self.room, self.mix, self.boast, self.u0 = bypass, room, None, 1.0, 0.0
        self.integral, self.normalise, self.size = True, False, np.ones_like(bypass)
        self.__dict__.update(told)

    def pi(self, s):
        x = s / self.size
        out = (self.bypass * x).sum(-1) + np.tanh((self.room * x).sum(-1))
        return out if self.mix is None else out @ self.mix.T

    def slope_bounds(self):
        low, high = self.bypass / self.size, self.boast * (self.bypass + self.room) / self.size
        keep = np.array([1.0, float(self.integral)])
        return low * keep, high * keep


class Curved(Plant):
    """y' = A y + B (u + g u^3 / width^2) + N sin(W y), Jacobians with an optional slip."""

    name = "curved"

    def __init__(self, A, B, N, W, g=0.0, slip=None, box=1.0, limit=10.0):
        self.n, self.A, self.B, self.N, self.W, self.g, self.slip = len(A), A, B, N, W, g, slip
        self._box([box] * self.n, [limit] * self.n)

    def f(self, y, u, t=0.0):
        y, u = np.asarray(y, dtype=float), np.asarray(u, dtype=float)
        acts = u + self.g * u**3
        return y @ self.A.T + acts @ self.B.T + np.sin(y @ self.W.T) @ self.N.T

    def f_y(self, y, u, t=0.0):
        y = np.asarray(y, dtype=float)
        J = self.A + (self.N * np.cos(y @ self.W.T)[..., None, :]) @ self.W
        return self._with_slip(J, 0)

    def f_u(self, y, u, t=0.0):
        u = np.asarray(u, dtype=float)
        J = self.B * (1 + 3 * self.g * u**2)[..., None, :] + 0 * np.asarray(y)[..., None]
        return self._with_slip(J, 1)

    def _with_slip(self, J, which):
        if self.slip is None or self.slip[0] != which:
            return J
        J = np.array(J)
        J[..., self.slip[1], self.slip[2]] *= self.slip[3]
        return J


@dataclass
class Trial:
    kind: str
    plant: Any
    policy: Any
    transforms: Any
    region: Any
    h: float | None
    y_ref: Any = 0.0


def modes(rng, n, pairs):
    """A random state matrix with real modes, or with complex pairs where they fit."""
    D = np.diag(rng.choice([-1.0, -1.0, -1.0, 0.3], n) * rng.uniform(0.2, 4.0, n))
    if pairs:
        for i in range(0, n - 1, 2):
            s, w = -rng.uniform(0.05, 2.0), rng.uniform(0.2, 6.0)
            D[i : i + 2, i : i + 2] = [[s, w], [-w, s]]
    V = np.eye(n) + rng.uniform(0.1, 0.6) * rng.normal(size=(n, n))
    return V @ D @ np.linalg.inv(V)


def draw(seed: int) -> Trial:
    """One random question."""
    rng = np.random.default_rng(seed)
    kind = str(rng.choice(list(KINDS), p=np.array(list(KINDS.values())) / sum(KINDS.values())))
    box = "box" in kind or "slip" in kind
    n = int(rng.choice([1, 2, 3, 4, 5, 6, 7, 8], p=[0.2, 0.3, 0.2, 0.15, 0.07, 0.05, 0.02, 0.01]))
    n = min(n, 3) if box else n
    pairs = "complex" in kind
    n = max(n, 2) if pairs or "coupled" in kind else n
    A, B = modes(rng, n, pairs), np.eye(n) + 0.5 * rng.normal(size=(n, n))
    rate, unit = (
        (10.0 ** rng.integers(-9, 10, 2) if rng.random() < 0.3 else (1.0, 1.0))
        if not box
        else (1.0, 1.0)
    )
    h = None if rng.random() < 0.5 else float(10 ** rng.uniform(-2.5, -0.3)) / rate
    if "stiff" in kind:
        A, h = (
            A - np.diag(10 ** rng.uniform(0, 3.5, n)),
            float(10 ** rng.uniform(-1.5, -0.5)) / rate,
        )
    low = 10 ** rng.uniform(-1.5, 0.7, (n, 2))
    policy = Tanh(low, low * rng.uniform(0, 1.5, (n, 2)), size=np.array([1.0, 1 / rate]) * unit)
    A, B = A * rate, B * rate * unit  # y in `unit`, u in 1
    size = float(rng.uniform(0.05, 0.5))
    region = Region([-size] * n, [size] * n, integral=size, points=5) if box else None
    transforms = None
    if pairs:
        transforms = feedback(A, B)
        if rng.random() < 0.5:
            from cmc.theory import combinations

            transforms = getattr(combinations, "block_schur", feedback)(A, B)
    if kind == "linear, own transforms":
        if rng.random() < 0.5:  # nearly triangular, in bad units
            A, B = np.triu(A), np.triu(B) * 10 ** rng.uniform(-3, 3, (n, n))
            B += np.tril(rng.normal(size=(n, n)), -1) * 10 ** rng.uniform(-12, 0)
        transforms = AuxiliarySpace.identity(A, B)
        policy.R = np.where(np.diag(B) < 0, -1.0, 1.0)
    plant: Any = LinearPlant(A, B)
    plant.u_low, plant.u_high = np.full(n, -np.inf), np.full(n, np.inf)
    if kind == "command limits":
        plant.u_low, plant.u_high = np.full(n, -1.0), np.full(n, 2.0)
    if kind == "wrong or scaled R":
        policy.R = rng.choice([1.0, 1.0, -1.0], n) * 10 ** rng.uniform(-1, 1, n)
        policy.normalise = bool(rng.random() < 0.5)
    policy.integral = kind != "no integral" or rng.random() < 0.2
    if kind == "coupled policy":
        policy.mix = np.eye(n) + rng.uniform(0, 3) * rng.normal(size=(n, n))
    if kind == "slopes outside of what is stated":
        policy.boast = rng.uniform(0.3, 1.2)
    if box:
        if "no bypass" in kind:
            policy.bypass = 0 * policy.bypass
            policy.room = low * 2
        else:
            N, W = rng.normal(size=(2, n, n)) * rng.uniform(0.1, 1.2)
            g = rng.uniform(0, 1.0) if "non-affine" in kind else 0.0
            slip = None
            if "slip" in kind:
                slip = (
                    int(rng.integers(2)),
                    *rng.integers(n, size=2),
                    1 + rng.choice([-2, -1, 0.5, 2]),
                )
            plant = Curved(A, B, N, W, g, slip, box=size)
    return Trial(kind, plant, policy, transforms, region, h)


class Truth:
    """The loop of a trial in (y, int z), written down afresh."""

    def __init__(self, trial: Trial) -> None:
        self.t, self.n = trial, trial.plant.n
        plant, n = trial.plant, self.n
        zero = np.zeros(n)
        if trial.transforms is not None:
            T, Ta = trial.transforms.T_y, trial.transforms.T_a
            self.spaces = lambda y: (T, Ta)
        elif plant.constant:
            space = decompose(plant.f_y(zero, zero), plant.f_u(zero, zero))
            self.spaces = lambda y: (space.T_y, space.T_a)
        else:
            try:
                from cmc.theory.simulate import transforms_of
            except ImportError:  # as it was before eigenvectors kept their signs

                def transforms_of(plant, *_):
                    return lambda y: decompose(plant.f_y(y, u := plant.hold(y)), plant.f_u(y, u))

            found = transforms_of(plant, None, zero)
            self.spaces = lambda y: ((space := found(y)).T_y, space.T_a)
        self.T = np.array(self.spaces(zero)[0])

    def signals(self, y, I):
        T, Ta = self.spaces(y)
        policy, plant = self.t.policy, self.t.plant
        z = (T @ y[..., None])[..., 0]
        R = getattr(policy, "R", None)
        if R is None:
            R = np.diagonal(T @ plant.f_u(y, 0 * y) @ Ta, axis1=-2, axis2=-1)
        factor = 1 / R if policy.normalise else np.sign(R)
        return z, factor, Ta

    def command(self, z, I, factor, Ta):
        s = np.stack([z, I * float(self.t.policy.integral)], axis=-1)
        return (Ta @ (-factor * self.t.policy.pi(s))[..., None])[..., 0]

    def move(self, s):
        """ds/dt, or the next sample."""
        n, h, f = self.n, self.t.h, self.t.plant.f
        y, I = s[..., :n], s[..., n:]
        z, factor, Ta = self.signals(y, I)
        if h is None:
            return np.concatenate([f(y, self.command(z, I, factor, Ta)), z], axis=-1)
        I = I + h * z
        u = self.command(z, I, factor, Ta)
        if self.t.plant.constant:
            A, B = self.t.plant.A, self.t.plant.B
            step = expm(np.block([[A, B], [np.zeros((n, 2 * n))]]) * h)
            return np.concatenate([y @ step[:n, :n].T + u @ step[:n, n:].T, I], axis=-1)
        parts = 40
        for _ in range(parts):
            d = h / parts
            a = f(y, u)
            b = f(y + d / 2 * a, u)
            c = f(y + d / 2 * b, u)
            y = y + d / 6 * (a + 2 * b + 2 * c + f(y + d * c, u))
        return np.concatenate([y, I], axis=-1)

    def states(self, rng, count):
        n, region = self.n, self.t.region
        if region is not None:
            high = np.concatenate([np.asarray(region.y_high), np.full(n, float(region.integral))])
            return rng.uniform(-1, 1, (count, 2 * n)) * high
        size = np.broadcast_to(self.t.policy.size, (n, 2))
        y = rng.normal(size=(count, n)) * np.linalg.norm(np.linalg.inv(self.T), axis=1) * size[0, 0]
        I = rng.normal(size=(count, n)) * size[0, 1]
        return np.concatenate([y, I], axis=-1) * 10 ** rng.uniform(-2, 2, (count, 1))

    def jacobians(self, s):
        m = s.shape[-1]
        J = np.empty((*s.shape, m))
        for j in range(m):
            step = 1e-5 * (np.abs(s[:, j]) + 0.01 * np.abs(s[:, j]).max())
            ahead, behind = s.copy(), s.copy()
            ahead[:, j] += step
            behind[:, j] -= step
            J[:, :, j] = (self.move(ahead) - self.move(behind)) / (2 * step[:, None])
        return J

    def in_metric(self, J, answer):
        """Jacobians in the coordinates of a certificate's metric."""
        n, m = self.n, len(answer.metric)
        if answer.evidence == "proof":
            C = np.eye(2 * n)
            C[:n, :n] = self.T
            J = C @ J @ np.linalg.inv(C)
        return J[:, :m, :m] if m in (n, 2 * n) else J

    def contracts(self, rng) -> bool:
        """Whether the loop looks contracting: all linearizations decay, and so do pairs."""
        J = self.jacobians(self.states(rng, 200))
        m = 2 * self.n if self.t.policy.integral else self.n
        eigenvalues = np.linalg.eigvals(J[:, :m, :m])
        if self.t.h is None:
            return bool(eigenvalues.real.max() < 0)
        return bool(np.abs(eigenvalues).max() < 1)


def falsehood(trial: Trial, answer: Any, rng: np.random.Generator) -> str:
    """What contradicts a certificate that holds, or ""."""
    truth = Truth(trial)
    J = truth.in_metric(truth.jacobians(truth.states(rng, 600)), answer)
    theta = np.linalg.cholesky(answer.metric).T
    local = theta @ J @ np.linalg.inv(theta)
    h = trial.h
    if h is None:
        rates = -np.linalg.eigvalsh((local + local.swapaxes(1, 2)) / 2)[:, -1]
    else:
        rates = -np.log(np.linalg.norm(local, 2, axis=(1, 2))) / h
    scale = np.abs(local).max() if h is None else 1 / h
    wanted = answer.rate if answer.evidence == "proof" else 0.0
    if rates.min() < wanted - 1e-3 * answer.rate - 1e-6 * scale * (answer.evidence == "proof"):
        return f"rate {rates.min():.4g} where {answer.rate:.4g} 1/s is promised"
    m = 2 * truth.n if trial.policy.integral else truth.n
    eigenvalues = np.linalg.eigvals(truth.jacobians(truth.states(rng, 600))[:, :m, :m])
    if (eigenvalues.real.max() >= 0) if h is None else (np.abs(eigenvalues).max() >= 1):
        return "an unstable linearization"
    return _simulated(trial, answer, truth, rng)


def _simulated(trial: Trial, answer: Any, truth: Truth, rng: np.random.Generator) -> str:
    """Pairs of trajectories, inside the ball where there is a box or a limit."""
    n, m = truth.n, len(answer.metric)
    theta = np.linalg.cholesky(answer.metric).T
    C = np.eye(2 * n)
    if answer.evidence == "proof":
        C[:n, :n] = truth.T
    C = C[:m]
    ball, rest = getattr(answer, "ball", np.nan), getattr(answer, "rest", None)
    limited = trial.region is not None or np.isfinite(trial.plant.u_low).any()
    start = truth.states(rng, 8)
    if limited:
        if rest is None or not np.isfinite(ball):
            return ""
        x = rng.normal(size=(8, m))
        x = rest + 0.999 * ball * x / np.linalg.norm(x @ theta.T, axis=1, keepdims=True)
        start = x @ np.linalg.pinv(C).T
    h, s = trial.h, start
    J = truth.jacobians(s)[:, :m, :m]
    fast = np.abs(np.linalg.eigvals(J)).max()
    step = h if h is not None else 0.05 / fast
    first = None
    for k in range(400):
        x = s @ C.T
        if limited and np.isfinite(ball):
            away = np.linalg.norm((x - rest) @ theta.T, axis=1).max()
            if away > ball * (1 + 1e-6):
                return f"left the ball: {away:.4g} > {ball:.4g}"
            if trial.region is not None and h is None:
                edge = np.concatenate(
                    [np.asarray(trial.region.y_high), np.full(n, float(trial.region.integral))]
                )
                if (np.abs(s[:, :m]) > edge[:m] * (1 + 1e-9)).any():
                    return "left the box"
        distance = np.linalg.norm((x[1:] - x[:-1]) @ theta.T, axis=1)
        first = distance if first is None else first
        bound = first * np.exp(-answer.rate * step * k) if answer.evidence == "proof" else first
        if (distance > bound * (1 + 1e-3) + 1e-9 * first).any():
            return f"a pair is {np.max(distance / bound):.4g} times its bound apart"
        if h is not None:
            s = truth.move(s)
            continue
        a = truth.move(s)
        b = truth.move(s + step / 2 * a)
        c = truth.move(s + step / 2 * b)
        s = s + step / 6 * (a + 2 * b + 2 * c + truth.move(s + step * c))
    return ""


def ask(trial: Trial) -> Any:
    """The certificate of a trial; None where the question raised."""
    kwargs = {"region": trial.region, "h": trial.h, "transforms": trial.transforms}
    return certify(trial.policy, trial.plant, **kwargs)


def main(count: int, first: int = 0, most: int = 8) -> None:
    """Print held, false and refused for each kind, of plants with at most so many signals."""
    held, false, right, refused, raised, asked = (Counter() for _ in range(6))
    began = time.process_time()
    for seed in range(first, first + count):
        trial, rng = draw(seed), np.random.default_rng([seed, 1])
        if trial.plant.n > most:
            continue
        asked[trial.kind] += 1
        try:
            answer = ask(trial)
        except Exception as error:  # every kind of failure is counted
            raised[trial.kind] += 1
            print(f"seed {seed}, {trial.kind}: {type(error).__name__}: {error}")
            answer = None
        if answer is not None and answer.holds:
            held[trial.kind] += 1
            try:
                why = falsehood(trial, answer, rng)
            except (ValueError, np.linalg.LinAlgError) as error:
                why = f"check failed: {error}"
            if why:
                false[trial.kind] += 1
                print(
                    f"FALSE, seed {seed}, {trial.kind}, n = {trial.plant.n}, h = {trial.h}: {why}"
                )
                continue
        try:
            true = Truth(trial).contracts(rng)
        except (ValueError, np.linalg.LinAlgError):
            continue
        right[trial.kind] += true
        refused[trial.kind] += true and (answer is None or not answer.holds)
    print(f"{'kind':36s} asked  hold false error  contract refused")
    for kind in [*KINDS, "all"]:
        row = [
            c.total() if kind == "all" else c[kind]
            for c in (asked, held, false, raised, right, refused)
        ]
        print(f"{kind:36s} {row[0]:5d} {row[1]:5d} {row[2]:5d} {row[3]:5d} {row[4]:9d} {row[5]:7d}")
    print(f"{(time.process_time() - began) / count:.2f} s of one core a trial")


if __name__ == "__main__":
    main(*(int(word) for word in sys.argv[1:]))
