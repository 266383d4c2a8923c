"""Configuration of the peg-touch environment: every number, with its unit and its source."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cmc.envs.vector import set_counts, set_numbers
from cmc.theory.arrays import number

INTERFACES = ("auxiliary", "identity", "raw")


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
        positive = ["tau_x", "tau_z", "h", "action_limit", "force_error_cap"]
        ranges = ("K_sur", "surface", "x_limits", "z_limits", "x_d", "f_d", "x0", "z0")
        if self.stiffness_reference is not None:
            positive.append("stiffness_reference")
        set_numbers(self, "", positive, above=0.0)
        set_numbers(self, "", ("weight_x", "weight_f", "mount_angle"))
        set_numbers(self, "2", (*ranges, "u0"))
        for name in ranges:
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name}: wanted (low, high), got {(low, high)}")
        number("K_sur", self.K_sur[0], above=0.0)
        set_counts(self, ("horizon",))
        if not isinstance(self.shift, PegShift):
            raise ValueError(f"shift: wanted a PegShift, got {self.shift!r}")
        if self.interface not in INTERFACES:
            raise ValueError(f"interface: wanted one of {INTERFACES}, got {self.interface!r}")

    def observation_bounds(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
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
