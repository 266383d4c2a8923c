"""Gymnasium environments; importing this package registers them."""

from gymnasium.envs.registration import register

register(
    id="cmc/PegTouch-v0",
    entry_point="cmc.envs.peg_touch:PegTouchEnv",
    vector_entry_point="cmc.envs.peg_touch:PegTouchVectorEnv",
)
