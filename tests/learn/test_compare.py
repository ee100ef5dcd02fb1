"""The comparison: rows of toy contenders, and the analysis on rows written by hand."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from learn import analysis as a
from learn import compare as c
from learn.baselines import Baseline, ConstantVelocity, Frozen, Oracle
from sim.simulator import SimulationError
from sim.trajectory import Trajectory

BOX = np.array([[0.0, 1.0], [0.0, 1.0]])


def trajectory(seed=0, frames=16, scene="hand"):
    """Nine particles, all of which drift; one more is kinematic."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(3), np.arange(3)), -1).reshape(-1, 2) * 0.05 + 0.3
    path = grid + rng.normal(0, 2e-3, (frames, 9, 2)).cumsum(axis=0)
    path = np.concatenate([path, np.full((frames, 1, 2), 0.9)], axis=1).astype(np.float32)
    kind = np.array([5] * 9 + [3], np.int8)
    return Trajectory(path, kind, 0.01, 0.1, BOX, {"name": scene, "gravity": [0, -9.81], "spacing": 0.05}, seed, {"name": "hand"})


class Off(Oracle):
    """The truth plus an offset: a learned model whose error is known. It may fail at a frame."""

    kind = "learned"

    def __init__(self, name, truths, offset, settings=None, fails_at=None, fault="nan"):
        super().__init__(truths)
        self.name, self.offset, self.settings, self.fails_at, self.fault = name, offset, settings or {}, fails_at, fault

    def advance(self):
        block = super().advance() + np.float32(self.offset)
        if self.fails_at is not None and self.frame >= self.fails_at:
            if self.fault == "nan":
                return block * np.nan
            raise SimulationError("time step at its floor")
        return block


class Solver(Off):
    kind = "solver"


class Strided(Baseline):
    """Frozen, three frames a call."""

    name, kind, history = "strided", "learned", 9

    def advance(self):
        return np.repeat(super().advance(), 3, axis=0)

    def step(self):
        pass


TRUTHS = [trajectory(seed) for seed in range(3)]
SETTINGS = c.CompareSettings(horizons=(1, 5, 100), one_step_samples=4, curve_points=5)


def by_name(rows):
    return {row["contender"]: row for row in rows}


def test_rows_of_known_error():
    rows = c.compare([Oracle(TRUTHS), Off("off", TRUTHS, 0.05), Solver("rung", TRUTHS, 0.01), Frozen()], TRUTHS, SETTINGS)
    found = by_name(rows)
    assert list(found) == ["oracle", "off", "rung", "frozen"]
    oracle, off, rung = found["oracle"], found["off"], found["rung"]
    assert oracle["rollout_mse"] == {"1": 0, "5": 0, "100": None, "all": 0} and oracle["one_step_mse"] == 0 and oracle["emd"]["1"] == 0
    assert off["rollout_mse_moving"]["all"] == pytest.approx(0.05**2, rel=1e-5)
    assert off["rollout_mse"]["5"] == pytest.approx(0.05**2, rel=1e-5)  # the offset moves the kinematic particle too
    assert off["one_step_mse_moving"] == pytest.approx(0.05**2, rel=1e-5) and off["one_step_note"] is None
    assert rung["one_step_mse"] is None and "scene" in rung["one_step_note"]
    assert (off["scene"], off["kind"], off["reference"], off["status"]) == ("hand", "learned", "teacher", "ok")
    assert (off["trajectories"], off["runs"], off["known_frames"], off["frames"], off["failures"]) == (3, 3, 6, 10, 0)
    assert off["seconds_per_simulated_second"] == pytest.approx(off["seconds_per_frame"] / 0.01)
    assert off["divergence_time"] is None and off["first_non_finite"] is None
    assert len(off["spread"]["per_trajectory"]) == 3 and off["spread"]["per_trajectory"][1]["trajectory_seed"] == 1
    assert [(run["particles"], run["context"]) for run in off["spread"]["per_trajectory"]] == [(10, {})] * 3
    assert off["spread"]["min"]["rollout_mse"]["all"] <= off["rollout_mse"]["all"] <= off["spread"]["max"]["rollout_mse"]["all"]
    assert off["curves"]["frame"] == [1, 3, 5, 8, 10]
    assert off["curves"]["mse"]["median"] == pytest.approx([0.05**2] * 5, rel=1e-4)
    json.dumps(c.summary(rows), allow_nan=False)


def test_rows_tell_the_numbers_of_a_context():
    """The last columns, after the container's acceleration."""
    truth = replace(TRUTHS[0], scene=TRUTHS[0].scene | {"context": ["sand.friction_angle"]}, context=np.tile(np.float32([1, 2, 37.5]), (16, 1)))
    (row,) = c.compare([Frozen()], [truth], SETTINGS)
    assert row["spread"]["per_trajectory"][0]["context"] == {"sand.friction_angle": 37.5} and "context" not in row["mean"]


def test_failures_are_rows():
    contenders = [
        Off("breaks", TRUTHS, 0.0, fails_at=10),
        Off("stops", TRUTHS, 0.0, fails_at=8, fault="raise"),
        Off("fails at once", TRUTHS, 0.0, fails_at=0, fault="raise"),
        Off("one of three", TRUTHS[:1], 0.0),
    ]
    contenders[3].begin = lambda start, begin=contenders[3].begin: _begin_or_fail(begin, start)
    found = by_name(c.compare(contenders, TRUTHS, SETTINGS))
    breaks = found["breaks"]
    assert breaks["status"] == "failed in 3 of 3: non-finite position (frame 10)" and breaks["failures"] == 3
    assert breaks["rollout_mse"]["1"] == 0 and breaks["rollout_mse"]["all"] is None and breaks["emd"]["1"] is None
    assert breaks["first_non_finite"] == 5 and breaks["divergence_time"] == pytest.approx(0.05)
    assert found["stops"]["status"] == "failed in 3 of 3: time step at its floor (frame 8)"
    assert found["fails at once"]["one_step_mse"] is None and found["fails at once"]["rollout_mse"]["1"] is None
    # Two of three failed: the median is infinitely bad, not the one good run.
    assert found["one of three"]["failures"] == 2 and found["one of three"]["rollout_mse"]["all"] is None
    assert found["one of three"]["spread"]["min"]["rollout_mse"]["all"] == 0
    json.dumps(list(found.values()), allow_nan=False)


def _begin_or_fail(begin, start):
    try:
        begin(start)
    except ValueError:
        raise SimulationError("no such scene") from None


def test_training_seeds_are_one_row():
    models = [Off("model", TRUTHS, 0.01 * (seed + 1), {"depth": 2, "seed": seed}) for seed in range(3)]
    (row,) = c.compare(models, TRUTHS, SETTINGS)
    assert row["settings"] == {"depth": 2, "seeds": [0, 1, 2]} and row["runs"] == 9 and row["trajectories"] == 3
    assert row["rollout_mse_moving"]["all"] == pytest.approx(0.02**2, rel=1e-4)
    assert [entry["seed"] for entry in row["spread"]["per_seed"]] == [0, 1, 2]
    assert row["spread"]["per_seed"][2]["rollout_mse_moving"]["all"] == pytest.approx(0.03**2, rel=1e-4)
    assert row["mean"]["rollout_mse_moving"]["all"] == pytest.approx((0.01**2 + 0.02**2 + 0.03**2) / 3, rel=1e-4)


@pytest.mark.parametrize("other", [{"depth": 3, "seed": 1}, {"depth": 2, "seed": 0}])
def test_one_name_for_two_contenders_is_refused(other):
    with pytest.raises(ValueError, match="rename them"):
        c.compare([Off("model", TRUTHS, 0, {"depth": 2, "seed": 0}), Off("model", TRUTHS, 0, other)], TRUTHS, SETTINGS)


def test_strides_and_the_hungriest_history():
    found = by_name(c.compare([Strided(), Frozen()], TRUTHS, SETTINGS))
    assert found["strided"]["known_frames"] == found["frozen"]["known_frames"] == 9
    assert found["strided"]["rollout_mse"] == found["frozen"]["rollout_mse"]
    assert found["strided"]["one_step_mse"] == found["frozen"]["one_step_mse"]
    with pytest.raises(ValueError, match="needs more than the 9 known"):
        c.compare([Strided()], [trajectory(frames=9)], SETTINGS)


def test_one_row_per_scene():
    truths = [trajectory(0, scene="a"), trajectory(1, scene="b"), trajectory(2, scene="b")]
    rows = c.compare([Frozen(), ConstantVelocity()], truths, SETTINGS)
    assert [(row["scene"], row["contender"], row["trajectories"]) for row in rows] == [
        ("a", "frozen", 1),
        ("a", "constant velocity", 1),
        ("b", "frozen", 2),
        ("b", "constant velocity", 2),
    ]


# Timing: the clock is ours, so nothing depends on the machine.


class Ticking:
    """Costs 5 s to compile in its first begin, 1 s in every begin, ``seconds`` an advance."""

    kind, settings = "learned", {}

    def __init__(self, name, clock, seconds, block=1, fails_in_run=None):
        self.name, self.clock, self.seconds, self.block, self.fails_in_run, self.runs = name, clock, seconds, block, fails_in_run, 0

    def begin(self, start):
        self.clock.log.append(self.name)
        self.clock.now += 1 if self.runs else 6
        self.runs += 1

    def advance(self):
        if self.runs == self.fails_in_run:
            raise SimulationError("broken")
        self.clock.now += self.seconds
        return np.zeros((self.block, 10, 2), np.float32)


class Clock:
    def __init__(self):
        self.now, self.log = 0.0, []

    def perf_counter(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(c, "time", clock)
    return clock


def test_timing_is_interleaved_warm_and_without_compilation(clock):
    start = c.start_from(TRUTHS[0], 6)
    one, block = c.time_interleaved([Ticking("one", clock, 0.5), Ticking("block", clock, 0.8, block=4)], start, frames=6)
    assert clock.log == ["one", "block"] + ["one", "block", "block", "one"] * 2 + ["one", "block"]
    assert one.seconds_per_frame == pytest.approx(0.5) and len(one.per_frame) == 5 and one.compile_seconds == pytest.approx(5)
    assert block.seconds_per_frame == pytest.approx(0.2)  # two calls of four frames: eight frames were paid for
    rows = c.attach_timing(c.compare([Off("one", TRUTHS, 0)], TRUTHS, SETTINGS), [one, block], "hand")
    assert rows[0]["seconds_per_frame"] == pytest.approx(0.5) and rows[0]["seconds_per_simulated_second"] == pytest.approx(50)
    assert rows[0]["compile_seconds"] == pytest.approx(5) and rows[0]["timing_spread"] == {
        "seconds_per_frame": pytest.approx([0.5, 0.5]),
        "n": 5,
        "rounds": pytest.approx([0.5] * 5),
        "frames": 6,
    }


def test_timing_of_failures_and_too_few_repeats(clock):
    start = c.start_from(TRUTHS[0], 6)
    never, later = c.time_interleaved([Ticking("never", clock, 1, fails_in_run=1), Ticking("later", clock, 1, fails_in_run=3)], start, 2)
    assert never.seconds_per_frame is None and never.status == "failed: broken" and math.isnan(never.compile_seconds)
    assert len(later.per_frame) == 1 and later.status == "failed: broken"
    row = {"scene": "hand", "contender": "never", "seconds_per_frame": None}
    assert c.attach_timing([row], [never], "hand") == [row] and c.attach_timing([row], [later], "elsewhere") == [row]
    with pytest.raises(ValueError, match="at least 5"):
        c.time_interleaved([], start, 2, repeats=4)


def test_hardware_and_versions_are_recorded():
    machine = c.hardware()
    assert machine["cpu"] and machine["cores"] >= 1 and set(machine["flags"]) <= set(c._FLAGS) and "OMP_NUM_THREADS" in machine["threads"]
    assert c.versions()["numpy"] == np.__version__
    json.dumps([machine, c.versions()])


# Analysis, on rows by hand.


def row(name, kind, error, seconds, spread=0.0, failures=0, **more):
    return {
        "scene": "sand",
        "reference": "teacher",
        "contender": name,
        "kind": kind,
        "failures": failures,
        "runs": 10,
        "trajectories": 10,
        "frames": 100,
        "status": f"failed in {failures} of 10: non-finite position (frame 9)" if failures else "ok",
        "rollout_mse_moving": {"20": None if error is None else error / 4, "all": error},
        "emd": {"0.5": 1.0, "1": 2.0},
        "mean": {"rollout_mse_moving": {"all": error}, "emd": {"1": 2.0}},
        "spread": {"per_seed": []},
        "seconds_per_frame": seconds,
        "timing_spread": {"rounds": [seconds * (1 + spread * side) for side in (-1, 0, 1, 0, -1)], "n": 5},
        **more,
    }


TEACHER = row("teacher", "reference", 0.0, 10.0)
LADDER = [TEACHER, row("fine", "solver", 1e-6, 4.0), row("coarse", "solver", 1e-4, 1.0), row("worst", "solver", 1e-2, 0.5)]
TRIVIAL = [row("frozen", "trivial", 1.0, 1e-6), row("ballistic", "trivial", 0.1, 1e-6)]


def test_model_that_never_wins():
    model = row("gns", "learned", 1e-3, 8.0, cost={"generation_seconds": 60.0, "training_seconds": 600.0, "trajectories": 50})
    rows = [*LADDER, *TRIVIAL, model]
    assert a.speed_up_paper(rows, model) == pytest.approx(1.25)
    assert a.speed_up_at_equal_error(rows, model) == {"ratio": 0.125, "rung": "coarse", "rung_kind": "solver", "outcome": "loses"}
    assert a.error_at_equal_time(rows, model) == {"rung": "fine", "error": 1e-6, "ratio": pytest.approx(1000)}
    (result,) = a.analyse(rows)
    assert result["break_even"] == "never" and result["break_even_reference"] == pytest.approx(660 / 200) and not result["pareto"]
    assert result["worse_than_trivial"] == []
    text = a.verdict(rows)
    assert text.startswith(
        "On sand (10 test trajectories of 100 predicted frames, truth: teacher, error: rollout MSE of moving particles over all frames), "
        "no learned model wins at equal error; the solver is 8 times faster than the best, gns"
    )
    assert "50 trajectories" in text and "never paid back at equal error" in text and "1.2 times as fast" in text


def test_model_that_wins():
    model = row("gns", "learned", 5e-5, 0.8, cost={"generation_seconds": 40.0, "training_seconds": 600.0})
    other = row("slow gns", "learned", 5e-5, 8.0)
    rows = [*LADDER, *TRIVIAL, other, model]
    equal = a.speed_up_at_equal_error(rows, model)
    assert equal == {"ratio": pytest.approx(5.0), "rung": "fine", "rung_kind": "solver", "outcome": "wins"}
    assert a.error_at_equal_time(rows, model)["rung"] == "worst" and a.error_at_equal_time(rows, model)["ratio"] == pytest.approx(5e-3)
    result = a.analyse(rows)[1]
    assert result["break_even"] == pytest.approx(640 / (320)) and result["pareto"]
    text = a.verdict(rows)
    assert "gns wins at equal error, 5 times faster than the solver" in text and "paid back at equal error after 2 rollouts" in text


def test_only_the_reference_is_accurate_enough():
    model = row("gns", "learned", 1e-8, 2.0)
    equal = a.speed_up_at_equal_error([*LADDER, model], model)
    assert (equal["rung"], equal["rung_kind"], equal["ratio"], equal["outcome"]) == ("teacher", "reference", 5.0, "wins")
    assert "it is the reference itself: no cheaper rung reaches that error" in a.verdict([*LADDER, model])


def test_no_rung_at_all():
    model = row("gns", "learned", 1e-8, 2.0)
    rows = [*LADDER[1:], model]
    assert a.speed_up_at_equal_error(rows, model)["outcome"] == "no rung" and a.speed_up_paper(rows, model) is None
    assert "no speed-up at equal error is defined" in a.verdict(rows)
    slow = row("cheap", "learned", 1e-3, 0.1)
    assert a.error_at_equal_time(rows, slow) == {"rung": None, "error": None, "ratio": None}


def test_equal_time_with_the_reference():
    model = row("gns", "learned", 1e-3, 20.0)
    assert a.error_at_equal_time([*LADDER, model], model) == {"rung": "teacher", "error": 0.0, "ratio": None}


def test_a_tie_within_the_spread():
    model = row("gns", "learned", 1e-3, 0.9, spread=0.2)
    assert a.speed_up_at_equal_error([*LADDER, model], model)["outcome"] == "ties"
    assert "no learned model wins at equal error; gns ties" in a.verdict([*LADDER, model])


def test_every_round_must_agree_on_the_winner():
    """A single slow run of the solver makes no tie, rounds of both signs do, whatever the medians."""

    def outcome(*rounds):
        model = row("gns", "learned", 1e-3, 0.5) | {"timing_spread": {"rounds": list(rounds), "n": 5}}
        rung = row("coarse", "solver", 1e-4, 1.0) | {"timing_spread": {"rounds": [1.0, 1.0, 1.0, 1.0, 9.0], "n": 5}}
        return a.speed_up_at_equal_error([TEACHER, rung, model], model)["outcome"]

    assert outcome(0.5, 0.5, 0.5, 0.5, 4.0) == "wins"  # slow together: the ranges overlap, no round is lost
    assert outcome(0.5, 0.5, 0.5, 1.1, 0.5) == "ties"
    assert outcome(1.1, 1.1, 1.1, 1.1, 9.9) == "loses"


def test_a_tenth_more_error():
    """A rung that errs by 8 % more in a fourth of the time makes of 8 times 2; one by 11 % more nothing."""
    model = row("gns", "learned", 1e-4, 0.5)
    exact, near, far = row("exact", "solver", 9e-5, 4.0), row("near", "solver", 1.08e-4, 1.0), row("far", "solver", 1.11e-4, 0.1)
    (result,) = a.analyse([TEACHER, exact, near, far, model])
    assert (result["equal_error"]["ratio"], result["equal_error_slack"]["ratio"]) == (8.0, 2.0)
    text = a.verdict([TEACHER, exact, near, far, model])
    assert "gns wins at equal error, 8 times faster" in text and "Beside rungs that err up to a tenth more, it wins by 2." in text
    assert "a tenth more" not in a.verdict([TEACHER, exact, far, model])
    two = [row | {"scene": scene} for scene in ("sand", "goop") for row in (TEACHER, exact, *([near] if scene == "goop" else []), model)]
    assert "gns on sand, 8 times faster than the solver; gns on goop, 8 times faster than the solver (2 beside rungs that err up" in a.verdict(two)


def test_each_training_by_itself():
    """Of three errors, 1e-3, 1e-5 and .1, a rung of time 1, one of 4 and one of .5 are the cheapest as accurate; the model takes .8."""
    model = row("gns", "learned", 1e-3, 0.8)
    model["spread"] = {"per_seed": [{"seed": k, "rollout_mse_moving": {"all": error}} for k, error in enumerate((1e-3, 1e-5, 0.1))]}
    (result,) = a.analyse([*LADDER, model])
    wanted = [a.speed_up_at_equal_error(LADDER, row("gns", "learned", error, 0.8)) for error in (1e-3, 1e-5, 0.1)]
    assert result["equal_error_seeds"] == wanted and len({equal["rung"] for equal in wanted}) == 3
    assert "Trainings by themselves: 2 win (1.2, 5); 1 loses (0.62)." in a.verdict([*LADDER, model])
    model["spread"]["per_seed"][2] = model["spread"]["per_seed"][0]
    assert "Trainings by themselves: each of 3 wins (1.2, 1.2, 5)." in a.verdict([*LADDER, model])
    model["spread"]["per_seed"] = model["spread"]["per_seed"][:1]
    assert a.analyse([*LADDER, model])[0]["equal_error_seeds"] == [] and "Trainings" not in a.verdict([*LADDER, model])


def test_means_that_say_something_else():
    model = row("gns", "learned", 1e-3, 0.5, mean={"rollout_mse_moving": {"all": 2e-2}})
    (result,) = a.analyse([*LADDER, model])
    assert (result["equal_error"]["rung"], result["equal_error_mean"]["rung"]) == ("coarse", "worst")
    assert (result["equal_error"]["outcome"], result["equal_error_mean"]["outcome"]) == ("wins", "ties")
    assert (
        "gns wins at equal error, 2 times" in (text := a.verdict([*LADDER, model]))
        and "By the mean of the errors in place of their median, it ties." in text
    )
    slower = row("gns", "learned", 1e-3, 0.9, mean={"rollout_mse_moving": {"all": 2e-2}})
    assert "place of their median, the solver is 1.8 times faster." in a.verdict([*LADDER, slower])
    lost = row("gns", "learned", 1e-3, 0.5, mean={"rollout_mse_moving": {"all": 0.5}})
    assert "place of their median, it is worse than a trivial baseline." in a.verdict([*LADDER, *TRIVIAL, lost])
    assert "place of their median" not in a.verdict([*LADDER, row("gns", "learned", 1e-3, 0.5)])


def test_whole_rollouts_are_timed_unless_a_study_says_less(clock):
    contenders = [Ticking("one", clock, 0.5), Ticking("block", clock, 0.8, block=4)]
    timings = c.time_comparison(contenders, TRUTHS[0], SETTINGS)
    assert {timing.frames for timing in timings} == {len(TRUTHS[0].position) - c.known_frames(contenders, SETTINGS)}
    assert {timing.frames for timing in c.time_comparison(contenders, TRUTHS[0], SETTINGS, 3)} == {3}


def test_failures_win_nothing():
    failed = row("gns", "learned", 1e-8, 0.1, failures=2)
    broken_rung = row("broken", "solver", 1e-8, 0.01, failures=1)
    rows = [*LADDER, broken_rung, failed]
    assert a.speed_up_at_equal_error(rows, failed)["outcome"] == "failed"
    text = a.verdict(rows)
    assert "no learned model wins: none finished every rollout." in text and "gns (learned) failed in 2 of 10" in text
    assert "broken (solver) failed in 1 of 10" in text
    model = row("other", "learned", 1e-8, 1.0)
    assert a.speed_up_at_equal_error([*rows, model], model)["rung"] == "teacher"
    assert [point["contender"] for point in a.pareto_front([*rows, model])] == ["worst", "other", "teacher"]


def test_worse_than_trivial_cannot_win():
    model = row("gns", "learned", 0.5, 0.1)
    nothing = row("dead", "learned", None, 0.1, failures=10)
    rows = [*LADDER, *TRIVIAL, model, nothing]
    assert a.worse_than_trivial(rows, model) == ["ballistic"] and a.worse_than_trivial(rows, nothing) == ["frozen", "ballistic"]
    equal = a.speed_up_at_equal_error(rows, model)
    assert equal["ratio"] == pytest.approx(5.0) and equal["outcome"] == "worse than trivial"
    text = a.verdict(rows)
    assert "no learned model wins: gns" in text and "worse than the trivial ballistic" in text and " wins at equal error" not in text


def test_chaos_floor():
    floor = row("perturbed", "floor", 2e-4, 10.0)
    model = row("gns", "learned", 5e-5, 2.0)
    rows = [*LADDER, floor, model]
    assert a.over_floor(rows, model) == {"20": 0.25, "all": 0.25} and a.over_floor(LADDER, TEACHER) == {"20": None, "all": None}
    # Below the floor errors mean nothing: "coarse" (1e-4) counts as accurate as the model (5e-5).
    assert a.speed_up_at_equal_error(rows, model)["rung"] == "coarse"
    assert "0.25 times the chaos floor" in a.verdict(rows)


def test_references_and_scenes_are_kept_apart():
    model = row("gns", "learned", 1e-3, 8.0, reference="fine teacher")
    elsewhere = row("rung", "solver", 1e-9, 0.1, scene="water", reference="fine teacher")
    assert a.speed_up_at_equal_error([*LADDER, elsewhere, model], model)["outcome"] == "no rung"
    text = a.verdict([*LADDER, elsewhere, model])
    assert text.startswith("No learned model wins at equal error (rollout MSE of moving particles over all frames) on any of the 3 scenes. On sand (")
    assert "On sand (truth: fine teacher) no solver rung that was timed is as accurate." in text
    assert "On sand (truth: teacher) and water no learned model was compared." in text


def elsewhere(scene, *rows):
    return [row | {"scene": scene} for row in (*LADDER, *TRIVIAL, *rows)]


def test_the_verdict_on_several_scenes_counts():
    loses = elsewhere("sand", row("gns", "learned", 1e-3, 8.0)) + elsewhere("goop", row("grid", "learned", 1e-3, 2.0))
    text = a.verdict(loses)
    assert text.startswith("No learned model wins at equal error (rollout MSE of moving particles over all frames) on any of the 2 scenes.")
    assert text.endswith("On 2 the best loses to the solver, by the least on goop, where grid takes 2 times as long.")
    more = (
        elsewhere("water", row("gns", "learned", 5e-5, 0.8))
        + elsewhere("snow", row("gns", "learned", 0.5, 0.1))
        + elsewhere("jelly", row("gns", "learned", None, 0.1, failures=10))
        + elsewhere("mud", row("gns", "learned", 1e-3, 0.9, spread=0.2))
    )
    missed = a.Target("snow", "gns", a.MOVING_MSE, high=0.1)
    text = a.verdict(loses + more, [missed])
    assert text.startswith(
        "At equal error (rollout MSE of moving particles over all frames) a learned model wins on 1 of 6 scenes: gns on water, 5 times faster than "
        "the solver. On 2 the solver is faster, by the least on goop, where grid takes 2 times as long. On mud the best ties with the solver"
    )
    assert "On snow the best is worse than a trivial baseline. On jelly none finished every rollout. Missed: gns on snow" in text


def test_other_yardsticks():
    end = a.Yardstick("emd", "1")
    assert end.of(TEACHER) == 2.0 and str(end) == "EMD at the end" and str(a.Yardstick("emd", "0.5")) == "EMD at 50% of the run"
    mean = a.Yardstick("emd", "1", over="mean")
    assert mean.of(TEACHER | {"mean": {"emd": {"1": 3.0}}}) == 3.0 and str(mean) == "mean EMD at the end"
    assert str(a.Yardstick("one_step_mse", None)) == "one step MSE" and str(a.Yardstick("rollout_mse", "20")) == "rollout MSE over 20 frames"


def test_targets():
    model = row("gns", "learned", 1e-3, 8.0)
    rows = [*TRIVIAL, model]
    reached = a.Target("sand", "gns", a.MOVING_MSE, high=0.2, relative_to="ballistic")
    missed = a.missed_targets(
        rows,
        [
            reached,
            a.Target("sand", "gns", a.Yardstick("emd", "1"), high=1.5),
            a.Target("sand", "gns", a.Yardstick("emd", "0.5"), low=1.5, high=3),
            a.Target("sand", "none", a.MOVING_MSE, high=1),
            a.Target("sand", "ballistic", a.Yardstick("emd", "1"), high=1.5),
            a.Target("sand", "none", a.Yardstick("emd", "1"), low=1.5),
        ],
    )
    assert missed == [
        "EMD at the end is not at most 1.5 but 2 (gns on sand), 2 (ballistic on sand)",
        "gns on sand: EMD at 50% of the run is 1, not at least 1.5",
        "none on sand: rollout MSE of moving particles over all frames is unknown, not at most 1",
        "none on sand: EMD at the end is unknown, not at least 1.5",
    ]
    assert a.verdict(rows, [reached]).endswith("The target of the study is reached.")
    assert "Missed: none on sand" in a.verdict(rows, [a.Target("sand", "none", a.MOVING_MSE, high=1)])


def test_a_speed_up_at_equal_error_can_be_a_target():
    rows = elsewhere("sand", row("gns", "learned", 1e-3, 0.25), row("grid", "learned", 1e-3, 8.0))  # a rung of that error takes 1
    ratio = {entry["contender"]: entry["equal_error"]["ratio"] for entry in a.analyse(rows)}
    speed = a.Yardstick(a.SPEED_UP, None)
    best = a.Target("sand", c.BEST_LEARNED, speed, low=3)
    assert ratio["gns"] > 3 > ratio["grid"] and a.missed_targets(rows, [best]) == []
    missed = a.missed_targets(rows, [a.Target("sand", "grid", speed, low=3), a.Target("sand", c.BEST_LEARNED, speed, low=99)])
    assert missed == [
        f"grid on sand: speed-up at equal error is {ratio['grid']:.3g}, not at least 3",
        f"gns on sand: speed-up at equal error is {ratio['gns']:.3g}, not at least 99",
    ]
    bad = elsewhere("sand", row("gns", "learned", 0.5, 0.01))  # fast, and worse than a trivial baseline
    assert a.missed_targets(bad, [best]) == ["gns on sand: speed-up at equal error is unknown, not at least 3"]
    assert a.missed_targets(elsewhere("sand"), [best]) == ["best learned on sand: speed-up at equal error is unknown, not at least 3"]


def test_break_even():
    assert a.break_even(100.0, 3.0, 1.0) == 50 and a.break_even(100.0, 1.0, 1.0) == "never" and a.break_even(100.0, 1.0, 3.0) == "never"


def test_no_learned_model():
    assert "no learned model was compared" in a.verdict(LADDER)


def test_the_trajectory_of_the_median_error():
    def rows(*errors):
        runs = [{"model_seed": 0, "rollout_mse_moving": {"all": error}} for error in errors]
        other = {"model_seed": 1, "rollout_mse_moving": {"all": 0.0}}  # another training of it, which films do not show
        return [{"contender": "gns", "spread": {"per_trajectory": [*runs, other]}}]

    assert c.median_trajectory(rows(3.0, 1.0, 2.0), "gns") == 2
    assert c.median_trajectory(rows(3.0, 1.0, 2.0, 4.0), "gns") == 2  # the lower of the two in the middle
    assert c.median_trajectory(rows(None, 1.0, 2.0), "gns") == 2 and c.median_trajectory(rows(None, None, 2.0), "gns") == 0
