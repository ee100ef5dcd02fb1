"""Pictures and films: right place, right colour, right file, with and without OpenGL."""

import subprocess
import sys

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from sim import render
from sim.errors import InputError
from sim.trajectory import PARTICLE_TYPES, Trajectory

RED, BLUE = (220, 40, 30), (30, 60, 200)
BOUNDS = {2: np.array([[0.1, 0.9], [0.1, 0.6]]), 3: np.array([[0.0, 1.0], [0.0, 0.8], [0.0, 0.7]])}


def toy(frames=10, dim=2, types=None) -> Trajectory:
    """A lattice that slides along the first axis, faster at its top."""
    axes = np.meshgrid(*[0.2 + 0.04 * np.arange(6)] * dim, indexing="ij")
    lattice = np.stack([axis.ravel() for axis in axes], axis=1)
    position = np.repeat(lattice[None], frames, axis=0)
    position[..., 0] += 0.02 * np.arange(frames)[:, None] * lattice[:, 1] / lattice[:, 1].max()
    kinds = np.full(len(lattice), PARTICLE_TYPES["water"]) if types is None else np.resize(types, len(lattice))
    scene = {"name": "toy", "gravity": [0.0, -9.81, 0.0][:dim], "spacing": 0.04}
    return Trajectory(position.astype(np.float32), kinds.astype(np.int8), 0.01, 0.1, BOUNDS[dim], scene, 3, {"name": "solver"})


@pytest.fixture(params=["opengl", "matplotlib"])
def backend(request, monkeypatch):
    """Every picture by both painters; the fallback's advice is expected there and nowhere else."""
    if request.param == "matplotlib":
        monkeypatch.setattr(render, "gl_works", lambda: False)
    elif not render.gl_works():
        pytest.skip(f"no OpenGL: {render.GL_REMEDY}")
    return request.param


pytestmark = pytest.mark.filterwarnings("ignore:no OpenGL here:RuntimeWarning")


def film(path) -> tuple[dict, np.ndarray]:
    """(ffmpeg's description, [pictures, height, width, 3])."""
    reader = imageio_ffmpeg.read_frames(str(path))
    description = next(reader)
    width, height = description["size"]
    return description, np.stack([np.frombuffer(data, np.uint8).reshape(height, width, 3) for data in reader])


def near(picture, colour, reach=70) -> np.ndarray:
    """[height, width] bool: pixels of about this colour (lighting shades a sphere)."""
    return np.abs(picture.astype(int) - colour).sum(axis=2) < reach


@pytest.mark.parametrize("dim", [2, 3])
def test_particle_is_where_the_camera_says(backend, dim):
    view = render.View(BOUNDS[dim], 320, [0.0, -9.81, 0.0][:dim])
    points = np.array([[0.3, 0.25, 0.6], [0.75, 0.5, 0.2]])[:, :dim]
    places, _ = view.project(points)
    painter = render._painter(view, 5, 14.0, 2)
    picture = painter.paint(points, np.array([RED, BLUE], np.uint8))
    moved = painter.paint(points[:1], np.array([BLUE], np.uint8))
    painter.close()
    assert picture.shape == (view.height, view.width, 3)
    for colour, place in ((RED, places[0]), (BLUE, places[1])):
        rows, columns = np.nonzero(near(picture, colour))
        assert np.hypot(columns.mean() + 0.5 - place[0], rows.mean() + 0.5 - place[1]) < 1.0
        assert 0.5 * np.pi * 7**2 < len(rows) < 1.1 * np.pi * 7**2
    # The same plotter again: new colour, and the particle that the picture lacks is gone.
    assert not near(moved, RED).any()
    assert near(moved, BLUE)[int(places[0][1]), int(places[0][0])]


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("shape", [(1, 1, 1), (4, 1, 1), (1, 4, 1), (1, 1, 4)])
def test_whole_box_is_in_view(dim, shape):
    bounds = np.array([[-0.5, -0.5 + length] for length in shape[:dim]], float)
    view = render.View(bounds, 200)
    corners = view.corners[:, :dim]
    places, depth = view.project(corners)
    assert (places >= 0).all() and (places <= [view.width, view.height]).all()
    assert (depth > view.clipping[0]).all() and (depth < view.clipping[1]).all()
    assert np.ptp(places[:, 0]) > 0.6 * view.width or np.ptp(places[:, 1]) > 0.6 * view.height
    assert len(view.edges()) == (4 if dim == 2 else 12)


def test_gravity_points_down_in_3d():
    view = render.View(BOUNDS[3], 200, [0.0, 0.0, -9.81])
    (low, high), _ = view.project(np.array([[0.5, 0.4, 0.1], [0.5, 0.4, 0.6]]))
    assert low[1] > high[1]


def test_film_of_a_toy_trajectory(backend, tmp_path):
    path = tmp_path / "film.mp4"
    render.render_trajectory(path, toy(frames=10), width=240)
    description, pictures = film(path)
    assert description["codec"] == "h264" and description["pix_fmt"].startswith("yuv420p")
    assert len(pictures) == 10
    assert pictures.shape[1] % 2 == 0 and pictures.shape[2] % 2 == 0 and pictures.shape[2] > 240
    assert pictures[0].std() > 5 and np.abs(pictures[0].astype(int) - pictures[-1]).max() > 50
    assert [entry.name for entry in tmp_path.iterdir()] == ["film.mp4"]


def test_comparison_film_and_still_in_3d(backend, tmp_path):
    truth = toy(frames=4, dim=3)
    for name in ("film.mp4", "still.png"):
        render.render_comparison(tmp_path / name, truth, truth.position[1:] + np.float32(0.02), first=1, width=160)
    _, pictures = film(tmp_path / "film.mp4")
    still = np.asarray(Image.open(tmp_path / "still.png"))
    assert len(pictures) == 3 and pictures.shape[1:] == still.shape
    assert still.std() > 5 and pictures[-1].std() > 5


def test_perfect_prediction_looks_like_the_solver(backend, tmp_path):
    truth = toy()
    render.render_comparison(tmp_path / "still.png", truth, truth.position, width=200)
    picture = np.asarray(Image.open(tmp_path / "still.png"))
    view = render.View(truth.bounds, 200)
    sheet = render._Sheet(render.comparison_panes(truth, truth.position, 0, np.array([9]), ("solver", "model")), view, 3, True)
    solver, model, error = (picture[y : y + view.height, x : x + view.width] for x, y in sheet.corners)
    assert np.array_equal(solver, model)
    saturation = np.ptp(error, axis=2)
    assert saturation.max() < 40 and np.ptp(solver, axis=2).max() > 80  # no error is grey, speed is not


def test_strip_has_a_column_per_time_and_a_row_per_contender(backend, tmp_path):
    truth = toy()
    render.render_strip(tmp_path / "one.png", truth, [0.0, 0.03, 0.06], width=120)
    render.render_strip(tmp_path / "two.png", truth, [0.0, 0.03, 0.06], predictions={"model": truth.position[2:]}, first=2, width=120)
    one, two = (np.asarray(Image.open(tmp_path / name)) for name in ("one.png", "two.png"))
    assert one.shape[1] == two.shape[1] and one.shape[0] < two.shape[0]
    saturation, half = np.ptp(two[:, :120], axis=2), len(two) // 2  # the first column; the second row lacks time 0
    assert saturation[:half].max() > 60 and saturation[half:].max() < 30


def test_solver_and_model_share_limits_and_error_is_in_spacings():
    truth = toy()
    prediction = truth.position * np.float32(1.0) + np.float32(0.08) * np.array([1, 0], np.float32)
    prediction[-1, 0, 1] += 50.0  # a model's explosion must not wash out the solver's colours
    solver, model, error = render.comparison_panes(truth, prediction, 0, np.arange(10), ("solver", "model"))
    assert solver.scale is model.scale
    assert solver.scale.low == 0 and 2.0 <= solver.scale.high <= 2.1
    assert np.allclose(error.value[0], 2.0, atol=1e-4)
    assert 2.0 <= error.scale.high < 3
    still = render.comparison_panes(truth, prediction, 0, np.array([3]), ("solver", "model"))
    assert still[2].scale.high == error.scale.high  # a still has the limits of its film


def test_failed_rollout_vanishes_and_says_so(backend, tmp_path, monkeypatch):
    truth = toy()
    prediction = truth.position[1:].copy()
    prediction[5:] = np.nan
    seen = {}
    monkeypatch.setattr(render, "render_film", lambda path, panes, *_, footers, **__: seen.update(panes=panes, footers=footers))
    render.render_comparison(tmp_path / "film.mp4", truth, prediction, first=1, names=("solver", "GNS"), note="speed-up 2x")
    assert "failed" not in seen["footers"][4] and "MSE so far 0.0e+00" in seen["footers"][4]
    assert seen["footers"][5].endswith("GNS failed at frame 6") and "nan" not in seen["footers"][5]
    monkeypatch.undo()
    if backend == "matplotlib":
        monkeypatch.setattr(render, "gl_works", lambda: False)
    render.render_still(tmp_path / "lost.png", [seen["panes"][1]], truth.bounds, 0.04, picture=7, width=120)
    lost = np.asarray(Image.open(tmp_path / "lost.png"))[24:80]
    assert np.ptp(lost, axis=2).max() < 30


def test_callers_own_footer(monkeypatch):
    truth, seen = toy(), {}
    monkeypatch.setattr(render, "render_still", lambda *_, footer, **__: seen.update(footer=footer))
    render.render_comparison("still.png", truth, truth.position, footer="frame {}".format, time=0.04)
    assert seen["footer"] == "frame 4"


def test_kinds_have_their_colours_and_the_static_ones_are_grey(monkeypatch):
    seen = {}
    monkeypatch.setattr(render, "render_film", lambda path, panes, *_, **__: seen.update(pane=panes[0]))
    render.render_trajectory("film.mp4", toy(types=[5, 6, 3]))
    pane = seen["pane"]
    colours = pane.scale.colours(pane.value[0])[:3]
    assert [tuple(colour) for colour in colours] == [render.TYPE_COLOURS[name] for name in ("water", "sand", "boundary")]
    assert [name for name, _ in pane.scale.entries] == ["boundary", "water", "sand"]
    render.render_trajectory("film.mp4", toy(types=[5, 3]))
    assert tuple(seen["pane"].scale.colours(seen["pane"].value[0])[1]) == render.KINEMATIC_GREY


def test_several_kinds_are_told_apart_beside_a_prediction_too(monkeypatch):
    truth, seen = toy(types=[5, 6, 3]), []
    solver, model, error = render.comparison_panes(truth, truth.position + np.float32(0.01), 0, np.arange(3), ("solver", "model"))
    for pane in (solver, model):
        assert (pane.value == truth.particle_type).all() and [name for name, _ in pane.scale.entries] == ["boundary", "water", "sand"]
    assert not error.scale.entries and np.isnan(error.value[:, truth.particle_type == 3]).all()
    monkeypatch.setattr(render, "render_still", lambda path, panes, *_, **__: seen.extend(panes))
    render.render_strip("strip.png", truth, [0.0, 0.03], predictions={"model": truth.position})
    assert len(seen) == 4 and all((pane.value == truth.particle_type).all() for pane in seen)


def test_speed_is_a_backward_difference():
    position = np.zeros((4, 1, 2), np.float32)
    position[:, 0, 0] = [0.0, 0.1, 0.3, 0.6]
    assert np.allclose(render.speeds(position, np.array([0, 1, 2, 3]), 0.1, np.array([True]))[:, 0], [1, 1, 2, 3], atol=1e-5)
    assert np.isnan(render.speeds(position, np.array([2]), 0.1, np.array([False]))).all()
    assert (render.speeds(position[:1], np.array([0]), 0.1, np.array([True])) == 0).all()


@pytest.mark.parametrize("frames", [1, 7, 149, 150, 151, 1000, 4001])
def test_films_skip_frames_evenly(frames):
    chosen = render.film_frames(frames)
    assert 1 <= len(chosen) <= 150 and chosen[0] == 0 and chosen[-1] < frames
    assert len(set(np.diff(chosen))) <= 1


def test_long_text_stays_in_its_pane():
    from PIL import ImageFont

    font = ImageFont.load_default(15)
    cut = render._fitted("waterdrop, seed 8688832179248457", font, 100)
    assert cut.endswith("…") and 60 < font.getlength(cut) <= 100
    assert render._fitted("short", font, 100) == "short"


def test_limits_read_well():
    assert [render._round_up(value) for value in (1.234, 0.0301, 99.5, 2.0, 0.0, float("nan"))] == pytest.approx([1.3, 0.031, 100.0, 2.0, 1.0, 1.0])


def test_spacing_without_a_scene_is_measured():
    trajectory = toy()
    trajectory.scene.pop("spacing")
    assert render.particle_spacing(trajectory) == pytest.approx(0.04, rel=1e-3)


def test_other_suffixes_are_the_users_mistake(tmp_path):
    with pytest.raises(InputError, match="films are .mp4"):
        render.render_trajectory(tmp_path / "film.webm", toy())
    with pytest.raises(InputError, match="films are .mp4"):
        render.render_comparison(tmp_path / "film", toy(), toy().position)
    assert not any(tmp_path.iterdir())


def test_prediction_must_fit(tmp_path):
    with pytest.raises(InputError, match="must fit the truth"):
        render.render_comparison(tmp_path / "film.mp4", toy(), toy().position, first=3)


def test_a_film_is_complete_or_absent(tmp_path, monkeypatch):
    class Broken:
        def __init__(self, *_):
            self.left = 3

        def paint(self, points, rgb):
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt
            return np.full((100, 160, 3), 255, np.uint8)

        def close(self):
            pass

    monkeypatch.setattr(render, "gl_works", lambda: True)
    monkeypatch.setattr(render, "_GLPainter", Broken)
    with pytest.raises(KeyboardInterrupt):
        render.render_trajectory(tmp_path / "film.mp4", toy(), width=160)
    assert not any(tmp_path.iterdir())


CRASHED, REFUSED = subprocess.CompletedProcess([], -11, "", ""), subprocess.CompletedProcess([], 0, "no OpenGL", "")


@pytest.mark.parametrize("outcome", [CRASHED, REFUSED, subprocess.TimeoutExpired([], 1)])
def test_a_crash_of_the_probe_means_no_opengl(monkeypatch, outcome):
    def run(*_, **__):
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    monkeypatch.setattr(render.subprocess, "run", run)
    assert render.gl_works.__wrapped__() is False


def test_without_opengl_the_remedy_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(render, "gl_works", lambda: False)
    with pytest.warns(RuntimeWarning, match="apt-get install -y libgl1 libegl1 libxrender1"):
        render.render_strip(tmp_path / "strip.png", toy(), [0.0], width=100)


def test_import_is_light():
    code = "import sys, sim.render; print([name for name in ('pyvista', 'matplotlib', 'PIL', 'torch', 'taichi') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
