"""Lesson 11: its cells against the library, the training that it shows, its exercises."""

import numpy as np
import pytest
import torch
from lesson import lesson

from cmc.envs.peg_maze import SOFT, STIFF, PegMaze
from cmc.learning.hiro import log_likelihood
from cmc.learning.latent import LatentConfig, LatentModel, Rollouts
from cmc.learning.low_level import LowLevel, latent_policy, rollout
from cmc.learning.planning import CriticView, Planning
from cmc.learning.td3 import TD3, Batch, TD3Config
from cmc.policies import DirectPolicy, JointNetwork
from cmc.results import at, compare, tidy

HERE = lesson("11")
HERE |= {"STEPS": 480, "WARM_UP": 160, "TESTS": 2, "TEST_EVERY": 480}


@pytest.fixture
def low():
    return HERE["Low"](STIFF, start_gain=5.0)


def rollouts(config, price):
    """The library's rollouts of the lesson's model."""
    L = config.gains.latent
    mass, integrates = HERE["MASS"].double().numpy(), np.repeat([1.0, 0.0], 3)
    gains = (L.K_p, L.K_d, L.K1, L.K2, np.array(config.u_limit))
    model = LatentModel(*gains, mass, integrates, config.tick)
    return Rollouts(model, 20, LatentConfig(force_weight=price))


@pytest.mark.parametrize("price", [0.0, 0.7])
def test_the_rollout_is_the_librarys(low, price):
    draw = torch.Generator().manual_seed(0)
    e, v, push = (s * torch.randn(1, 16, 6, generator=draw) for s in (0.004, 0.01, 0.2))
    blocked = (torch.rand(1, 16, 6, generator=draw) < 0.3) & (HERE["MASS"] > 0)
    ours = HERE["cost"](low, STIFF, e, v, push, blocked, price)
    starts = torch.cat([e, v], -1)
    theirs = rollouts(STIFF, price).cost(latent_policy(low.net), starts, blocked, push)
    torch.testing.assert_close(ours, theirs[0], rtol=1e-4, atol=1e-6)


def test_the_low_level_is_odd_capped_and_starts_where_it_is_told():
    for config in (SOFT, STIFF):
        L = config.gains.latent
        cap = (1.0 / config.tick - L.K_d) / (L.K2 * config.u_limit)
        np.testing.assert_allclose(HERE["Low"](config).slopes(), 0.3, rtol=1e-5)
        low = HERE["Low"](config, start_gain=1e6)
        assert (low.slopes() <= 0.991 * cap).all()
        y = torch.randn(1, 9, 6)
        torch.testing.assert_close(low(-y, -y), -low(y, y))


def test_the_low_level_climbs_to_its_cap_alone():
    climb = HERE["learn_alone"](HERE["Low"](STIFF), STIFF, price=0.0, updates=12)
    L = STIFF.gains.latent
    cap = (1.0 / 0.02 - L.K_d[:3]) / L.K2[:3]
    assert (climb[0] < 0.05 * cap).all()
    assert (climb[-1] > 0.8 * cap).all()
    assert (climb[-1] <= cap).all()


def linear_of(net):
    return [m for m in net if isinstance(m, torch.nn.Linear)]


def agent_of(planner, **options):
    """The library's TD3 with the lesson's networks, and a batch from its memory."""
    config = TD3Config(discount=0.5, target_noise=0.0, **options)
    actor = DirectPolicy(
        JointNetwork(3, inputs=15, hidden=(128, 128), seeds=[0], last=1.0), squash=True
    )
    agent = TD3(actor, [0], 15, 3, config, view=lambda s, a: HERE["near"](s[0], a[0])[None])
    pairs = [(agent.actor, planner.actor), (agent.target_actor, planner.slow[0])]
    pairs = [(theirs.network.mlp, [ours]) for theirs, ours in pairs]
    pairs += [(agent.critics, planner.critics), (agent.target_critics, planner.slow[1])]
    with torch.no_grad():
        for theirs, nets in pairs:
            for c, net in enumerate(nets):
                for k, layer in enumerate(linear_of(net)):
                    theirs.weights[k][c].copy_(layer.weight.T)
                    theirs.biases[k][c].copy_(layer.bias[None])
    s, a, r, following = (torch.randn(128, n) for n in (15, 3, 1, 15))
    a = a.clamp(-1, 1)
    batch = Batch(
        s[None], a[None], r.T, following[None], torch.ones(1, 128), torch.zeros(1, 128, 0)
    )
    return agent, batch


def test_the_target_is_the_librarys():
    """The library's critic error is the distance of its critics from the lesson's target."""
    torch.manual_seed(0)
    planner = HERE["Planner"]()
    with torch.no_grad():
        for parameter in planner.slow.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    agent, batch = agent_of(planner)
    s, a = batch.observation[0], batch.action[0]
    with torch.no_grad():
        wanted = HERE["target"](
            batch.reward.T, batch.next_observation[0], *planner.slow, 0.5, noise=0.0
        )
        x = HERE["near"](s, a)
        error = sum((q(x) - wanted).square().mean() for q in planner.critics)
    found = agent.update(batch)
    np.testing.assert_allclose(found, float(error), rtol=1e-4)


def test_the_actor_step_is_the_librarys():
    torch.manual_seed(0)
    planner = HERE["Planner"]()
    agent, batch = agent_of(planner, actor_period=1, pull=0.003, critic_rate=1e-12)
    HERE["actor_loss"](batch.observation[0], planner.actor, planner.critics[0]).backward()
    agent.update(batch)
    weights = agent.actor.network.mlp.weights
    for ours, theirs in zip(linear_of(planner.actor), weights, strict=True):
        torch.testing.assert_close(theirs.grad[0], ours.weight.grad.T, rtol=1e-3, atol=1e-6)


def test_what_the_critics_see_is_the_librarys():
    task, center, half = PegMaze(SOFT, num=4, seed=0), HERE["CENTER"], HERE["HALF"]
    scale = {"position": 1 / half, "goal": 1 / half, "velocity": np.repeat([20.0, 1.0], 3)}
    planning = Planning({"position": center, "goal": center}, scale, center - half, center + half)
    obs = task.reset()
    s, a = HERE["see"](task, obs), torch.rand(4, 3) * 2 - 1
    np.testing.assert_allclose(s, planning.observe(task, obs), atol=1e-5)
    np.testing.assert_allclose(center + half * a.numpy(), planning.subgoal(a.numpy()), atol=1e-9)
    ours, theirs = HERE["near"](s, a), CriticView(task, planning)(s, a)
    assert ours.shape == theirs.shape
    for row in range(4):  # the same numbers, in another order
        np.testing.assert_allclose(
            np.sort(ours[row].numpy()), np.sort(theirs[row].numpy()), atol=1e-4
        )


def test_a_segment_is_the_librarys(low):
    rewards = []
    for library in (False, True):
        task = PegMaze(STIFF, num=3, seed=5)
        task.reset()
        obs = task.set_subgoal(np.tile([0.42, -0.028, 0.008], (3, 1)))
        if library:
            policy = LowLevel(latent_policy(low.net))
            rewards.append(rollout(task, policy, obs, (1, 3), explore=False)[1][0])
        else:
            rewards.append(HERE["pursue"](task, obs, low)[1]["reward"].mean(0))
    np.testing.assert_allclose(*rewards, rtol=1e-6)


def test_likelihood_is_the_librarys():
    states, speeds, actions, goal = HERE["lived"](HERE["Pull"](0), 0.1)
    goals = HERE["candidates"](states, goal)
    assert torch.equal(goals[0], goal)
    assert goals.shape == (10, 7)
    today = HERE["between"](0.6)
    ours = HERE["likelihood"](today, states, speeds, actions, goals)

    def actor(seen):
        return today(*seen.split(7, dim=-1))

    parts = (states[:-1], speeds, actions, goals)
    reach = torch.full((7,), -1e9), torch.full((7,), 1e9)
    theirs = log_likelihood(actor, *(part[None, None] for part in parts), reach)[0, 0]
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


def test_a_low_level_that_did_not_change_keeps_its_sub_goal():
    assert HERE["relabel"](3, 0.0, 0.1, 2)["picked"] == 0
    assert HERE["relabel"](3, 1.0, 0.1, 2)["picked"] != 0


def test_the_slider_shows_chatter_in_the_command():
    wild = HERE["gain_step"](50.0, "x", "stiff")["u"][-6:]
    assert (wild[1:] * wild[:-1] < 0).all()
    calm = HERE["gain_step"](13.0, "y", "stiff")
    assert "(K_d + g K2) h = 0.99" in calm["title"]
    np.testing.assert_allclose(calm["arm"], calm["model"], atol=0.3)


@pytest.mark.parametrize(
    "change",
    [{}, {"learn": False}, {"discount": 0.9}, {"reward": lambda log: log["success"] - 1.0}],
)
def test_a_short_training_runs(change):
    seen = []
    run = HERE["train"](lambda *row: seen.append(row), **change)
    assert run["curve"][-1][0] == 480
    assert [row[0] for row in seen] == [480]
    moved = run["low"].slopes()[0] != pytest.approx(0.3, rel=1e-3)
    assert moved == change.get("learn", True)
    played = HERE["play"](run["planner"], run["low"])
    assert played["qpos"].shape[:2] == (400, 1)
    assert played["success"].shape == (400, 1)


def test_training_without_a_low_level_runs():
    run = HERE["train"](lambda *row: None, low=HERE["by_hand"](0.0), learn=False)
    assert len(run["curve"]) == 2


# ---- sentences about shipped results


@pytest.fixture(scope="module")
def table():
    return at(tidy("peg_maze").query("test == 'nominal'"))


def by(table, method, key="success"):
    return table[table.method == method][key]


def test_learning_pays_from_an_untuned_start(table):
    assert round(100 * by(table, "ctd3").mean()) == 99
    assert round(100 * by(table, "ctd3").min()) == 96
    assert round(100 * by(table, "frozen").mean()) == 59
    assert (100 * by(table, "frozen").min(), 100 * by(table, "frozen").max()) == (1, 99)
    assert by(table, "ctd3", "return").min() > by(table, "frozen", "return").max()
    named = [("ctd3", "frozen", "success")]
    named += [("ctd3", other, "return") for other in ("frozen", "gain")]
    found = compare(table, named)
    assert found.p_holm.round(3).tolist()[:2] == [0.111, 0.024]
    assert [round(found.iloc[2][key], 2) for key in ("difference", "low", "high")] == [
        0,
        -0.05,
        0.05,
    ]
    assert round(100 * by(table, "gain").mean()) == 99


def test_little_is_left_to_learn_from_a_slope_set_by_hand(table):
    assert by(table, "ctd3_tuned").min() == by(table, "frozen_tuned").min() == 1.0


def test_a_critic_is_a_poor_teacher_at_this_length(table):
    names = ("td3_corrected", "td3", "ctd3_positive", "ctd3_paper", "control")
    assert [round(100 * by(table, name).mean()) for name in names] == [20, 10, 2, 0, 21]
    assert all((by(table, name) > 0.5).sum() == 1 for name in ("td3_corrected", "control"))
    ours = table[~table.method.str.startswith("hiro")]
    assert ours.step.unique().tolist() == [140_000]


def test_in_the_stiff_regime_a_corrected_critic_teaches_well():
    last = at(tidy("peg_maze_stiff"))
    assert last.success.min() == 1.0
    early = at(tidy("peg_maze_stiff"), 40_000).groupby("method").success.mean()
    assert early["td3_corrected"] == 1.0 > 0.5 > early["ctd3"]
    returns = last.groupby("method")["return"].mean().round(2)
    assert (returns["td3_corrected"], returns["ctd3"]) == (-0.68, -0.87)
    assert round(compare(last, [("ctd3", "td3_corrected", "return")]).p.iloc[0], 3) == 0.016


def test_hiro_is_compared_with_a_rigid_peg(table):
    shares = {}
    for study in ("peg_maze", "peg_maze_stiff"):
        rows = tidy(study).query("test == 'nominal'")
        shares[study] = 100 * rows.groupby("method").below_1_N_50hz.mean()
    assert round(shares["peg_maze_stiff"]["ctd3"], 1) == 72.7
    rigid = at(tidy("peg_maze_stiff")).query("method == 'ctd3'")
    assert rigid.success.min() == 1.0
    ends = [100 * part.below_1_N_50hz.mean() for part in (rigid, table[table.method == "hiro"])]
    assert [round(share, 1) for share in ends] == [95.5, 92.7]
    assert round(shares["peg_maze"]["hiro"], 1) == 90.9
    assert shares["peg_maze"]["ctd3"] > 99.95
    hiro = table[table.method == "hiro"]
    assert round(100 * hiro.success.mean()) == 16
    assert (hiro.seed.nunique(), hiro.step.max()) == (3, 500_000)
    assert round(100 * by(table, "hiro_matched").mean()) == 34


def test_the_cap_costs_a_few_percent():
    """Cost of a 5 mm step at the cap, above the least over all gains."""
    L, slopes = SOFT.gains.latent, np.linspace(0, 60, 61)
    cap = (1.0 / 0.02 - L.K_d[0]) / L.K2[0]
    for config in (SOFT, STIFF):
        g = torch.tensor(slopes / config.u_limit[0], dtype=torch.float32)[None, :, None]
        step = 0.005 * torch.ones(1, 61, 6)
        path = HERE["unroll"](HERE["by_hand"](g), config, step, 0 * step)
        cost = torch.stack([e[0, :, 0].abs() for _, e in path]).mean(0).numpy()
        assert 0 <= np.interp(cap, slopes, cost) / cost.min() - 1 < 0.08
