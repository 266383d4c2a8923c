"""Gymnasium environments; importing this package registers them."""

from gymnasium.envs.registration import register

register(
    id="cmc/PegTouch-v0",
    entry_point="cmc.envs.peg_touch:PegTouchEnv",
    vector_entry_point="cmc.envs.peg_touch:PegTouchVectorEnv",
)
register(
    id="cmc/PegMaze-v0",
    entry_point="cmc.envs.peg_maze:PegMazeEnv",
    vector_entry_point="cmc.envs.peg_maze:PegMazeVectorEnv",
)
register(
    id="cmc/PegMazeJoint-v0",
    entry_point="cmc.envs.peg_maze:PegMazeEnv",
    vector_entry_point="cmc.envs.peg_maze:PegMazeVectorEnv",
    kwargs={"regime": "joint"},
)
register(
    id="cmc/PegPush-v0",
    entry_point="cmc.envs.peg_push:PegPushEnv",
    vector_entry_point="cmc.envs.peg_push:PegPushVectorEnv",
)
register(
    id="cmc/Plant-v0",
    entry_point="cmc.envs.plant_env:PlantEnv",
    vector_entry_point="cmc.envs.plant_env:PlantVectorEnv",
)
