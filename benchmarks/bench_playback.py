"""Recorder cost per frame against `mj_step`, and page size per moving body and frame."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from benchmarks import best
from cmc.robot.panda import load_scene
from cmc.view.playback import record

FRAMES = 1001  # 20 s at 50 Hz


def run() -> Iterator[dict]:
    model = load_scene("peg_maze.xml")
    data = mujoco.MjData(model)
    qpos = data.qpos + 0.1 * np.sin(np.linspace(0, 20, FRAMES))[:, None] * np.ones(model.nq)
    times = 0.02 * np.arange(FRAMES)
    recording = record(model, qpos, times, trails=["tip"])
    calls = {
        "step": lambda: mujoco.mj_step(model, data, FRAMES),
        "record": lambda: record(model, qpos, times, trails=["tip"]),
        "page": recording.html,
    }
    cost = best(calls, repeats=5)
    us = 1e6 * cost["record"] / FRAMES
    ratio = cost["record"] / cost["step"]
    yield {"name": "record, per frame against mj_step", "ratio": ratio, "us": us}
    ratio = cost["page"] / cost["step"]
    yield {"name": "write the page, per frame against mj_step", "ratio": ratio}

    size, moving = len(recording.html().encode()), len(recording.bodies)
    still = len(record(model, qpos[:1], times[:1]).html().encode())
    yield {
        "name": "page of a 20 s episode at 50 Hz against 3 MB",
        "ratio": size / 3e6,
        "bytes": size,
        "bytes_without_motion": still,
        "moving_bodies": moving,
        "bytes_per_body_and_frame": (size - still) / FRAMES / moving,
    }
