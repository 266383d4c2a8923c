"""A two-link arm in a vertical plane: small enough to write down, nonlinear enough to be an arm.

H(q) q'' + C(q, q') q' + g(q) = tau with angles measured from the horizontal and from the first
link, x to the right and y up (textbook form, for example Spong, Hutchinson & Vidyasagar, Robot
Modeling and Control, 2006, ch. 7). With as many joints as task dimensions there is no null space,
so the task-space controller is the paper's equation without its pseudo-inverse.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
TorqueLaw = Callable[[float, Array, Array], Array]


class SingularPoseError(ValueError):
    """A straight or folded arm, where no torque gives the tip every acceleration."""


@dataclass(frozen=True)
class TwoLinkArm:
    """Uniform links of given lengths and masses; every method takes (..., 2) arrays.

    Attributes:
        lengths: m.
        masses: kg; the inertia of a link about its center is m l^2 / 12.
        gravity: m/s^2 along -y.
    """

    lengths: tuple[float, float] = (0.4, 0.3)
    masses: tuple[float, float] = (3.0, 2.0)
    gravity: float = 9.81

    def __post_init__(self) -> None:
        for name in ("lengths", "masses"):
            pair = np.asarray(getattr(self, name), dtype=float)
            if pair.shape != (2,) or not (np.isfinite(pair).all() and (pair > 0).all()):
                raise ValueError(f"{name} must be two positive numbers, got {pair}")

    def position(self, q: ArrayLike) -> Array:
        """Position of the tip, (..., 2), m."""
        q = np.asarray(q, dtype=float)
        first, both = q[..., 0], q[..., 0] + q[..., 1]
        l1, l2 = self.lengths
        return np.stack(
            [l1 * np.cos(first) + l2 * np.cos(both), l1 * np.sin(first) + l2 * np.sin(both)], -1
        )

    def jacobian(self, q: ArrayLike) -> Array:
        """Jacobian J of the tip, x' = J q', (..., 2, 2), m."""
        q = np.asarray(q, dtype=float)
        tip, l2 = self.position(q), self.lengths[1]
        both = q[..., 0] + q[..., 1]
        second = np.stack([-l2 * np.sin(both), l2 * np.cos(both)], -1)
        return np.stack([np.stack([-tip[..., 1], tip[..., 0]], -1), second], -1)

    def jacobian_rate(self, q: ArrayLike, dq: ArrayLike) -> Array:
        """J' q', the tip acceleration at q'' = 0, (..., 2), m/s^2: centripetal terms only."""
        q, dq = np.asarray(q, dtype=float), np.asarray(dq, dtype=float)
        first, both = q[..., 0], q[..., 0] + q[..., 1]
        l1, l2 = self.lengths
        w1, w2 = l1 * dq[..., 0] ** 2, l2 * (dq[..., 0] + dq[..., 1]) ** 2
        return -np.stack(
            [w1 * np.cos(first) + w2 * np.cos(both), w1 * np.sin(first) + w2 * np.sin(both)], -1
        )

    def inertia(self, q: ArrayLike) -> Array:
        """Mass matrix H(q), (..., 2, 2), kg m^2."""
        (l1, l2), (m1, m2) = self.lengths, self.masses
        cross = m2 * l1 * l2 / 2 * np.cos(np.asarray(q, dtype=float)[..., 1])
        h22 = m2 * l2**2 / 3 + 0 * cross
        h12 = h22 + cross
        h11 = m1 * l1**2 / 3 + m2 * l1**2 + h22 + 2 * cross
        return np.stack([np.stack([h11, h12], -1), np.stack([h12, h22], -1)], -2)

    def bias(self, q: ArrayLike, dq: ArrayLike) -> Array:
        """C(q, q') q' + g(q), (..., 2), N m."""
        q, dq = np.asarray(q, dtype=float), np.asarray(dq, dtype=float)
        (l1, l2), (m1, m2) = self.lengths, self.masses
        h = -m2 * l1 * l2 / 2 * np.sin(q[..., 1])
        elbow = m2 * l2 / 2 * np.cos(q[..., 0] + q[..., 1]) * self.gravity
        shoulder = (m1 * l1 / 2 + m2 * l1) * np.cos(q[..., 0]) * self.gravity + elbow
        swing = h * dq[..., 1] * (2 * dq[..., 0] + dq[..., 1])
        return np.stack([swing + shoulder, -h * dq[..., 0] ** 2 + elbow], -1)

    def acceleration(self, q: ArrayLike, dq: ArrayLike, tau: ArrayLike) -> Array:
        """Joint acceleration q'' under torques, (..., 2), rad/s^2."""
        rest = np.asarray(tau, dtype=float) - self.bias(q, dq)
        return np.asarray(np.linalg.solve(self.inertia(q), rest[..., None])[..., 0], dtype=float)

    def task_torque(self, q: ArrayLike, dq: ArrayLike, p: ArrayLike) -> Array:
        """Torque that gives the tip the acceleration p: H J^-1 (p - J' q') + C q' + g, (..., 2).

        Called on an arm with other masses than the real one, it is the controller of an
        engineer who does not know the masses.

        Raises:
            SingularPoseError: where |det J| is below a thousandth of its largest value.
        """
        jac = self.jacobian(q)
        if np.any(np.abs(np.linalg.det(jac)) < 1e-3 * self.lengths[0] * self.lengths[1]):
            raise SingularPoseError(
                f"the arm is straight or folded at q = {np.asarray(q)}: J has no inverse"
            )
        wanted = np.asarray(p, dtype=float) - self.jacobian_rate(q, dq)
        ddq = np.linalg.solve(jac, wanted[..., None])
        return (self.inertia(q) @ ddq)[..., 0] + self.bias(q, dq)  # tau_task_space_control

    def reach(self, x: ArrayLike) -> Array:
        """Angles (..., 2) that put the tip at x, elbow down.

        Raises:
            ValueError: for points outside the annulus that the arm reaches.
        """
        x = np.asarray(x, dtype=float)
        l1, l2 = self.lengths
        cosine = (np.sum(x**2, axis=-1) - l1**2 - l2**2) / (2 * l1 * l2)
        if not np.all(np.abs(cosine) <= 1.0):
            raise ValueError(f"the tip reaches {abs(l1 - l2):g} to {l1 + l2:g} m, got {x}")
        second = np.arccos(cosine)
        inner = np.arctan2(l2 * np.sin(second), l1 + l2 * np.cos(second))
        return np.stack([np.arctan2(x[..., 1], x[..., 0]) - inner, second], -1)


def simulate(
    arm: TwoLinkArm, law: TorqueLaw, q: ArrayLike, dq: ArrayLike, times: ArrayLike
) -> tuple[Array, Array]:
    """Motion of the arm under torques held between the given times, by RK4 within each interval.

    Args:
        arm: the real arm.
        law: torque (t, q, q') -> (..., 2), N m, asked once per interval.
        q: first angles (..., 2), rad.
        dq: first rates (..., 2), rad/s.
        times: (T,), s; every interval is one Runge-Kutta step.

    Returns:
        Angles and rates at the times, (T, ..., 2) each.
    """
    times = np.asarray(times, dtype=float)
    state = np.stack([np.asarray(q, dtype=float), np.asarray(dq, dtype=float)])
    path = np.empty((len(times), *state.shape))
    path[0] = state
    for k, h in enumerate(np.diff(times)):
        tau = law(float(times[k]), state[0], state[1])

        def rate(s: Array, tau: Array = tau) -> Array:
            return np.stack([s[1], arm.acceleration(s[0], s[1], tau)])

        k1 = rate(state)
        k2 = rate(state + h / 2 * k1)
        k3 = rate(state + h / 2 * k2)
        k4 = rate(state + h * k3)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        path[k + 1] = state
    return path[:, 0], path[:, 1]
