"""Pictures and films of trajectories: particles as small lit spheres in a thin box, on white, with one bar and one footer.

A picture is a grid of *panes*. Every pane is drawn by the same painter with the same camera, and colours come from a
``Scale`` with limits fixed over the clip, so panes can be compared by eye. pyvista draws the particles where OpenGL works;
elsewhere matplotlib draws the same panes (flat discs) from the same projection. Titles, bars and footers are set by
pillow in both cases: about a millisecond a frame, and the two paths cannot drift apart.

Missing GL libraries end a process with a segmentation fault instead of an exception, hence the probe in a subprocess.
"""

from __future__ import annotations

import math
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from sim.errors import InputError, RunError
from sim.trajectory import PARTICLE_TYPES, Trajectory, atomic_path

GL_REMEDY = "apt-get install -y libgl1 libegl1 libxrender1"
FILM_FRAMES = 150  #: at most so many pictures in a film: six seconds, and the cost of a film is the number of its pictures
FILM_RATE = 25  #: pictures per second
PANE_WIDTH = 480  #: pixels; text and margins scale with it
LENS = math.radians(25.0)  #: vertical opening of the 3D camera
MARGIN = 0.04  #: free share of a pane on each side of the box

INK, MUTED, BOX = (34, 34, 34), (110, 110, 110), (178, 178, 178)
KINEMATIC_GREY = (150, 150, 150)
TYPE_COLOURS = {
    "rigid": (176, 84, 48),
    "boundary": KINEMATIC_GREY,
    "water": (47, 111, 171),
    "sand": (201, 162, 94),
    "goop": (104, 153, 82),
    "elastic": (146, 92, 160),
    "snow": (150, 200, 214),
}

_PROBE = """
from vtkmodules.vtkCommonCore import vtkLogger
vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.vtkRenderingCore import vtkRenderWindow, vtkRenderer
window = vtkRenderWindow()
window.SetOffScreenRendering(1)
window.SetSize(16, 16)
window.AddRenderer(vtkRenderer())
window.Render()
print("drawn" if window.SupportsOpenGL() else "no OpenGL")
"""


@cache
def gl_works() -> bool:
    """Whether VTK can draw off screen here; asked once per process, in a subprocess because the failure is a crash."""
    try:
        answer = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        return False
    return answer.returncode == 0 and "drawn" in answer.stdout


# ---------------------------------------------------------------------------------------------------------------- colours


@dataclass(frozen=True)
class Scale:
    """A colour scale with fixed limits.

    table [256, 3] uint8; low, high: values at its ends; label: what is shown; entries: (name, colour) of a scale of kinds,
    whose values are indices into ``table``; it is drawn as swatches instead of a bar.
    """

    table: np.ndarray
    low: float
    high: float
    label: str
    entries: tuple[tuple[str, tuple[int, int, int]], ...] = ()

    def colours(self, value: np.ndarray) -> np.ndarray:
        """[n] values to [n, 3] uint8; values beyond the limits take the end colours, NaN is the grey of kinematic particles."""
        top = len(self.table) - 1
        share = np.clip((np.asarray(value, float) - self.low) / (self.high - self.low), 0.0, 1.0)
        missing = np.isnan(share)
        rgb = self.table[np.rint(np.where(missing, 0.0, share) * top).astype(int)]
        rgb[missing] = KINEMATIC_GREY
        return rgb


def _table(name: str, start: float = 0.0, ground: tuple[int, int, int] | None = None) -> np.ndarray:
    """[256, 3] uint8 of a matplotlib colour map from ``start`` on; ``ground`` replaces its first colour and blends away by a third."""
    from matplotlib import colormaps

    rgb = colormaps[name](np.linspace(start, 1.0, 256))[:, :3] * 255
    if ground is not None:
        weight = np.clip(1 - np.linspace(0, 3, 256), 0, 1)[:, None]
        rgb = weight * np.asarray(ground, float) + (1 - weight) * rgb
    return np.rint(rgb).astype(np.uint8)


def _round_up(value: float) -> float:
    """The next number of two significant digits, so that limits read well on a bar; 1 where there is no positive value."""
    if not (math.isfinite(value) and value > 0):
        return 1.0
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / unit - 1e-9) * unit


def speed_scale(speed: np.ndarray) -> Scale:
    """Viridis from 0 to the 99.5th percentile of the finite values [...], rounded up: a single fast droplet must not darken the rest."""
    finite = speed[np.isfinite(speed)]
    return Scale(_table("viridis"), 0.0, _round_up(float(np.percentile(finite, 99.5)) if finite.size else 0.0), "speed")


def error_scale(error: np.ndarray) -> Scale:
    """Light grey to dark red (OrRd) from 0 to the 99th percentile of the finite values [...] (in particle spacings), rounded up."""
    finite = error[np.isfinite(error)]
    limit = _round_up(float(np.percentile(finite, 99.0)) if finite.size else 0.0)
    return Scale(_table("OrRd", 0.15, (222, 222, 222)), 0.0, limit, "distance to truth, in spacings")


def type_scale(particle_type: np.ndarray) -> Scale:
    """One fixed colour per particle type id [particles], swatches for the types that are present."""
    names = {number: name for name, number in PARTICLE_TYPES.items()}
    table = np.tile(np.asarray(KINEMATIC_GREY, np.uint8), (256, 1))
    for number, name in names.items():
        table[number] = TYPE_COLOURS[name]
    present = [names.get(int(number), f"type {number}") for number in np.unique(particle_type)]
    return Scale(table, 0.0, 255.0, "", tuple((name, TYPE_COLOURS.get(name, KINEMATIC_GREY)) for name in present))


# ----------------------------------------------------------------------------------------------------------------- camera


class View:
    """One camera for all panes: the whole box in view, head on and parallel in 2D, through a 25-degree lens in 3D.

    ``width`` x ``height`` [pixels] is the pane that fits the box; ``position``, ``centre``, ``up`` [3] place the camera;
    ``parallel_scale`` is half the height of the visible world (2D) or None.
    """

    def __init__(self, bounds: np.ndarray, width: int = PANE_WIDTH, gravity: Sequence[float] | None = None):
        bounds = np.asarray(bounds, float)
        self.dim = len(bounds)
        lower, upper = self._lift(bounds.T)
        corners = np.array([[(lower, upper)[i][0], (lower, upper)[j][1], (lower, upper)[k][2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        self.corners = np.unique(corners, axis=0)
        self.centre = (lower + upper) / 2
        if self.dim == 2:
            self.up, self.forward = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0])
        else:
            axis = int(np.argmax(np.abs(gravity))) if gravity is not None and np.any(gravity) else 1
            upward = np.eye(3)[axis]
            # From the front, a quarter to the side and somewhat above: front wall and free surface are both seen.
            side, front = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            self.forward = -(0.42 * side + 0.84 * front + 0.34 * upward)
            self.forward /= np.linalg.norm(self.forward)
            self.up = upward - (upward @ self.forward) * self.forward
            self.up /= np.linalg.norm(self.up)
        self.right = np.cross(self.forward, self.up)
        across, along, depth = ((self.corners - self.centre) @ axis for axis in (self.right, self.up, self.forward))
        # Very tall or flat boxes are letter-boxed: a pane is never more than 1.5 times as high as wide, nor lower than a quarter.
        self.width = width
        self.height = 2 * round(width * float(np.clip(np.ptp(along) / np.ptp(across), 0.25, 1.5)) / 2)
        free = 1 - 2 * MARGIN
        if self.dim == 2:
            self.parallel_scale = max(np.ptp(along) / 2, np.ptp(across) / 2 * self.height / width) / free
            self._distance = 4 * self.parallel_scale
        else:
            self.parallel_scale = None
            slope = math.tan(LENS / 2) * free
            self._distance = float(np.max(np.maximum(np.abs(along), np.abs(across) * self.height / width) / slope - depth))
        self.position = self.centre - self._distance * self.forward
        reach = float(np.linalg.norm(self.corners - self.centre, axis=1).max())
        self.clipping = (max(self._distance - 1.5 * reach, 1e-3 * self._distance), self._distance + 1.5 * reach)

    def _lift(self, points: np.ndarray) -> np.ndarray:
        """[..., dim] to [..., 3]."""
        points = np.asarray(points, float)
        return points if self.dim == 3 else np.concatenate([points, np.zeros((*points.shape[:-1], 1))], axis=-1)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[n, dim] to pixels [n, 2] (x to the right, y down, from the pane's upper left corner) and depth [n] from the camera."""
        offset = self._lift(points) - self.position
        depth = offset @ self.forward
        half = self.parallel_scale if self.dim == 2 else depth * math.tan(LENS / 2)
        scale = self.height / 2 / half
        return np.stack([self.width / 2 + offset @ self.right * scale, self.height / 2 - offset @ self.up * scale], axis=1), depth

    def pixels(self, length: float) -> float:
        """Pixels that a length covers in the middle of the box."""
        half = self.parallel_scale if self.dim == 2 else self._distance * math.tan(LENS / 2)
        return length * self.height / 2 / half

    def edges(self) -> np.ndarray:
        """[edges, 2, 3]: the lines of the box."""
        pairs = [(a, b) for i, a in enumerate(self.corners) for b in self.corners[i + 1 :] if np.count_nonzero(a != b) == 1]
        return np.array(pairs)


# --------------------------------------------------------------------------------------------------------------- painters


class _GLPainter:
    """Draws panes by pyvista. The plotter is made once; a picture only assigns points and colours in place.

    Pictures are drawn ``oversample`` times too large and reduced by a box filter: sphere edges are cut in the fragment
    shader, where multisampling does not reach, and VTK's own supersampling costs three times as much for the same look.
    """

    def __init__(self, view: View, particles: int, size: float, oversample: int = 2):
        import pyvista
        from vtkmodules.vtkCommonCore import vtkLogger

        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)  # "bad X server connection" is harmless: VTK goes on to EGL
        self.view, self.oversample = view, oversample
        self.plotter = pyvista.Plotter(off_screen=True, window_size=(view.width * oversample, view.height * oversample), lighting="none")
        self.plotter.disable_anti_aliasing()
        self.plotter.render_window.SetMultiSamples(0)
        self.plotter.set_background("white")
        self.plotter.add_light(pyvista.Light(light_type="headlight"))
        # Particles that a picture lacks wait here, out of sight: the number of points never changes.
        self.parked = np.tile(view.centre + 1e3 * view._distance * view.right, (particles, 1)).astype(np.float32)
        self.mesh = pyvista.PolyData(self.parked.copy())
        self.mesh.point_data["rgb"] = np.zeros((particles, 3), np.uint8)
        self.plotter.add_points(
            self.mesh, scalars="rgb", rgb=True, render_points_as_spheres=True, point_size=max(size, 1.5) * oversample,
            ambient=0.55, diffuse=0.5, specular=0.03, reset_camera=False,
        )  # fmt: skip
        self.plotter.add_lines(view.edges().reshape(-1, 3), color=np.array(BOX) / 255, width=1.2 * oversample)
        camera = self.plotter.camera
        camera.position, camera.focal_point, camera.up = view.position, view.centre, view.up
        if view.parallel_scale is None:
            camera.view_angle = math.degrees(LENS)
        else:
            camera.parallel_projection, camera.parallel_scale = True, view.parallel_scale
        self.plotter.show(auto_close=False)

    def paint(self, points: np.ndarray, rgb: np.ndarray) -> np.ndarray:
        """[n, dim] finite points and [n, 3] uint8 colours to a picture [height, width, 3] uint8."""
        from PIL import Image

        placed = self.parked.copy()
        placed[: len(points)] = self.view._lift(points)
        colours = np.zeros((len(placed), 3), np.uint8)
        colours[: len(points)] = rgb
        self.mesh.points = placed
        self.mesh.point_data["rgb"] = colours
        self.plotter.camera.clipping_range = self.view.clipping
        self.plotter.render()
        return np.asarray(Image.fromarray(self.plotter.screenshot(return_img=True)).reduce(self.oversample))

    def close(self) -> None:
        self.plotter.close()


class _MatplotlibPainter:
    """Draws the same panes without OpenGL: discs at the projected positions, far ones first."""

    def __init__(self, view: View, particles: int, size: float, oversample: int = 2):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import EllipseCollection, LineCollection
        from matplotlib.figure import Figure

        self.view = view
        figure = Figure(figsize=(view.width / 100, view.height / 100), dpi=100, facecolor="white")
        self.canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, view.width), ylim=(view.height, 0))
        axes.set_axis_off()
        lines = [view.project(edge[:, : view.dim])[0] for edge in view.edges()]
        axes.add_collection(LineCollection(lines, colors=[np.array(BOX) / 255], linewidths=0.9))
        size = max(size, 1.5)
        discs = EllipseCollection([size], [size], [0], units="xy", offsets=np.empty((0, 2)), offset_transform=axes.transData, linewidths=0)
        self.discs = axes.add_collection(discs)

    def paint(self, points: np.ndarray, rgb: np.ndarray) -> np.ndarray:
        """As ``_GLPainter.paint``."""
        places, depth = self.view.project(points)
        order = np.argsort(-depth, kind="stable")
        self.discs.set_offsets(places[order])
        self.discs.set_facecolor(rgb[order] / 255)
        self.canvas.draw()
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()

    def close(self) -> None:
        self.canvas.figure.clear()


def _painter(view: View, particles: int, size: float, oversample: int) -> _GLPainter | _MatplotlibPainter:
    if gl_works():
        return _GLPainter(view, particles, size, oversample)
    warnings.warn(f"no OpenGL here, so matplotlib draws the pictures, as flat discs; for lit spheres: {GL_REMEDY}", RuntimeWarning, stacklevel=3)
    return _MatplotlibPainter(view, particles, size, oversample)


# ------------------------------------------------------------------------------------------------------- panes and layout


@dataclass(frozen=True)
class Pane:
    """One moving picture of a film. title; position [pictures, particles, dim] (NaN: not drawn); value [pictures, particles] in ``scale``."""

    title: str
    position: np.ndarray
    value: np.ndarray
    scale: Scale


def _fitted(text: str, font, room: float) -> str:
    """The text, cut with an ellipsis where it is wider than ``room`` pixels."""
    if font.getlength(text) <= room:
        return text
    while text and font.getlength(text + "…") > room:
        text = text[:-1]
    return text.rstrip() + "…"


class _Sheet:
    """Places panes in a grid, with a title over each, one bar per run of panes that share a scale, and a footer."""

    def __init__(self, panes: Sequence[Pane], view: View, columns: int, footer: bool):
        from matplotlib import get_data_path
        from PIL import Image, ImageDraw, ImageFont

        unit = float(np.clip(view.width / PANE_WIDTH, 0.75, 1.1))  # the small panes of a strip keep readable text
        inset = round(MARGIN * view.width)  # text begins where the box begins
        face = str(Path(get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf")
        title_font, self.font = (ImageFont.truetype(face, max(9, round(points * unit))) for points in (19, 15))
        gap, title, bar = (round(pixels * unit) for pixels in (16, 32, 34))
        rows = math.ceil(len(panes) / columns)
        lines = [panes[row * columns : (row + 1) * columns] for row in range(rows)]
        one_scale = all(pane.scale is panes[0].scale for pane in panes)  # then a single bar under the last row says it all
        width = columns * (view.width + gap) + gap
        self.corners, y = [], gap // 2
        marks = []
        for row, line in enumerate(lines):
            for column, pane in enumerate(line):
                x = gap + column * (view.width + gap)
                marks.append((x + inset, y, pane.title))
                self.corners.append((x, y + title))
            y += title + view.height
            if not one_scale or row == rows - 1:
                y += bar
        self.footer_at = (gap + inset, y)
        y += bar if footer else gap // 2
        self.size = (width + width % 2, y + y % 2)  # yuv420p wants even sizes
        self.ground = Image.new("RGB", self.size, "white")
        draw = ImageDraw.Draw(self.ground)
        for x, top, text in marks:
            draw.text((x, top + title / 2), _fitted(text, title_font, view.width - inset), INK, title_font, anchor="lm")
        for row, line in enumerate(lines):
            if one_scale and row < rows - 1:
                continue
            middle = self.corners[row * columns][1] + view.height + bar / 2
            first = 0
            for column in range(1, len(line) + 1):
                if column == len(line) or line[column].scale is not line[first].scale:
                    left = self.corners[row * columns + first][0]
                    right = self.corners[row * columns + column - 1][0] + view.width
                    self._legend(draw, line[first].scale, (left + right) / 2, middle, unit)
                    first = column

    def _legend(self, draw, scale: Scale, middle: float, y: float, unit: float) -> None:
        """One line centred on (middle, y): "label  low [bar] high", or a swatch per kind."""
        space, length, thick = 9 * unit, round(130 * unit), round(11 * unit)
        wide = self.font.getlength
        if scale.entries:
            x = middle - sum(thick + wide(name) + 3 * space for name, _ in scale.entries) / 2
            for name, colour in scale.entries:
                draw.ellipse((x, y - thick / 2, x + thick, y + thick / 2), fill=colour)
                draw.text((x + thick + space, y), name, MUTED, self.font, anchor="lm")
                x += thick + wide(name) + 3 * space
            return
        low, high = f"{scale.low:g}", f"{scale.high:g}"
        x = middle - (wide(scale.label) + wide(low) + wide(high) + length + 4 * space) / 2
        draw.text((x, y), scale.label, MUTED, self.font, anchor="lm")
        x += wide(scale.label) + 2 * space
        draw.text((x, y), low, MUTED, self.font, anchor="lm")
        x += wide(low) + space
        for i in range(length):
            shade = tuple(int(c) for c in scale.table[i * (len(scale.table) - 1) // (length - 1)])
            draw.line((x + i, y - thick / 2, x + i, y + thick / 2), fill=shade)
        draw.text((x + length + space, y), high, MUTED, self.font, anchor="lm")

    def picture(self, parts: Sequence[np.ndarray], footer: str) -> np.ndarray:
        """[height, width, 3] uint8 of one moment: the panes' pictures and the footer."""
        from PIL import Image, ImageDraw

        sheet = self.ground.copy()
        for corner, part in zip(self.corners, parts, strict=True):
            sheet.paste(Image.fromarray(part), corner)
        if footer:
            room = self.size[0] - 2 * self.footer_at[0]
            ImageDraw.Draw(sheet).text(self.footer_at, _fitted(footer, self.font, room), INK, self.font)
        return np.asarray(sheet)


def _pictures(
    panes: Sequence[Pane],
    bounds: np.ndarray,
    spacing: float,
    footers: Sequence[str],
    columns: int | None,
    width: int,
    gravity: Sequence[float] | None,
    oversample: int,
) -> tuple[tuple[int, int], Iterable[np.ndarray]]:
    """(width, height) and the pictures, drawn one by one as they are asked for."""
    view = View(bounds, width, gravity)
    sheet = _Sheet(panes, view, columns or len(panes), any(footers))
    particles = max(pane.position.shape[1] for pane in panes)

    def draw() -> Iterable[np.ndarray]:
        with closing(_painter(view, particles, view.pixels(spacing), oversample)) as painter:
            for i, footer in enumerate(footers):
                parts = []
                for pane in panes:
                    there = np.isfinite(pane.position[i]).all(axis=1)
                    parts.append(painter.paint(pane.position[i][there], pane.scale.colours(pane.value[i][there])))
                yield sheet.picture(parts, footer)

    return sheet.size, draw()


def render_film(
    path: str | Path, panes: Sequence[Pane], bounds: np.ndarray, spacing: float, *,
    footers: Sequence[str] | None = None, columns: int | None = None, width: int = PANE_WIDTH, gravity: Sequence[float] | None = None,
    rate: float = FILM_RATE,
) -> None:  # fmt: skip
    """Write an H.264 film (yuv420p, even size: plays in browsers) of the panes side by side, complete or not at all.

    bounds [dim, 2]; spacing [length]: the diameter of a particle; footers: one line per picture; columns: panes in a row
    (all); width [pixels] of a pane; gravity [dim] tells which way is up in 3D; rate: pictures per second.
    Raises ``RunError`` where ffmpeg fails.
    """
    import imageio_ffmpeg

    count = len(panes[0].position)
    size, pictures = _pictures(panes, bounds, spacing, footers or [""] * count, columns, width, gravity, 2)
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", f"{rate:g}", "-i", "-"]
    coded = ["-an", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "23", "-preset", "veryfast", "-movflags", "+faststart"]
    # Not by imageio_ffmpeg's own writer: it takes no notice of ffmpeg's exit code, and a full disk would leave half a film as a whole one.
    with atomic_path(path) as temporary, tempfile.TemporaryFile() as said:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", *raw, *coded, str(temporary)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said, start_new_session=True) as ffmpeg:
            assert ffmpeg.stdin is not None  # a pipe
            try:
                with suppress(BrokenPipeError):  # it ended early; its exit code tells
                    for picture in pictures:
                        ffmpeg.stdin.write(np.ascontiguousarray(picture).data)
                    ffmpeg.stdin.close()
                failed = ffmpeg.wait()
            except BaseException:
                ffmpeg.kill()
                raise
            finally:
                with suppress(BrokenPipeError):
                    ffmpeg.stdin.close()
        if failed:
            said.seek(0)
            lines = said.read().decode(errors="replace").splitlines() or [f"exit code {failed}"]
            why = re.sub(r"^\[.*?\] ", "", lines[0])  # without the part of ffmpeg that says so
            raise RunError(f"{path}: ffmpeg could not write the film: {why}")


def render_still(
    path: str | Path, panes: Sequence[Pane], bounds: np.ndarray, spacing: float, *,
    picture: int = 0, footer: str = "", columns: int | None = None, width: int = PANE_WIDTH, gravity: Sequence[float] | None = None,
) -> None:  # fmt: skip
    """Write one picture of the panes in a box ``bounds`` [dim, 2] as PNG; ``picture`` indexes the panes' pictures, the rest as in ``render_film``."""
    from PIL import Image

    chosen = [Pane(pane.title, pane.position[picture][None], pane.value[picture][None], pane.scale) for pane in panes]
    _, pictures = _pictures(chosen, bounds, spacing, [footer], columns, width, gravity, 3)
    with atomic_path(path) as temporary:
        Image.fromarray(next(iter(pictures))).save(temporary, format="PNG", optimize=True)


# ------------------------------------------------------------------------------------------------------- from trajectories


def film_frames(frames: int, at_most: int = FILM_FRAMES) -> np.ndarray:
    """[pictures]: evenly spaced frame numbers from 0, no more than ``at_most``: every k-th frame, so that motion stays even."""
    return np.arange(0, frames, max(1, math.ceil(frames / at_most)))


def particle_spacing(trajectory: Trajectory) -> float:
    """Spacing of the recorded particles [length]: as the scene says, else the median distance to the nearest neighbour at the start."""
    if trajectory.scene.get("spacing"):
        return float(trajectory.scene["spacing"])
    from scipy.spatial import cKDTree

    start = trajectory.position[0].astype(float)
    return float(np.median(cKDTree(start).query(start, k=2)[0][:, 1])) if len(start) > 1 else trajectory.radius / 2


def speeds(position: np.ndarray, frames: np.ndarray, frame_step: float, moving: np.ndarray) -> np.ndarray:
    """[len(frames), particles] speed [length / s] from backward differences (forward at frame 0); NaN for kinematic particles."""
    later = np.clip(frames, 1, max(len(position) - 1, 1))
    if len(position) < 2:
        speed = np.zeros((len(frames), position.shape[1]))
    else:
        speed = np.linalg.norm(position[later] - position[later - 1], axis=2) / frame_step
    return np.where(moving, speed, np.nan)


def _suffix(path: str | Path) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in (".mp4", ".png"):
        raise InputError(path, "suffix", suffix, "films are .mp4, stills are .png")
    return suffix


def _gravity(trajectory: Trajectory) -> Sequence[float] | None:
    return trajectory.scene.get("gravity")


def _failure(position: np.ndarray) -> int | None:
    """Index of the first frame with a particle that is nowhere, or None."""
    lost = ~np.isfinite(position).all(axis=(1, 2))
    return int(np.argmax(lost)) if lost.any() else None


def _colouring(trajectory: Trajectory, position: np.ndarray, frames: np.ndarray) -> tuple[Callable[[np.ndarray, np.ndarray], np.ndarray], Scale]:
    """How the particles of a trajectory and of its predictions are coloured: by type where several kinds move, else by speed.

    Returns value(positions [n, particles, dim], frames [m]) -> [m, particles] and its scale, the limits of speed of ``position`` at ``frames``.
    """
    if len(np.unique(trajectory.particle_type[trajectory.moving])) > 1:
        kind = trajectory.particle_type.astype(float)
        return lambda _, chosen: np.tile(kind, (len(chosen), 1)), type_scale(trajectory.particle_type)

    def speed(positions: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        return speeds(positions, chosen, trajectory.frame_step, trajectory.moving)

    return speed, speed_scale(speed(position, frames))


def render_trajectory(path: str | Path, trajectory: Trajectory, *, width: int | None = None) -> None:
    """A film (``.mp4``) or a strip of six moments (``.png``) of one trajectory, coloured by speed, or by type where several kinds move.

    Raises ``InputError`` for another suffix. ``width``: pixels of a pane (720 in a film, 300 in a strip).
    """
    if _suffix(path) == ".png":
        render_strip(path, trajectory, width=width or 300)
        return
    frames = film_frames(len(trajectory.position))
    value, scale = _colouring(trajectory, trajectory.position, frames)
    seed = "" if trajectory.seed is None else f", seed {trajectory.seed}"
    name = f"{trajectory.scene.get('name', 'scene')}{seed}, {trajectory.simulator.get('name', 'solver')}"
    footers = [f"t = {frame * trajectory.frame_step:.3f} s" for frame in frames]
    if not trajectory.ok:
        footers[-1] += f"   {trajectory.status}"
    pane = Pane(name, trajectory.position[frames], value(trajectory.position, frames), scale)
    render_film(path, [pane], trajectory.bounds, particle_spacing(trajectory), footers=footers, width=width or 720, gravity=_gravity(trajectory))


def render_strip(
    path: str | Path, trajectory: Trajectory, times: Sequence[float] | None = None, *,
    predictions: Mapping[str, np.ndarray] | None = None, first: int = 0, name: str = "solver", width: int = 300,
) -> None:  # fmt: skip
    """A film strip: the trajectory at several times [s] side by side (default: six from ``first`` to the end), PNG; colours as in a film.

    predictions: further rows, name -> [frames, particles, dim], whose frame 0 is the trajectory's frame ``first``. All rows
    share times, camera and speed limits (the trajectory's). Moments that a row lacks, or lost to a failure, are empty boxes.
    """
    count, step = len(trajectory.position), trajectory.frame_step
    chosen = np.linspace(first, count - 1, min(6, count - first)) if times is None else np.clip(np.asarray(times, float) / step, 0, count - 1)
    chosen = np.rint(chosen).astype(int)
    value, scale = _colouring(trajectory, trajectory.position, chosen)
    truth = value(trajectory.position, chosen)
    label = f"{name}, " if predictions else ""
    panes = [Pane(f"{label}t = {k * step:.2f} s", trajectory.position[k][None], shown[None], scale) for k, shown in zip(chosen, truth, strict=True)]
    nowhere = np.full((1, *trajectory.position.shape[1:]), np.nan, np.float32)
    for row, position in (predictions or {}).items():
        inside = [int(k) - first for k in chosen]
        for k, i in zip(chosen, inside, strict=True):
            there = 0 <= i < len(position)
            shown = value(position, np.array([i])) if there else np.zeros((1, nowhere.shape[1]))
            panes.append(Pane(f"{row}, t = {k * step:.2f} s", position[i][None] if there else nowhere, shown, scale))
    render_still(path, panes, trajectory.bounds, particle_spacing(trajectory), columns=len(chosen), width=width, gravity=_gravity(trajectory))


def comparison_panes(truth: Trajectory, prediction: np.ndarray, first: int, frames: np.ndarray, names: tuple[str, str]) -> list[Pane]:
    """Three panes, solver | model | error, at ``frames``: indices into ``prediction`` [frames, particles, dim], whose 0 is the truth's ``first``.

    Solver and model are coloured alike, by type where several kinds move, else by speed on the solver's scale; the error is each
    predicted particle's distance to its true place, in particle spacings. Limits are fixed over the whole prediction.
    """
    true, spacing = truth.position[first : first + len(prediction)], particle_spacing(truth)

    def error(chosen: np.ndarray) -> np.ndarray:
        distance = np.linalg.norm(prediction[chosen].astype(float) - true[chosen], axis=2)
        return np.where(truth.moving, distance / spacing, np.nan)

    clip = film_frames(len(prediction))  # a still has the limits of its film
    value, scale = _colouring(truth, true, clip)
    distance = error_scale(error(clip))
    return [
        Pane(names[0], true[frames], value(true, frames), scale),
        Pane(names[1], prediction[frames], value(prediction, frames), scale),
        Pane("error", prediction[frames], error(frames), distance),
    ]


def render_comparison(
    path: str | Path, truth: Trajectory, prediction: np.ndarray, *,
    first: int = 0, names: tuple[str, str] = ("solver", "model"), note: str = "", footer: Callable[[int], str] | None = None,
    time: float | None = None, width: int = PANE_WIDTH,
) -> None:  # fmt: skip
    """A film (``.mp4``) or still (``.png``) of solver | model | error.

    prediction [frames, particles, dim]: frame i is compared with the truth's frame ``first + i``; NaN frames (a failed rollout)
    show no particles and the footer says "failed at frame k" (the truth's numbering). footer(i): the footer at prediction
    frame i; the default gives the time and the mean squared error so far (moving particles, over frames and axes), and ``note``
    after it, for instance the speed-up. time [s]: the moment of a still (the last). Raises ``InputError`` for another suffix
    or for a prediction that does not fit the truth.
    """
    suffix = _suffix(path)
    prediction = np.asarray(prediction, np.float32)
    if prediction.ndim != 3 or prediction.shape[1:] != truth.position.shape[1:] or first + len(prediction) > len(truth.position):
        raise InputError(path, "prediction", prediction.shape, f"must fit the truth's {truth.position.shape} from frame {first} on")
    squared = ((prediction.astype(float) - truth.position[first : first + len(prediction)])[:, truth.moving] ** 2).mean(axis=(1, 2))
    running = np.cumsum(squared) / np.arange(1, len(squared) + 1)
    failed = _failure(prediction)

    def line(i: int) -> str:
        if footer is not None:
            text = footer(i)
        else:
            lost = failed is not None and i >= failed
            error = "" if lost else f"   MSE so far {running[i]:.1e}"
            text = f"t = {(first + i) * truth.frame_step:.3f} s{error}" + (f"   {note}" if note else "")
        return text + (f"   {names[1]} failed at frame {first + failed}" if failed is not None and i >= failed else "")

    if suffix == ".mp4":
        frames = film_frames(len(prediction))
    else:
        moment = len(prediction) - 1 if time is None else round(time / truth.frame_step) - first
        frames = np.array([int(np.clip(moment, 0, len(prediction) - 1))])
    panes = comparison_panes(truth, prediction, first, frames, names)
    footers = [line(int(i)) for i in frames]
    if suffix == ".mp4":
        render_film(path, panes, truth.bounds, particle_spacing(truth), footers=footers, width=width, gravity=_gravity(truth))
    else:
        render_still(path, panes, truth.bounds, particle_spacing(truth), footer=footers[0], width=width, gravity=_gravity(truth))
