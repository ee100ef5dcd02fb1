from __future__ import annotations

import csv
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import dummy_model
import h5py
import numpy as np
import pytest
import torch
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[1]))

from disks import small_disk

from learn import train as training
from learn.checkpoint import load_model, load_state, read_model_file, save_model
from learn.cli import main
from learn.dataset import Dataset, DataSettings
from learn.train import Adam, Config, Muon, TrainSettings, load_config, rollout_score, train
from sim.errors import InputError, RunError
from sim.trajectory import ShardReader

STEPS = 240
BASE = {"steps": STEPS, "learning_rate": 1e-2, "warmup_steps": 20, "log_every": 10, "checkpoint_every": 17, "validations": 4, "validation_frames": 12}


def config(**changes: object) -> Config:
    return Config(model="dummy", training=TrainSettings(**(BASE | changes)), data=DataSettings(mirror=True))


def rows(path: Path) -> list[dict[str, str]]:
    """A CSV file without its times."""
    with open(path) as file:
        return [{name: value for name, value in row.items() if name != "seconds"} for row in csv.DictReader(file)]


def assert_same(one: object, two: object) -> None:
    """Bitwise equality of nested tensors, times excepted."""
    assert type(one) is type(two)
    if isinstance(one, torch.Tensor):
        assert one.dtype == two.dtype and torch.equal(one, two)
    elif isinstance(one, dict):
        assert one.keys() == two.keys()
        for key in one:
            if "seconds" not in key:
                assert_same(one[key], two[key])
    elif isinstance(one, list):
        assert len(one) == len(two)
        for first, second in zip(one, two, strict=True):
            assert_same(first, second)
    else:
        assert one == two


def assert_same_run(one: Path, two: Path) -> None:
    for name in ("log.csv", "validation.csv"):
        assert rows(one / name) == rows(two / name)
    assert_same(load_state(one / "checkpoint.pt"), load_state(two / "checkpoint.pt"))
    assert_same(read_model_file(one / "best.pt"), read_model_file(two / "best.pt"))
    first, second = (json.loads((run / "done.json").read_text()) for run in (one, two))
    assert_same(first, second)


@pytest.fixture(scope="module")
def unbroken(bounce_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("unbroken") / "run"
    train(config(), bounce_dataset, run)
    return run


def test_what_a_run_leaves(unbroken: Path) -> None:
    assert sorted(path.name for path in unbroken.iterdir()) == ["best.pt", "checkpoint.pt", "done.json", "log.csv", "validation.csv"]
    done = json.loads((unbroken / "done.json").read_text())
    assert done["steps"] == STEPS and done["parameters"] == 6 and 0 < done["validation_seconds"] < done["seconds"]
    log, validation = rows(unbroken / "log.csv"), rows(unbroken / "validation.csv")
    assert [int(row["step"]) for row in log] == list(range(10, STEPS + 1, 10))
    assert {row["window"] for row in log[:11]} == {"3"} and {row["window"] for row in log[12:]} == {"4"}
    assert float(log[-1]["loss"]) < 0.5 * float(log[0]["loss"])
    assert [int(row["step"]) for row in validation] == [60, 120, 180, 240]
    scores = [float(row["rollout_mse"]) for row in validation]
    best = min(scores)
    assert done["best_rollout_mse"] == best and done["best_step"] == 60 * (1 + scores.index(best))
    assert read_model_file(unbroken / "best.pt")["provenance"]["rollout_mse"] == best


def test_best_holds_the_averaged_weights_it_was_chosen_by(unbroken: Path, bounce_dataset: Path) -> None:
    model, valid = load_model(unbroken / "best.pt"), Dataset(bounce_dataset, "valid")
    scores = [rollout_score(model, valid.trajectory(number), 12)[0] for number in range(2)]
    assert float(np.mean(scores)) == json.loads((unbroken / "done.json").read_text())["best_rollout_mse"]


def test_a_finished_run_is_not_repeated(unbroken: Path, bounce_dataset: Path) -> None:
    before = {path.name: path.read_bytes() for path in unbroken.iterdir()}
    assert train(config(), bounce_dataset, unbroken) == json.loads(before["done.json"])
    assert {path.name: path.read_bytes() for path in unbroken.iterdir()} == before


#: What a child process of a test begins with: the dummy model, slowed down so that a kill hits it in its work.
SLOW = """
import os, random, signal, sys, time
sys.path[:0] = [{here!r}, {root!r}]
import dummy_model, torch
torch.set_num_threads(1)
from learn.model import MODELS
MODELS["dummy"] = ("dummy_model", "Dummy")
from learn.train import Config, Trainer
plain = dummy_model.Dummy.loss
def slow(self, *arguments):
    time.sleep(0.005)
    return plain(self, *arguments)
dummy_model.Dummy.loss = slow
"""

CHILD = (
    SLOW
    + """
Trainer(Config.model_validate_json({config!r}), {data!r}, {run!r}).run()
"""
)


def test_killed_and_resumed_is_bitwise_unbroken(unbroken: Path, bounce_dataset: Path, tmp_path: Path) -> None:
    """kill -9 at some instant past a checkpoint, then the same command again."""
    run, root = tmp_path / "run", Path(training.__file__).parents[1]
    code = CHILD.format(here=str(Path(__file__).parent), root=str(root), config=config().model_dump_json(), data=str(bounce_dataset), run=str(run))
    child = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, start_new_session=True)
    try:
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and child.poll() is None:
            # Past the first validation, and past at least one checkpoint by a logged row that resuming must take back.
            if (run / "validation.csv").exists() and len(rows(run / "validation.csv")) >= 1 and int(rows(run / "log.csv")[-1]["step"]) >= 80:
                break
            time.sleep(0.002)
        assert child.poll() is None, child.stderr.read().decode()
    finally:
        child.kill()
        child.wait()
    at = load_state(run / "checkpoint.pt")["progress"]["step"]
    assert 60 <= at < STEPS and not (run / "done.json").exists()
    (run / ".checkpoint.pt.1.tmp.pt").write_bytes(b"half a checkpoint")
    with open(run / "log.csv", "a") as file:
        file.write(f"{at + 100},1.0,0.1,0.1,0.1,3\n{at + 1}")  # a row past the checkpoint, and half a row
    train(config(), bounce_dataset, run)
    assert not (run / ".checkpoint.pt.1.tmp.pt").exists()
    assert_same_run(run, unbroken)


FORKS = (
    SLOW
    + """
instants = random.Random({seed})
killed = 0
while killed < {kills}:
    child = os.fork()
    if child == 0:
        Trainer(Config.model_validate_json({config!r}), {data!r}, {run!r}).run()
        os._exit(0)
    time.sleep(instants.uniform(0.02, 0.3))
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        killed += 1
    else:
        break
print(killed)
"""
)


def test_killed_at_twenty_random_instants(unbroken: Path, bounce_dataset: Path, tmp_path: Path) -> None:
    """kill -9 wherever it hits: before the first checkpoint, in a write, in a validation. A run that ends first is begun anew."""
    root, killed, run, seed = Path(training.__file__).parents[1], 0, tmp_path / "run", 0
    while killed < 20:
        run, seed = tmp_path / f"run-{seed}", seed + 1
        code = FORKS.format(here=str(Path(__file__).parent), root=str(root), config=config().model_dump_json(), data=str(bounce_dataset),
                            run=str(run), seed=seed, kills=20 - killed)  # fmt: skip
        child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
        assert child.returncode == 0, child.stderr
        killed += int(child.stdout)
        train(config(), bounce_dataset, run)
        assert_same_run(run, unbroken)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_with_a_checkpoint(unbroken: Path, bounce_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """A signal in a step, then one in a validation rollout; the run ends bitwise like the unbroken one."""
    loss, advance = dummy_model.Dummy.loss, dummy_model.Dummy.advance

    def interrupted_loss(self, *arguments):
        if self.calls == 36:
            os.kill(os.getpid(), number)
        return loss(self, *arguments)

    def interrupted_advance(self):
        if not os.path.exists(tmp_path / "once"):
            (tmp_path / "once").touch()
            os.kill(os.getpid(), number)
        return advance(self)

    before = signal.getsignal(number)
    monkeypatch.setattr(dummy_model.Dummy, "loss", interrupted_loss)
    monkeypatch.setattr(dummy_model.Dummy, "advance", interrupted_advance)
    for step in (37, 60):
        with pytest.raises(RunError, match=rf"{signal.Signals(number).name} at step {step}; .* resume"):
            train(config(), bounce_dataset, tmp_path / "run")
        assert load_state(tmp_path / "run" / "checkpoint.pt")["progress"]["step"] == step
        monkeypatch.setattr(dummy_model.Dummy, "loss", loss)
    assert signal.getsignal(number) is before
    train(config(), bounce_dataset, tmp_path / "run")
    assert_same_run(tmp_path / "run", unbroken)


def test_another_configuration_is_refused(unbroken: Path, bounce_dataset: Path) -> None:
    before = {path.name: path.read_bytes() for path in unbroken.iterdir()}
    with pytest.raises(InputError, match=r"checkpoint\.pt: config\.training\.batch = 3: .*another --out"):
        train(config(batch=3), bounce_dataset, unbroken)
    with pytest.raises(InputError, match=r"config\.settings\.noise = 0\.2"):
        train(Config(model="dummy", settings={"noise": 0.2}, training=config().training, data=config().data), bounce_dataset, unbroken)
    assert {path.name: path.read_bytes() for path in unbroken.iterdir()} == before


def test_another_data_set_is_refused(unbroken: Path, bounce_dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    for name in ("train", "valid"):
        (tmp_path / "data" / name).symlink_to(bounce_dataset / name)
    content = json.loads((bounce_dataset / "dataset.json").read_text())
    content["statistics"]["velocity_std"][0] *= 2
    (tmp_path / "data" / "dataset.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"spec\.velocity_std"):
        train(config(), tmp_path / "data", unbroken)


@pytest.mark.parametrize("damage", ["truncated", "text", "optimizer", "progress", "generator", "nan"])
def test_a_damaged_training_state_is_an_input_error(unbroken: Path, bounce_dataset: Path, tmp_path: Path, damage: str) -> None:
    run, raw = tmp_path / "run", (unbroken / "checkpoint.pt").read_bytes()
    run.mkdir()
    if damage in ("truncated", "text"):
        (run / "checkpoint.pt").write_bytes(raw[: len(raw) // 2] if damage == "truncated" else b"nothing")
    else:
        state = load_state(unbroken / "checkpoint.pt")
        if damage == "optimizer":
            state["optimizer"]["mean"] = state["optimizer"]["mean"][:1]
        elif damage == "progress":
            state["progress"]["step"] = "many"
        elif damage == "generator":
            state["generator"] = torch.zeros(3, dtype=torch.uint8)
        else:
            state["average"]["linear.bias"].fill_(math.nan)
        torch.save(state, run / "checkpoint.pt")
    with pytest.raises(InputError, match="checkpoint.pt"):
        train(config(), bounce_dataset, run)
    assert [path.name for path in run.iterdir()] == ["checkpoint.pt"]


def test_a_loss_that_is_not_finite_stops_the_run(bounce_dataset: Path, tmp_path: Path) -> None:
    broken = Config(model="dummy", settings={"nan_at": 0.6}, training=config().training)
    with pytest.raises(RunError, match=r"step 144: loss = nan.*learning_rate"):
        train(broken, bounce_dataset, tmp_path / "run")
    assert not (tmp_path / "run" / "done.json").exists()
    state = load_state(tmp_path / "run" / "checkpoint.pt")
    assert state["progress"]["step"] == 136 and all(torch.isfinite(value).all() for value in state["model"].values())
    assert load_model(tmp_path / "run" / "best.pt")


def test_a_full_disk_stops_the_run_in_one_line(unbroken: Path, bounce_dataset: Path, tmp_path: Path) -> None:
    """It fills up under the tables, checkpoints, the best model: what is there is whole, and with room the run ends as one that had room."""
    disk, stages, pages = tmp_path / "disk", [()], 0
    run = disk / "run"
    with small_disk(disk) as leave:
        while not (run / "done.json").exists():
            leave(4096 * pages)
            try:
                train(config(), bounce_dataset, run)
            except RunError as error:
                assert str(error) == f"{run}: cannot be written (No space left on device); mend that and give the same command again to resume"
            present = tuple(sorted(path.name for path in run.glob("*.pt")))
            assert not list(run.glob(".*")) and ("checkpoint.pt" not in present or load_state(run / "checkpoint.pt"))
            assert "best.pt" not in present or load_model(run / "best.pt")
            if present == stages[-1]:
                pages += 1  # it came no further with what there was
            stages.append(present)
        assert {(), ("checkpoint.pt",), ("best.pt", "checkpoint.pt")} <= set(stages) and pages > 3
        assert_same_run(unbroken, run)


def test_a_budget_in_minutes(bounce_dataset: Path, tmp_path: Path) -> None:
    """Progress is elapsed time: it ends in time, the learning rate reaches its floor, and the budget counts the whole run."""
    done = train(config(steps=None, minutes=0.04, checkpoint_every=None, validations=3), bounce_dataset, tmp_path / "run")
    assert 2.4 <= done["seconds"] < 10 and done["steps"] > 10
    log = rows(tmp_path / "run" / "log.csv")
    assert float(log[-1]["learning_rate"]) < 1e-3 and {row["window"] for row in log} == {"3", "4"}
    assert 1 <= len(rows(tmp_path / "run" / "validation.csv")) <= 3


def test_validate_every(bounce_dataset: Path, tmp_path: Path) -> None:
    train(config(steps=50, validate_every=20), bounce_dataset, tmp_path / "run")
    assert [row["step"] for row in rows(tmp_path / "run" / "validation.csv")] == ["20", "40", "50"]


def test_rollouts_that_fail_are_never_best_but_a_model_is_left(bounce_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dummy_model.Dummy, "advance", lambda self: np.full((1, *self.state.shape[1:]), np.nan, np.float32))
    done = train(config(steps=40), bounce_dataset, tmp_path / "run")
    found = rows(tmp_path / "run" / "validation.csv")
    assert [(row["rollout_mse"], row["finished"], row["best"]) for row in found] == [("inf", "0.0", "1")] + [("inf", "0.0", "0")] * 3
    assert done["best_step"] == 10 and load_model(tmp_path / "run" / "best.pt")


def test_adam_is_the_published_rule() -> None:
    """Against Algorithm 2 of Loshchilov and Hutter (2019), written out in float64; a parameter without gradient stays."""
    torch.manual_seed(0)
    weight, unused = torch.nn.Parameter(torch.randn(5, 3)), torch.nn.Parameter(torch.ones(2))
    mine, kept = Adam([unused, weight], weight_decay=0.1), unused.detach().clone()
    expected, mean, square = weight.detach().double(), 0.0, 0.0
    for t in range(1, 21):
        gradient, rate = torch.randn(5, 3), 1e-2 / t
        weight.grad = gradient.clone()
        mine.step(rate)
        mean, square = 0.9 * mean + 0.1 * gradient.double(), 0.999 * square + 0.001 * gradient.double() ** 2
        step = (mean / (1 - 0.9**t)) / ((square / (1 - 0.999**t)).sqrt() + 1e-8)
        expected = expected - rate * (step + 0.1 * expected)
    torch.testing.assert_close(weight.detach().double(), expected, rtol=1e-5, atol=1e-6)
    assert torch.equal(unused, kept)


def test_muon_makes_singular_values_alike() -> None:
    """U diag(s) V^T -> U diag(s') V^T with s' near 1, for wide, tall and several matrices; nothing comes of nothing."""
    generator = torch.Generator().manual_seed(0)
    optimizer = Muon([], 0.0)
    for shape in ((20, 48), (48, 20), (16, 16)):
        left, _, right = torch.linalg.svd(torch.randn(3, *shape, generator=generator), full_matrices=False)
        values = torch.linspace(0.1, 1.0, min(shape)) * torch.tensor([1e-6, 1.0, 1e6])[:, None]
        found = left.mT @ optimizer.orthogonal(left * values[:, None] @ right) @ right.mT
        diagonal = found.diagonal(dim1=1, dim2=2)
        assert diagonal.min() > 0.6 and diagonal.max() < 1.25
        torch.testing.assert_close(found, torch.diag_embed(diagonal), rtol=0, atol=1e-4)
    assert not optimizer.orthogonal(torch.zeros(2, 16, 20)).any()


def test_muon_steps_matrices_and_leaves_the_rest_to_adam() -> None:
    """Its rule written out, a stencil's leading axis taken as rows; a bias goes Adam's way; what has no gradient stays; a restored run goes on."""
    torch.manual_seed(0)

    def parameters() -> list[torch.nn.Parameter]:
        generator = torch.Generator().manual_seed(1)
        return [torch.nn.Parameter(torch.randn(*shape, generator=generator)) for shape in ((9, 16, 20), (20, 30), (20, 30), (40,), (2, 30))]

    mine, adams, resumed = parameters(), parameters(), parameters()
    muon, adam = Muon(mine, weight_decay=0.1), Adam(adams[3:], weight_decay=0.1)
    assert [tuple(momentum.shape) for momentum in muon.momentum] == [(1, 144, 20), (2, 20, 30)]
    unused, expected, momentum = mine[1].detach().clone(), mine[0].detach().clone().view(144, 20), torch.zeros(144, 20)
    for t in range(1, 7):
        rate = 0.05 / t
        for k, parameter in enumerate(mine):
            parameter.grad = None if k == 1 else torch.randn(parameter.shape)
        for one, other in zip(adams[3:], mine[3:], strict=True):
            one.grad = other.grad.clone()
        gradient = mine[0].grad.view(144, 20)
        momentum = 0.95 * momentum + 0.05 * gradient
        expected = expected * (1 - 0.1 * rate) - rate * 0.2 * 12 * muon.orthogonal((0.05 * gradient + 0.95 * momentum)[None])[0]
        if t == 6:
            for one, other in zip(resumed, mine, strict=True):
                one.data.copy_(other)
                one.grad = None if other.grad is None else other.grad.clone()
            fresh = Muon(resumed, weight_decay=0.1)
            fresh.restore({key: [value.clone() for value in values] for key, values in muon.state().items()})
            fresh.step(rate)
        muon.step(rate)
        adam.step(rate)
    torch.testing.assert_close(mine[0].detach().view(144, 20), expected, rtol=1e-4, atol=1e-5)
    assert torch.equal(mine[1], unused) and all(torch.equal(*pair) for pair in zip(mine[3:], adams[3:], strict=True))
    assert all(torch.equal(*pair) for pair in zip(mine, resumed, strict=True))
    with pytest.raises(ValueError):
        fresh.restore({**muon.state(), "momentum": muon.momentum[:1]})


def test_schedules() -> None:
    cosine = TrainSettings(steps=1000, learning_rate=1e-3, final_learning_rate=1e-5, warmup_steps=10)
    assert cosine.rate(0, 0.0) == pytest.approx(1e-4) and cosine.rate(9, 0.0) == pytest.approx(1e-3)
    assert cosine.rate(500, 0.5) == pytest.approx((1e-3 + 1e-5) / 2) and cosine.rate(1000, 1.0) == pytest.approx(1e-5)
    paper = TrainSettings(steps=20_000_000, schedule="exponential", warmup_steps=0)
    for step in (0, 10**6, 5 * 10**6, 2 * 10**7):
        assert paper.rate(step, step / 2e7) == pytest.approx(1e-6 + (1e-4 - 1e-6) * 0.1 ** (step / 5e6))


def write(path: Path, content: object) -> Path:
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


GOOD = {"model": "dummy", "settings": {"noise": 0.1}, "training": {"steps": 5}, "data": {"stride": 2}}


def test_variants_change_what_they_name(tmp_path: Path) -> None:
    path = write(tmp_path / "c.yaml", {**GOOD, "variants": {"quiet": {"settings": {"noise": 0.0}, "training": {"batch": 7}, "data": {"stride": 3}}}})
    plain, quiet = load_config(path), load_config(path, variant="quiet")
    assert plain == load_config(write(tmp_path / "d.yaml", GOOD))
    assert quiet.settings == {**plain.settings, "noise": 0.0} and quiet.data.stride == 3
    assert quiet.training == plain.training.model_copy(update={"batch": 7})
    for variants, key, said in ((GOOD | {"variants": {"quiet": {}}}, "loud", "quiet"), (GOOD, "loud", "there are none"),
                                (GOOD | {"variants": [1]}, None, "must map"), (GOOD | {"variants": {"a": 3}}, None, "must map")):  # fmt: skip
        with pytest.raises(InputError, match=said):
            load_config(write(tmp_path / "c.yaml", variants), variant=key)


def test_load_config(tmp_path: Path) -> None:
    loaded = load_config(write(tmp_path / "c.yaml", GOOD), {"minutes": 2.0, "seed": 4})
    assert loaded.training.steps is None and loaded.training.minutes == 2.0 and loaded.training.seed == 4 and loaded.data.stride == 2
    assert load_config(write(tmp_path / "c.yaml", "model: gns\ntraining: {steps: 5, learning_rate: 1e-3}\n")).training.learning_rate == 1e-3


@pytest.mark.parametrize(
    ("content", "key"),
    [
        ("", "file"),
        ("- 1", "file"),
        ("a: [", "line 1"),
        ("\x00", "file"),
        ("[" * 400, "line 1"),
        ({**GOOD, "modle": "x"}, "modle"),
        ({"model": "dummy"}, "training"),
        ({**GOOD, "training": {}}, "exactly one of steps and minutes"),
        ({**GOOD, "training": {"steps": 1, "minutes": 1}}, "exactly one"),
        ({**GOOD, "training": {"steps": 0}}, r"training\.steps = 0"),
        ({**GOOD, "training": {"steps": 1, "lr": 1}}, r"training\.lr"),
        ({**GOOD, "training": {"minutes": float("nan")}}, r"training\.minutes"),
        ({**GOOD, "training": {"steps": 1, "learning_rate": "fast"}}, r"training\.learning_rate = 'fast'"),
        ({**GOOD, "training": {"steps": 1, "final_learning_rate": 1}}, "final_learning_rate"),
        ({**GOOD, "data": {"stride": 0}}, r"data\.stride"),
        ({**GOOD, "training": 3}, "training"),
        ({**GOOD, "settings": [1]}, "settings"),
        ("a: &a [x, x, x, x, x, x]\nb: &b [*a, *a, *a, *a, *a]\ntraining: [*b, *b, *b]\nmodel: m", "training"),
    ],
)
def test_bad_configurations(tmp_path: Path, bounce_dataset: Path, content: object, key: str, capsys: pytest.CaptureFixture) -> None:
    path = write(tmp_path / "c.yaml", content)
    with pytest.raises(InputError, match=rf"c\.yaml: .*{key}"):
        load_config(path)
    assert main(["train", str(path), "--data", str(bounce_dataset), "--out", str(tmp_path / "run")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1 and not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("content", "key"),
    [
        ({**GOOD, "model": "gsn"}, "model = 'gsn'"),
        ({**GOOD, "settings": {"nose": 1}}, "nose"),
        ({**GOOD, "settings": {"noise": -1}}, "noise"),
        ({**GOOD, "data": {"stride": 30}}, "stride"),
        ({**GOOD, "training": {"steps": 5, "batch": 10**6}}, "batch"),
        ({**GOOD, "data": {"skip_rest": 1e9}}, "skip_rest"),
        ({**GOOD, "training": {"steps": 5, "tensorboard": True}}, "tensorboard is missing"),
    ],
)
def test_configurations_that_do_not_fit(
    tmp_path: Path, bounce_dataset: Path, content: dict, key: str, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "find_spec", lambda name: None)
    path = write(tmp_path / "c.yaml", content)
    assert main(["train", str(path), "--data", str(bounce_dataset), "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and key in error and not (tmp_path / "run").exists()


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=st.text(max_size=60))
def test_config_text_fuzz(tmp_path: Path, text: str) -> None:
    try:
        load_config(write(tmp_path / "c.yaml", text))
    except InputError as error:
        assert "\n" not in str(error)


def test_command_line(unbroken: Path, bounce_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """train, info and rollout on the same checkpoint; the rollout is a shard like the solver's, with its history from the truth."""
    path = write(tmp_path / "c.yaml", GOOD)
    assert main(["train", str(path), "--data", str(bounce_dataset), "--out", str(tmp_path / "run"), "--steps", "8", "--seed", "2"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == 8
    assert main(["info", str(tmp_path / "run" / "best.pt")]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["model"] == "dummy" and shown["parameters"] == 6 and shown["spec"]["stride"] == 2
    out = tmp_path / "rollouts" / "shard.h5"
    assert main(["rollout", str(unbroken / "best.pt"), "--data", str(bounce_dataset), "--count", "2", "--out", str(out)]) == 0
    cost = json.loads((tmp_path / "rollouts" / "shard.h5.cost.json").read_text())
    assert set(cost["trajectories"]) == {"000000", "000001"} and cost["trajectories"]["000000"]["frames"] == 38
    test = Dataset(bounce_dataset, "test")
    with ShardReader(out) as reader:
        assert reader.indices() == [0, 1]
        predicted, truth = reader.read(1), test.trajectory(1)
    assert predicted.position.shape == truth.position.shape and predicted.ok and predicted.scene == truth.scene
    assert np.array_equal(predicted.position[:2], truth.position[:2]) and not np.array_equal(predicted.position[2:], truth.position[2:])
    assert predicted.simulator["name"] == "dummy" and predicted.simulator["checkpoint"] == shown_hash(unbroken / "best.pt", capsys)
    again = tmp_path / "again.h5"
    assert main(["rollout", str(unbroken / "best.pt"), "--data", str(bounce_dataset), "--count", "2", "--out", str(again)]) == 0
    assert again.read_bytes() == out.read_bytes()


def shown_hash(path: Path, capsys: pytest.CaptureFixture) -> str:
    capsys.readouterr()
    assert main(["info", str(path)]) == 0
    return json.loads(capsys.readouterr().out)["sha256"]


def test_command_line_mistakes(unbroken: Path, bounce_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    checkpoint, data, out = str(unbroken / "best.pt"), ["--data", str(bounce_dataset)], tmp_path / "o.h5"
    (tmp_path / "taken.h5").touch()
    for arguments in (
        ["rollout", checkpoint, *data, "--split", "nowhere", "--out", str(out)],
        ["rollout", checkpoint, *data, "--count", "9", "--out", str(out)],
        ["rollout", str(bounce_dataset / "dataset.json"), *data, "--out", str(out)],
        ["rollout", checkpoint, "--data", str(tmp_path), "--out", str(out)],
        ["rollout", checkpoint, *data, "--out", str(tmp_path / "taken.h5")],
        ["info", str(tmp_path / "none.pt")],
        ["train", str(tmp_path / "none.yaml"), *data, "--out", str(out)],
        ["train", str(write(tmp_path / "c.yaml", GOOD)), *data, "--out", str(tmp_path / "taken.h5")],
    ):
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert error.startswith("sluice-learn: ") and len(error.splitlines()) == 1
    for arguments in (["rollout", checkpoint, *data, "--count", "0", "--out", str(out)], ["train"], []):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 2
    assert not out.exists() and not (tmp_path / "o.h5.cost.json").exists()


def test_rollouts_that_all_fail_are_written_and_end_with_one(unbroken: Path, bounce_dataset: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(dummy_model.Dummy, "advance", lambda self: np.full((1, *self.state.shape[1:]), np.nan, np.float32))
    out = tmp_path / "o.h5"
    assert main(["rollout", str(unbroken / "best.pt"), "--data", str(bounce_dataset), "--count", "1", "--out", str(out)]) == 1
    assert "all 1 rollouts failed" in capsys.readouterr().err
    with h5py.File(out) as file:
        assert file["000000/position"].shape[0] == 2 and "failed: non-finite" in file["000000"].attrs["meta"]


def test_a_model_of_other_data_is_refused(bounce_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    from learn.dataset import DataSpec
    from learn.model import build

    spec = Dataset(bounce_dataset, "train").spec(1).to_dict()
    for change in ({"frame_step": 0.5}, {"particle_types": (6,)}):
        save_model(tmp_path / "best.pt", build("dummy", {}, DataSpec(**(spec | change))))
        assert main(["rollout", str(tmp_path / "best.pt"), "--data", str(bounce_dataset), "--out", str(tmp_path / "o.h5")]) == 2
        assert next(iter(change)).split("_")[0] in capsys.readouterr().err


def test_help_does_not_import_torch() -> None:
    code = "import sys\nfrom learn.cli import main\ntry:\n    main(['train', '--help'])\nexcept SystemExit:\n    assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, cwd=Path(training.__file__).parents[1])
