"""Recorder cost per frame against `mj_step`, and page size per moving body and frame."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator

import mujoco
import numpy as np

from cmc.robot.panda import load_scene
from cmc.view.playback import record

FRAMES = 1001  # 20 s at 50 Hz


def _cpu(task: Callable[[], object], repeats: int = 5) -> float:
    """Median CPU seconds of a task."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        task()
        times.append(time.process_time() - start)
    return statistics.median(times)


def run() -> Iterator[dict]:
    model = load_scene("peg_maze.xml")
    data = mujoco.MjData(model)
    qpos = data.qpos + 0.1 * np.sin(np.linspace(0, 20, FRAMES))[:, None] * np.ones(model.nq)
    times = 0.02 * np.arange(FRAMES)

    step = _cpu(lambda: [mujoco.mj_step(model, data) for _ in range(FRAMES)]) / FRAMES
    full = _cpu(lambda: record(model, qpos, times, trails=["tip"])) / FRAMES
    recording = record(model, qpos, times, trails=["tip"])
    page = _cpu(recording.html) / FRAMES
    yield {"name": "record, per frame against mj_step", "ratio": full / step, "us": 1e6 * full}
    yield {"name": "write the page, per frame against mj_step", "ratio": page / step}

    size = len(recording.html().encode())
    still = len(record(model, qpos[:1], times[:1]).html().encode())
    moving = len(recording.bodies)
    yield {
        "name": "page of a 20 s episode at 50 Hz against 3 MB",
        "ratio": size / 3e6,
        "bytes": size,
        "bytes_without_motion": still,
        "moving_bodies": moving,
        "bytes_per_body_and_frame": (size - still) / FRAMES / moving,
    }
