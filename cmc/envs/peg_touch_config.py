"""Configuration of the peg-touch environment: every number, with its unit and its source."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

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
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0.0):
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
        for name, value in vars(self).items():
            if isinstance(value, tuple):
                ordered = name == "u0" or value[0] <= value[1]
                if len(value) != 2 or not np.isfinite(value).all() or not ordered:
                    raise ValueError(f"{name}: wanted a finite (low, high), got {value}")
        for name in ("tau_x", "tau_z", "h", "action_limit", "force_error_cap"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ValueError(f"{name}: wanted a positive number, got {getattr(self, name)}")
        if self.K_sur[0] <= 0.0:
            raise ValueError(f"K_sur: wanted positive stiffnesses, got {self.K_sur}")
        if self.stiffness_reference is not None and not self.stiffness_reference > 0.0:
            raise ValueError(
                f"stiffness_reference: wanted None or a positive number, "
                f"got {self.stiffness_reference}"
            )
        if self.horizon < 1:
            raise ValueError(f"horizon: wanted at least 1 step, got {self.horizon}")
        if self.interface not in INTERFACES:
            raise ValueError(f"interface: wanted one of {INTERFACES}, got {self.interface!r}")
