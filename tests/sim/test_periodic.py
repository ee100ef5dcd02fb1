"""Periodic boxes by hand, and what is reckoned from the positions in them: statistics, exports."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOHDF import vtkHDFReader

from sim import periodic
from sim.errors import InputError
from sim.export import export
from sim.generate import training_statistics
from sim.simulator import start_from
from sim.trajectory import ShardReader, Trajectory, write_json, write_shard

BOUNDS = np.array([[1.0, 5.0], [0.0, 2.0]])
CHANNEL = {"name": "channel", "periodic": ["x"], "spacing": 0.5, "gravity": [0.0, 0.0]}
PERIOD = np.array([4.0, 0.0])


def drift(frames=6, axes=("x",)):
    """One particle that leaves through the right face at 1.5 a frame, one that stands at (4.75, 1.25): x = 2, 3.5, 1, 2.5, 4, 1.5."""
    x = np.array([2, 3.5, 1, 2.5, 4, 1.5], np.float32)[:frames]
    position = np.stack([np.stack([x, np.ones_like(x)], 1), np.tile(np.float32([4.75, 1.25]), (frames, 1))], 1)
    return Trajectory(
        position=position,
        particle_type=np.array([5, 5], np.int8),
        frame_step=0.5,
        radius=0.6,
        bounds=BOUNDS,
        scene=CHANNEL | {"periodic": list(axes)},
        seed=1,
        simulator={"name": "none"},
    )


def test_by_hand():
    assert periodic.period(CHANNEL, BOUNDS).tolist() == [4.0, 0.0] and periodic.period({}, BOUNDS) is None
    assert periodic.walls(BOUNDS, PERIOD).tolist() == [[-np.inf, np.inf], [0.0, 2.0]] and periodic.walls(BOUNDS, None) is not None
    assert periodic.shortest(np.array([[3.0, 3.0], [-2.5, 0.0], [1.9, -9.0]]), PERIOD).tolist() == [[-1.0, 3.0], [1.5, 0.0], [1.9, -9.0]]
    assert periodic.unwrapped(drift().position, PERIOD)[:, 0, 0].tolist() == [2.0, 3.5, 5.0, 6.5, 8.0, 9.5]
    assert periodic.wrapped(np.array([[5.0, 5.0], [0.5, -1.0], [13.25, 1.0]]), BOUNDS, PERIOD).tolist() == [[1.0, 5.0], [4.5, -1.0], [1.25, 1.0]]
    assert np.isnan(periodic.wrapped(np.array([[np.nan, 1.0]]), BOUNDS, PERIOD)[0, 0])


def test_where_there_are_walls_nothing_is_touched():
    position = drift().position
    for untouched in (periodic.unwrapped(position, None), periodic.wrapped(position, BOUNDS, None), periodic.shortest(position, None)):
        assert untouched is position


#: Libraries that are loaded by other tests let the processor take subnormal numbers for zero.
COORDINATE = st.floats(-40, 40, allow_subnormal=False)


@given(st.lists(st.tuples(COORDINATE, COORDINATE), min_size=2, max_size=20))
@example([(1 - 4.5e-16, 0.0), (1 - 2.2e-16, 0.0), (1 - 1e-17, 0.0)])
def test_wrapping_and_unwrapping_change_images_only(rows):
    position = np.array(rows)[:, None]
    inside, smooth = periodic.wrapped(position, BOUNDS, PERIOD), periodic.unwrapped(position, PERIOD)
    assert (inside[..., 0] >= 1).all() and (inside[..., 0] < 5).all() and (inside[..., 1] == position[..., 1]).all()
    assert np.abs(np.diff(smooth[..., 0], axis=0)).max() <= 2 + 1e-9 and (smooth[0] == position[0]).all()
    for other in (inside, smooth):
        turns = (other - position)[..., 0] / 4
        np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)


def test_a_hair_below_the_lower_face_is_on_it():
    assert periodic.wrapped(np.array([[1 - 1e-17, -1e-300]]), np.zeros((2, 2)) + [[0, 1]], np.array([1.0, 1.0])).tolist() == [[0.0, 0.0]]
    periodic.tree(np.array([[-1e-300, 0.0], [1.0, 0.0]]), np.array([1.0, 0.0]))  # refuses points on the upper face


def test_a_start_goes_on_through_the_faces_to_where_the_present_is():
    start = start_from(drift(), 4)
    assert start.history[:, 0, 0].tolist() == [-2.0, -0.5, 1.0, 2.5] and start.history.dtype == np.float32
    assert start.walls.tolist() == [[-np.inf, np.inf], [0.0, 2.0]]


def test_statistics_by_hand(tmp_path):
    """Velocities 1.5 and 0 a frame, no acceleration; in frames 0, 2, 5 the two are 1.27, 0.35 and 0.79 apart, by the image: 1, 2, 1 neighbours."""
    write_shard(tmp_path / "a.h5", {0: drift()})
    found = training_statistics([tmp_path / "a.h5"])
    assert found["velocity_mean"] == [0.75, 0.0] and found["velocity_std"] == [0.75, 0.0]
    assert found["acceleration_mean"] == [0.0, 0.0] and found["acceleration_std"] == [0.0, 0.0]
    assert found["neighbours"] == pytest.approx((1 + 2 + 1) / 3)
    write_shard(tmp_path / "b.h5", {0: replace(drift(), scene=CHANNEL | {"periodic": []})})
    assert training_statistics([tmp_path / "b.h5"])["velocity_mean"] != found["velocity_mean"]


@pytest.mark.parametrize("axes", [3, ["z"], [["x"]], {"x": 1}])
def test_axes_that_are_none_are_refused(tmp_path, axes):
    write_shard(tmp_path / "a.h5", {0: replace(drift(), scene=CHANNEL | {"periodic": axes})})
    with ShardReader(tmp_path / "a.h5") as reader, pytest.raises(InputError, match="scene.periodic = .*: must be a list of axes among x, y"):
        reader.read(0)


@pytest.fixture
def data(tmp_path):
    write_shard(tmp_path / "data/train/shard-00000.h5", {0: drift()})
    entry = {"trajectories": 1, "ok": 1, "failed": [], "shards": ["train/shard-00000.h5"]}
    statistics = training_statistics([tmp_path / "data/train/shard-00000.h5"])
    write_json(
        tmp_path / "data/dataset.json",
        {"format_version": 1, "scene": "channel", "family": {}, "seed": 1, "shard_size": 8, "splits": {"train": entry}, "statistics": statistics},
    )
    return tmp_path / "data"


def test_lagrangebench_is_told_the_axes(data, tmp_path):
    export(data, tmp_path / "out", "lagrangebench")
    assert json.loads((tmp_path / "out/metadata.json").read_text())["periodic_boundary_conditions"] == [True, False, False]
    with h5py.File(tmp_path / "out/train.h5") as file:
        assert file["00000/position"][:, 0, 0].tolist() == [2.0, 3.5, 1.0, 2.5, 4.0, 1.5]


@pytest.mark.parametrize("name", ["deepmind", "geoelements"])
def test_formats_without_periodic_boxes_refuse_them(data, tmp_path, name):
    with pytest.raises(InputError, match="give lagrangebench"):
        export(data, tmp_path / "out", name)
    assert not (tmp_path / "out").exists()


def test_paraview_gets_velocities_without_jumps(data, tmp_path):
    export(data, tmp_path / "out", "vtkhdf")
    reader = vtkHDFReader()
    reader.SetFileName(str(tmp_path / "out/train/000000.vtkhdf"))
    reader.UpdateInformation()
    for frame in (2, 5):
        reader.UpdateTimeStep(frame * 0.5)
        assert vtk_to_numpy(reader.GetOutputDataObject(0).GetPointData().GetArray("velocity")).tolist() == [[3.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
