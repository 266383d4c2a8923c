"""The peg-touch study: trainings resume, files are checked, predictions meet measurements."""

import json

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

from cmc import store
from cmc.studies import peg_touch
from cmc.studies.peg_touch_evaluation import ERROR_BINS, equilibrium, record
from cmc.theory.sampled import sampled_margin

SMALL = peg_touch.PegTouchStudy(episodes=64, snapshot_every=32)
TRAINED = [name for name, arm in peg_touch.METHODS.items() if arm.trained]
FEW = peg_touch.TestConfig(trajectories=64)


def shipped():
    names = []
    for name in TRAINED:
        try:
            peg_touch.contents(name)
        except FileNotFoundError:
            continue
        names.append(name)
    return names


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return peg_touch.train("cppo_bounded", [3, 5], out=folder, study=SMALL)


@pytest.mark.parametrize("name", TRAINED)
def test_every_method_trains_is_kept_and_comes_back(name, tmp_path):
    path = peg_touch.train(
        name, [0, 1], out=tmp_path, study=peg_touch.PegTouchStudy(episodes=16, snapshot_every=16)
    )
    marks, record = peg_touch.contents(name, path)
    assert marks == [16]
    assert record["seeds"] == [0, 1]
    both = peg_touch.load(name, path=path)
    obs = torch.randn(2, 9, 4)
    for seed in range(2):
        one = peg_touch.load(name, seed=seed, path=path)
        torch.testing.assert_close(one(obs[seed]), both(obs)[seed])
    fresh = peg_touch.build(name, [0, 1])
    assert not torch.equal(fresh(obs), both(obs))


@pytest.mark.parametrize("reason", [KeyboardInterrupt, SystemExit])
def test_a_stopped_run_ends_with_the_same_policies(reason, run, tmp_path):
    """An interrupt keeps the last update; anything harsher goes back to the last kept policy."""

    def stop(report):
        if report["update"] == 3:
            raise reason

    with pytest.raises(reason):
        peg_touch.train("cppo_bounded", [3, 5], out=tmp_path, study=SMALL, callback=stop)
    resumed = peg_touch.train("cppo_bounded", [3, 5], out=tmp_path, study=SMALL)
    wanted, _ = store.load_checkpoint(run)
    found, _ = store.load_checkpoint(resumed)
    assert wanted.keys() == found.keys()
    for name, tensor in wanted.items():
        np.testing.assert_array_equal(found[name], tensor)


def test_a_run_of_another_configuration_is_not_resumed(run, tmp_path):
    folder = tmp_path / "copy"
    peg_touch.train("cppo", [0], out=folder, study=SMALL)
    with pytest.raises(store.CheckpointError):
        peg_touch.train("cppo", [1], out=folder, study=SMALL)


def test_the_learning_curve_has_one_row_an_update(run):
    episodes, returns = peg_touch.learning_curve("cppo_bounded", run)
    assert episodes.tolist() == [16, 32, 48, 64]
    assert returns.shape == (4, 2)
    assert (returns < 0).all()


@pytest.mark.parametrize("kind", ["missing", "foreign", "truncated", "pickled", "other method"])
def test_bad_checkpoints_are_refused(kind, run, tmp_path):
    path = tmp_path / "file.safetensors"
    name = "cppo_bounded"
    if kind == "foreign":
        save_file({"weight": np.zeros(3)}, path)
    elif kind == "truncated":
        path.write_bytes(run.read_bytes()[:-100])
    elif kind == "pickled":
        torch.save({"weight": torch.zeros(3)}, path)
    elif kind == "other method":
        path, name = run, "cppo"
    with pytest.raises(store.CheckpointError):
        peg_touch.load(name, path=path)


def test_unknown_names_are_refused(run):
    with pytest.raises(ValueError, match="unknown method 'sac'"):
        peg_touch.train("sac")
    with pytest.raises(ValueError, match="fixed gains"):
        peg_touch.train("pi")
    with pytest.raises(ValueError, match="at least one"):
        peg_touch.train("cppo", [])
    with pytest.raises(ValueError, match="episode: wanted one of"):
        peg_touch.load("cppo_bounded", 7, path=run)
    with pytest.raises(ValueError, match="seed: wanted"):
        peg_touch.load("cppo_bounded", seed=2, path=run)
    with pytest.raises(ValueError, match="unknown shift"):
        peg_touch.shifted(peg_touch.task_of("cppo"), "gravity")
    with pytest.raises(ValueError, match="at least 1"):
        peg_touch.evaluate(["pi"], trajectories=0)


def test_one_seed_is_tested_like_all_of_them(run):
    task = peg_touch.task_of("cppo_bounded")
    both = record(peg_touch.load("cppo_bounded", path=run), task, FEW, 2)
    for seed in range(2):
        alone = record(peg_touch.load("cppo_bounded", seed=seed, path=run), task, FEW, 1)
        np.testing.assert_allclose(alone.returns[0], both.returns[seed], rtol=1e-4)


@pytest.mark.parametrize("name", ["pi", "pi_scaled"])
@pytest.mark.parametrize("shift", list(peg_touch.SHIFTS))
def test_prediction_meets_measurement_for_known_gains(name, shift):
    task = peg_touch.shifted(peg_touch.task_of(name), shift)
    policy = peg_touch.build(name)
    found = peg_touch.run_test(
        policy, task, peg_touch.TestConfig(trajectories=500), 1, predict="weights"
    )
    assert found["agreement"][0] >= 0.98
    assert found["drift"] == [0.0]
    assert sum(found["histogram_f"]) == 500 == sum(found["histogram_x"])
    assert len(found["histogram_f"]) == len(ERROR_BINS) - 1
    if name == "pi_scaled":
        assert found["oscillation"] == [0.0]


def test_the_equilibrium_of_fixed_gains_is_the_one_on_paper():
    policy, task = peg_touch.build("pi"), peg_touch.task_of("pi")
    envs = record(policy, task, FEW, 1).envs
    s, exists = equilibrium(policy, envs, 1)
    assert exists.all()
    gains = policy.network.gains.numpy()
    z_d = envs.sampled["f_d"] / envs.sampled["K_sur"] + envs.true_peg.surface(envs.sampled["x_d"])
    np.testing.assert_allclose(s[0, :, 0, 1], (2.0 - envs.sampled["x_d"]) / gains[0, 1], atol=1e-4)
    np.testing.assert_allclose(s[0, :, 1, 1], (-0.5 - z_d) / gains[1, 1], atol=1e-4)


@pytest.mark.parametrize("name", ["cppo_capped", "cppo_scaled", "cppo_bounded"])
def test_caps_hold_for_any_weights(name):
    """Weights far from trained ones: the bound is met by construction, for the worst plant."""
    policy, task = peg_touch.build(name, [0, 1]), peg_touch.task_of(name)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.mul_(30.0)
    _, high = policy.slope_bounds()
    gain = 2.0 * np.array([0.5, task.stiffness_reference or task.K_sur[1]])
    margin = sampled_margin(
        high[..., 0],
        np.maximum(high[..., 1], 1e-9),
        0.5 * np.array([task.tau_x, task.tau_z]),
        gain,
        task.h,
    )
    assert (margin > 0).all()
    slope = policy.jacobian(torch.randn(2, 500, 2, 2)).detach().numpy()
    assert (slope.max(axis=1) <= high * (1 + 1e-4)).all()


def test_evaluation_keeps_what_is_done_and_is_json(tmp_path):
    study = peg_touch.PegTouchStudy(episodes=32, snapshot_every=16)
    peg_touch.train("cppo_scaled", [0, 1], out=tmp_path, study=study)
    seen = []
    options = {"trajectories": 16, "folder": tmp_path / "kept", "checkpoints": tmp_path}
    options["progress"] = lambda *row: seen.append(row)
    first = peg_touch.evaluate(["cppo_scaled"], **options)
    json.dumps(first, allow_nan=False)
    found = first["methods"]["cppo_scaled"]
    assert seen[-1][:2] == (len(found["tests"]),) * 2
    kept = tmp_path / "kept" / "cppo_scaled.json"
    half = store.read_json(kept)
    half["tests"] = half["tests"][:3]
    half["tests"][0]["return"] = [1.0, 2.0]  # to be recognized: what is there is not repeated
    store.write_json(kept, half)
    again = peg_touch.evaluate(["cppo_scaled"], **options)["methods"]["cppo_scaled"]
    assert again["tests"][0]["return"] == [1.0, 2.0]
    assert again["tests"][1:] == found["tests"][1:]
    assert [c["episode"] for c in found["certificates"]] == [16, 32]
    assert all(c["signs"] and all(c["design"]) for c in found["certificates"])


@pytest.mark.parametrize("name", shipped())
def test_shipped_checkpoints_are_complete(name):
    marks, found = peg_touch.contents(name)
    assert marks == list(range(1000, 15_001, 1000))
    assert len(found["seeds"]) == 5
    assert f"--method {name}" in found["command"]
    episodes, returns = peg_touch.learning_curve(name)
    assert episodes[-1] >= 15_000
    assert returns[-50:].mean() > returns[:10].mean() + 20
    sidecar = store.read_json(store.asset("checkpoints", f"peg_touch_{name}.json"))
    assert sidecar["configuration"] == found["configuration"]


@pytest.mark.parametrize("name", ["cppo", "ppo", "cppo_bounded"])
def test_shipped_runs_begin_as_the_present_code_does(name, tmp_path):
    """The first updates of one seed, trained again alone, are those of the shipped five."""
    path = peg_touch.train(name, [0], episodes=32, out=tmp_path)
    _, found = peg_touch.learning_curve(name, path)
    _, wanted = peg_touch.learning_curve(name)
    np.testing.assert_allclose(found[:2, 0], wanted[:2, 0], rtol=1e-3)


def test_shipped_results_belong_to_the_shipped_checkpoints():
    answer = peg_touch.results()
    assert set(answer["methods"]) == {*shipped(), "pi", "pi_scaled"}
    for name, found in answer["methods"].items():
        for test in found["tests"]:
            for key in ("oscillation", "drift", "offset"):
                assert np.all((np.array(test[key]) >= 0) & (np.array(test[key]) <= 1)), name
    assert answer["claims"] == peg_touch.claims(answer["methods"])
    name, mark = "cppo_capped", 5000
    fresh = peg_touch.run_test(
        peg_touch.load(name, mark), peg_touch.task_of(name), peg_touch.TestConfig(), 5
    )
    kept = peg_touch.at(answer["methods"][name], mark)
    np.testing.assert_allclose(fresh["return"], kept["return"], rtol=1e-3)


def test_what_signs_and_caps_promise_is_measured_in_the_shipped_results():
    totals = peg_touch.results()["totals"]
    for name, found in totals["worst"].items():
        if peg_touch.METHODS[name].capped:
            assert found["largest_oscillation"] == 0.0, name
    for name in ("cppo", "cppo_capped", "cppo_bounded"):
        assert totals["worst"][name]["largest_drift"] == 0.0, name
    assert totals["agreement"] >= 0.98
    assert totals["agreement_where_some_oscillate"] >= 0.98
    tests = peg_touch.results()["methods"]["cppo_capped"]["tests"]
    full = [t for t in tests if t["h"] == 0.01]
    assert len(full) == 15 * len(peg_touch.SHIFTS)
    assert all(t["trajectories"] == 8000 and len(t["oscillation"]) == 5 for t in full)
