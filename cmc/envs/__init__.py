"""Gymnasium environments; importing this package registers them."""

from typing import Any

from gymnasium.envs.registration import register

_ENVIRONMENTS: dict[str, tuple[str, dict[str, Any]]] = {
    "PegTouch": ("peg_touch:PegTouch", {}),
    "PegMaze": ("peg_maze:PegMaze", {}),
    "PegMazeJoint": ("peg_maze:PegMaze", {"regime": "joint"}),
    "PegPush": ("peg_push:PegPush", {}),
    "Plant": ("plant_env:Plant", {}),
}
for _name, (_place, _options) in _ENVIRONMENTS.items():
    register(
        id=f"cmc/{_name}-v0",
        entry_point=f"cmc.envs.{_place}Env",
        vector_entry_point=f"cmc.envs.{_place}VectorEnv",
        kwargs=_options,
    )
