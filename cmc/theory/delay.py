"""Delay and noise against gain: where a sampled loop stops being stable, and what noise costs.

The loop is one auxiliary dimension of a diagonalized plant: a lag, a policy that looks at the
error and its integral through one ratio, a hold, and a command that arrives late::

    tau e'(t) = -e(t) + gain u(t),    u(t) = u_k  for  t_k + delay <= t < t_{k+1} + delay
    u_k = -slope (e_k + I_k / integral_time),    I_k = I_{k-1} + period e_k

Neither the lag nor the hold is approximated, and the delay need not be a whole number of samples.
How large may the slope be? `LagLoop.largest_gain` (exact, from the frequency response) and
`spectral_radius` (exact, from the matrix of one sample) agree; up to `class_gain` *every* policy
with slopes in that range contracts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import brentq

from cmc.theory.arrays import Array, checked, number

_FREQUENCIES = 8192  # points of the frequency grid, refined by bisection
_MOST_SAMPLES = 1000  # of delay: the matrix of one sample has as many rows


@dataclass(frozen=True)
class LagLoop:
    """A lag with sampled proportional-integral feedback; all values are positive.

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

    def _stable(self, delay: float, slope: float) -> tuple[Array, float]:
        """The matrix of one sample and its spectral radius, below 1."""
        matrix, radius = self.sample_matrix(delay, slope), self.spectral_radius(delay, slope)
        if not radius < 1.0:
            raise ValueError(
                f"the loop is not stable: spectral radius {radius:.4g} at slope {slope:.4g}; "
                f"it is stable below {float(self.largest_gain(delay)):.4g}"
            )
        return matrix, radius

    def noise_gain(self, delay: float, slope: float) -> float:
        """Standard deviation of e per standard deviation of independent sensor noise n_k, at rest.

        The policy sees e_k + n_k, and so does its integral: b is the first column of Phi without
        the lag's own a, and the state's covariance solves S = Phi S Phi^T + b b^T.
        """
        matrix, _ = self._stable(delay, slope)
        b = matrix[:, 0] - np.eye(len(matrix))[0] * np.exp(-self.period / self.tau)
        return float(np.sqrt(solve_discrete_lyapunov(matrix, np.outer(b, b))[0, 0]))

    def disturbance_gain(self, delay: float, slope: float) -> float:
        """Largest |e| at the samples per unit of a disturbance |d_k| <= 1 added to the command.

        The sum of the absolute impulse response from rest, until what is left is below 1e-12.
        """
        matrix, radius = self._stable(delay, slope)
        steps = int(np.ceil(np.log(1e-12) / np.log(radius))) + len(matrix)
        if steps > 10_000_000:
            raise ValueError(f"the loop decays too slowly to be summed up: {radius!r} a sample")
        state, total = np.eye(len(matrix))[0], 0.0
        state = state * self.gain * -np.expm1(-self.period / self.tau)
        for _ in range(steps):
            total += abs(state[0])
            state = matrix @ state
        return float(total)


def _angles() -> Array:
    # Logarithmic near zero, where the integrator turns the phase; linear up to half the sample rate
    low = np.geomspace(1e-5, 0.05, _FREQUENCIES // 4, endpoint=False)
    return np.concatenate([low, np.linspace(0.05, np.pi, 3 * _FREQUENCIES // 4)])
