"""The generator: reproducible bytes, resume after kill -9, quarantine, and every way a run can end."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))  # worker processes inherit it

from fake_teacher import AlwaysFailing, Broken, FakeTeacher, FullDisk, SometimesFailing, Suicidal  # noqa: E402
from tiny import FAMILY, family, hidden, shards, without_cost  # noqa: E402

import sim.generate  # noqa: E402
from sim.errors import InputError, RunError  # noqa: E402
from sim.generate import generate, simulate, training_statistics, trajectory_seed  # noqa: E402
from sim.trajectory import ShardReader, write_shard  # noqa: E402


def run_here(out, shards, jobs, teacher, progress):
    simulator = teacher()
    for shard in shards:
        sim.generate._make_shard(out, shard, simulator, 0.0, progress.trajectory)


@pytest.fixture
def here(monkeypatch):
    """Shards are made in this process: starting another takes a second, and not every test is about processes."""
    monkeypatch.setattr(sim.generate, "_run_workers", run_here)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """Six trajectories in shards of two, made in this process."""
    folder = tmp_path_factory.mktemp("data") / "tiny"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sim.generate, "_run_workers", run_here)
        generate(family(), {"train": 6}, folder, shard_size=2, teacher=FakeTeacher)
    return folder


def start_slow(folder, jobs=2):
    """The same six trajectories, slowly, in a process (group) of its own."""
    code = (
        "import sys; from sim.cli import main; import sim.generate as g; from fake_teacher import SlowTeacher\n"
        "g.generate.__kwdefaults__['teacher'] = SlowTeacher\n"
        "raise SystemExit(main(sys.argv[1:]))\n"
    )
    scene = folder.parent / "tiny.yaml"
    scene.write_text(json.dumps(FAMILY))
    arguments = ["generate", str(scene), "--split", "train", "--count", "6", "--shard-size", "2", "--jobs", str(jobs), "--out", str(folder)]
    environment = os.environ | {"PYTHONPATH": f"{HERE}:{HERE.parent.parent}"}
    # A shell ignores SIGINT in what it runs in the background, and children inherit that.
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


def wait_for(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "nothing happened"
        time.sleep(0.005)


def workers_of(process):
    return [int(line) for line in subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True).stdout.split()]


def alive(identity):
    try:
        return Path(f"/proc/{identity}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def test_seed_depends_on_base_split_and_index():
    seeds = {trajectory_seed(base, split, index) for base in (0, 1) for split in ("train", "valid", "test") for index in range(50)}
    assert len(seeds) == 300
    assert all(seed < 2**53 for seed in seeds)
    assert trajectory_seed(3, "valid", 7) == trajectory_seed(3, "valid", 7)


def test_data_set_as_documented(reference):
    content = json.loads((reference / "dataset.json").read_text())
    assert content["format_version"] == 1 and content["scene"] == "tiny" and content["family"]["frames"] == 12
    entry = content["splits"]["train"]
    assert entry["shards"] == [f"train/shard-0000{number}.h5" for number in range(3)]
    assert (entry["trajectories"], entry["ok"], entry["failed"]) == (6, 6, [])
    assert set(entry["cost"]) == {"wall_seconds", "compile_seconds"}
    assert all((reference / "train" / f"shard-0000{number}.cost.json").exists() for number in range(3))
    assert [ShardReader(reference / name).indices() for name in entry["shards"]] == [[0, 1], [2, 3], [4, 5]]
    assert not hidden(reference)


def test_a_trajectory_is_reproducible_alone(reference):
    scene = family().sample(trajectory_seed(0, "train", 3))
    alone = simulate(FakeTeacher(), scene)
    stored = ShardReader(reference / "train/shard-00001.h5").read(3)
    np.testing.assert_array_equal(alone.position, stored.position)
    assert stored.scene == scene.to_dict() and stored.seed == scene.seed and stored.ok
    assert stored.diagnostics["kinetic_energy"].shape == (12,)
    np.testing.assert_array_equal(stored.position[0], scene.particles(refine=1).position.astype(np.float32))


def test_bytes_do_not_depend_on_jobs(reference, tmp_path):
    generate(family(), {"train": 6}, tmp_path / "tiny", shard_size=2, jobs=3, teacher=FakeTeacher)
    assert shards(tmp_path / "tiny") == shards(reference)
    assert without_cost(tmp_path / "tiny") == without_cost(reference)


def test_statistics_are_those_of_plain_numpy(reference):
    paths = sorted((reference / "train").glob("*.h5"))
    trajectories = [reader.read(index) for reader in map(ShardReader, paths) for index in reader.indices()]
    velocity = np.concatenate([np.diff(t.position.astype(float), axis=0).reshape(-1, 2) for t in trajectories])
    acceleration = np.concatenate([np.diff(t.position.astype(float), n=2, axis=0).reshape(-1, 2) for t in trajectories])
    found = training_statistics(paths, jobs=2)
    np.testing.assert_allclose(found["velocity_mean"], velocity.mean(0), rtol=1e-9)
    np.testing.assert_allclose(found["velocity_std"], velocity.std(0), rtol=1e-9)
    np.testing.assert_allclose(found["acceleration_mean"], acceleration.mean(0), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found["acceleration_std"], acceleration.std(0), rtol=1e-9)
    sizes = [t.position.shape[1] for t in trajectories]
    assert found["particles"] == [min(sizes), np.mean(sizes), max(sizes)] and found["frames"] == 12
    assert found == json.loads((reference / "dataset.json").read_text())["statistics"]


def test_statistics_by_hand(tmp_path):
    """Three frames, a moving particle at 0, 1, 3 and a wall particle 0.5 beside it: v = 1, 2, a = 1; two neighbours, then one."""
    template = simulate(FakeTeacher(), family().sample(0))
    position = np.zeros((3, 2, 2), np.float32)
    position[:, 0, 0] = [0, 1, 3]
    position[:, 1, 0] = 0.5
    fields = template.__dict__ | {"position": position, "particle_type": np.array([5, 3], np.int8), "radius": 0.6, "diagnostics": {}}
    write_shard(tmp_path / "shard.h5", {0: type(template)(**fields)})
    found = training_statistics([tmp_path / "shard.h5"])
    assert found["velocity_mean"] == [1.5, 0.0] and found["velocity_std"] == [0.5, 0.0]
    assert found["acceleration_mean"] == [1.0, 0.0] and found["acceleration_std"] == [0.0, 0.0]
    assert found["neighbours"] == pytest.approx((2 + 2 + 1) / 3)


@pytest.mark.parametrize("victim", ["everything", "parent alone"])
def test_resume_after_kill_9_gives_the_same_bytes(reference, tmp_path, victim, here):
    folder = tmp_path / "tiny"
    process = start_slow(folder)
    wait_for(lambda: (folder / "train/shard-00000.h5").exists() or process.poll() is not None)
    workers = workers_of(process)
    assert workers
    if victim == "everything":
        os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
    process.wait()
    wait_for(lambda: not any(map(alive, workers)))
    before = shards(folder)
    assert 0 < len(before) < 3
    assert json.loads((folder / "dataset.json").read_text())["splits"] == {}
    (folder / "train" / ".shard-00002.h5.123.tmp.h5").write_bytes(b"what a kill leaves")
    generate(family(), {"train": 6}, folder, shard_size=2, teacher=FakeTeacher)
    assert shards(folder) == shards(reference)
    assert without_cost(folder) == without_cost(reference)
    assert not hidden(folder)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_ends_the_workers_and_leaves_no_temporaries(tmp_path, number, code):
    folder = tmp_path / "tiny"
    process = start_slow(folder)
    wait_for(lambda: (folder / "train/shard-00000.h5").exists() or process.poll() is not None)
    workers = workers_of(process)
    os.killpg(process.pid, number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == code
    assert "the same command continues" in errors and "Traceback" not in errors
    wait_for(lambda: not any(map(alive, workers)), 5)  # one of them is Python's own resource tracker, which ends by itself
    assert not hidden(folder)
    assert shards(folder)


def test_a_killed_worker_is_noticed(tmp_path):
    with pytest.raises(RunError, match=r"signal 9 \(SIGKILL.*run the same command again"):
        generate(family(), {"train": 4}, tmp_path / "tiny", shard_size=1, jobs=2, teacher=Suicidal)
    assert not hidden(tmp_path)


def test_disk_full_is_one_line_and_finished_shards_stay(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(sim.generate, "_run_workers", run_here)
        generate(family(), {"train": 2}, tmp_path / "tiny", shard_size=2, teacher=FakeTeacher)
    before = shards(tmp_path / "tiny")
    with pytest.raises(RunError, match="shard-00001.h5: cannot be written: File too large") as caught:
        generate(family(), {"train": 6}, tmp_path / "tiny", shard_size=2, teacher=FullDisk)
    assert "\n" not in str(caught.value)
    assert shards(tmp_path / "tiny") == before and not hidden(tmp_path)


def test_a_fault_of_ours_is_one_line(tmp_path, capfd):
    with pytest.raises(RunError, match="KeyError") as caught:
        generate(family(), {"train": 1}, tmp_path / "tiny", teacher=Broken)
    assert "\n" not in str(caught.value)
    assert "Traceback" in capfd.readouterr().err


def test_failures_are_quarantined(tmp_path, here):
    content = generate(family(), {"train": 12}, tmp_path / "tiny", shard_size=1, teacher=SometimesFailing)
    entry = content["splits"]["train"]
    failed = {failure["index"]: failure for failure in entry["failed"]}
    for index in range(12):
        seed = trajectory_seed(0, "train", index)
        if seed % 2:
            assert failed[index]["status"] == "failed: time step at its floor (frame 4)"
        elif seed % 4 == 0:
            assert failed[index]["status"] == "failed: non-finite position (frame 5)"
        else:
            assert index not in failed
        assert index not in failed or failed[index]["seed"] == seed
    assert 0 < entry["ok"] == 12 - len(failed) == len(entry["shards"])
    stored = [index for name in entry["shards"] for index in ShardReader(tmp_path / "tiny" / name).indices()]
    assert sorted([*stored, *failed]) == list(range(12))
    again = generate(family(), {"train": 12}, tmp_path / "tiny", shard_size=1, teacher=Suicidal)
    assert again["splits"] == content["splits"], "nothing may run again"


def test_a_failed_trajectory_keeps_its_finite_frames():
    seed = next(seed for seed in range(1, 100, 2))
    trajectory = simulate(SometimesFailing(), family().sample(seed))
    assert not trajectory.ok and len(trajectory.position) == 4
    assert np.isfinite(trajectory.position).all()
    assert all(len(values) == 4 for values in trajectory.diagnostics.values())


def test_all_failing_is_an_error(tmp_path, here):
    with pytest.raises(RunError, match="all 3 trajectories of train failed; the first: failed: time step at its floor"):
        generate(family(), {"train": 3}, tmp_path / "tiny", teacher=AlwaysFailing)
    content = json.loads((tmp_path / "tiny/dataset.json").read_text())
    assert content["splits"]["train"]["ok"] == 0 and content["statistics"] is None


def test_nothing_is_written_for_a_scene_that_cannot_be_sampled(tmp_path):
    box = {"material": "water", "shape": {"kind": "box", "size": [0.2, 0.2]}, "center": [0.05, 0.5]}
    with pytest.raises(InputError, match=r"tiny.yaml: bodies\[0\] = .*outside the box"):
        generate(family(bodies=[box]), {"train": 20}, tmp_path / "tiny", teacher=FakeTeacher)
    assert not (tmp_path / "tiny").exists()


@pytest.mark.parametrize(
    ("changes", "options", "key"),
    [
        ({"frames": 13}, {}, "family.frames"),
        ({"gravity": [0.0, -5.0]}, {}, "family.gravity"),
        ({}, {"seed": 1}, "seed"),
        ({}, {"shard_size": 3}, "shard_size"),
        ({"materials": {"water": {"model": "water", "sound_speed": 6.0}}}, {}, "sound_speed"),
    ],
)
def test_a_folder_made_with_other_settings_is_refused(reference, changes, options, key):
    before = {path: path.stat().st_mtime_ns for path in reference.rglob("*")}
    with pytest.raises(InputError, match=rf"dataset\.json: \S*{key} = .*give another --out"):
        generate(family(**changes), {"train": 6}, reference, **({"shard_size": 2} | options), teacher=FakeTeacher)
    assert {path: path.stat().st_mtime_ns for path in reference.rglob("*")} == before


def test_fewer_trajectories_than_there_are_is_refused(reference):
    for count in (5, 4):
        with pytest.raises(InputError, match="already holds more"):
            generate(family(), {"train": count}, reference, shard_size=2, teacher=FakeTeacher)


def test_extending_gives_the_bytes_of_one_run(reference, tmp_path, here):
    """The last shard of three is half full before and is made again; splits may differ, they change no trajectory."""
    generate(family(), {"train": 3}, tmp_path / "tiny", shard_size=2, teacher=FakeTeacher)
    generate(family(), {"train": 6}, tmp_path / "tiny", shard_size=2, teacher=FakeTeacher)
    assert shards(tmp_path / "tiny") == shards(reference)
    assert without_cost(tmp_path / "tiny") == without_cost(reference)


@pytest.mark.parametrize("damage", ["truncated", "garbage", "nan", "no cost", "missing"])
def test_damaged_shards_are_made_again(reference, tmp_path, here, damage, capfd):
    folder = tmp_path / "tiny"
    (folder / "train").mkdir(parents=True)
    for path in (*reference.glob("*.json"), *reference.glob("train/*")):
        (folder / path.relative_to(reference)).write_bytes(path.read_bytes())
    shard = folder / "train/shard-00001.h5"
    data = shard.read_bytes()
    if damage == "truncated":
        shard.write_bytes(data[: len(data) // 2])
    elif damage == "garbage":
        shard.write_bytes(b"garbage" * 100)
    elif damage == "nan":
        import h5py

        with h5py.File(shard, "r+") as file:
            file["000002/position"][3, 0, 0] = np.nan
    elif damage == "no cost":
        shard.with_suffix(".cost.json").unlink()
    else:
        shard.unlink()
    generate(family(), {"train": 6}, folder, shard_size=2, teacher=FakeTeacher)
    assert shards(folder) == shards(reference)


def test_foreign_folders_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is not a folder"):
        generate(family(), {"train": 1}, tmp_path / "file", teacher=FakeTeacher)
    with pytest.raises(InputError, match="cannot be written"):
        generate(family(), {"train": 1}, tmp_path / "file" / "below", teacher=FakeTeacher)
    (tmp_path / "other/train").mkdir(parents=True)
    (tmp_path / "other/train/shard-00000.h5").write_bytes(b"")
    with pytest.raises(InputError, match="missing beside the shards"):
        generate(family(), {"train": 1}, tmp_path / "other", teacher=FakeTeacher)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/dataset.json").write_text('{"format_version": 1}')
    with pytest.raises(InputError, match="missing or of the wrong kind"):
        generate(family(), {"train": 1}, tmp_path / "broken", teacher=FakeTeacher)


def test_two_runs_on_one_folder(tmp_path, here):
    """The same split: the second is refused. Other splits side by side: dataset.json describes all of them in the end."""
    folder = tmp_path / "tiny"
    process = start_slow(folder)
    try:
        wait_for(lambda: (folder / "train").exists() and workers_of(process))
        with pytest.raises(InputError, match="another run is writing here"):
            generate(family(), {"train": 6}, folder, shard_size=2, teacher=FakeTeacher)
        generate(family(), {"valid": 2}, folder, shard_size=2, teacher=FakeTeacher)
    finally:
        assert process.wait(timeout=60) == 0
        process.stderr.close()
    assert set(json.loads((folder / "dataset.json").read_text())["splits"]) == {"train", "valid"}


def test_the_solver_gives_a_trajectory_the_same_bits_alone_and_in_company():
    """Fields made for a larger scene, or left over from another, must not show."""
    from sim.mpm.solver import MPMSimulator

    scenes = [family(frames=30).sample(seed) for seed in (1, 2, 3)]
    scenes.sort(key=lambda scene: len(scene.particle_type()))
    company = MPMSimulator()
    company.load(family(frames=30, bodies=[{"material": "water", "shape": {"kind": "box", "size": [0.8, 0.8]}}]).sample(0))
    together = [simulate(company, scene) for scene in reversed(scenes)][::-1]
    alone = simulate(MPMSimulator(), scenes[0])
    np.testing.assert_array_equal(together[0].position, alone.position)
    assert all(np.array_equal(together[0].diagnostics[name], alone.diagnostics[name]) for name in alone.diagnostics)
