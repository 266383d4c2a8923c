"""Policies: signs and bounds of slopes, closed-form Jacobians, batching of seeds, checkpoints."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cmc.policies import (
    ConvexGradientNetwork,
    DirectPolicy,
    IndependentNetwork,
    JointNetwork,
    LinearNetwork,
    ModularPolicy,
    NegativeWeightError,
    PositiveNetwork,
    StackedMLP,
    as_numpy,
)
from cmc.policies.latent_signal import Trial

f64 = torch.float64
APART = {"z": slice(0, 2), "integral": slice(2, 4)}
NET = PositiveNetwork(2)


def shake(network, scale=1.0, seed=0):
    """Give every parameter a random value of either sign: any weights must keep the promises."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(scale * torch.randn(parameter.shape, generator=generator, dtype=f64))
    return network


def signals(*shape, scale=2.0, seed=1):
    return scale * torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=f64)


def autograd_slopes(network, s):
    """d pi_i / d s_kj by autograd, (batch, n, n, 2), for s (batch, n, 2)."""
    full = torch.autograd.functional.jacobian(network, s)  # (B, n, B, n, 2)
    return torch.stack([full[b, :, b] for b in range(s.shape[0])])


@pytest.mark.parametrize("hidden", [(8,), (8, 6), (7, 6, 5)])
@pytest.mark.parametrize("bias", [True, False])
def test_positive_jacobian_equals_autograd(hidden, bias):
    cap = {"slope_min": [0.1, 0.2], "slope_max": [1.5, 0.9], "joint_cap": ([1.0, 0.5], [1.2, 0.7])}
    for options in ({}, cap):
        network = PositiveNetwork(2, hidden=hidden, bias=bias, dtype=f64, **options)
        s = signals(9, 2, 2)
        full = autograd_slopes(shake(network), s)
        slope = network.jacobian(s)
        torch.testing.assert_close(torch.einsum("biij->bij", full), slope)
        assert full[:, [0, 1], [1, 0]].abs().max() == 0  # one network per dimension


def test_unconstrained_jacobian_equals_autograd_and_has_both_signs():
    s = signals(20, 3, 2)
    for kind in (IndependentNetwork, JointNetwork):
        network = shake(kind(3, hidden=(8, 8), dtype=f64))
        slope = network.jacobian(s)
        torch.testing.assert_close(torch.einsum("biij->bij", autograd_slopes(network, s)), slope)
        assert slope.min() < 0 < slope.max()


@pytest.mark.parametrize("seed", range(4))
def test_slopes_lie_in_the_promised_interval(seed):
    low, high = np.array([[0.3, 0.1], [0.0, 0.2]]), np.array([[0.9, 0.4], [0.2, 3.0]])
    network = PositiveNetwork(2, slope_min=low, slope_max=high, dtype=f64)
    slope = shake(network, 3.0, seed).jacobian(signals(4000, 2, 2, scale=3.0, seed=seed)).detach()
    lower, upper = network.slope_bounds()
    assert np.array_equal(lower, low)
    assert (upper <= high * (1 + 1e-12)).all()
    assert (slope >= torch.as_tensor(lower)).all()
    assert (slope <= torch.as_tensor(upper) * (1 + 1e-12)).all()


@pytest.mark.parametrize("seed", range(4))
def test_joint_cap_holds_and_is_reached_without_biases(seed):
    weight, limit = np.array([1.0, 0.005]), np.array([0.5, 0.02])
    options = {"joint_cap": (weight, limit), "slope_min": 1e-3, "dtype": f64}
    network = shake(PositiveNetwork(2, **options), 2.0, seed)
    s = signals(4000, 2, 2, seed=seed)
    assert (network.jacobian(s).detach().numpy() @ weight <= limit * (1 + 1e-9)).all()
    odd = shake(PositiveNetwork(2, bias=False, **options), 2.0, seed)
    at_zero = odd.jacobian(torch.zeros(1, 2, 2, dtype=f64)).detach().numpy()
    np.testing.assert_allclose(at_zero[0] @ weight, limit, rtol=1e-9)


def test_plain_network_has_positive_slopes_a_tight_bound_and_is_odd_without_biases():
    network = shake(PositiveNetwork(2, hidden=(8, 8), dtype=f64), 0.3)
    assert (network.jacobian(signals(500, 2, 2)) > 0).all()
    odd = PositiveNetwork(2, bias=False, dtype=f64)
    lower, upper = odd.slope_bounds()
    at_zero = odd.jacobian(torch.zeros(2, 2, dtype=f64)).detach().numpy()
    np.testing.assert_allclose(at_zero, upper)
    assert (lower == 0).all()
    odd = PositiveNetwork(2, bias=False, slope_min=0.25, dtype=f64)
    s = signals(50, 2, 2)
    torch.testing.assert_close(odd(-s), -odd(s))
    far = 1e4 * torch.ones(1, 2, 2, dtype=f64)  # the bypass cures saturation
    torch.testing.assert_close(odd.jacobian(far), torch.full((1, 2, 2), 0.25, dtype=f64))


@pytest.mark.parametrize("kind", [PositiveNetwork, IndependentNetwork, JointNetwork])
def test_a_seed_does_not_depend_on_its_company(kind):
    s = signals(3, 11, 2, 2)
    batch = kind(2, seeds=[4, 7, 9], dtype=f64)
    for position, seed in enumerate([4, 7, 9]):
        alone = kind(2, seeds=[seed], dtype=f64)
        torch.testing.assert_close(alone(s[position : position + 1])[0], batch(s)[position])
    permuted = kind(2, seeds=[9, 4, 7], dtype=f64)
    torch.testing.assert_close(permuted(s[[2, 0, 1]]), batch(s)[[2, 0, 1]])
    same = batch(s[:1].expand(3, 11, 2, 2))
    assert not torch.allclose(same[0], same[1])


@pytest.mark.parametrize(
    "kind", [PositiveNetwork, IndependentNetwork, JointNetwork, ConvexGradientNetwork]
)
def test_batch_axes_are_free(kind):
    network = kind(3)
    s = signals(4, 5, 3, 2).float()
    torch.testing.assert_close(network(s)[2, 3], network(s[2, 3]))
    seeded = kind(3, seeds=[1, 2])
    assert seeded(s[:2]).shape == (2, 5, 3)
    torch.testing.assert_close(seeded(s[:2])[:, 4], seeded(s[:2, 4:5])[:, 0])
    with pytest.raises(ValueError, match="seeds|flat inputs"):
        seeded(s)
    with pytest.raises(ValueError, match="s needs"):
        network(signals(4, 2, 2).float())


def test_convex_gradient_is_monotone_with_a_symmetric_jacobian():
    network = shake(ConvexGradientNetwork(3, hidden=16, seeds=[0, 1], dtype=f64))
    s = signals(2, 7, 3, 2)
    slope = network.jacobian(s)
    alone = ConvexGradientNetwork(3, hidden=16, dtype=f64)
    with torch.no_grad():
        alone.W.copy_(network.W[:2]), alone.a.copy_(network.a[:2]), alone.b.copy_(network.b[:2])
    torch.testing.assert_close(autograd_slopes(alone, s[0]), slope[0])
    torch.testing.assert_close(slope, slope.transpose(2, 3))
    for term in (0, 1):
        assert torch.linalg.eigvalsh(slope[..., term]).min() > 0
    t = signals(2, 7, 3, 2, seed=5)
    same_integral = torch.stack([t[..., 0], s[..., 1]], -1)
    assert (((network(s) - network(same_integral)) * (s - same_integral)[..., 0]).sum(-1) > 0).all()
    lower, upper = network.slope_bounds()
    diagonal = torch.einsum("sbiij->sbij", slope).detach().numpy()
    assert (diagonal >= lower[:, None]).all()
    assert (diagonal <= upper[:, None] + 1e-12).all()


def test_command_has_the_sign_that_R_asks_for():
    policy = ModularPolicy(PositiveNetwork(2, dtype=f64), u0=[2.0, -0.5])
    s, R = signals(30, 2, 2), signals(30, 2, seed=3)
    T_a = torch.linalg.qr(signals(30, 2, 2, seed=4))[0]

    def auxiliary(s):
        return torch.linalg.solve(T_a, policy.command(s, R, T_a) - policy.u0)

    slope = torch.autograd.functional.jacobian(lambda s: auxiliary(s).sum(0), s)
    for i in range(2):
        for j in range(2):
            assert (slope[i, :, i, j] * R[:, i] < 0).all()  # constraint_sign
    torch.testing.assert_close(policy.command(s, R), policy.command(s, R, torch.eye(2, dtype=f64)))


def test_variants_of_the_command():
    s, R, other = signals(30, 2, 2), signals(30, 2, seed=3), signals(30, 2, 2, seed=9)
    network = PositiveNetwork(2, dtype=f64)
    policy = ModularPolicy(network, normalise=True)  # slopes are loop gains
    torch.testing.assert_close(R * policy.command(s, R), -network(s))
    policy = ModularPolicy(network, integral=False)
    other[..., 0] = s[..., 0]
    torch.testing.assert_close(policy(other.flatten(1)), policy(s.flatten(1)))
    assert (policy.jacobian(s)[..., 1] == 0).all()
    assert (policy.jacobian(s)[..., 0] > 0).all()
    assert (policy.slope_bounds()[1][..., 1] == 0).all()


def test_observation_layout():
    layout = {"s": slice(1, 5), "R": slice(5, 7), "T_a": slice(7, 11)}
    policy = ModularPolicy(PositiveNetwork(2, seeds=[0, 1], dtype=f64), layout=layout, u0=1.0)
    observation = signals(2, 6, 12)
    s, T_a = (observation[..., layout[name]].reshape(2, 6, 2, 2) for name in ("s", "T_a"))
    expected = policy.command(s, observation[..., 5:7], T_a)
    torch.testing.assert_close(policy(observation), expected)
    np.testing.assert_allclose(as_numpy(policy)(observation.numpy()), expected.detach().numpy())
    observation[0, 0, 0] = torch.nan
    with pytest.raises(ValueError, match="finite"):
        as_numpy(policy)(observation.numpy())
    with pytest.raises(ValueError, match="layout"):
        ModularPolicy(PositiveNetwork(2), layout={"R": slice(4)})
    with pytest.raises(ValueError, match="without zeros"):
        ModularPolicy(PositiveNetwork(2), R=[1.0, 0.0])
    constant = ModularPolicy(PositiveNetwork(2, dtype=f64), R=[2.0, -3.0])
    plain = observation[1, :, :4]
    R = torch.tensor([2.0, -3.0], dtype=f64)
    torch.testing.assert_close(constant(plain), constant.command(plain.reshape(6, 2, 2), R))
    direct = DirectPolicy(JointNetwork(2, inputs=4, dtype=f64), part=slice(0, 4), u0=[1.0, 2.0])
    assert direct(signals(3, 12)).shape == (3, 2)
    with pytest.raises(ValueError, match="flat inputs"):
        direct(signals(3, 2))


def test_signals_and_integrals_may_stand_apart_and_commands_may_be_bounded():
    network, s = PositiveNetwork(2, seeds=[0, 1], dtype=f64), signals(2, 6, 2, 2)
    policy = ModularPolicy(network, layout=APART, R=[-1.0, 1.0], squash=True)
    found = policy(torch.cat([s[..., 0], s[..., 1]], -1))
    sign = torch.tensor([1.0, -1.0], dtype=f64)
    torch.testing.assert_close(found, sign * torch.tanh(network(s)))
    direct = DirectPolicy(JointNetwork(2, inputs=4, dtype=f64), squash=True)
    flat = s.flatten(-2)
    torch.testing.assert_close(direct(flat), torch.tanh(direct.unsquashed(flat)))


def test_fixed_gains():
    gains = np.array([[2.0, 40.0], [0.5, 8.0]])
    network = LinearNetwork(gains, seeds=[0, 1])
    s = signals(2, 5, 2, 2).float()
    expected = (s * torch.tensor(gains, dtype=torch.float32)).sum(-1)
    torch.testing.assert_close(ModularPolicy(network)(s.flatten(-2)), -expected)
    np.testing.assert_allclose(as_numpy(ModularPolicy(network))(s.flatten(-2).numpy()), -expected)
    assert [bound.shape for bound in network.slope_bounds()] == [(2, 2, 2)] * 2
    assert not network.state_dict()
    with pytest.raises(ValueError, match="gains"):
        LinearNetwork([1.0, 2.0])


def test_state_dict_round_trip_and_refusal():
    network = shake(PositiveNetwork(2, seeds=[0, 1], slope_max=2.0, dtype=f64))
    state = network.state_dict()
    assert all((value >= 0).all() for name, value in state.items() if "weights" in name)
    other = PositiveNetwork(2, seeds=[5, 6], slope_max=2.0, dtype=f64)
    s = signals(2, 9, 2, 2)
    assert not torch.allclose(other(s), network(s))
    other.load_state_dict(state)
    assert torch.equal(other(s), network(s))
    policy = ModularPolicy(other)
    wrong = policy.state_dict()
    wrong["network.mlp.weights.1"][0, 1, 2] = -0.5
    with pytest.raises(NegativeWeightError, match=r"network\.mlp\.weights\.1.*-0\.5"):
        policy.load_state_dict(wrong)
    wrong["network.mlp.weights.1"][0, 1, 2] = torch.nan
    with pytest.raises(NegativeWeightError):
        policy.load_state_dict(wrong)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"slope_min": -0.1}, "slope_min"),
        ({"slope_min": 0.5, "slope_max": 0.5}, "above slope_min"),
        ({"slope_max": np.nan}, "slope_max"),
        ({"slope_max": [1.0, 2.0, 3.0]}, "shape"),
        ({"slope_min": 0.5, "joint_cap": ([1.0, 1.0], 0.9)}, "no room"),
        ({"joint_cap": ([0.0, 0.0], 1.0)}, "no room"),
        ({"seeds": []}, "seeds needs"),
        ({"seeds": [-1]}, "seeds needs"),
        ({"seeds": "0"}, "seeds needs"),
        ({"hidden": (0,)}, "hidden"),
        ({"joint_cap": 1.0}, "joint_cap needs a pair"),
        ({"bias": "no"}, "bias needs"),
    ],
)
def test_bad_options(options, match):
    with pytest.raises(ValueError, match=match):
        PositiveNetwork(2, **options)


@pytest.mark.parametrize("bad", [None, "x", np.nan, -1, 1j, [], object(), np.zeros((2, 3, 5))])
@pytest.mark.parametrize(
    ("name", "call"),
    [
        *(("n", kind) for kind in (PositiveNetwork, JointNetwork, ConvexGradientNetwork)),
        ("hidden", lambda x: IndependentNetwork(2, hidden=x)),
        ("gains", LinearNetwork),
        ("mu", lambda x: ConvexGradientNetwork(2, mu=x)),
        ("copies", lambda x: StackedMLP(2, 1, copies=x)),
        ("network", ModularPolicy),
        ("part", lambda x: DirectPolicy(JointNetwork(2, inputs=3), part=x)),
        ("policy", as_numpy),
        ("s", NET),
        ("s", ConvexGradientNetwork(2).jacobian),
        ("R", lambda x: ModularPolicy(NET).command(torch.zeros(3, 2, 2), x)),
        ("observation", ModularPolicy(NET)),
        ("observation", lambda x: as_numpy(ModularPolicy(NET, layout={"s": slice(2, 6)}))(x)),
        ("starts", lambda x: Trial(x, 0.1, 1.0)),
        ("duration", lambda x: Trial(np.zeros((3, 2, 2)), 0.1, x)),
    ],
)
def test_what_is_wrong_is_named(name, call, bad):
    with pytest.raises((TypeError, ValueError), match=rf"\b{name}\b"):
        call(bad)
