"""Exercise of lesson 10: the acceleration-based task-space torque."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from cmc.exercises import check, expect, expect_close
from cmc.robot.panda import JOINTS, READY, load_scene

Array = NDArray[np.float64]


@check("10-torque")
def torque(answer: Callable[[Array, Array, Array, Array, Array], Array]) -> None:
    """Judge `my_torque(M, J, h, drift, p)` by the tip acceleration that the simulator reports.

    The torque is applied to the Panda in random states; the site's acceleration must be p.
    """
    model = load_scene("panda.xml")
    model.dof_damping[:] = 0.0
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    site = model.site("tip_nominal").id
    body = int(model.site_bodyid[site])
    for _ in range(5):
        data.qpos[:JOINTS] = READY + 0.3 * rng.normal(size=JOINTS)
        data.qvel[:JOINTS] = rng.normal(size=JOINTS)
        mujoco.mj_forward(model, data)
        M, J, rate = (
            np.zeros((model.nv, model.nv)),
            np.zeros((6, model.nv)),
            np.zeros((6, model.nv)),
        )
        mujoco.mj_fullM(model, data, M)
        mujoco.mj_jacSite(model, data, J[:3], J[3:], site)
        mujoco.mj_jacDot(model, data, rate[:3], rate[3:], data.site_xpos[site], body)
        drift, h, p = rate @ data.qvel, data.qfrc_bias.copy(), rng.normal(size=6)
        tau = np.asarray(answer(M, J, h, drift, p), dtype=float)
        expect(tau.shape == (JOINTS,), f"the torque should have shape (7,), yours {tau.shape}")
        data.qfrc_applied[:JOINTS] = tau
        mujoco.mj_forward(model, data)
        found = J @ data.qacc + drift
        data.qfrc_applied[:] = 0.0
        expect_close(found, p, "the tip acceleration under your torque", atol=1e-7)
