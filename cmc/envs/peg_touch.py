"""Peg touch (paper section VI and appendix F): reach a position and a contact force on a surface.

`PegTouchVectorEnv` steps thousands of trajectories with one set of numpy operations;
`PegTouchEnv` is the same environment with a single trajectory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import ArrayLike, NDArray

from cmc.envs.checks import checked
from cmc.envs.peg_touch_config import INTERFACES, PegShift, PegTouchConfig
from cmc.envs.vector import NativeVectorEnv, SingleEnv, Step, without_pictures
from cmc.plants import Peg

__all__ = ["INTERFACES", "PegShift", "PegTouchConfig", "PegTouchEnv", "PegTouchVectorEnv"]

Array = NDArray[np.float64]
SAMPLED = ("x0", "z0", "x_d", "f_d", "K_sur", "surface_sin", "surface_cos")


class PegTouchVectorEnv(NativeVectorEnv):
    """Peg touch, natively batched.

    A peg moves horizontally (x) and vertically (z) behind two first-order lags,

        tau_x x' + x = u_x,   tau_z z' + z = u_z,   f = K_sur min(z - g(x), 0),
        g(x) = surface_sin sin x + surface_cos cos x,

    and is to hold x at `x_d` and the contact force f at `f_d`. Between two commands the lags are
    integrated exactly (zero-order hold). Stiffness, surface and targets differ per trajectory.

    ## Action space

    | Num | Action          | Min | Max | Unit |
    |-----|-----------------|-----|-----|------|
    | 0   | a_1, horizontal | -3  | 3   | m    |
    | 1   | a_2, vertical   | -3  | 3   | m    |

    The command is u = u0 + T_a a ("auxiliary") or u = u0 + a ("identity", "raw"), turned by
    `mount_angle`, then clipped to `x_limits` and `z_limits`; with `stiffness_reference`, a_2 is
    first divided by the relative stiffness. Larger actions are accepted and saturate in the same
    place; NaN and infinity are refused.

    ## Observation space

    With e = y - y_d, y = (x, f), and integrals I_k = I_{k-1} + h z_k that include the new value:

    | Num | "auxiliary" (z = T_y e) | "identity" | "raw" | Unit      |
    |-----|-------------------------|------------|-------|-----------|
    | 0   | z_1                     | e_x        | x     | m         |
    | 1   | integral of z_1         | of e_x     | f     | m s, N    |
    | 2   | z_2                     | e_f        | x_d   | N, m      |
    | 3   | integral of z_2         | of e_f     | f_d   | N s, N    |

    `obs.reshape(-1, 2, 2)` is the policy's input s (dimension, [signal, integral]). Bounds are
    what the limits and the horizon allow. R_11 and R_22 are positive in both interfaces, so a
    contracting policy decreases in both inputs (paper-wide sign rule).

    T_y and T_a belong to the nominal in-contact model, also while the peg is in the air.

    ## Rewards

    The sum of two named terms, evaluated after the step (`info["reward_terms"]`):
    - position: `-weight_x |e_x|`
    - force: `-weight_f min(|e_f|, force_error_cap)`

    ## Starting state

    x, z, targets, stiffness and surface are uniform in the configuration's ranges; integrals
    start with the first error. `reset(options={"parameters": {name: value}})` fixes any of
    `SAMPLED`. `reset(seed=[s_1, ..., s_G])` gives each of G equal groups of trajectories its own
    random stream, so that what one group sees does not depend on the others.

    ## Episode end

    No termination. Truncation after `horizon` steps.

    ## Info

    - `reward_terms`: term to (num_envs,) array.
    - `privileged`: (num_envs, 10) float32, all that a critic needs in training: both errors and
      integrals, x, z, f_d, log stiffness and both surface coefficients, scaled to order one.
    - at truncation in same-step mode: `final_obs` and `final_info`, with the masks `_final_obs`
      and `_final_info`.

    ## Arguments

    | Parameter        | Type                | Default    | Description                         |
    |------------------|---------------------|------------|-------------------------------------|
    | `num_envs`       | int                 | 1          | trajectories                        |
    | `config`         | PegTouchConfig      | training   | every number of the task            |
    | `autoreset_mode` | AutoresetMode, str  | SAME_STEP  | see `NativeVectorEnv`               |
    | `privileged`     | bool                | True       | whether info carries `privileged`   |
    | other keywords   | fields of config    |            | replace single fields               |

    ## Version history

    * v0: first version.
    """

    privileged_size = 10

    def __init__(
        self,
        num_envs: int = 1,
        config: PegTouchConfig | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        privileged: bool = True,
        **overrides: Any,
    ) -> None:
        without_pictures(overrides.pop("render_mode", None))
        self.config = c = replace(config or PegTouchConfig(), **overrides)
        action = spaces.Box(-c.action_limit, c.action_limit, (2,), np.float32)
        observation = spaces.Box(*c.observation_bounds(), dtype=np.float32)
        super().__init__(num_envs, observation, action, autoreset_mode)
        self._with_privileged, self._mount = privileged, _rotation(c.mount_angle)
        self._generators: list[np.random.Generator] = []
        self.position: Array = np.zeros((num_envs, 2))
        """Position (x, z) [m], shape (num_envs, 2)."""
        self.integral: Array = np.zeros((num_envs, 2))
        """Integral of the signal, shape (num_envs, 2)."""
        self.command: Array = np.tile(np.asarray(c.u0, dtype=float), (num_envs, 1))
        """Last applied command (u_x, u_z) [m], shape (num_envs, 2)."""
        self.force: Array = np.zeros(num_envs)
        """Contact force f [N], shape (num_envs,)."""
        self.error: Array = np.zeros((num_envs, 2))
        """Latent tracking error y - y_d, shape (num_envs, 2) [m, N]."""
        self.signal: Array = np.zeros((num_envs, 2))
        """What the policy is fed before its integral, T_y e or e, shape (num_envs, 2)."""
        self.steps = np.zeros(num_envs, dtype=np.int64)
        self.sampled: dict[str, Array] = {}
        """Values drawn at reset, name in `SAMPLED` to (num_envs,) array."""

    def _begin(self, mask: NDArray[np.bool_], options: dict[str, Any]) -> NDArray[np.float32]:
        self._restart(mask, options.get("parameters", {}))
        return self._observe()

    def _advance(self, actions: ArrayLike) -> Step:
        if not self.sampled:
            raise gym.error.ResetNeeded("call reset before step")
        a = checked(actions, (self.num_envs, 2), "actions")
        c = self.config
        if c.stiffness_reference is not None:
            scale = c.stiffness_reference / self.sampled["K_sur"]
            a = np.stack([a[:, 0], scale * a[:, 1]], axis=-1)
        if c.interface != "auxiliary" and c.mount_angle != 0.0:
            a = a @ self._mount.T  # in the auxiliary space T_a turns the command back
        low, high = zip(c.x_limits, c.z_limits, strict=True)
        self.command = np.clip(np.asarray(c.u0) + a, low, high)
        x, z = self.position.T
        x, z = self.true_peg.step(x, z, self.command, c.h)  # exact zero-order hold
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
        shear = self.nominal_peg.K_sur * self.nominal_peg.surface_slope(self.position[:, 0])
        T_y = np.zeros((self.num_envs, 2, 2))
        T_y[:, 0, 0] = T_y[:, 1, 1] = 1.0
        T_y[:, 1, 0] = shear  # inverse_solution: T_y f_y T_y^-1 = diag(-1/tau_x, -1/tau_z)
        T_a = np.broadcast_to(self._mount.T, T_y.shape)  # inverse_solution: R = T_y f_u T_a
        return T_y, T_a

    def _sense(self) -> None:
        """Force, error and signal at the present position."""
        x, z = self.position.T
        self.force = self.true_peg.contact_force(x, z)
        error = [x - self.sampled["x_d"], self.force - self.sampled["f_d"]]
        self.error = np.stack(error, axis=-1)
        if self.config.interface == "auxiliary":
            shear = self.nominal_peg.K_sur * self.nominal_peg.surface_slope(x)
            error[1] = error[1] + shear * error[0]  # T_y e, see `transforms`
        self.signal = np.stack(error, axis=-1)

    def _seed(self, seed: int | Sequence[int | None] | None) -> None:
        if isinstance(seed, Sequence):
            if len(seed) == 0 or self.num_envs % len(seed):
                raise ValueError(
                    f"seed: wanted a number of seeds that divides {self.num_envs}, got {len(seed)}"
                )
            self._generators = [np.random.default_rng(s) for s in seed]
        elif seed is not None or not self._generators:
            VectorEnv.reset(self, seed=seed)
            self._generators = [self.np_random]

    def _restart(self, mask: NDArray[np.bool_], fixed: Mapping[str, ArrayLike]) -> None:
        unknown = set(fixed) - set(SAMPLED)
        if unknown:
            raise ValueError(f"parameters: wanted names in {SAMPLED}, got {sorted(unknown)}")
        c = self.config
        ranges = [getattr(c, name.split("_")[0] if "surface" in name else name) for name in SAMPLED]
        low, high = np.array(ranges).T
        group = self.num_envs // len(self._generators)
        unit = np.concatenate([g.random((group, len(SAMPLED))) for g in self._generators])
        drawn = low + (high - low) * unit
        for index, name in enumerate(SAMPLED):
            value = np.broadcast_to(np.asarray(fixed.get(name, drawn[:, index]), float), mask.shape)
            if not np.isfinite(value).all():
                raise ValueError(f"parameters: {name} is not finite")
            self.sampled[name] = np.where(mask, value, self.sampled.get(name, value))
        start = np.stack([self.sampled["x0"], self.sampled["z0"]], axis=-1)
        self.position = np.where(mask[:, None], start, self.position)
        self.command = np.where(mask[:, None], np.asarray(c.u0), self.command)
        self.integral = np.where(mask[:, None], 0.0, self.integral)
        self.steps = np.where(mask, 0, self.steps)
        self.nominal_peg, self.true_peg = self._pegs()
        self._sense()
        self.integral = np.where(mask[:, None], c.h * self.signal, self.integral)

    def _pegs(self) -> tuple[Peg, Peg]:
        """The plant the controller believes in, and the one that answers it."""
        c, s = self.config, self.sampled
        nominal = Peg(
            tau_x=c.tau_x,
            tau_z=c.tau_z,
            K_sur=s["K_sur"],
            surface_sin=s["surface_sin"],
            surface_cos=s["surface_cos"],
        )
        if c.shift == PegShift():
            return nominal, nominal
        true = Peg(
            tau_x=c.tau_x * c.shift.tau_x,
            tau_z=c.tau_z * c.shift.tau_z,
            K_sur=s["K_sur"] * c.shift.K_sur,
            surface_sin=s["surface_sin"] * c.shift.surface,
            surface_cos=s["surface_cos"] * c.shift.surface,
        )
        return nominal, true

    def _observe(self) -> NDArray[np.float32]:
        if self.config.interface == "raw":
            s = self.sampled
            columns = [self.position[:, 0], self.force, s["x_d"], s["f_d"]]
        else:
            signal, integral = self.signal, self.integral
            columns = [signal[:, 0], integral[:, 0], signal[:, 1], integral[:, 1]]
        return np.stack(columns, axis=-1).astype(np.float32)

    def _describe(self, info: dict[str, Any]) -> dict[str, NDArray[np.float32]]:
        """What a critic may know, if it is wanted."""
        if not self._with_privileged:
            return {}
        s, (x, z), error = self.sampled, self.position.T, self.error
        scaled = [
            error[:, 0],
            np.clip(error[:, 1] / 3.0, -5.0, 5.0),
            self.integral[:, 0],
            np.clip(self.integral[:, 1], -5.0, 5.0),
            x - 2.0,
            z,
            s["f_d"] + 1.5,
            np.log(s["K_sur"]) - 2.5,
            100.0 * s["surface_sin"],
            100.0 * s["surface_cos"],
        ]
        return {"privileged": np.stack(scaled, axis=-1).astype(np.float32)}


class PegTouchEnv(SingleEnv):
    """Peg touch, one trajectory; everything else is documented at `PegTouchVectorEnv`."""

    def __init__(
        self, config: PegTouchConfig | None = None, render_mode: str | None = None, **overrides: Any
    ) -> None:
        without_pictures(render_mode)
        super().__init__(PegTouchVectorEnv(1, config, AutoresetMode.DISABLED, **overrides))
        self.config = self.batch.config


def _rotation(angle: float) -> Array:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine], [sine, cosine]])
