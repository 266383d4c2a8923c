"""Two-level studies made small enough to train in seconds."""

from __future__ import annotations

from dataclasses import replace

from cmc.learning.hierarchy import HierarchyConfig
from cmc.studies.study import Study

SMALL = HierarchyConfig(worlds=2, samples=80, high_updates=4, low_updates=4, warm_up=80)


def small(study: Study) -> Study:
    """Few worlds, short episodes, narrow networks; policies are kept every 120 steps."""
    c = study.config
    config = replace(
        c,
        hierarchy=replace(SMALL, reward_scale=c.hierarchy.reward_scale),
        planner=replace(c.planner, critic_hidden=(16,), batch=16),
        low=replace(c.low, critic_hidden=(16,), batch=16, critic_head_start=0),
        task=replace(c.task, ticks=60),
        joint_task=c.joint_task and replace(c.joint_task, ticks=60),
        joint_hidden=(8,),
        latent=replace(c.latent, batch=8),
        ppo=replace(c.ppo, critic_hidden=(8,), epochs=2, minibatches=2),
        planner_hidden=(16,),
        low_hidden=(8,),
    )
    return replace(study, config=config, every=120)
