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
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from cmc.envs.peg_touch_config import INTERFACES, PegShift, PegTouchConfig
from cmc.plants import Peg

__all__ = ["INTERFACES", "PegShift", "PegTouchConfig", "PegTouchEnv", "PegTouchVectorEnv"]

Array = NDArray[np.float64]
SAMPLED = ("x0", "z0", "x_d", "f_d", "K_sur", "surface_sin", "surface_cos")


class PegTouchVectorEnv(VectorEnv[NDArray[np.float32], ArrayLike, Any]):
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
    | `autoreset_mode` | AutoresetMode       | SAME_STEP  | or DISABLED: states stay after the end |
    | `privileged`     | bool                | True       | whether info carries `privileged`   |
    | other keywords   | fields of config    |            | replace single fields               |

    ## Version history

    * v0: first version.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
    privileged_size = 10

    def __init__(
        self,
        num_envs: int = 1,
        config: PegTouchConfig | None = None,
        autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP,
        privileged: bool = True,
        **overrides: Any,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs: wanted at least 1, got {num_envs}")
        if autoreset_mode not in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED):
            raise ValueError(f"autoreset_mode: wanted SAME_STEP or DISABLED, got {autoreset_mode}")
        overrides.pop("render_mode", None)
        self.config = replace(config or PegTouchConfig(), **overrides)
        self.num_envs = num_envs
        self.metadata = {**self.metadata, "autoreset_mode": autoreset_mode}
        self._with_privileged = privileged
        self._same_step = autoreset_mode is AutoresetMode.SAME_STEP
        c = self.config
        self.single_action_space = spaces.Box(-c.action_limit, c.action_limit, (2,), np.float32)
        self.single_observation_space = spaces.Box(*_observation_bounds(c), dtype=np.float32)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._mount = _rotation(c.mount_angle)
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

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start new trajectories, all of them or those of `options["reset_mask"]`."""
        options = options or {}
        self._seed(seed)
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs)), dtype=bool)
        if mask.shape != (self.num_envs,):
            raise ValueError(f"reset_mask: wanted shape ({self.num_envs},), got {mask.shape}")
        self._restart(mask, options.get("parameters", {}))
        return self._observe(), self._info()

    def step(
        self, actions: ArrayLike
    ) -> tuple[NDArray[np.float32], Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Hold one command for a control period in every trajectory."""
        if not self.sampled:
            raise gym.error.ResetNeeded("call reset before step")
        a = np.asarray(actions, dtype=np.float64)
        if a.shape != (self.num_envs, 2):
            raise ValueError(f"actions: wanted shape ({self.num_envs}, 2), got {a.shape}")
        if not np.isfinite(a).all():
            raise ValueError("actions: wanted finite numbers, got NaN or infinity")
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
        error = np.abs(self.error)
        terms = {
            "position": -c.weight_x * error[:, 0],
            "force": -c.weight_f * np.minimum(error[:, 1], c.force_error_cap),
        }
        reward = terms["position"] + terms["force"]
        truncated = self.steps >= c.horizon
        obs = self._observe()
        info: dict[str, Any] = {"reward_terms": terms, **self._info()}
        if self._same_step and truncated.any():
            info |= {"final_obs": obs, "_final_obs": truncated}
            info |= {"final_info": self._info(), "_final_info": truncated}
            self._restart(truncated, {})
            obs = self._observe()
            info |= self._info()
        return obs, reward, np.zeros(self.num_envs, dtype=bool), truncated, info

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
            super().reset(seed=seed)
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

    def _info(self) -> dict[str, NDArray[np.float32]]:
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


class PegTouchEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Peg touch, one trajectory; everything else is documented at `PegTouchVectorEnv`."""

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(
        self,
        config: PegTouchConfig | None = None,
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        self.batch = PegTouchVectorEnv(1, config, AutoresetMode.DISABLED, **overrides)
        self.config = self.batch.config
        self.render_mode = render_mode
        self.action_space = self.batch.single_action_space
        self.observation_space = self.batch.single_observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start a new trajectory; see the class for `options`."""
        super().reset(seed=seed)
        stream = int(self.np_random.integers(2**31))
        obs, info = self.batch.reset(seed=stream, options=options)
        return obs[0], {"privileged": info["privileged"][0]}

    def step(
        self, action: ArrayLike
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold one command for a control period."""
        obs, reward, _, truncated, info = self.batch.step(np.asarray(action)[None])
        terms = {name: float(term[0]) for name, term in info["reward_terms"].items()}
        info = {"reward_terms": terms, "privileged": info["privileged"][0]}
        return obs[0], float(reward[0]), False, bool(truncated[0]), info


def _rotation(angle: float) -> Array:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine], [sine, cosine]])


def _observation_bounds(c: PegTouchConfig) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Largest values the limits and the horizon allow; generous, finite."""
    stiffness, amplitude = c.K_sur[1], 2.0 * float(np.hypot(*np.abs(c.surface)))
    force = stiffness * c.shift.K_sur * (max(map(abs, c.z_limits)) + c.shift.surface * amplitude)
    if c.interface == "raw":
        lowest = np.array([c.x_limits[0], -force, c.x_d[0], c.f_d[0]])
        highest = np.array([c.x_limits[1], 0.0, c.x_d[1], c.f_d[1]])
        return lowest.astype(np.float32), highest.astype(np.float32)
    reach = max(c.x_limits[1], c.x_d[1], c.x0[1]) - min(c.x_limits[0], c.x_d[0], c.x0[0])
    signal = np.array([reach, force + max(map(abs, c.f_d)) + stiffness * amplitude * reach])
    time = (c.horizon + 1) * c.h
    highest = 1.001 * np.stack([signal, time * signal], axis=-1).ravel()
    return -highest.astype(np.float32), highest.astype(np.float32)
