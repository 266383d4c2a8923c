"""Configuration of the peg-touch environment: every number, with its unit and its source."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cmc.envs.checks import set_numbers, whole

INTERFACES = ("auxiliary", "identity", "raw")


@dataclass(frozen=True)
class PegShift:
    """Factors between the model the controller believes in and the plant that answers it."""

    tau_x: float = 1.0
    """Factor on the lag of x [-]. The paper's generalisation test: 0.5 and 1.5 (fig:1 c)."""
    tau_z: float = 1.0
    """Factor on the lag of z [-]. Paper: 0.5 and 1.5."""
    K_sur: float = 1.0
    """Factor on the stiffness of the surface [-]. Paper: 100 %, so 2."""
    surface: float = 1.0
    """Factor on both surface coefficients [-]. Paper: 0.5 and 1.5."""

    def __post_init__(self) -> None:
        set_numbers(self, dict.fromkeys(("tau_x", "tau_z", "K_sur", "surface"), 0))
        for name, value in vars(self).items():
            if value <= 0.0:
                raise ValueError(f"shift {name}: wanted a positive factor, got {value}")


@dataclass(frozen=True)
class PegTouchConfig:
    """Every number of the task. Defaults are the training set."""

    tau_x: float = 0.0437
    """Lag of the horizontal axis [s]. Paper, appendix F."""
    tau_z: float = 0.01
    """Lag of the vertical axis [s]. Paper, appendix F."""
    K_sur: tuple[float, float] = (1.0, 31.0)
    """Range of the surface stiffness [N/m]. Paper, appendix F."""
    surface: tuple[float, float] = (-0.01, 0.01)
    """Range of both coefficients of the surface profile [m]. Paper, appendix F."""
    x_limits: tuple[float, float] = (1.0, 3.0)
    """Range of x, and of its command [m]. Paper for x; our choice for the command."""
    z_limits: tuple[float, float] = (-3.0, 1.0)
    """Range of z, and of its command [m]. Paper for z; our choice for the command."""
    x_d: tuple[float, float] = (1.0, 3.0)
    """Range of the desired position [m]. Our choice (the paper samples it, without a range)."""
    f_d: tuple[float, float] = (-2.5, -0.5)
    """Range of the desired force [N]; negative, because f <= 0 in contact. Our choice."""
    x0: tuple[float, float] = (1.0, 3.0)
    """Range of the first position [m]. Our choice."""
    z0: tuple[float, float] = (0.0, 1.0)
    """Range of the first height [m]: the peg starts above the surface. Our choice."""
    u0: tuple[float, float] = (2.0, -0.5)
    """Command to which the policy's output is added [m]. Our choice."""
    h: float = 0.01
    """Control period, with a zero-order hold on the command [s]. Our choice."""
    horizon: int = 50
    """Steps in an episode. Our choice."""
    weight_x: float = 0.5
    """Weight of the position error in the reward [1/m]. Our choice."""
    weight_f: float = 0.5
    """Weight of the force error in the reward [1/N]. Our choice."""
    force_error_cap: float = 5.0
    """Force error beyond which the reward falls no further [N]. Our choice."""
    action_limit: float = 3.0
    """Bound of the declared action space [m]; the command itself saturates earlier. Our choice."""
    mount_angle: float = 0.0
    """Angle between the command axes and the plant's axes [rad]. Our extension: at 0 it is the
    paper's plant; elsewhere every entry of f_u is non-zero and T_a is the rotation back."""
    stiffness_reference: float | None = None
    """If given, a_2 is multiplied by this over the nominal stiffness [N/m]: R_22 is then the same
    on every surface and a slope is a loop gain. Our extension; None is the paper's setting."""
    interface: str = "auxiliary"
    """What the policy sees and commands: one of `INTERFACES` (see `PegTouchVectorEnv`)."""
    shift: PegShift = field(default_factory=PegShift)
    """True parameters over nominal ones; T_y and T_a keep the nominal ones. Paper, fig:1 c."""

    def __post_init__(self) -> None:
        positive: tuple[str, ...] = ("tau_x", "tau_z", "h", "action_limit", "force_error_cap")
        ranges = ("K_sur", "surface", "x_limits", "z_limits", "x_d", "f_d", "x0", "z0")
        more = ("weight_x", "weight_f", "mount_angle")
        set_numbers(self, dict.fromkeys((*ranges, "u0"), 2) | dict.fromkeys((*positive, *more), 0))
        if self.stiffness_reference is not None:
            set_numbers(self, {"stiffness_reference": 0})
            positive = (*positive, "stiffness_reference")
        for name in positive:
            if getattr(self, name) <= 0.0:
                raise ValueError(f"{name}: wanted a positive number, got {getattr(self, name)}")
        for name in ranges:
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name}: wanted (low, high), got {(low, high)}")
        if self.K_sur[0] <= 0.0:
            raise ValueError(f"K_sur: wanted positive stiffnesses, got {self.K_sur}")
        object.__setattr__(self, "horizon", whole("horizon", self.horizon))
        if not isinstance(self.shift, PegShift):
            raise ValueError(f"shift: wanted a PegShift, got {self.shift!r}")
        if self.interface not in INTERFACES:
            raise ValueError(f"interface: wanted one of {INTERFACES}, got {self.interface!r}")

    def observation_bounds(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Largest observations (4,) the limits and the horizon allow; generous, finite."""
        c = self
        stiffness, amplitude = c.K_sur[1], 2.0 * float(np.hypot(*np.abs(c.surface)))
        force = (
            stiffness * c.shift.K_sur * (max(map(abs, c.z_limits)) + c.shift.surface * amplitude)
        )
        if c.interface == "raw":
            lowest = np.array([c.x_limits[0], -force, c.x_d[0], c.f_d[0]])
            highest = np.array([c.x_limits[1], 0.0, c.x_d[1], c.f_d[1]])
            return lowest.astype(np.float32), highest.astype(np.float32)
        reach = max(c.x_limits[1], c.x_d[1], c.x0[1]) - min(c.x_limits[0], c.x_d[0], c.x0[0])
        signal = np.array([reach, force + max(map(abs, c.f_d)) + stiffness * amplitude * reach])
        time = (c.horizon + 1) * c.h
        highest = 1.001 * np.stack([signal, time * signal], axis=-1).ravel()
        return -highest.astype(np.float32), highest.astype(np.float32)
