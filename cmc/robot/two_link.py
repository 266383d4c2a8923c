"""A two-link arm in a vertical plane: small enough to write down, nonlinear enough to be an arm.

H(q) q'' + C(q, q') q' + g(q) = tau with angles measured from the horizontal and from the first
link, x to the right and y up (textbook form, for example Spong, Hutchinson & Vidyasagar, Robot
Modeling and Control, 2006, ch. 7). With as many joints as task dimensions there is no null space,
so the task-space controller is the paper's equation without its pseudo-inverse.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.arrays import Array, checked, increasing, need, number, together

TorqueLaw = Callable[[float, Array, Array], Array]


@dataclass(frozen=True)
class TwoLinkArm:
    """Uniform links, m and kg, under gravity along -y, m/s^2; methods take (..., 2) arrays.

    The inertia of a link about its center is m l^2 / 12. Wrong shapes raise ValueError, or
    TypeError, with the argument's name; states that are not finite give NaN, as a simulation that
    diverges needs.
    """

    lengths: tuple[float, float] = (0.4, 0.3)
    masses: tuple[float, float] = (3.0, 2.0)
    gravity: float = 9.81

    def __post_init__(self) -> None:
        for name in ("lengths", "masses"):
            checked(name, getattr(self, name), "2", above=0.0)
        number("gravity", self.gravity)

    def _along(self, q: ArrayLike, first: Any, second: Any) -> Array:
        """Sum of a vector along each link, of the given sizes, (..., 2)."""
        q = _pair("q", q)
        a, b = q[..., 0], q[..., 0] + q[..., 1]
        x, y = first * np.cos(a) + second * np.cos(b), first * np.sin(a) + second * np.sin(b)
        return np.stack([x, y], -1)

    def position(self, q: ArrayLike) -> Array:
        """Position of the tip, (..., 2), m."""
        return self._along(q, *self.lengths)

    def jacobian(self, q: ArrayLike) -> Array:
        """Jacobian J of the tip, x' = J q', (..., 2, 2), m."""
        columns = np.stack([self.position(q), self._along(q, 0.0, self.lengths[1])], -1)
        return np.stack([-columns[..., 1, :], columns[..., 0, :]], -2)  # a turn by 90 degrees

    def jacobian_rate(self, q: ArrayLike, dq: ArrayLike) -> Array:
        """J' q', the tip acceleration at q'' = 0, (..., 2), m/s^2: centripetal terms only."""
        dq, (l1, l2) = _pair("dq", dq), self.lengths
        return -self._along(q, l1 * dq[..., 0] ** 2, l2 * (dq[..., 0] + dq[..., 1]) ** 2)

    def inertia(self, q: ArrayLike) -> Array:
        """Mass matrix H(q), (..., 2, 2), kg m^2."""
        (l1, l2), (m1, m2) = self.lengths, self.masses
        cross = m2 * l1 * l2 / 2 * np.cos(_pair("q", q)[..., 1])
        h22 = m2 * l2**2 / 3 + 0 * cross
        h12 = h22 + cross
        h11 = m1 * l1**2 / 3 + m2 * l1**2 + h22 + 2 * cross
        return np.stack([np.stack([h11, h12], -1), np.stack([h12, h22], -1)], -2)

    def bias(self, q: ArrayLike, dq: ArrayLike) -> Array:
        """C(q, q') q' + g(q), (..., 2), N m."""
        q, dq = _pair("q", q), _pair("dq", dq)
        (l1, l2), (m1, m2) = self.lengths, self.masses
        h = -m2 * l1 * l2 / 2 * np.sin(q[..., 1])
        elbow = m2 * l2 / 2 * np.cos(q[..., 0] + q[..., 1]) * self.gravity
        shoulder = (m1 * l1 / 2 + m2 * l1) * np.cos(q[..., 0]) * self.gravity + elbow
        swing = h * dq[..., 1] * (2 * dq[..., 0] + dq[..., 1])
        return np.stack([swing + shoulder, -h * dq[..., 0] ** 2 + elbow], -1)

    def acceleration(self, q: ArrayLike, dq: ArrayLike, tau: ArrayLike) -> Array:
        """Joint acceleration q'' under torques, (..., 2), rad/s^2."""
        rest = _pair("tau", tau) - self.bias(q, dq)
        return np.asarray(np.linalg.solve(self.inertia(q), rest[..., None])[..., 0], dtype=float)

    def task_torque(self, q: ArrayLike, dq: ArrayLike, p: ArrayLike) -> Array:
        """Torque that gives the tip the acceleration p: H J^-1 (p - J' q') + C q' + g, (..., 2).

        Called on an arm with other masses than the real one, it is the controller of an
        engineer who does not know the masses.
        A ValueError where |det J| is below a thousandth of its largest value.
        """
        jac = self.jacobian(q)
        if np.any(np.abs(np.linalg.det(jac)) < 1e-3 * self.lengths[0] * self.lengths[1]):
            raise ValueError(f"the arm is straight or folded at q = {q!r}: J has no inverse")
        wanted = _pair("p", p) - self.jacobian_rate(q, dq)
        ddq = np.linalg.solve(jac, wanted[..., None])
        return (self.inertia(q) @ ddq)[..., 0] + self.bias(q, dq)  # tau_task_space_control

    def reach(self, x: ArrayLike) -> Array:
        """Angles (..., 2) that put the tip at x, elbow down.

        A ValueError for points outside the annulus that the arm reaches.
        """
        x, (l1, l2) = _pair("x", x, True), self.lengths
        cosine = (np.sum(x**2, axis=-1) - l1**2 - l2**2) / (2 * l1 * l2)
        if np.any(np.abs(cosine) > 1.0):
            raise ValueError(f"x: the tip reaches {abs(l1 - l2):g} to {l1 + l2:g} m, got {x}")
        second = np.arccos(cosine)
        inner = np.arctan2(l2 * np.sin(second), l1 + l2 * np.cos(second))
        return np.stack([np.arctan2(x[..., 1], x[..., 0]) - inner, second], -1)


def _pair(name: str, value: ArrayLike, finite: bool = False) -> Array:
    return checked(name, value, "... 2", finite=finite)


def simulate(
    arm: TwoLinkArm, law: TorqueLaw, q: ArrayLike, dq: ArrayLike, times: ArrayLike
) -> tuple[Array, Array]:
    """Angles and rates at the times, (T, ..., 2) each, from `q` and `dq`, (..., 2).

    The torque `law(t, q, q')`, N m, is held between two times, each one Runge-Kutta step (RK4).
    """
    need(callable(law), "law", "a function", law)
    times = increasing("times", times)
    path = [np.stack(together(q=_pair("q", q, True), dq=_pair("dq", dq, True)))]
    for t, h in zip(times, np.diff(times), strict=False):
        tau, state = _pair("law(t, q, dq)", law(float(t), *path[-1])), path[-1]

        def rate(s: Array, tau: Array = tau) -> Array:
            return np.stack([s[1], arm.acceleration(s[0], s[1], tau)])

        k1 = rate(state)
        k2 = rate(state + h / 2 * k1)
        k3 = rate(state + h / 2 * k2)
        k4 = rate(state + h * k3)
        path.append(state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
    angles, rates = np.swapaxes(path, 0, 1)
    return angles, rates
