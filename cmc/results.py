"""Results of the studies as tidy tables, and intervals over seeds.

    data = tidy("peg_push")                       # a row for each method, kept policy and seed
    share(at(data), "success")                    # last policies: percent, interval over seeds
    compare(at(data), [("ctd3", "control", "success"), ("ctd3", "gain", "return")])

A seed is one training, and the unit of every interval and test: the episodes of one seed share its
policy, so pooling them would count one training a hundred times. With five seeds the smallest
possible p-value of a comparison is 2/252 = .008; an interval without width says that these seeds
agree, not that every other would.

Columns of `tidy(study)`; other tables are described in `TABLES`:

| column | what it is |
|---|---|
| method, title | its name in `python -m cmc list`, and in figures |
| test | "nominal", or the change of the plant that the policy is tested under |
| step, episode | when the policy was kept, steps or episodes of each seed; 0: fixed gains |
| last | whether it is the method's last kept policy |
| seed | of the training |
| episodes, trajectories | how many the row is about |
| return | mean sum of rewards |
| cost | low_level: mean cost of segments of the latent model (`cmc.learning.latent`) |
| unstable, off, unstable_shifted, off_shifted | shares of tests, see `cmc.studies.own_plant` |
| certified_m, cpu_s | half-width of the largest certified box, m; CPU time of a seed, s |
| left_worst, left_mean | softness: share of a 5 mm step that is left after .4 s |
| speed_x, impact_x_N, press_x_N, mass_x_kg | contact along x, see `cmc.studies.softness` |
| speed_y, impact_y_N, press_y_N, mass_y_kg | the same along y |
| force_999_N | softness: 99.9 % quantile of the largest force in a tick, N |
| success, touched | share of episodes with the tip in the goal at the last tick, at any tick |
| passed_by | share of episodes that touched and were elsewhere at the last tick |
| nearest_mm, final_mm | median distance to the goal, smallest and at the end, mm |
| deepest_mm, median_deepest_mm | deepest penetration, of all episodes and median of theirs, mm |
| no_contact, below_1_N, below_5_N | share of ticks by the largest force in a tick |
| largest_N | largest force, N; these four with `_50hz` look at the end of each tick only |
| moved_mm, moved_x_mm, ... | mean displacement for a step of 5 mm along -x: along it, in x, y, z |
| starts_mm, push_mm | spread of that displacement over starts; moved by a push of 2 N, mm |
| slope_x, ... slope_rz | du/dy at rest; peg touch: bound of k1 + (h/2) k2 |
| cap_x, ... cap_rz | what construction keeps that slope below |
| h | control period, s (peg touch, as all below) |
| oscillation, drift, offset | share of trajectories that the detectors flag, at most one each |
| error_x, error_f, error_f_90 | median error, m and N, and the 90 % quantile of the force's, N |
| wrong_sign_signal, wrong_sign_integral | share of visited states with a negative slope |
| prediction | "weights" or "visited": from what oscillation is predicted |
| predicted_oscillation, agreement | share predicted, and share of trajectories predicted rightly |
| reachable | share of targets that the policy has an equilibrium for |
| above_percent, rate | cost above that of the optimum, %; certified rate, 1/s (composition) |

`data.attrs` is the record of the file: study, command, commit, versions. Columns that it names
under `pooled` are known for all seeds together only and the same in each seed's row (but for tests
under other contact).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import stats

from cmc import store
from cmc.theory.arrays import checked

TABLES = {
    "tests": "a row for each method, test, kept policy and seed",
    "curves": "training: `reward` a tick or `return` of an episode by step or episode, smoothed",
    "episodes": "test episodes of the last policies: `nearest_mm`, `final_mm`",
    "histograms": "peg touch: `count` of trajectories of all seeds by mean force error, N",
    "certificates": "peg touch: what holds for a kept policy, from its weights",
}
"""Tables of a study; not every study has all."""
RESAMPLES = 9999  # bootstrap samples; drawn from the same stream in every call


def tidy(study: str, table: str = "tests") -> pd.DataFrame:
    """A table, one of `TABLES`, of shipped results; the module's docstring lists the columns."""
    wanted = file_name(study, table)
    there = sorted(path.stem for path in store.asset("results").glob("*.csv"))
    if wanted.removesuffix(".csv") not in there:
        raise ValueError(f"no results {wanted!r} are shipped; there are {', '.join(there)}")
    return read(store.asset("results", wanted))


def file_name(study: str, table: str) -> str:
    """Name of a table's file."""
    if not isinstance(study, str):
        raise ValueError(f"study: wanted a name, got {study!r}")
    if not isinstance(table, str) or table not in TABLES:
        raise ValueError(f"table: wanted one of {', '.join(TABLES)}, got {table!r}")
    return f"{study}.csv" if table == "tests" else f"{study}_{table}.csv"


def read(path: str | Path) -> pd.DataFrame:
    """A table and its record (`attrs`) from a file that `write` made; a ValueError for others."""
    with store.as_path("path", path).open(encoding="utf-8") as file:
        try:
            record = json.loads(file.readline().removeprefix("#"))
            data = pd.read_csv(file)
        except ValueError as error:  # of JSON, of the text's code, of pandas
            said = f"{path}: wanted a record in the first line and a table below it"
            raise ValueError(f"{said} ({error})") from error
    if not isinstance(record, dict) or not isinstance(data.index, pd.RangeIndex):
        raise ValueError(f"{path}: wanted a record in the first line, and rows as long as the head")
    data.attrs = record
    return data


def write(folder: str | Path, table: str, data: pd.DataFrame, record: Mapping[str, Any]) -> Path:
    """Write a table of `record["study"]`: CSV, six digits, below a line with the record."""
    head = store.as_json("record", record, "study")
    path = store.as_path("folder", folder) / file_name(record["study"], table)
    text = _table(data).to_csv(index=False, float_format="%.6g", lineterminator="\n")
    return store.write_atomic(path, lambda file: file.write(f"# {head}\n{text}".encode()))


def at(
    data: pd.DataFrame, when: int | None = None, *, test: str = "nominal", h: float = 0.01
) -> pd.DataFrame:
    """Rows of one test and one kept policy of each method: a row for each method and seed.

    `when` is step or episode of the policy, the last one if None; fixed gains are always there. `h`
    is the control period of the test, s, where there are several. A ValueError names what there is.
    """
    time = "step" if "step" in _table(data, "last", "test") else "episode"
    several = "h" in data and data["h"].nunique() > 1
    asked = {"test": test} | ({"h": h} if several else {}) | ({} if when is None else {time: when})
    for key, value in asked.items():
        there = data[key].dropna().unique().tolist()
        if value not in there:
            name = "when" if key == time else key
            raise ValueError(f"{name}: wanted one of {there}, got {value!r}")
    chosen = data[time].isin([when, 0]) if when is not None else data["last"]
    chosen = chosen & (data["test"] == test)
    return data[chosen & (data["h"] == h)] if several else data[chosen]


def _table(data: Any, *columns: Any) -> pd.DataFrame:
    """The one door for tables: a DataFrame that has these columns."""
    if not isinstance(data, pd.DataFrame):
        raise ValueError(f"data: wanted a table, as `tidy` answers, got {type(data).__name__}")
    for name in columns:
        if not isinstance(name, str) or name not in data:
            raise ValueError(f"data has no column {name!r}; it has {', '.join(map(str, data))}")
    return data


def spread(data: pd.DataFrame, key: str, by: str | Sequence[str] = "method") -> pd.DataFrame:
    """Mean over seeds of a figure, its 95 % bootstrap interval, smallest and largest seed.

    `data` has one row for each seed in each group, else a ValueError says so; `key` is the figure's
    column, and `by` the columns that make the groups. Answers by group `mean`, `low`, `high`
    (percentile bootstrap over seeds; NaN for one seed), `least`, `largest` and `seeds`, their
    number. Groups without the figure are left out.
    """
    keys: list[Any] = [*by] if isinstance(by, list | tuple) else [by]
    data = _figures(data, key, *(keys or [by]), "seed")
    if data.duplicated([*keys, "seed"]).any():
        raise ValueError(
            f"wanted one row for each seed in a group by {', '.join(keys)}, got several: choose "
            "policies and tests first (`at`), or add columns to `by`"
        )
    found = {}
    for group, rows in data.groupby(by, sort=False):
        x = rows[key].to_numpy(float)
        low, high = _bootstrap((x,), np.mean)
        found[group] = {"mean": x.mean(), "low": low, "high": high}
        found[group] |= {"least": x.min(), "largest": x.max(), "seeds": len(x)}
    answer = pd.DataFrame.from_dict(found, orient="index")
    answer.index.names = keys
    return answer.astype({"seeds": int}) if found else answer


def _figures(data: Any, key: str, *columns: Any) -> pd.DataFrame:
    """The rows that have a figure, a finite number."""
    x = _table(data, key, *columns)[key]
    if not pd.api.types.is_numeric_dtype(x) or np.isinf(x.astype(float)).any():
        raise ValueError(f"key: wanted a column of finite numbers, got {key!r}")
    return data[x.notna()]


def share(
    data: pd.DataFrame, key: str = "success", by: str | Sequence[str] = "method"
) -> pd.DataFrame:
    """`spread` of a share, in percent."""
    answer = spread(data, key, by)
    answer.loc[:, "mean":"largest"] *= 100.0  # type: ignore[misc]
    return answer


def against(data: pd.DataFrame, arm: str, other: str, key: str = "success") -> pd.Series:
    """One method's mean over seeds of a figure, minus another's; `data` has a row for each seed.

    Answers `difference`, `low`, `high` (95 %, percentile bootstrap over both methods' seeds) and
    `p`, exact and two-sided: the share of all ways to deal the seeds to two methods that differ as
    much. A ValueError says if a method is missing, or one of its seeds has several rows.
    """
    pair = []
    for name in (arm, other):
        rows = _figures(data, key, "method", "seed")
        rows = rows[rows["method"] == name] if isinstance(name, str) else rows[:0]
        if rows.empty:
            there = ", ".join(data["method"].unique())
            raise ValueError(f"no {key} of {name!r}; there are {there}")
        if rows["seed"].duplicated().any():
            raise ValueError(f"{name}: wanted one row for each seed, got several (`at` chooses)")
        pair.append(rows[key].to_numpy(float))
    a, b = pair
    low, high = _bootstrap((a, b), _gap)
    p = stats.permutation_test((a, b), _gap, vectorized=True, n_resamples=np.inf).pvalue
    return pd.Series({"difference": a.mean() - b.mean(), "low": low, "high": high, "p": float(p)})


def compare(data: pd.DataFrame, comparisons: Iterable[tuple[str, str, str]]) -> pd.DataFrame:
    """`against` for comparisons (arm, other, key) that were named before looking.

    A row for each, with `p_holm`: p-values corrected by Holm for all that are in the list.
    """
    try:
        named = [(arm, other, key) for arm, other, key in comparisons]
    except (TypeError, ValueError):
        named = []
    if not named:
        raise ValueError(f"comparisons: wanted some (arm, other, key), got {comparisons!r}")
    answer = pd.DataFrame([against(data, *three) for three in named])
    answer.index = pd.MultiIndex.from_tuples(named, names=["method", "other", "key"])
    return answer.assign(p_holm=holm(answer["p"]))


def holm(p: ArrayLike) -> np.ndarray:
    """Holm's correction: max over j <= i of (m - j) p_(j) in rising order, at most 1."""
    p = checked("p", p, "tests", least=0.0)
    if (p > 1).any():
        raise ValueError(f"p: wanted probabilities, got {p.max()}")
    order = np.argsort(p)
    rising = np.maximum.accumulate((len(p) - np.arange(len(p))) * p[order])
    answer = np.empty_like(rising)
    answer[order] = np.minimum(rising, 1.0)
    return answer


def _gap(a: np.ndarray, b: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.asarray(a.mean(axis=axis) - b.mean(axis=axis))


def _bootstrap(samples: tuple[np.ndarray, ...], statistic: Any) -> tuple[float, float]:
    """95 % percentile interval; the seeds of each sample are drawn with replacement."""
    if min(map(len, samples)) < 2:
        return np.nan, np.nan
    options: Any = {"vectorized": True, "n_resamples": RESAMPLES, "method": "percentile"}
    found = stats.bootstrap(samples, statistic, rng=np.random.default_rng(0), **options)
    return float(found.confidence_interval.low), float(found.confidence_interval.high)
