"""Lesson 09: its cells against the library, its sentences against the shipped results."""

import numpy as np
import pytest
import torch
from lesson import lesson

from cmc.learning.ppo import surrogate_gradient
from cmc.policies import PositiveNetwork
from cmc.results import tidy
from cmc.studies import peg_touch, runner
from cmc.studies.peg_touch_tests import detect
from cmc.theory.sampled import largest_slope

HERE = lesson("09")
POLICY = runner.load(peg_touch.STUDY, "cppo", 5000).policy


@pytest.fixture(scope="module")
def table():
    data = tidy("peg_touch")
    return data.assign(unstable=data.oscillation + data.drift)


def of(table, method, episode, test="nominal", h=0.01):
    rows = table[(table.method == method) & (table.test == test) & (table.h == h)]
    return rows[rows.episode == episode]


def test_the_surrogate_is_the_librarys():
    draw = torch.Generator().manual_seed(0)
    mean, action = torch.randn(2, 2, 30, 2, generator=draw)
    old, A = torch.randn(2, 2, 30, generator=draw)
    mean.requires_grad_()
    log_std = torch.full((2, 1, 2), -0.3, requires_grad=True)
    (-HERE["surrogate"](mean, log_std, action, old, A, 0.2).sum()).backward()
    by_mean, by_log_std, _ = surrogate_gradient(
        mean.detach(), log_std.detach(), action, old, A, 0.2
    )
    torch.testing.assert_close(mean.grad, by_mean)
    torch.testing.assert_close(log_std.grad, by_log_std)


def test_advantages_are_a_sum_of_decaying_errors():
    rng = np.random.default_rng(0)
    reward, value = (torch.as_tensor(x) for x in rng.normal(size=(2, 1, 6, 3)))
    last = torch.as_tensor(rng.normal(size=(1, 3)))
    found = HERE["advantages"](reward, value, last, 0.9, 0.8).numpy()
    after = np.concatenate([value[:, 1:], last[:, None]], 1)
    delta = reward.numpy() + 0.9 * after - value.numpy()
    for t in range(6):
        wanted = sum((0.9 * 0.8) ** (k - t) * delta[:, k] for k in range(t, 6))
        np.testing.assert_allclose(found[:, t], wanted)


def test_positive_weights_are_the_only_difference():
    free, positive = (HERE["Modular"]((0,), p) for p in (False, True))
    s = torch.randn(1, 200, 4).requires_grad_()
    slopes = {}
    for name, policy in (("free", free), ("positive", positive)):
        own = [torch.autograd.grad(-policy(s)[..., i].sum(), s)[0] for i in (0, 1)]
        slopes[name] = torch.cat([own[0][..., :2], own[1][..., 2:]], -1)
        cross = torch.cat([own[0][..., 2:], own[1][..., :2]], -1)
        assert (cross == 0).all()  # one network for each dimension
    assert (slopes["positive"] > 0).all()
    assert (slopes["free"] < 0).any()


def test_the_network_is_the_librarys():
    ours, theirs = HERE["Modular"]((0,), True, 8), PositiveNetwork(2, hidden=(8, 8), seeds=[0])
    with torch.no_grad():
        for target, source in zip(theirs.mlp.weights, ours.used(), strict=True):
            target.copy_(source.reshape(target.shape))
        for target, source in zip(theirs.mlp.biases, ours.biases, strict=True):
            target.copy_(source.reshape(target.shape))
        s = torch.randn(1, 5, 4)
        torch.testing.assert_close(ours(s), -theirs(s.unflatten(-1, (2, 2))))


def test_the_cap_holds_whatever_the_weights():
    policy = HERE["Capped"]((0, 1), True)
    with torch.no_grad():
        for weight in policy.weights:
            weight.mul_(3.0)
    s = (3.0 * torch.randn(2, 400, 4)).requires_grad_()
    limit = largest_slope(np.array([0.0437, 0.01]) / 2, np.array([1.0, 62.0]), 0.01)
    for i in (0, 1):
        slope = torch.autograd.grad(-policy(s)[..., i].sum(), s)[0][..., 2 * i :][..., :2].numpy()
        assert (slope[..., 0] + 0.005 * slope[..., 1]).max() < limit[i]


def test_the_detector_is_the_studys():
    tail, env = HERE["trial"](POLICY, 5, "all, fast")
    flat = tail.reshape(len(tail), -1, 2)
    wanted = detect(flat, env.config.h)["oscillation"]
    found = HERE["rattles"](tail).any(-1).ravel()
    assert (found == wanted).mean() > 0.99
    assert found.mean() > 0.5


def test_the_bound_predicts_who_rattles():
    for shift in ("nominal", "all, fast"):
        tail, env = HERE["trial"](POLICY, 5, shift)
        gain, bound = HERE["loop_gain"](POLICY, env, 5)
        right = (gain > bound).any(-1) == HERE["rattles"](tail).any(-1)
        assert right.mean() > 0.95


@pytest.mark.parametrize("h", [2.0, 30.0])
def test_the_slider_at_its_ends(h):
    out = HERE["press"](5000, h, "nominal", "force")
    assert (": 0% rattle" in out["cppo_title"]) == (h == 2.0)
    assert ": 0% rattle" in HERE["press"](4600, 10.0, "all, fast", "position")["cppo_capped_title"]


def test_two_updates_change_the_policy_and_report():
    seen = []
    policy = HERE["Modular"]((0, 1, 2), True)
    before = policy.weights[0].detach().clone()
    run = HERE["train"](policy, lambda *row: seen.append(row), updates=2)
    assert [row[0] for row in seen] == [16, 32]
    assert run["curve"].shape == (3, 2)
    assert not torch.equal(before, policy.weights[0])


def test_claim_of_similar_returns(table):
    for episode, ppo, cppo in ((5000, "-6.2", "-6.3"), (15000, "-6.0", "-6.2")):
        assert f"{of(table, 'ppo', episode)['return'].mean():.1f}" == ppo
        assert f"{of(table, 'cppo', episode)['return'].mean():.1f}" == cppo
    assert f"{of(table, 'ppo_raw', 15000)['return'].mean():.1f}" == "-11.0"


def test_claim_of_growing_shares(table):
    late = table[(table.test == "nominal") & (table.h == 0.01) & (table.episode >= 5000)]
    for episode in (5000, 15000):
        assert round(100 * of(table, "ppo", episode).unstable.mean(), 1) == 0.0
    assert round(100 * of(table, "ppo_raw", 5000).unstable.mean(), 1) == 0.2
    assert round(100 * of(table, "ppo_raw", 15000).unstable.mean(), 1) == 4.5
    cppo = late[late.method == "cppo"]
    assert cppo.drift.max() == 0.0
    (only,) = cppo.oscillation[cppo.oscillation > 0]
    assert round(100 * only, 1) == 7.6
    for h, share in ((0.002, 0), (0.005, 0), (0.02, 85)):
        assert round(100 * of(table, "cppo", 5000, h=h).oscillation.mean()) == share


def late_shares(study):
    """Percent that oscillates or drifts by method, episode and seed, from episode 5000 on."""
    late = tidy(study).query("test == 'nominal' and episode >= 5000")
    unstable = 100 * (late.oscillation + late.drift)
    return unstable.groupby([late.method, late.episode, late.seed]).sum()


def test_claims_at_two_milliseconds():
    share = late_shares("peg_touch_2ms")
    assert share["cppo"].max() == 0.0
    raw = share["ppo_raw"].unstack()
    assert (raw.index.min(), raw.index.max()) == (5000, 15_000)
    assert round(raw.max().max(), 1) == 5.1
    assert (round(raw.loc[5000].mean(), 2), round(raw.loc[15_000].mean(), 2)) == (0.37, 1.07)
    (only,) = (again := late_shares("peg_touch_2ms_10000")["cppo"])[again > 0]
    assert round(only, 1) == 0.6


def test_a_shorter_hold_does_not_cure_shifted_plants():
    early = tidy("peg_touch_2ms").query("method == 'cppo' and episode == 5000")
    share = (100 * early.groupby("test").oscillation.mean()).round()
    assert (share["lags x 0.5"], share["all, fast"]) == (40, 72)


def test_claims_at_five_milliseconds():
    share = late_shares("peg_touch_5ms")
    cppo = share["cppo"]
    assert sorted(cppo[cppo > 0].round(1)) == [0.1, pytest.approx(8.6, abs=0.06)]
    assert len(cppo) == 55
    raw = share["ppo_raw"].unstack()
    assert (round(raw.loc[5000].mean(), 2), round(raw.loc[15_000].mean(), 2)) == (0.22, 1.51)


def test_claim_of_generalization(table):
    shifts = set(table.test) - {"nominal"}
    for other, low, high in (("ppo", 0.27, 1.08), ("ppo_raw", 12, 2857)):
        ratios = [
            of(table, other, 5000, test).error_f.median()
            / of(table, "cppo", 5000, test).error_f.median()
            for test in shifts
        ]
        assert min(ratios) == pytest.approx(low, rel=0.25)
        assert max(ratios) == pytest.approx(high, rel=0.25)
    assert round(100 * of(table, "cppo", 5000, "lags x 0.5").unstable.mean()) == 86


def test_claim_of_contraction():
    found = tidy("peg_touch", "certificates")
    found = found[found.episode.isin([15000])]
    by = found.groupby("method").contracting.sum()
    assert (by["cppo"], by["cppo_bounded"]) == (0, 5)
    assert found[found.method == "cppo"].signs.all()


def test_the_hand_tuned_controller_has_the_best_return(table):
    last = table[(table.test == "nominal") & (table.h == 0.01) & table["last"]]
    assert last.groupby("method")["return"].mean().idxmax() == "pi"
