"""Two loops that meet every stated inequality at every instant and still do not contract.

Both live on one lag y' = lag y + u + d(t) with a policy a(z, I), z = y, I = int z. The inequalities
of theorem 2 (`eq_theorem2`) ask for negative slopes, and get them. A Hurwitz matrix at every frozen
time says nothing about a matrix that moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike

from cmc.plants.base import Array


class Loop(Protocol):
    """A closed loop in s = (z, int z): right-hand side, Jacobian, period of its time dependence."""

    @property
    def name(self) -> str:
        """The name under which `cmc.plants.loop` builds it."""

    @property
    def period(self) -> float:
        """Period of the time dependence, s."""

    def rhs(self, t: float, s: ArrayLike) -> Array:
        """ds/dt, (..., 2)."""

    def jacobian(self, t: float, s: ArrayLike) -> Array:
        """[[Lambda + R p, R q], [1, 0]] at time t and state s, (..., 2, 2)."""


@dataclass(frozen=True)
class FloquetLoop:
    """A lag whose integral slope breathes: q(t) = -(1 + depth cos(2 t)).

    Lambda = -0.05, R = 1, p = -0.05, so trace -0.1 and determinant at least 1 - depth at every
    time. Over one period pi the Floquet multipliers are -1.263 and -0.579: it grows by 26 %
    a period, by parametric resonance.

    Attributes:
        lag: Lambda, 1/s.
        p: Slope in z, 1/s.
        depth: How deep the integral slope breathes, 0 to below 1.
    """

    lag: float = -0.05
    p: float = -0.05
    depth: float = 0.5
    name: ClassVar[str] = "floquet"
    period: ClassVar[float] = np.pi

    def __post_init__(self) -> None:
        if not (self.lag + self.p < 0 and 0 <= self.depth < 1):
            raise ValueError(
                "the counter-example meets the paper's inequalities: it needs lag + p < 0 and "
                f"0 <= depth < 1, got lag {self.lag}, p {self.p}, depth {self.depth}"
            )

    def slopes(self, t: float) -> tuple[float, float]:
        """Slopes (p, q) in z and in int z at time t."""
        return self.p, -(1 + self.depth * np.cos(2 * t))

    def rhs(self, t: float, s: ArrayLike) -> Array:
        """J(t) s, (..., 2)."""
        s = np.asarray(s, dtype=float)
        return (self.jacobian(t, s) @ s[..., None])[..., 0]

    def jacobian(self, t: float, s: ArrayLike) -> Array:
        """[[lag + p, q(t)], [1, 0]], (..., 2, 2)."""
        p, q = self.slopes(t)
        jac = np.array([[self.lag + p, q], [1.0, 0.0]])
        return np.broadcast_to(jac, (*np.shape(s)[:-1], 2, 2)).copy()


@dataclass(frozen=True)
class TwoAttractorLoop:
    """A positive-weight tanh policy under a bounded disturbance keeps two attractors.

    With w = int z:  w'' = -0.1 w' - [10 tanh(0.02 w) + 0.8 tanh(w)] + force cos(0.65 t).
    The slopes in z and in w are negative everywhere, yet two oscillations, of amplitude 0.570 and
    4.517 in w, both attract: trajectories do not forget their start.

    Attributes:
        force: Amplitude of the disturbance.
        lag: Lambda, 1/s.
        p: Slope in z, 1/s.
    """

    force: float = 0.3
    lag: float = -0.05
    p: float = -0.05
    name: ClassVar[str] = "two_attractors"
    period: ClassVar[float] = 2 * np.pi / 0.65

    def policy(self, z: ArrayLike, integral: ArrayLike) -> Array:
        """Command p z - [10 tanh(0.02 I) + 0.8 tanh(I)]: positive weights, sign rule."""
        integral = np.asarray(integral, dtype=float)
        pull = 10 * np.tanh(0.02 * integral) + 0.8 * np.tanh(integral)
        return self.p * np.asarray(z, dtype=float) - pull

    def slopes(self, integral: ArrayLike) -> tuple[float, Array]:
        """Slopes (p, q) in z and in int z at the given integral."""
        integral = np.asarray(integral, dtype=float)
        pull = 0.2 / np.cosh(0.02 * integral) ** 2 + 0.8 / np.cosh(integral) ** 2
        return self.p, -pull

    def rhs(self, t: float, s: ArrayLike) -> Array:
        """ds/dt for s = (z, int z), (..., 2)."""
        s = np.asarray(s, dtype=float)
        z, integral = s[..., 0], s[..., 1]
        disturbance = self.force * np.cos(0.65 * t)
        z_dot = self.lag * z + self.policy(z, integral) + disturbance
        return np.stack([z_dot, z], axis=-1)

    def jacobian(self, t: float, s: ArrayLike) -> Array:
        """[[lag + p, q], [1, 0]], (..., 2, 2)."""
        s = np.asarray(s, dtype=float)
        p, q = self.slopes(s[..., 1])
        jac = np.zeros((*s.shape[:-1], 2, 2))
        jac[..., 0, 0], jac[..., 0, 1], jac[..., 1, 0] = self.lag + p, q, 1.0
        return jac
