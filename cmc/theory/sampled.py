"""Sampled control: zero-order hold puts the upper bound on the slopes that theory leaves out.

A lag tau y' = -y + K u is sampled every h seconds under u = -(k1 e_k + k2 I_k) with
I_k = I_{k-1} + h e_k, the new error included. In (e_k, I_{k-1}) one step is

    e_{k+1} = phi e_k - G (k1 + h k2) e_k - G k2 I_{k-1},    I_k = I_{k-1} + h e_k,

with phi = e^{-h/tau}, G = K (1 - phi). Jury's conditions on this 2x2 matrix are exactly

    k2 > 0,      k1 > -1/K,      k1 + (h/2) k2 < coth(h / (2 tau)) / K.

Another quadrature of the integral has another bound: forward Euler or the trapezoid rule decide
more than a third of random samples differently. The bound is exact for constant slopes; slopes that
vary need a common metric (`certificates.common_metric` with `h`). `LagLoop` adds a delay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm
from scipy.optimize import brentq

from cmc.theory.arrays import Array, checked, number

_FREQUENCIES = 8192  # points of the frequency grid, refined by bisection
_MOST_SAMPLES = 1000  # of delay: the matrix of one sample has as many rows


def hold_lag(Lambda: ArrayLike, R: ArrayLike, h: float) -> tuple[Array, Array]:
    """Exact step of z' = Lambda z + R a under a held a: z_{k+1} = phi z_k + G a_k, (...,) each.

    phi = e^{Lambda h}, G = R (e^{Lambda h} - 1) / Lambda, and R h where Lambda is 0; Lambda (...,)
    of any sign in 1/s, R (...,), h in s.
    """
    h, Lambda, R = number("h", h, above=0.0), checked("Lambda", Lambda), checked("R", R)
    flat = np.abs(Lambda * h) < 1e-12
    if (Lambda * h > 700).any():
        raise ValueError(f"Lambda h needs to be below 700, e^700 is the largest float; got h = {h}")
    growth = np.expm1(Lambda * h) / np.where(flat, 1.0, Lambda)
    return np.exp(Lambda * h), R * np.where(flat, h, growth)


def hold(Lambda: ArrayLike, R: ArrayLike, h: float) -> tuple[Array, Array]:
    """Exact step for matrices Lambda (n, n) in 1/s and R (n, m): z_{k+1} = Phi z_k + Gamma a_k.

    Phi = e^{Lambda h} and Gamma = int_0^h e^{Lambda s} ds R, both blocks of one exponential.
    """
    Lambda = checked("Lambda", Lambda, "n n")
    R = checked("R", R, "n m", n=len(Lambda))
    h, (n, m) = number("h", h, above=0.0), R.shape
    size = max(float(np.abs(R).max()), 1e-300)  # an exponential knows no units
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = Lambda * h, R / size
    step = expm(block) if np.abs(block).max() < 1e150 else np.nan * block
    if not np.isfinite(step).all():
        largest = np.abs(Lambda * h).max()
        raise ValueError(f"Lambda h is too large for e^(Lambda h); got {largest:g}")
    return step[:n, :n], step[:n, n:] * size * h


def sampled_matrix(
    k1: ArrayLike, k2: ArrayLike, Lambda: ArrayLike, R: ArrayLike, h: float
) -> Array:
    """One step in (z_k, I_{k-1}) of a_k = -(k1 z_k + k2 I_k), I_k = I_{k-1} + h z_k, (..., 2, 2).

    Slopes k1 and k2, positive where they damp for R > 0; Lambda in 1/s and R are -1/tau and K/tau
    for a lag, (...,) each; h in s.
    """
    phi, G = hold_lag(Lambda, R, h)
    phi, G, k1, k2 = np.broadcast_arrays(phi, G, checked("k1", k1), checked("k2", k2))
    step = np.empty((*phi.shape, 2, 2))
    step[..., 0, 0], step[..., 0, 1] = phi - G * (k1 + h * k2), -G * k2
    step[..., 1, 0], step[..., 1, 1] = h, 1.0
    return step


def _top(tau: ArrayLike, K: ArrayLike, h: ArrayLike) -> tuple[Array, Array, Array]:
    """coth(h / (2 tau)) / K, and K and h as arrays, all positive."""
    tau, K, h = (checked(*x, above=0.0) for x in (("tau", tau), ("K", K), ("h", h)))
    return 1 / (np.tanh(h / (2 * tau)) * K), K, h


def sampled_margin(
    k1: ArrayLike, k2: ArrayLike, tau: ArrayLike, K: ArrayLike, h: ArrayLike
) -> Array:
    """Distance to the edge of stability of a sampled lag, (...,): positive means stable.

    The smallest of the three slacks, each relative to the range coth(h/(2 tau))/K + 1/K of k1 (the
    one in k2 times h/2): 0 at the edge, and of order 1 in the middle. Slopes k1 and k2 (1/s), time
    constant tau (s), static gain K and sample time h (s), (...,) each.
    """
    top, K, h = _top(tau, K, h)
    k1, k2 = checked("k1", k1), checked("k2", k2)
    slack = np.broadcast_arrays(h / 2 * k2, k1 + 1 / K, top - k1 - h / 2 * k2)
    return np.asarray(np.min(slack, axis=0) / (top + 1 / K))


def largest_slope(
    tau: ArrayLike,
    K: ArrayLike,
    h: ArrayLike,
    *,
    ratio: ArrayLike | None = None,
    k2: ArrayLike | None = None,
) -> Array:
    """Largest slope k1 in the error for which a sampled lag is stable, (...,).

    k1 < coth(h/(2 tau))/K - (h/2) k2, divided by 1 + h ratio/2 where k2 = ratio k1.
    For the bare loop (k2 = 0) it is (1 + phi)/((1 - phi) K) with phi = e^{-h/tau}.

    Time constant tau (s), static gain K > 0 and sample time h (s); give ratio = k2 / k1 (1/s) or a
    bound k2 on the integral's own slope (1/s), (...,) each.
    """
    if ratio is not None and k2 is not None:
        raise ValueError("give ratio or k2, not both")
    top, K, h = _top(tau, K, h)
    other = checked("ratio", 0.0 if ratio is None else ratio, least=0.0)
    fixed = checked("k2", 0.0 if k2 is None else k2, least=0.0)
    limit = np.asarray((top - h / 2 * fixed) / (1 + h / 2 * other))
    if (limit <= 0).any():
        raise ValueError(
            f"k2 leaves no room for k1: (h/2) k2 reaches coth(h/(2 tau))/K = {np.min(top):.4g}"
        )
    return limit


@dataclass(frozen=True)
class LagLoop:
    """A lag under sampled proportional-integral feedback that arrives late; values are positive.

        tau e'(t) = -e(t) + gain u(t),   u(t) = u_k  for  t_k + delay <= t < t_{k+1} + delay
        u_k = -slope (e_k + I_k / integral_time),   I_k = I_{k-1} + period e_k

    Neither lag nor hold is approximated; the delay need not be a whole number of samples.

    Attributes:
        tau: Time constant of the lag, s (peg touch: the x axis, paper appendix PPO).
        gain: Output per command in steady state.
        period: Control period h, s (our choice).
        integral_time: Ratio of the slope on the error to the slope on its integral, s (our choice).
    """

    tau: float = 0.0437
    gain: float = 1.0
    period: float = 0.01
    integral_time: float = 0.1

    def __post_init__(self) -> None:
        for name in ("tau", "gain", "period", "integral_time"):
            object.__setattr__(self, name, number(name, getattr(self, name), above=0.0))

    def _late(self, delay: ArrayLike) -> tuple[NDArray[np.int64], float, Array, Array]:
        """Whole samples d of delay, and e_{k+1} = a e_k + b_new u_{k-d} + b_old u_{k-d-1}.

        The older command acts during the first part of the sample, the newer one after it.
        """
        samples = checked("delay", delay, least=0.0) / self.period
        if (samples > _MOST_SAMPLES).any():
            raise ValueError(f"delay needs at most {_MOST_SAMPLES} samples, got {samples.max():g}")
        whole = np.floor(samples + 1e-9)  # 0.03 / 0.01 is 2.9999...
        a = float(np.exp(-self.period / self.tau))
        rest = 1.0 - np.maximum(samples - whole, 0.0)
        newer = np.exp(-rest * self.period / self.tau)
        return whole.astype(np.int64), a, self.gain * (1.0 - newer), self.gain * (newer - a)

    def _response(self, delay: ArrayLike, angle: ArrayLike) -> NDArray[np.complex128]:
        """Open-loop response per unit slope, L(e^{j angle}), with angle = frequency * period.

        L(z) = (1 + h z / (T (z - 1))) (b_new z + b_old) / (z^{d+1} (z - a))
        """
        whole, a, b_new, b_old = self._late(delay)
        angle = np.asarray(angle, float)
        z = np.exp(1j * angle)
        controller = 1.0 + self.period / self.integral_time * z / (z - 1.0)
        late = np.exp(-1j * angle * (whole + 1))
        return np.asarray(controller * (b_new * z + b_old) * late / (z - a), dtype=np.complex128)

    def largest_gain(self, delay: ArrayLike) -> Array:
        """Smallest slope > 0 that puts a closed-loop pole on the unit circle; below it: stable.

        1 + k L(z) = 0 on |z| = 1 needs L real and negative: k = -1 / L(e^{j angle}) at the phase
        crossovers, half the sample rate (z = -1) included. Without delay it is the sampled-data
        bound k (1 + h / (2 T)) gain < coth(h / (2 tau)). Delays (...,) in s, slopes (...,).
        """
        delays = checked("delay", delay, least=0.0)
        angles = _angles()

        def first(late: float) -> float:
            values = self._response(late, angles[:-1]).imag
            where = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0.0)
            crossings = [
                brentq(lambda x: self._response(late, x).imag, *angles[i : i + 2], xtol=1e-14)
                for i in where
            ]
            real = self._response(late, np.array([*crossings, np.pi])).real
            return float(min((-1.0 / value for value in real if value < 0.0), default=np.inf))

        return np.array([first(float(late)) for late in delays.ravel()]).reshape(delays.shape)

    def class_gain(self, delay: ArrayLike) -> Array:
        """Largest k such that *every* policy with slopes in (0, k) contracts at this delay, (...,).

        The difference of two trajectories obeys the same loop with a slope that changes with time
        in that interval, so the sampled circle criterion applies to it: 1 + k Re L(e^{j angle}) > 0
        for all angles (Tsypkin), once the slopes keep some distance from both ends. Sufficient
        only; it never exceeds `largest_gain`, and equals it where there is no delay.
        """
        delays = checked("delay", delay, least=0.0)
        lowest = self._response(delays[..., None], _angles()).real.min(axis=-1)
        return np.where(lowest < 0.0, -1.0 / np.minimum(lowest, -1e-300), np.inf)

    def sample_matrix(self, delay: float, slope: float) -> Array:
        """Matrix of one sample for the state (e_k, I_{k-1}, u_{k-1}, ..., u_{k-d-1})."""
        whole, a, b_new, b_old = self._late(number("delay", delay, least=0.0))
        d, slope = int(whole), number("slope", slope)
        matrix = np.zeros((d + 3, d + 3))
        # u_k = -slope ((1 + h/T) e_k + I_{k-1} / T), because I_k holds the new error already
        command = np.zeros(d + 3)
        command[:2] = -slope * (1.0 + self.period / self.integral_time), -slope / self.integral_time
        commands = np.vstack([command, np.eye(d + 3)[2:]])  # u_k, u_{k-1}, ..., u_{k-d-1}
        matrix[0, 0] = a
        matrix[0] += float(b_new) * commands[d] + float(b_old) * commands[d + 1]
        matrix[1, :2] = self.period, 1.0
        matrix[2:] = commands[: d + 1]
        return matrix

    def spectral_radius(self, delay: float, slope: float) -> float:
        """Largest modulus of a closed-loop pole per sample; below 1 means stable."""
        return float(np.abs(np.linalg.eigvals(self.sample_matrix(delay, slope))).max())


def _angles() -> Array:
    # Logarithmic near zero, where the integrator turns the phase; linear up to half the sample rate
    low = np.geomspace(1e-5, 0.05, _FREQUENCIES // 4, endpoint=False)
    return np.concatenate([low, np.linspace(0.05, np.pi, 3 * _FREQUENCIES // 4)])
