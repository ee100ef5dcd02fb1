from __future__ import annotations

import dataclasses
import json
import shutil
from collections import Counter
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from learn.dataset import Dataset, DataSettings, DataSpec, Sampler
from sim.errors import InputError
from sim.trajectory import Trajectory, write_shard


def trajectory(position: np.ndarray, kinds: list[int] | None = None, context: np.ndarray | None = None, **changes) -> Trajectory:
    """A trajectory in the box [0, 1]^2 from hand-written positions [frames, particles, 2]."""
    position = np.asarray(position, np.float32)
    scene = {"spacing": 0.1, "gravity": [0.0, -1.0], **changes.pop("scene", {})}
    values = dict(
        position=position,
        particle_type=np.asarray(kinds or [5] * position.shape[1], np.int8),
        frame_step=0.1,
        radius=0.2,
        bounds=np.array([[0.0, 1.0]] * 2),
        scene=scene,
        seed=0,
        simulator={"name": "hand"},
        context=context,
    )
    return Trajectory(**(values | changes))


def ramp(frames: int, particles: int, offset: float = 0.0) -> np.ndarray:
    """x of particle p in frame t is offset + t / 100 + p / 10, y is half of it: every entry tells where it is from."""
    x = offset + np.arange(frames)[:, None] / 100 + np.arange(particles)[None] / 10
    return np.stack([x, x / 2], axis=2)


def test_window_content(tmp_path: Path, write_dataset) -> None:
    """Two windows of two trajectories at stride 3, checked entry by entry."""
    context = np.arange(10, dtype=np.float32)[:, None] * [1.0, 10.0]
    one, two = trajectory(ramp(10, 2), [5, 3], context), trajectory(ramp(10, 3, 0.5), [5, 5, 6], context + 1)
    dataset = Dataset(write_dataset(tmp_path, {"train": {0: one, 1: two}}), "train")
    windows = dataset.batch(np.array([[1, 2], [0, 0]]), frames=3, stride=3)
    assert windows.position.shape == (3, 5, 2) and windows.position.dtype == torch.float32
    np.testing.assert_allclose(windows.position[0, :, 0], [0.52, 0.62, 0.72, 0.0, 0.1], atol=1e-6)
    np.testing.assert_allclose(windows.position[2, :, 1], [0.29, 0.34, 0.39, 0.03, 0.08], atol=1e-6)
    assert windows.particle_type.tolist() == [5, 5, 6, 5, 3] and windows.particle_type.dtype == torch.int64
    assert windows.example.tolist() == [0, 0, 0, 1, 1] and windows.examples == 2
    assert windows.context[:, 0].tolist() == [[3, 21], [6, 51], [9, 81]]
    assert windows.context[:, 1].tolist() == [[0, 0], [3, 30], [6, 60]]
    moved = windows.to("cpu")
    assert torch.equal(moved.position, windows.position) and moved.examples == 2


def test_mirror_flips_a_copy(tmp_path: Path, write_dataset) -> None:
    dataset = Dataset(write_dataset(tmp_path, {"train": {0: trajectory(ramp(6, 2))}}), "train")
    rows = np.array([[0, 1], [0, 1]])
    plain = dataset.batch(rows, 3)
    flipped = dataset.batch(rows, 3, mirror=np.array([[True, False], [False, False]]))
    np.testing.assert_allclose(flipped.position[:, :2, 0], 1 - plain.position[:, :2, 0], atol=1e-7)
    assert torch.equal(flipped.position[:, :2, 1], plain.position[:, :2, 1])
    assert torch.equal(flipped.position[:, 2:], plain.position[:, 2:])
    assert torch.equal(dataset.batch(rows, 3).position, plain.position)


def test_sampler_mirrors_only_axes_without_gravity(bounce_dataset: Path) -> None:
    dataset = Dataset(bounce_dataset, "train")
    plain, mirrored = (Sampler(dataset, DataSettings(mirror=mirror), 16, 3) for mirror in (False, True))
    one, two = plain.next(3), mirrored.next(3)
    # The two draw the same windows, because the permutation is drawn first.
    assert torch.equal(one.position[..., 1], two.position[..., 1])
    before, after = (windows.position[..., 0].reshape(3, 16, 24) for windows in (one, two))
    flipped = [not torch.equal(before[:, k], after[:, k]) for k in range(16)]
    assert 0 < sum(flipped) < 16
    np.testing.assert_allclose(after[:, flipped], 1 - before[:, flipped], atol=1e-6)  # the box is [0.1, 0.9]


def test_mirror_refuses_a_context(tmp_path: Path, write_dataset) -> None:
    folder = write_dataset(tmp_path, {"train": {0: trajectory(ramp(6, 2), context=np.ones((6, 1), np.float32))}})
    with pytest.raises(InputError, match="mirror"):
        Sampler(Dataset(folder, "train"), DataSettings(mirror=True), 1, 0)


@pytest.mark.parametrize("stride", [1, 2, 5])
def test_statistics_against_numpy(bounce_dataset: Path, stride: int) -> None:
    train = Dataset(bounce_dataset, "train")
    found = train.statistics(stride)
    positions = [train.trajectory(number).position.astype(float) for number in range(len(train))]
    velocity = np.concatenate([(p[stride:] - p[:-stride]).reshape(-1, 2) for p in positions])
    acceleration = np.concatenate([(p[2 * stride :] - 2 * p[stride:-stride] + p[: -2 * stride]).reshape(-1, 2) for p in positions])
    for name, value in {"velocity": velocity, "acceleration": acceleration}.items():
        np.testing.assert_allclose(found[f"{name}_mean"], value.mean(0), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found[f"{name}_std"], value.std(0), rtol=1e-7)


def test_stride_one_is_what_the_generator_wrote(bounce_dataset: Path) -> None:
    for split in ("train", "valid"):
        spec = Dataset(bounce_dataset, split).spec(1)
        for name, value in Dataset(bounce_dataset, "train").statistics(1).items():
            np.testing.assert_allclose(getattr(spec, name), value, rtol=1e-7, atol=1e-10)
    assert spec.stride == 1 and spec.particle_types == (5,) and spec.gravity == (0.0, -9.81) and spec.context_mean is None


def test_statistics_leave_out_kinematic_particles_and_know_the_context(tmp_path: Path, write_dataset) -> None:
    still = np.concatenate([ramp(8, 2), np.full((8, 3, 2), 0.5)], axis=1)
    context = np.random.default_rng(0).normal(size=(8, 2)).astype(np.float32)
    folder = write_dataset(tmp_path, {"train": {0: trajectory(still, [5, 5, 3, 3, 3], context)}})
    spec = Dataset(folder, "train").spec(2)
    np.testing.assert_allclose(spec.velocity_mean, [0.02, 0.01], atol=1e-7)
    np.testing.assert_allclose(spec.velocity_std, [0, 0], atol=1e-7)
    assert spec.particle_types == (3, 5)
    np.testing.assert_allclose(spec.context_mean, context.mean(0), rtol=1e-6)
    np.testing.assert_allclose(spec.context_std, context.std(0), rtol=1e-6)


def test_spec_survives_json(bounce_dataset: Path) -> None:
    spec = Dataset(bounce_dataset, "train").spec(3)
    assert DataSpec.from_dict(json.loads(json.dumps(spec.to_dict()))) == spec


SPEC = {
    "dim": 2,
    "bounds": [[0, 1], [0, 1]],
    "radius": 0.1,
    "spacing": 0.05,
    "frame_step": 0.01,
    "stride": 1,
    "gravity": [0, -1],
    "particle_types": [5],
    "velocity_mean": [0, 0],
    "velocity_std": [1, 1],
    "acceleration_mean": [0, 0],
    "acceleration_std": [1, 1],
    "context_mean": None,
    "context_std": None,
}
SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
JSON = st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=3), max_leaves=4)


@pytest.mark.parametrize(
    "change",
    [
        {"dim": 4},
        {"dim": 3},
        {"bounds": [[1, 0], [0, 1]]},
        {"radius": 0},
        {"radius": float("nan")},
        {"stride": 1.5},
        {"stride": True},
        {"particle_types": []},
        {"particle_types": [6, 5]},
        {"particle_types": [9]},
        {"velocity_std": [1, -1]},
        {"context_mean": [1.0]},
        {"more": 1},
    ],
)
def test_spec_refuses(change: dict) -> None:
    with pytest.raises(InputError, match="there"):
        DataSpec.from_dict(SPEC | change, "there")


@settings(max_examples=60, deadline=None)
@given(st.dictionaries(st.sampled_from(sorted(SPEC)), JSON, max_size=3))
def test_spec_fuzz(change: dict) -> None:
    try:
        DataSpec.from_dict(SPEC | change)
    except InputError as error:
        assert "\n" not in str(error)


def test_an_epoch_is_a_permutation(bounce_dataset: Path) -> None:
    """Every window once in an epoch, epochs in different orders, none of them sorted."""
    dataset = Dataset(bounce_dataset, "train")
    windows = dataset.windows(4, 2)
    assert len(windows) == 5 * (40 - 3 * 2) and windows[:, 1].max() == 33
    sampler, seen = Sampler(dataset, DataSettings(stride=2), 10, 7), []
    for _ in range(2 * len(windows) // 10):
        position = sampler.next(4).position.reshape(4, 10, 24, 2)
        seen += [position[:, k].numpy().tobytes() for k in range(10)]
    truth = {dataset.batch(row[None], 4, 2).position.numpy().tobytes(): tuple(row) for row in windows}
    first, second = [truth[key] for key in seen[: len(windows)]], [truth[key] for key in seen[len(windows) :]]
    assert Counter(first) == Counter(second) == Counter(map(tuple, windows))
    assert first != second and first != sorted(first)
    # Global: a batch of ten draws from three trajectories or more on average.
    assert np.mean([len({row[0] for row in first[k : k + 10]}) for k in range(0, len(first), 10)]) > 3


def test_sampler_resumes_bitwise(bounce_dataset: Path) -> None:
    dataset, options = Dataset(bounce_dataset, "train"), DataSettings(mirror=True, skip_rest=0.1)
    unbroken = Sampler(dataset, options, 8, 5)
    lengths = [3] * 30 + [5] * 30
    batches = [unbroken.next(frames) for frames in lengths]
    broken = Sampler(dataset, options, 8, 5)
    for stop, frames in enumerate(lengths):
        if stop % 7 == 0:
            state = json.loads(json.dumps(broken.state()))
            broken = Sampler(dataset, options, 8, 5)
            broken.restore(state)
        assert torch.equal(broken.next(frames).position, batches[stop].position)
    assert not torch.equal(Sampler(dataset, options, 8, 6).next(3).position, batches[0].position)


def test_skip_rest_leaves_out_the_windows_at_rest(tmp_path: Path, write_dataset) -> None:
    """Moves for frames 0..9, rests for 10..29: windows that lie in the rest are left out, and no other."""
    path = np.concatenate([ramp(10, 2), np.repeat(ramp(10, 2)[-1:], 20, axis=0)])
    dataset = Dataset(write_dataset(tmp_path, {"train": {0: trajectory(path)}}), "train")
    assert len(dataset.windows(4)) == 27
    kept = dataset.windows(4, skip_rest=0.2)
    assert kept[:, 1].tolist() == list(range(9))
    with pytest.raises(InputError, match="skip_rest"):
        dataset.windows(4, skip_rest=1e3)
    late = Dataset(write_dataset(tmp_path / "late", {"train": {0: trajectory(np.concatenate([np.repeat(path[:1], 5, axis=0), path]))}}), "train")
    assert late.windows(4, skip_rest=0.2)[:, 1].tolist() == list(range(14)), "the rest before the first motion stays"


def test_small_memory_reads_from_disk_and_agrees(bounce_dataset: Path) -> None:
    kept, lazy = Dataset(bounce_dataset, "train"), Dataset(bounce_dataset, "train", memory=0)
    rows = kept.windows(4, 3)[::11]
    assert torch.equal(kept.batch(rows, 4, 3).position, lazy.batch(rows, 4, 3).position)
    assert lazy.spec(2) == kept.spec(2) and not lazy._positions


def test_failed_trajectories_are_left_out(tmp_path: Path, write_dataset) -> None:
    failed = dataclasses.replace(trajectory(ramp(6, 2)), status="failed: NaN (frame 6)")
    dataset = Dataset(write_dataset(tmp_path, {"train": {0: trajectory(ramp(6, 2)), 1: failed, 2: trajectory(ramp(6, 3))}}), "train")
    assert len(dataset) == 2 and dataset.trajectory(1).position.shape == (6, 3, 2)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"radius": 0.3}, "radius"),
        ({"frame_step": 0.2}, "frame_step"),
        ({"bounds": np.array([[0, 2], [0, 1]])}, "bounds"),
        ({"scene": {"spacing": 0.2}}, "spacing"),
        ({"scene": {"gravity": [1.0, 0.0]}}, "gravity"),
        ({"scene": {"gravity": None}}, "scene"),
    ],
)
def test_unlike_trajectories_are_refused(tmp_path: Path, write_dataset, change: dict, key: str) -> None:
    folder = write_dataset(tmp_path, {"train": {0: trajectory(ramp(6, 2)), 1: trajectory(ramp(6, 2), **change)}})
    with pytest.raises(InputError, match=key):
        Dataset(folder, "train")


@pytest.fixture
def copy(bounce_dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(bounce_dataset, tmp_path / "copy"))


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "[]",
        "\x00",
        '{"format_version": 2}',
        '{"format_version": 1}',
        '{"format_version": 1, "splits": {}}',
        '{"format_version": 1, "splits": {"train": []}}',
        '{"format_version": 1, "splits": {"train": {"shards": [1]}}}',
        '{"format_version": 1, "splits": {"train": {"shards": []}}}',
        '{"format_version": 1, "splits": {"train": {"shards": ["train/none.h5"]}}}',
        '{"format_version": 1, "splits": {"train": {"shards": ["train/shard-00000.h5"]}}}',
        '{"format_version": 1, "splits": {"train": {"shards": ["train/shard-00000.h5"]}}, "statistics": {"velocity_mean": ["a", 1]}}',
        "[" * 100_000,
    ],
)
def test_bad_dataset_json(copy: Path, content: str) -> None:
    (copy / "dataset.json").write_text(content)
    with pytest.raises(InputError) as error:
        Dataset(copy, "train").spec(1)
    assert "\n" not in str(error.value)


def test_missing_data_set_and_split(tmp_path: Path, bounce_dataset: Path) -> None:
    with pytest.raises(InputError, match="no such data set"):
        Dataset(tmp_path, "train")
    with pytest.raises(InputError, match="holds test, train, valid"):
        Dataset(bounce_dataset, "validation")


def test_non_finite_positions_are_refused(copy: Path) -> None:
    with h5py.File(copy / "train" / "shard-00000.h5", "r+") as file:
        file["000000/position"][5, 3, 1] = np.nan
    for memory in (0, 1 << 30):
        dataset = Dataset(copy, "train", memory=memory)
        with pytest.raises(InputError, match="non-finite"):
            dataset.batch(np.array([[0, 4]]), 3)
        with pytest.raises(InputError, match="non-finite"):
            dataset.trajectory(0)


def test_too_short_trajectories(tmp_path: Path, write_dataset) -> None:
    dataset = Dataset(write_dataset(tmp_path, {"train": {0: trajectory(ramp(6, 2))}}), "train")
    assert len(dataset.windows(6)) == 1
    with pytest.raises(InputError, match="window"):
        dataset.windows(7)
    with pytest.raises(InputError, match="stride"):
        dataset.spec(3)
    with pytest.raises(InputError, match="batch"):
        Sampler(dataset, DataSettings(), 3, 0).next(5)


def test_particle_types_out_of_range(tmp_path: Path, write_dataset) -> None:
    folder = write_dataset(tmp_path, {"train": {0: trajectory(ramp(6, 2))}})
    write_shard(folder / "train" / "shard-00000.h5", {0: trajectory(ramp(6, 2), [5, 9])})
    with pytest.raises(InputError, match="particle_type"):
        Dataset(folder, "train").spec(1)
