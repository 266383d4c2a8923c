"""What is observed of a peg task's worlds: fields, their layout, and the numbers of a tick."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc.robot.compiled import compiled, view
from cmc.robot.panda import JOINTS

Array = NDArray[np.float64]

#: What a task keeps of each world: the goal, m, seconds until the next sub-goal, ticks so far.
STATE = np.dtype([("goal", float, 3), ("left", float), ("ticks", int)])
#: What all worlds of a task share: kind of command, sliders and their first joint, the tick, s, the
#: length of an episode, and what counts as success (see `PandaTask`).
FIXED = np.dtype(
    [("joint", bool), ("sliders", int), ("first", int), ("tick", float), ("ticks", int)]
    + [("near", float), ("box", float, 3)]
)


def observation_layout(joint: bool, sliders: int) -> dict[str, slice]:
    """Field of the observation to its slice of the last axis, in order."""
    fields = {"position": 3, "rotation": 3, "velocity": 6, "goal": 3}
    if sliders:
        fields |= {"sliders": sliders, "slider_velocity": sliders}
    if joint:
        fields |= {"joints": JOINTS, "joint_velocity": JOINTS, "joint_error": JOINTS}
    else:
        fields |= {"error": 6, "latent": 6, "integral": 6}
    fields["time_to_go"] = 1
    ends = np.cumsum(list(fields.values())).tolist()
    return {name: slice(end - fields[name], end) for name, end in zip(fields, ends, strict=True)}


@compiled
def _length(vector: Array) -> Any:
    return np.sqrt((vector * vector).sum())


@compiled
def measure(
    rows: NDArray[Any],
    state: NDArray[Any],
    fixed: NDArray[Any],
    passed: int,
    obs: Array,
    numbers: Array,
    flags: NDArray[np.bool_],
) -> None:
    """Write observations (N, size), numbers (7, N) and flags (3, N), `passed` ticks later.

    Numbers: distance to the goal, m; tilt, rad; contact force, and the largest of the tick, N;
    deepest penetration, m; minus the distances to the sub-goal, m (or rad, of joints), and rad.
    Flags: terminated (never), truncated (the time is up), success.
    """
    c, n = fixed[0], fixed[0].sliders
    for k in range(len(rows)):
        w, s, o = rows[k], state[k], obs[k]
        s.left -= passed * c.tick
        s.ticks += passed
        o[0:3], o[3:6], o[6:12], o[12:15] = w.tip, w.rotation, w.tip_velocity, s.goal
        o[15 : 15 + n] = view(w.qpos, c.first + n)[c.first :]
        o[15 + n : 15 + 2 * n] = view(w.qvel, c.first + n)[c.first :]
        part, o[-1] = o[15 + 2 * n : -1], s.left
        if c.joint:
            missed = w.target_joints - view(w.qpos, JOINTS)
            part[:7], part[7:14], part[14:] = view(w.qpos, 7), view(w.qvel, 7), missed
        else:
            missed = w.target - w.tip
            part[:6], part[6:12], part[12:] = w.signals[:6], w.latent, w.integral
        away = s.goal - w.tip
        numbers[0, k], numbers[1, k] = _length(away), _length(w.rotation)
        numbers[2, k], numbers[3, k], numbers[4, k] = _length(w.force), w.peaks[0], w.peaks[1]
        numbers[5, k], numbers[6, k] = -_length(missed), -_length(w.signals[3:6])
        flags[0, k], flags[1, k] = False, s.ticks >= c.ticks
        flags[2, k] = numbers[0, k] < c.near and (np.abs(away) < c.box).all()
