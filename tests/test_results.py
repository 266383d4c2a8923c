"""Tables of shipped results, and statistics whose unit is the seed."""

from __future__ import annotations

import itertools

import numpy as np
import pandas as pd
import pytest

from cmc import results, store
from cmc.results import against, at, compare, holm, share, spread, tidy

SHIPPED = sorted(path.stem for path in store.asset("results").glob("*.csv"))
STUDIES = [name for name in SHIPPED if not name.endswith(tuple(results.TABLES))]
PUSH, MAZE = at(tidy("peg_push")), at(tidy("peg_maze"))


def table(**arms: list[float]) -> pd.DataFrame:
    """Figures of arms, one for each seed."""
    rows = [(name, k, v) for name, values in arms.items() for k, v in enumerate(values)]
    return pd.DataFrame(rows, columns=["method", "seed", "x"])


def every_resample(values: list[float]) -> np.ndarray:
    """Means of all ways to draw as many seeds with replacement, the exact bootstrap."""
    return np.array([np.mean(drawn) for drawn in itertools.product(values, repeat=len(values))])


# -- the statistics against exact enumerations -----------------------------------------------------


def test_the_interval_is_over_seeds_and_not_over_pooled_episodes() -> None:
    frozen = MAZE[MAZE["method"] == "frozen"]
    assert list(frozen["success"]) == [0.99, 0.02, 0.98, 0.01, 0.93]
    found = share(MAZE).loc["frozen"]
    assert found["mean"] == pytest.approx(58.6)
    exact = 100 * np.quantile(every_resample(list(frozen["success"])), [0.025, 0.975])
    assert [found["low"], found["high"]] == pytest.approx(list(exact), abs=1.5)
    assert found["high"] - found["low"] > 70  # 500 pooled episodes would have one of 9
    assert (found["least"], found["largest"], found["seeds"]) == pytest.approx((1, 99, 5))


def test_one_seed_has_no_interval_and_equal_seeds_have_one_without_width() -> None:
    found = spread(table(one=[3.0], same=[2.0, 2.0, 2.0]), "x")
    assert found.loc["one", ["low", "high"]].isna().all()
    assert list(found.loc["same", ["mean", "low", "high"]]) == [2.0, 2.0, 2.0]


def test_the_p_value_counts_every_way_to_deal_the_seeds() -> None:
    a, b = [1.0, 4.0, 2.5, 6.0], [0.5, 3.0, 1.5]
    gap, pool = np.mean(a) - np.mean(b), np.array(a + b)
    dealt = [list(c) for c in itertools.combinations(range(7), 4)]
    gaps = np.array([pool[c].mean() - np.delete(pool, c).mean() for c in dealt])
    left, right = (gaps <= gap + 1e-12).mean(), (gaps >= gap - 1e-12).mean()
    found = against(table(a=a, b=b), "a", "b", "x")
    assert found["difference"] == pytest.approx(gap)
    assert found["p"] == pytest.approx(min(1.0, 2 * min(left, right)))
    assert found["low"] < gap < found["high"]


def test_two_times_five_seeds_that_do_not_overlap_give_two_of_252() -> None:
    data = table(a=[5, 6, 7, 8, 9], b=[0, 1, 2, 3, 4])
    assert against(data, "a", "b", "x")["p"] == pytest.approx(2 / 252)
    assert against(data, "a", "a", "x")["p"] == pytest.approx(1.0)


def test_holm_by_hand_and_over_the_comparisons_named() -> None:
    assert list(holm([0.01, 0.04, 0.03, 0.005])) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert list(holm([0.6, 0.9])) == [1.0, 1.0]
    named = [("ctd3", "control", "return"), ("frozen", "control", "success")]
    found = compare(PUSH, named)
    assert list(found.index) == named
    assert list(found["p_holm"]) == pytest.approx(list(holm(found["p"])))
    pool = np.concatenate([MAZE.loc[MAZE["method"] == name, "success"] for name in named[1][:2]])
    rest = [2 * pool[list(c)].sum() - pool.sum() for c in itertools.combinations(range(10), 5)]
    gap = pool[:5].sum() - pool[5:].sum()
    wanted = 2 * min(np.mean(rest >= gap - 1e-9), np.mean(rest <= gap + 1e-9))
    assert compare(MAZE, named).loc[named[1], "p"] == pytest.approx(wanted)  # 252 ways to deal


def test_pooling_is_refused() -> None:
    data = tidy("peg_push")
    with pytest.raises(ValueError, match="one row for each seed in a group by method, got several"):
        share(data)
    with pytest.raises(ValueError, match="ctd3: wanted one row for each seed"):
        against(data, "ctd3", "frozen")
    with pytest.raises(ValueError, match="no success of 'nobody'"):
        against(PUSH, "ctd3", "nobody")


# -- the shipped tables ---------------------------------------------------------------------------


@pytest.mark.parametrize("study", STUDIES)
def test_a_table_has_one_row_for_each_method_test_policy_and_seed(study: str) -> None:
    data = tidy(study)
    time = "step" if "step" in data else "episode"
    keys = ["method", "test", time, "seed", *(["h"] if "h" in data else [])]
    assert not data.duplicated(keys).any()
    assert not data.drop(columns=["h"], errors="ignore").columns.difference(documented()).size
    for _, rows in data[data["test"] == "nominal"].groupby("method"):
        seeds = rows.groupby(keys[2:3] + keys[4:])["seed"].apply(tuple)
        assert seeds.nunique() == 1  # no seed is ever missing
        assert set(rows.loc[rows["last"], time]) == {rows[time].max()}
    assert data.attrs["study"] == study
    assert data.attrs["command"].startswith("python -m cmc")
    assert {"commit", "versions"} <= set(data.attrs)


def documented() -> set[str]:
    """Names in the table of the module's docstring, and those of axes spelled out."""
    rows = [line.split("|")[1] for line in (results.__doc__ or "").splitlines() if "|" in line]
    names = {name.strip() for row in rows for name in row.split(",")}
    axes = ("x", "y", "z", "rx", "ry", "rz")
    return (
        names
        | {f"{kind}_{a}" for kind in ("slope", "cap") for a in axes}
        | {f"moved_{a}_mm" for a in "xyz"}
        | {f"{k}_50hz" for k in ("no_contact", "below_1_N", "below_5_N", "largest_N")}
    )


@pytest.mark.parametrize("study", [s for s in STUDIES if "success" in tidy(s)])
def test_shares_keep_the_order_that_their_definitions_give(study: str) -> None:
    data = tidy(study)
    assert (data["success"] <= data["touched"]).all()  # the last tick is one of the ticks
    np.testing.assert_allclose(data["touched"] - data["success"], data["passed_by"], atol=1e-6)
    for end in ("", "_50hz"):
        shares = data[[f"no_contact{end}", f"below_1_N{end}", f"below_5_N{end}"]].to_numpy()
        assert (np.diff(shares, axis=1) >= 0).all()
        assert ((shares >= 0) & (shares <= 1)).all()
    largest = data.groupby(["method", "test", "step"])[["largest_N", "largest_N_50hz"]].max()
    assert (largest["largest_N"] >= largest["largest_N_50hz"] - 1e-9).all()
    ends = tidy(study, "episodes").groupby(["method", "seed"])["final_mm"].median()
    for (method, seed), median in ends.items():
        row = at(data)[(at(data)["method"] == method) & (at(data)["seed"] == seed)]
        assert median == pytest.approx(row["final_mm"].item(), abs=0.01)


def test_fixed_gains_are_beside_every_kept_policy() -> None:
    rows = at(tidy("peg_touch"), 5000)
    assert {"pi", "cppo"} <= set(rows["method"])
    assert set(rows["h"]) == {0.01}


def test_what_is_written_is_read_again(tmp_path: object) -> None:
    rows = pd.DataFrame([{"method": "a", "seed": 0, "x": 1 / 3, "last": True}])
    path = results.write(str(tmp_path), "tests", rows, {"study": "s", "command": "c"})
    found = results.read(path)
    assert found.attrs == {"study": "s", "command": "c"}
    assert found.loc[0, "x"] == pytest.approx(1 / 3, rel=1e-5)
    assert found.loc[0, "last"]
    path.write_text("method,seed\na,0\n")
    with pytest.raises(ValueError, match="wanted a record in the first line"):
        results.read(path)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: at(tidy("peg_push"), 7), "when: wanted one of"),
        (lambda: at(tidy("peg_push"), test="none"), "test: wanted one of"),
        (lambda: at(tidy("peg_touch"), h=0.5), "h: wanted one of"),
        (lambda: at([1]), "data: wanted a table"),
        (lambda: spread(PUSH, "nothing"), "data has no column 'nothing'"),
        (lambda: spread(PUSH, "title"), "key: wanted a column of finite numbers"),
        (lambda: spread(PUSH.assign(success=np.inf), "success"), "key: wanted .* finite"),
        (lambda: compare(PUSH, []), "comparisons: wanted some"),
        (lambda: holm([0.1, np.nan]), "p needs finite"),
        (lambda: holm([1.5]), "p: wanted probabilities"),
    ],
)
def test_what_has_no_answer_is_refused_by_name(call, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        call()


def test_unknown_tables_and_studies_are_named() -> None:
    with pytest.raises(ValueError, match="table: wanted one of tests, curves"):
        tidy("peg_push", "nothing")
    with pytest.raises(ValueError, match=r"no results 'nobody\.csv' are shipped; there are"):
        tidy("nobody")
