"""Peg touch (paper section VI, appendix F): reach a position and a contact force on a surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import ArrayLike

from cmc.envs.peg_touch_config import INTERFACES, PegShift, PegTouchConfig
from cmc.envs.vector import Array, Array32, Mask, NativeVectorEnv, Seed, SingleEnv, Step
from cmc.plants import Peg
from cmc.theory.arrays import checked

__all__ = ["INTERFACES", "PegShift", "PegTouchConfig", "PegTouchEnv", "PegTouchVectorEnv"]

SAMPLED = ("x0", "z0", "x_d", "f_d", "K_sur", "surface_sin", "surface_cos")


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
      of `SAMPLED`. `reset(seed=[s_1, ..., s_G])` gives each of G equal groups of trajectories its
      own random stream, so that what one group sees does not depend on the others.
    - End: no termination; truncated after `horizon` steps.
    - Info: `privileged` (num_envs, 10) float32, all that a critic needs in training: both errors
      and integrals, x, z, f_d, log stiffness and both surface coefficients, of order one.

    Args:
        num_envs: trajectories.
        config: every number of the task; `overrides` replace single fields of it.
        autoreset_mode: see `NativeVectorEnv`.
        privileged: whether info carries `privileged`.

    Attributes:
        position: (x, z) [m]. command: last applied (u_x, u_z) [m]. error: y - y_d [m, N].
        signal: what the policy is fed, T_y e or e; integral: of it. All (num_envs, 2).
        force: contact force f [N], (num_envs,).
        sampled: values drawn at reset, name in `SAMPLED` to (num_envs,) array.
    """

    privileged_size = 10

    def __init__(
        self,
        num_envs: int = 1,
        config: PegTouchConfig | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        privileged: bool = True,
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        self.config = c = replace(config or PegTouchConfig(), **overrides)
        action = spaces.Box(-c.action_limit, c.action_limit, (2,), np.float32)
        observation = spaces.Box(*c.observation_bounds(), dtype=np.float32)
        super().__init__(num_envs, observation, action, autoreset_mode, render_mode)
        cosine, sine = np.cos(c.mount_angle), np.sin(c.mount_angle)
        self._mount = np.array([[cosine, -sine], [sine, cosine]])
        self._with_privileged = privileged
        self._generators: list[np.random.Generator] = []
        self.position, self.integral = np.zeros((num_envs, 2)), np.zeros((num_envs, 2))
        self.command: Array = np.tile(c.u0, (num_envs, 1))
        self.steps = np.zeros(num_envs, dtype=np.int64)
        self.sampled: dict[str, Array] = {}

    def _advance(self, actions: ArrayLike) -> Step:
        if not self.sampled:
            raise gym.error.ResetNeeded("call reset before step")
        a, c = checked("actions", actions, "N 2", N=self.num_envs), self.config
        if c.stiffness_reference is not None:
            scale = c.stiffness_reference / self.sampled["K_sur"]
            a = np.stack([a[:, 0], scale * a[:, 1]], axis=-1)
        if c.interface != "auxiliary" and c.mount_angle != 0.0:
            a = a @ self._mount.T  # in the auxiliary space T_a turns the command back
        low, high = zip(c.x_limits, c.z_limits, strict=True)
        self.command = np.clip(np.asarray(c.u0) + a, low, high)
        x, z = self.true_peg.step(
            self.position[:, 0], self.position[:, 1], self.command, c.h
        )  # exact zero-order hold
        self.position = np.stack([x, z], axis=-1)
        self._sense()
        self.integral = self.integral + c.h * self.signal
        self.steps += 1
        e_x, e_f = np.abs(self.error).T
        force = -c.weight_f * np.minimum(e_f, c.force_error_cap)
        terms = {"position": -c.weight_x * e_x, "force": force}
        reward = terms["position"] + terms["force"]
        truncated = self.steps >= c.horizon
        ended = np.zeros(self.num_envs, dtype=bool)
        return self._observe(), reward, ended, truncated, {"reward_terms": terms}

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

    def _seed(self, seed: Seed) -> None:
        if isinstance(seed, Sequence):
            if len(seed) == 0 or self.num_envs % len(seed):
                raise ValueError(
                    f"seed: wanted a number of seeds that divides {self.num_envs}, got {len(seed)}"
                )
            self._generators = [np.random.default_rng(s) for s in seed]
        elif seed is not None or not self._generators:
            VectorEnv.reset(self, seed=seed)
            self._generators = [self.np_random]

    def _begin(self, mask: Mask, options: dict[str, Any]) -> Array32:
        c, fixed = self.config, options.get("parameters", {})
        unknown = set(fixed) - set(SAMPLED)
        if unknown:
            raise ValueError(f"parameters: wanted names in {SAMPLED}, got {sorted(unknown)}")
        ranges = [getattr(c, name.split("_")[0] if "surface" in name else name) for name in SAMPLED]
        low, high = np.array(ranges).T
        group = self.num_envs // len(self._generators)
        unit = np.concatenate([g.random((group, len(SAMPLED))) for g in self._generators])
        drawn = low + (high - low) * unit
        for index, name in enumerate(SAMPLED):
            value = checked(f"parameters: {name}", fixed.get(name, drawn[:, index]))
            value = np.broadcast_to(value, mask.shape)
            self.sampled[name] = np.where(mask, value, self.sampled.get(name, value))
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

    def _describe(self, info: dict[str, Any]) -> dict[str, Array32]:
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
