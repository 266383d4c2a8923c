"""Peg touch (paper section VI, appendix F): reach a position and a contact force on a surface."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike

from cmc.envs.vector import Array32, Mask, NativeVectorEnv, SingleEnv, Step, set_counts, set_numbers
from cmc.plants import Peg
from cmc.theory.arrays import Array, checked

INTERFACES = ("auxiliary", "identity", "raw")
SAMPLED = ("x0", "z0", "x_d", "f_d", "K_sur", "surface_sin", "surface_cos")


@dataclass(frozen=True)
class PegShift:
    """True parameters over the nominal ones that the controller believes in (fig:1 c) [-]."""

    tau_x: float = 1.0  # lag of x; the paper's generalisation test: 0.5 and 1.5
    tau_z: float = 1.0  # lag of z; paper: 0.5 and 1.5
    K_sur: float = 1.0  # stiffness of the surface; paper: 100 % more, so 2
    surface: float = 1.0  # both surface coefficients; paper: 0.5 and 1.5

    def __post_init__(self) -> None:
        set_numbers(self, "", tuple(vars(self)), above=0.0)


@dataclass(frozen=True)
class PegTouchConfig:
    """Every number of the task; defaults are the training set. Pairs are (low, high)."""

    # Paper, appendix F:
    tau_x: float = 0.0437  # lag of the horizontal axis [s]
    tau_z: float = 0.01  # lag of the vertical axis [s]
    K_sur: tuple[float, float] = (1.0, 31.0)  # surface stiffness [N/m]
    surface: tuple[float, float] = (-0.01, 0.01)  # both coefficients of the surface profile [m]
    x_limits: tuple[float, float] = (1.0, 3.0)  # x, and its command (ours) [m]
    z_limits: tuple[float, float] = (-3.0, 1.0)  # z, and its command (ours) [m]
    # Our choice (the paper samples what is desired, without a range):
    x_d: tuple[float, float] = (1.0, 3.0)  # desired position [m]
    f_d: tuple[float, float] = (-2.5, -0.5)  # desired force [N]; negative, as f <= 0 in contact
    x0: tuple[float, float] = (1.0, 3.0)  # first position [m]
    z0: tuple[float, float] = (0.0, 1.0)  # first height [m]: above the surface
    u0: tuple[float, float] = (2.0, -0.5)  # command to which the policy's output is added [m]
    h: float = 0.01  # control period, with a zero-order hold on the command [s]
    horizon: int = 50  # steps in an episode
    weight_x: float = 0.5  # weight of the position error in the reward [1/m]
    weight_f: float = 0.5  # weight of the force error in the reward [1/N]
    force_error_cap: float = 5.0  # force error beyond which the reward falls no further [N]
    action_limit: float = 3.0  # bound of the declared action space; commands saturate earlier [m]
    # Our extensions:
    mount_angle: float = 0.0
    """Angle between the command axes and the plant's axes [rad]. At 0 it is the paper's plant;
    elsewhere every entry of f_u is non-zero and T_a is the rotation back."""
    stiffness_reference: float | None = None
    """If given, a_2 is multiplied by this over the nominal stiffness [N/m]: R_22 is then the same
    on every surface and a slope is a loop gain. None is the paper's setting."""
    interface: str = "auxiliary"
    """What the policy sees and commands: one of `INTERFACES` (see `PegTouchVectorEnv`)."""
    shift: PegShift = field(default_factory=PegShift)
    """What the plant has otherwise than T_y and T_a believe. Paper, fig:1 c."""

    def __post_init__(self) -> None:
        ranges = ("surface", "x_limits", "z_limits", "x_d", "f_d", "x0", "z0")
        reference = () if self.stiffness_reference is None else ("stiffness_reference",)
        positive = ("tau_x", "tau_z", "h", "action_limit", "force_error_cap", *reference)
        set_numbers(self, "", positive, above=0.0)
        set_numbers(self, "", ("weight_x", "weight_f", "mount_angle"))
        set_numbers(self, "2", (*ranges, "u0"))
        set_numbers(self, "2", ("K_sur",), above=0.0)
        for name in (*ranges, "K_sur"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name}: wanted (low, high), got {(low, high)}")
        set_counts(self, ("horizon",))
        if not isinstance(self.shift, PegShift):
            raise ValueError(f"shift: wanted a PegShift, got {self.shift!r}")
        if self.interface not in INTERFACES:
            raise ValueError(f"interface: wanted one of {INTERFACES}, got {self.interface!r}")

    def observation_bounds(self) -> tuple[Array32, Array32]:
        """Largest observations (4,) the limits and the horizon allow; generous, finite."""
        c, stiffness = self, self.K_sur[1]
        amplitude = 2.0 * float(np.hypot(*np.abs(c.surface)))
        deepest = max(map(abs, c.z_limits)) + c.shift.surface * amplitude
        force = stiffness * c.shift.K_sur * deepest
        if c.interface == "raw":
            lowest = np.array([c.x_limits[0], -force, c.x_d[0], c.f_d[0]])
            highest = np.array([c.x_limits[1], 0.0, c.x_d[1], c.f_d[1]])
        else:
            reach = max(c.x_limits[1], c.x_d[1], c.x0[1]) - min(c.x_limits[0], c.x_d[0], c.x0[0])
            pull = force + max(map(abs, c.f_d)) + stiffness * amplitude * reach
            signal, time = np.array([reach, pull]), (c.horizon + 1) * c.h
            highest = 1.001 * np.stack([signal, time * signal], axis=-1).ravel()
            lowest = -highest
        return lowest.astype(np.float32), highest.astype(np.float32)


class PegTouchVectorEnv(NativeVectorEnv):
    """Peg touch, natively batched: thousands of trajectories in one set of numpy operations.

    A peg moves horizontally (x) and vertically (z) behind two first-order lags,

        tau_x x' + x = u_x,   tau_z z' + z = u_z,   f = K_sur min(z - g(x), 0),
        g(x) = surface_sin sin x + surface_cos cos x,

    and is to hold x at `x_d` and the contact force f at `f_d`. Between two commands the lags are
    integrated exactly (zero-order hold). Stiffness, surface and targets differ per trajectory.

    - Action (2,): a = (horizontal, vertical), m; the command is u = u0 + T_a a ("auxiliary") or
      u = u0 + a ("identity", "raw"), turned by `mount_angle`, then clipped to `x_limits` and
      `z_limits`. With `stiffness_reference`, a_2 is first divided by the relative stiffness. More
      than `action_limit` is accepted; NaN and infinity are refused.
    - Observation (4,), with e = y - y_d, y = (x, f): (z_1, integral, z_2, integral) of z = T_y e
      ("auxiliary") or e ("identity"), m, m s, N, N s; integrals I_k = I_{k-1} + h z_k include the
      new value. Or (x, f, x_d, f_d), m and N ("raw"). `obs.reshape(-1, 2, 2)` is the policy's input
      s (dimension, [signal, integral]). R_11 and R_22 are positive in both interfaces, so that a
      contracting policy decreases in both inputs (paper-wide sign rule). T_y and T_a are of the
      nominal in-contact model, also while the peg is in the air.
    - Reward: the sum of `info["reward_terms"]`, after the step: position, `-weight_x |e_x|`, and
      force, `-weight_f min(|e_f|, force_error_cap)`.
    - Start: x, z, targets, stiffness and surface are uniform in the configuration's ranges;
      integrals start with the first error. `reset(options={"parameters": {name: value}})` fixes any
      of `SAMPLED`.
    - End: no termination; truncated after `horizon` steps.
    - Info: `privileged` (num_envs, 10) float32, all that a critic needs in training: both errors
      and integrals, x, z, f_d, log stiffness and both surface coefficients, of order one.

    `overrides` replace single fields of `config`; `privileged` says whether info carries it.

    Attributes:
        position: (x, z) [m]. command: last applied (u_x, u_z) [m]. error: y - y_d [m, N].
        signal: what the policy is fed, T_y e or e; integral: of it. All (num_envs, 2).
        force: contact force f [N], (num_envs,).
        sampled: values drawn at reset, name in `SAMPLED` to (num_envs,) array.
    """

    def __init__(
        self,
        num_envs: int = 1,
        config: PegTouchConfig | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        privileged: bool = True,
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        if not isinstance(config, PegTouchConfig | None):
            raise TypeError(f"config: wanted a PegTouchConfig, got {config!r}")
        self.config = c = replace(config or PegTouchConfig(), **overrides)
        action = spaces.Box(-c.action_limit, c.action_limit, (2,), np.float32)
        observation = spaces.Box(*c.observation_bounds(), dtype=np.float32)
        super().__init__(num_envs, observation, action, autoreset_mode, render_mode)
        cosine, sine = np.cos(c.mount_angle), np.sin(c.mount_angle)
        self._mount = np.array([[cosine, -sine], [sine, cosine]])
        self._with_privileged = privileged
        self.position, self.integral = np.zeros((num_envs, 2)), np.zeros((num_envs, 2))
        self.command: Array = np.tile(c.u0, (num_envs, 1))
        self.steps = np.zeros(num_envs, dtype=np.int64)
        self.sampled: dict[str, Array] = {}

    def _advance(self, actions: ArrayLike) -> Step:
        a, c = checked("actions", actions, "N 2", N=self.num_envs), self.config
        if c.stiffness_reference is not None:
            scale = c.stiffness_reference / self.sampled["K_sur"]
            a = np.stack([a[:, 0], scale * a[:, 1]], axis=-1)
        if c.interface != "auxiliary" and c.mount_angle != 0.0:
            a = a @ self._mount.T  # in the auxiliary space T_a turns the command back
        low, high = zip(c.x_limits, c.z_limits, strict=True)
        self.command = np.clip(np.asarray(c.u0) + a, low, high)
        x, z = self.position.T
        moved = self.true_peg.step(x, z, self.command, c.h)  # exact zero-order hold
        self.position = np.stack(moved, axis=-1)
        self._sense()
        self.integral = self.integral + c.h * self.signal
        self.steps += 1
        e_x, e_f = np.abs(self.error).T
        force = -c.weight_f * np.minimum(e_f, c.force_error_cap)
        terms = {"position": -c.weight_x * e_x, "force": force}
        reward, ended = terms["position"] + terms["force"], np.zeros(self.num_envs, dtype=bool)
        return self._observe(), reward, ended, self.steps >= c.horizon, {"reward_terms": terms}

    def transforms(self) -> tuple[Array, Array]:
        """T_y and T_a of the nominal in-contact model at the present x, (num_envs, 2, 2) each.

        The model is linearised at the command that would hold the peg where it is (u_x = x),
        where the exact f_y has the lower left entry K g' (1/tau_x - 1/tau_z). Its slow eigenvector
        is (1, -K g'), the fast one (0, 1); eigenvectors are scaled to a unit diagonal of T_y, which
        keeps order, sign and scale continuous in x:

            T_y = [[1, 0], [K g', 1]],   T_y f_u = diag(1/tau_x, K/tau_z),   T_a = rotation back.
        """
        T_y = np.tile(np.eye(2), (self.num_envs, 1, 1))
        T_y[:, 1, 0] = self._shear()  # inverse_solution: T_y f_y T_y^-1 = diag(-1/tau_x, -1/tau_z)
        return T_y, np.broadcast_to(self._mount.T, T_y.shape)  # inverse_solution: R = T_y f_u T_a

    def _shear(self) -> Array:
        peg = self.nominal_peg
        return np.asarray(peg.K_sur * peg.surface_slope(self.position[:, 0]))

    def _sense(self) -> None:
        """Force, error and signal at the present position."""
        x, z = self.position.T
        self.force = self.true_peg.contact_force(x, z)
        error = [x - self.sampled["x_d"], self.force - self.sampled["f_d"]]
        self.error = np.stack(error, axis=-1)
        if self.config.interface == "auxiliary":
            error[1] = error[1] + self._shear() * error[0]  # T_y e, see `transforms`
        self.signal = np.stack(error, axis=-1)

    def _begin(self, mask: Mask, options: dict[str, Any]) -> Array32:
        c, fixed = self.config, options.get("parameters", {})
        if not isinstance(fixed, dict) or set(fixed) - set(SAMPLED):
            raise ValueError(f"parameters: wanted values by name, of {SAMPLED}, got {fixed!r}")
        ranges = [getattr(c, name.split("_")[0] if "surface" in name else name) for name in SAMPLED]
        low, high = np.array(ranges).T
        drawn = dict(zip(SAMPLED, self._draw(low, high, len(SAMPLED)).T, strict=True))
        for name, value in fixed.items():
            found = checked(label := f"parameters: {name}", value)
            found = found if found.ndim else np.full(self.num_envs, found)
            least = 0.0 if name == "K_sur" else None
            drawn[name] = checked(label, found, "N", N=self.num_envs, above=least)
        for name, value in drawn.items():
            kept = self.sampled.get(name, value)
            self.sampled[name] = np.asarray(np.where(mask, value, kept), dtype=float)
        start = np.stack([self.sampled["x0"], self.sampled["z0"]], axis=-1)
        self.position = np.where(mask[:, None], start, self.position)
        self.command = np.where(mask[:, None], c.u0, self.command)
        self.steps = np.where(mask, 0, self.steps)
        self.nominal_peg, self.true_peg = self._peg(PegShift()), self._peg(c.shift)
        self._sense()
        self.integral = np.where(mask[:, None], c.h * self.signal, self.integral)
        return self._observe()

    def _peg(self, shift: PegShift) -> Peg:
        c, s = self.config, self.sampled
        return Peg(
            tau_x=c.tau_x * shift.tau_x,
            tau_z=c.tau_z * shift.tau_z,
            K_sur=s["K_sur"] * shift.K_sur,
            surface_sin=s["surface_sin"] * shift.surface,
            surface_cos=s["surface_cos"] * shift.surface,
        )

    def _observe(self) -> Array32:
        if self.config.interface == "raw":
            s = self.sampled
            columns = np.stack([self.position[:, 0], self.force, s["x_d"], s["f_d"]], axis=-1)
        else:
            columns = np.stack([self.signal, self.integral], axis=-1).reshape(-1, 4)
        return columns.astype(np.float32)

    def _describe(self) -> dict[str, Array32]:
        """What a critic may know, if it is wanted."""
        if not self._with_privileged:
            return {}
        s, (x, z) = self.sampled, self.position.T
        (e_x, e_f), (I_x, I_f) = self.error.T, self.integral.T
        scaled = [e_x, np.clip(e_f / 3.0, -5.0, 5.0), I_x, np.clip(I_f, -5.0, 5.0), x - 2.0, z]
        scaled += [s["f_d"] + 1.5, np.log(s["K_sur"]) - 2.5]
        scaled += [100.0 * s["surface_sin"], 100.0 * s["surface_cos"]]
        return {"privileged": np.stack(scaled, axis=-1).astype(np.float32)}


class PegTouchEnv(SingleEnv):
    """Peg touch, one trajectory; everything else is documented at `PegTouchVectorEnv`."""

    many = PegTouchVectorEnv
