"""Former name of `cmc.robot.osc`."""

from cmc.robot.osc import MAZE_GAINS, PUSH_GAINS, ControlLaw, Form, Gains, TaskSpaceController

__all__ = ["MAZE_GAINS", "PUSH_GAINS", "ControlLaw", "Form", "Gains", "TaskSpaceController"]
