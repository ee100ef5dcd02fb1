"""Obstacles: solids that never move, known by their signed distance; families of them with sampling ranges; their particles.

A resolved obstacle offers ``distance(points [n, dim]) -> (distance [n], normal [n, dim])``: the exact Euclidean distance [length],
negative inside, and its gradient, a unit vector that points out of the solid. Everything is NumPy in float64 and runs when a
scene is loaded; the solver sees one field of distances and normals on its grid nodes (``combine``), the learned models see
kinematic particles (``boundary_particles``).

Decision: a solid must be at least ``THINNEST`` grid cells thick. A quadratic B-spline reaches 1.5 cells, so across a plate of that
thickness a particle on one face touches only nodes inside the plate or on its own side: nothing is pushed through, and both faces
work. A ramp without thickness would need two velocities on the nodes beside it. From three cells on no node is reached from both faces:
then those inside carry the velocity on across the surface (``sim.mpm.solver.column_table``), and what rests there has its own pressure. In
thinner plates they are held, a staircase that water feels as up to several times its pressure in the layer next to it.

Known: solids that only touch leak along the seam where it lies on a line of nodes, for there both say that their surface is near. Let them overlap
by a cell.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy.spatial import ConvexHull, cKDTree

from sim.errors import InputError
from sim.fields import Finite, Friction, Positive, Range, Strict, check_range, check_vectors, mistake, sample

#: Least thickness of an obstacle, in cells of the grid that it is put on.
THINNEST = 1.5
#: Triangles in a mesh; it travels in every trajectory file.
_MOST_TRIANGLES = 20_000


def _nearest(points: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest of 2D edges [m, 2, 2] to each point [n, 2]: the foot [n, 2] and the edge's index [n]."""
    foot, which = np.zeros_like(points), np.zeros(len(points), int)
    best = np.full(len(points), np.inf)
    for index, (a, b) in enumerate(edges):
        along = b - a
        t = np.clip((points - a) @ along / max(along @ along, 1e-300), 0.0, 1.0)
        candidate = a + t[:, None] * along
        square = ((points - candidate) ** 2).sum(1)
        nearer = square < best
        foot[nearer], which[nearer], best[nearer] = candidate[nearer], index, square[nearer]
    return foot, which


def _signed(points: np.ndarray, foot: np.ndarray, inside: np.ndarray, fallback: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance and normal from the nearest points of a surface; ``fallback`` [n, dim]: outward normals for points that lie on it."""
    offset = points - foot
    length = np.linalg.norm(offset, axis=1)
    sign = np.where(inside, -1.0, 1.0)
    far = length > 1e-12
    normal = np.where(far[:, None], offset * (sign / np.where(far, length, 1.0))[:, None], fallback)
    return sign * length, normal


def _left(edges: np.ndarray) -> np.ndarray:
    """[m, 2] unit normals to the left of edges [m, 2, 2]."""
    along = edges[:, 1] - edges[:, 0]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    return np.stack([-along[:, 1], along[:, 0]], 1)


class _Solid(Strict):
    friction: Friction | None = None
    _walls: np.ndarray | None = None  # [dim, 2]: the box's, where what lies on or beyond them is no surface (``within``)

    def extent(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Lower and upper corner of the bounding box; None for what has no end."""
        return None

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed distance [n] and outward normal [n, dim] of points [n, dim], as the head of this file says."""
        raise NotImplementedError

    def check(self, where: str, dim: int) -> None:
        """Raise the first fault: resolved solids may come from a data file that anyone has written."""
        for name in type(self).model_fields:
            value = getattr(self, name)
            nested = isinstance(value, list) and bool(value) and isinstance(value[0], list)
            for entry in value if nested else [value]:
                if isinstance(entry, list) and len(entry) != (needed := 3 if name == "faces" else dim):
                    raise mistake(f"{where}.{name}", entry, f"needs {needed} entries")

    def _beyond(self, corners: np.ndarray) -> np.ndarray:
        """[m]: faces or edges, by their corners [m, k, dim], that lie on or beyond one of the walls."""
        if self._walls is None:
            return np.zeros(len(corners), bool)
        hair = 1e-9 * np.ptp(self._walls)
        low, high = self._walls.T
        return ((corners <= low + hair).all(1) | (corners >= high - hair).all(1)).any(1)

    def _into(self, points: np.ndarray) -> np.ndarray:
        """``points``, those on or beyond a wall a hair inside, where it is plain what is solid."""
        if self._walls is None:
            return points
        hair = 1e-7 * np.ptp(self._walls)
        return np.clip(points, self._walls[:, 0] + hair, self._walls[:, 1] - hair)


class _Planar(_Solid):
    def check(self, where: str, dim: int) -> None:
        _in_2d(where, self.kind, dim)  # type: ignore[attr-defined]
        super().check(where, dim)


class Segment(_Planar):
    """All points within thickness / 2 of a straight line (2D): a ramp with round ends."""

    kind: Literal["segment"]
    start: list[Finite]
    end: list[Finite]
    thickness: Positive

    def extent(self) -> tuple[np.ndarray, np.ndarray]:
        ends = np.array([self.start, self.end])
        return ends.min(0) - self.thickness / 2, ends.max(0) + self.thickness / 2

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        edge = np.array([[self.start, self.end]], float)
        foot, _ = _nearest(points, edge)
        length, normal = _signed(points, foot, np.zeros(len(points), bool), np.broadcast_to(_left(edge), points.shape))
        return length - self.thickness / 2, normal


class Polygon(_Planar):
    """A simple polygon (2D), convex or not, its corners in either order."""

    kind: Literal["polygon"]
    vertices: Annotated[list[list[Finite]], Field(min_length=3, max_length=256)]

    def extent(self) -> tuple[np.ndarray, np.ndarray]:
        return np.min(self.vertices, axis=0), np.max(self.vertices, axis=0)

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        corners = np.array(self.vertices, float)
        following = np.roll(corners, -1, axis=0)
        area = (corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]).sum()
        edges = np.stack([corners, following], 1)
        inside, near = np.zeros(len(points), bool), self._into(points)
        for a, b in edges:  # the number of edges that a ray to the right crosses is odd inside
            spans = (a[1] > near[:, 1]) != (b[1] > near[:, 1])
            if spans.any():
                cut = a[0] + (near[spans, 1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
                inside[spans] ^= near[spans, 0] < cut
        hidden = self._beyond(edges)
        edges = edges[~hidden] if not hidden.all() else edges
        foot, which = _nearest(points, edges)
        return _signed(points, foot, inside, (-np.sign(area) * _left(edges))[which])


class Floor(_Planar):
    """All below a polyline ``vertices`` with ascending x (2D); level beyond its ends."""

    kind: Literal["floor"]
    vertices: Annotated[list[list[Finite]], Field(min_length=2, max_length=256)]

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        line = np.array(self.vertices, float)
        far = 1e3 * (np.abs(line).max() + np.abs(points).max(initial=1.0))
        line = np.concatenate([[[-far, line[0, 1]]], line, [[far, line[-1, 1]]]])
        edges = np.stack([line[:-1], line[1:]], 1)
        foot, which = _nearest(points, edges)
        return _signed(points, foot, points[:, 1] < np.interp(points[:, 0], *line.T), _left(edges)[which])


class Ball(_Solid):
    """A disc (2D) or ball (3D)."""

    kind: Literal["ball"]
    center: list[Finite]
    radius: Positive

    def extent(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array(self.center) - self.radius, np.array(self.center) + self.radius

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        up = np.eye(points.shape[1])[1]
        length, normal = _signed(points, np.broadcast_to(self.center, points.shape), np.zeros(len(points), bool), np.broadcast_to(up, points.shape))
        return length - self.radius, normal


class Box(_Solid):
    """A rectangle (2D) or box (3D) along the axes."""

    kind: Literal["box"]
    lower: list[Finite]
    upper: list[Finite]

    def extent(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array(self.lower), np.array(self.upper)

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = self.extent()
        if self._walls is not None:
            size, corner = 2 * np.ptp(self._walls) + np.abs(upper - lower).max(), np.stack([lower, upper])
            (low, high), hair = self._walls.T, 1e-9 * np.ptp(self._walls)
            lower, upper = np.where(corner[0] <= low + hair, low - size, lower), np.where(corner[1] >= high - hair, high + size, upper)
        offset = points - (lower + upper) / 2
        beyond = np.abs(offset) - (upper - lower) / 2
        axis, rows = beyond.argmax(1), np.arange(len(points))
        face = np.zeros_like(points)
        face[rows, axis] = np.where(offset[rows, axis] < 0, -1.0, 1.0)
        inside = beyond[rows, axis] <= 0
        foot = np.where(inside[:, None], points - face * beyond[rows, axis][:, None], np.clip(points, lower, upper))
        return _signed(points, foot, inside, face)


class Halfspace(_Solid):
    """Everything behind a plane: the solid is on the side that ``normal`` points away from."""

    kind: Literal["halfspace"]
    point: list[Finite]
    normal: list[Finite]

    def check(self, where: str, dim: int) -> None:
        super().check(where, dim)
        if not np.linalg.norm(self.normal) > 0:
            raise mistake(f"{where}.normal", self.normal, "has no direction")

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        normal = np.array(self.normal) / np.linalg.norm(self.normal)
        return (points - self.point) @ normal, np.broadcast_to(normal, points.shape).copy()


class Mesh(_Solid):
    """A closed triangle mesh (3D). vertices [n][3]; faces [m][3] indices, in any orientation."""

    kind: Literal["mesh"]
    vertices: list[list[Finite]]
    faces: list[list[int]]

    def check(self, where: str, dim: int) -> None:
        if dim != 3:
            raise mistake(f"{where}.kind", self.kind, "meshes are 3D; use a polygon")
        super().check(where, dim)
        faces = np.array(self.faces)
        if not 0 < len(faces) <= _MOST_TRIANGLES or faces.min() < 0 or faces.max() >= len(self.vertices):
            raise mistake(f"{where}.faces", self.faces[:1], f"must be at most {_MOST_TRIANGLES} triangles of indices of vertices")
        try:
            closed_surface(self.vertices, self.faces)
        except ValueError as error:
            raise mistake(f"{where}.faces", self.faces[:1], str(error)) from None

    def extent(self) -> tuple[np.ndarray, np.ndarray]:
        return np.min(self.vertices, axis=0), np.max(self.vertices, axis=0)

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """VTK: nearest cells, and the sign of the angle-weighted pseudo-normal (Baerentzen & Aanaes 2005), robust at edges and corners."""
        surface = closed_surface(self.vertices, self.faces)
        import pyvista

        cloud = pyvista.PolyData(np.ascontiguousarray(points, np.float64))
        sign = np.asarray(pyvista.PolyData(self._into(cloud.points)).compute_implicit_distance(surface)["implicit_distance"], float)
        hidden = self._beyond(np.asarray(surface.points, float)[np.asarray(surface.regular_faces)])
        if hidden.any() and not hidden.all():
            surface = surface.remove_cells(hidden)
        cells, foot = surface.find_closest_cell(cloud.points, return_closest_point=True)
        return _signed(points, np.asarray(foot, float), sign < 0, np.asarray(surface.face_normals, float)[cells])


def closed_surface(vertices, faces):
    """A pyvista surface with normals pointing out; ``ValueError`` where the mesh is not closed."""
    import pyvista

    faces = np.asarray(faces, np.int64)
    corners = np.concatenate([np.full((len(faces), 1), 3), faces], 1).ravel()
    surface = pyvista.PolyData(np.asarray(vertices, float), corners).clean()
    if surface.n_open_edges or not surface.is_manifold:
        raise ValueError(f"not a closed surface ({surface.n_open_edges} open edges)")
    return surface.compute_normals(cell_normals=True, point_normals=False, auto_orient_normals=True, consistent_normals=True)


Obstacle = Annotated[Segment | Polygon | Floor | Ball | Box | Halfspace | Mesh, Field(discriminator="kind")]


def within(obstacles: list, bounds: np.ndarray) -> list:
    """The same solids as particles inside ``bounds`` [dim, 2] meet them: without the faces that lie on or beyond a wall.

    A wedge in a corner or a plate from wall to wall goes on behind the walls. Were its ends surfaces, the nearest one beside a wall
    would be the wall's own, and particles would be let down into the solid along it.
    """
    found = [obstacle.model_copy() for obstacle in obstacles]
    for obstacle in found:
        obstacle._walls = np.asarray(bounds, float)
    return found


def combine(obstacles: list, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Union of at least one obstacle: distance [n], normal [n, dim], index of the nearest obstacle [n]."""
    distance, normal = obstacles[0].distance(points)
    nearest = np.zeros(len(points), int)
    for index, obstacle in enumerate(obstacles[1:], start=1):
        other, its_normal = obstacle.distance(points)
        nearer = other < distance
        distance, normal, nearest = np.where(nearer, other, distance), np.where(nearer[:, None], its_normal, normal), np.where(nearer, index, nearest)
    return distance, normal, nearest


def boundary_particles(obstacles: list, bounds: np.ndarray, spacing: float) -> np.ndarray:
    """[k, dim]: one layer of particles half a spacing below the obstacles' surface, about a spacing apart, inside the box.

    A particle stands for a blob one spacing wide, so this layer's outer faces are the surface. Candidates: the corners of a fine
    lattice (found by bisecting cells that may hold the layer) moved onto it along the normal; kept in ascending order of their
    coordinates unless a kept one is nearer than a little less than a spacing. No random numbers.
    """
    lower, upper = np.asarray(bounds, float).T
    dim, depth = len(lower), spacing / 2
    edge = 4.0 * spacing
    counts = np.maximum(np.ceil((upper - lower) / edge).astype(int), 1)
    centres = lower + (np.stack(np.meshgrid(*[np.arange(count) for count in counts], indexing="ij"), -1).reshape(-1, dim) + 0.5) * edge
    # Along a line, candidates an eighth of a spacing apart keep the gaps even; over a surface a quarter will do, and must.
    fine = spacing / 8 if dim == 2 else spacing / 4
    halves = np.stack(np.meshgrid(*[[-0.25, 0.25]] * dim, indexing="ij"), -1).reshape(-1, dim)
    while True:
        level = combine(obstacles, centres)[0] + depth
        centres = centres[np.abs(level) <= edge * np.sqrt(dim) / 2]
        if edge <= fine or not len(centres):
            break
        centres = (centres[:, None] + halves * edge).reshape(-1, dim)
        edge /= 2
    for _ in range(3):
        if len(centres):
            level, normal, _ = combine(obstacles, centres)
            centres = centres - (level + depth)[:, None] * normal
    if len(centres):
        on_layer = np.abs(combine(obstacles, centres)[0] + depth) < 1e-3 * spacing
        centres = centres[on_layer & (centres >= lower).all(1) & (centres <= upper).all(1)]
    centres = np.unique(np.round(centres, 12), axis=0)
    if not len(centres):
        return np.empty((0, dim))
    tree, alive, kept = cKDTree(centres), np.ones(len(centres), bool), []
    apart = (0.94 if dim == 2 else 0.9) * spacing
    for index in range(len(centres)):
        if alive[index]:
            kept.append(index)
            alive[tree.query_ball_point(centres[index], apart)] = False
    return centres[kept]


# --- families ---------------------------------------------------------------------------------------------------------


class _Family(Strict):
    """``count`` obstacles; ``center`` defaults to anywhere in the box where the obstacle fits as a whole. friction: default the walls'."""

    count: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0, le=64)]] = (1, 1)
    friction: Friction | None = None

    def check(self, where: str, dim: int, cell: float) -> None:
        """Raise the first fault; ``cell``: grid spacing."""
        if self.count[0] > self.count[1]:
            raise mistake(f"{where}.count", list(self.count), "low must not exceed high")

    def place(self, bounds: np.ndarray, rng: np.random.Generator) -> _Solid:
        """Draw one."""
        raise NotImplementedError


def _center(center: list[Range] | None, half: np.ndarray, bounds: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    if center is not None:
        return np.array([sample(value, rng) for value in center])
    lower, upper = bounds.T
    return lower + half + rng.uniform(size=len(half)) * np.maximum(upper - lower - 2 * half, 0)


def _thick(where: str, value: Range, cell: float, share: float = 1.0) -> None:
    least = THINNEST * cell * share
    check_range(where, value, least, f"thinner than {THINNEST:g} grid cells, so that particles leak through; use at least {least:.4g}")


class SegmentFamily(_Family):
    """Straight ramps: ``length`` between the ends of the axis; ``angle`` [degrees] from the x axis; ``thickness`` of the plate."""

    kind: Literal["segment"]
    length: Range
    angle: Range
    thickness: Range
    center: list[Range] | None = None

    def check(self, where: str, dim: int, cell: float) -> None:
        super().check(where, dim, cell)
        _in_2d(where, self.kind, dim)
        check_vectors(where, {"center": self.center}, dim)
        check_range(f"{where}.angle", self.angle)
        check_range(f"{where}.length", self.length, 1e-9, "must be positive")
        _thick(f"{where}.thickness", self.thickness, cell)

    def place(self, bounds: np.ndarray, rng: np.random.Generator) -> Segment:
        length, angle, thickness = sample(self.length, rng), np.radians(sample(self.angle, rng)), sample(self.thickness, rng)
        half = length / 2 * np.array([np.cos(angle), np.sin(angle)])
        center = _center(self.center, np.abs(half) + thickness / 2, bounds, rng)
        return Segment(kind="segment", start=(center - half).tolist(), end=(center + half).tolist(), thickness=thickness, friction=self.friction)


class PolygonFamily(_Family):
    """A fixed polygon (``vertices``), or random convex ones: hulls of ``corners`` points on a circle of ``radius`` at even angles,
    each shifted by up to a quarter of the gap, and turned."""

    kind: Literal["polygon"]
    vertices: list[list[Finite]] | None = None
    radius: Range | None = None
    corners: tuple[Annotated[int, Field(ge=3)], Annotated[int, Field(ge=3, le=64)]] = (3, 7)
    center: list[Range] | None = None

    def check(self, where: str, dim: int, cell: float) -> None:
        super().check(where, dim, cell)
        _in_2d(where, self.kind, dim)
        check_vectors(where, {"center": self.center}, dim)
        if (self.vertices is None) == (self.radius is None):
            raise mistake(f"{where}.vertices", self.vertices, "give either vertices (a fixed polygon) or radius (random ones)")
        if self.corners[0] > self.corners[1]:
            raise mistake(f"{where}.corners", list(self.corners), "low must not exceed high")
        if self.radius is not None:
            # The slimmest, a triangle with two corners moved together (arcs 60, 120, 180 degrees), has an inscribed circle 0.73 radii wide.
            _thick(f"{where}.radius", self.radius, cell, 1 / 0.73)
            return
        if self.center is not None:
            raise mistake(f"{where}.center", self.center, "fixed vertices have their place; remove center")
        vertices = self.vertices or []
        for index, vertex in enumerate(vertices):
            check_vectors(where, {f"vertices[{index}]": vertex}, dim)
        _check_outline(where, vertices)

    def place(self, bounds: np.ndarray, rng: np.random.Generator) -> Polygon:
        if self.vertices is not None:
            return Polygon(kind="polygon", vertices=self.vertices, friction=self.friction)
        assert self.radius is not None  # by ``check``
        radius, corners = sample(self.radius, rng), int(rng.integers(self.corners[0], self.corners[1] + 1))
        angles = rng.uniform(0, 2 * np.pi) + 2 * np.pi / corners * (np.arange(corners) + rng.uniform(-0.25, 0.25, corners))
        center = _center(self.center, np.full(2, radius), bounds, rng)
        vertices = center + radius * np.stack([np.cos(angles), np.sin(angles)], 1)
        return Polygon(kind="polygon", vertices=vertices.tolist(), friction=self.friction)


class BallFamily(_Family):
    """Discs (2D) or balls (3D)."""

    kind: Literal["ball"]
    radius: Range
    center: list[Range] | None = None

    def check(self, where: str, dim: int, cell: float) -> None:
        super().check(where, dim, cell)
        check_vectors(where, {"center": self.center}, dim)
        _thick(f"{where}.radius", self.radius, cell, 0.5)

    def place(self, bounds: np.ndarray, rng: np.random.Generator) -> Ball:
        radius = sample(self.radius, rng)
        center = _center(self.center, np.full(len(bounds), radius), bounds, rng)
        return Ball(kind="ball", center=center.tolist(), radius=radius, friction=self.friction)


class BoxFamily(_Family):
    """Rectangles (2D) or boxes (3D) along the axes, ``size`` [low, high] an axis."""

    kind: Literal["box"]
    size: list[Range]
    center: list[Range] | None = None

    def check(self, where: str, dim: int, cell: float) -> None:
        super().check(where, dim, cell)
        check_vectors(where, {"center": self.center, "size": self.size}, dim)
        for axis, edge in enumerate(self.size):
            _thick(f"{where}.size[{axis}]", edge, cell)

    def place(self, bounds: np.ndarray, rng: np.random.Generator) -> Box:
        half = np.array([sample(edge, rng) for edge in self.size]) / 2
        center = _center(self.center, half, bounds, rng)
        return Box(kind="box", lower=(center - half).tolist(), upper=(center + half).tolist(), friction=self.friction)


class HalfspaceFamily(_Family):
    """Everything behind a plane through ``point``, on the side that ``normal`` points away from."""

    kind: Literal["halfspace"]
    point: list[Range]
    normal: list[Range]

    def check(self, where: str, dim: int, cell: float) -> None:
        super().check(where, dim, cell)
        check_vectors(where, {"point": self.point, "normal": self.normal}, dim)
        if all((low <= 0 <= high) if isinstance(value, tuple) else value == 0 for value in self.normal for low, high in [_ends(value)]):
            raise mistake(f"{where}.normal", self.normal, "may come out as zero; keep one entry away from it")

    def place(self, bounds: np.ndarray, rng: np.random.Generator) -> Halfspace:
        point, normal = ([sample(value, rng) for value in values] for values in (self.point, self.normal))
        return Halfspace(kind="halfspace", point=point, normal=normal, friction=self.friction)


class FloorFamily(_Family):
    """A piecewise linear floor from wall to wall (2D): ``pieces`` [low, high] of equal width, the height of each joint drawn from ``height``."""

    kind: Literal["floor"]
    pieces: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1, le=64)]]
    height: Range

    def check(self, where: str, dim: int, cell: float) -> None:
        super().check(where, dim, cell)
        _in_2d(where, self.kind, dim)
        if self.pieces[0] > self.pieces[1]:
            raise mistake(f"{where}.pieces", list(self.pieces), "low must not exceed high")
        check_range(f"{where}.height", self.height)

    def place(self, bounds: np.ndarray, rng: np.random.Generator) -> Floor:
        pieces = int(rng.integers(self.pieces[0], self.pieces[1] + 1))
        vertices = [[float(x), sample(self.height, rng)] for x in np.linspace(bounds[0, 0], bounds[0, 1], pieces + 1)]
        return Floor(kind="floor", vertices=vertices, friction=self.friction)


class MeshFamily(_Family):
    """A closed mesh from a file (STL, OBJ, PLY; its path is relative to the scene file), ``scale`` times as large, around ``center``."""

    kind: Literal["mesh"]
    file: str
    scale: Range = 1.0
    center: list[Range] | None = None

    def check(self, where: str, dim: int, cell: float) -> None:
        super().check(where, dim, cell)
        if dim != 3:
            raise mistake(f"{where}.kind", self.kind, "meshes are 3D; use a polygon")
        check_vectors(where, {"center": self.center}, dim)
        check_range(f"{where}.scale", self.scale, 1e-9, "must be positive")

    def read(self, folder: Path, where: object, key: str) -> tuple[np.ndarray, np.ndarray]:
        """Vertices [n, 3] about the centre of their bounding box, faces [m, 3]; raises ``InputError``."""
        import meshio

        path = folder / self.file
        try:
            # Its reader of PLY prints, and all of them end a program with SystemExit on some damaged files.
            mesh = meshio.read(path)
            vertices, faces = np.asarray(mesh.points, float), mesh.get_cells_type("triangle")
            quads = mesh.get_cells_type("quad")
            if len(quads):
                faces = np.concatenate([np.reshape(faces, (-1, 3)), quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
            if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(faces) or not np.isfinite(vertices).all():
                raise ValueError("no triangles in 3D")
            if len(faces) > _MOST_TRIANGLES:
                raise ValueError(f"{len(faces)} triangles, at most {_MOST_TRIANGLES} are allowed")
            surface = closed_surface(vertices, faces)
        except (Exception, SystemExit) as error:
            fault = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise InputError(where, f"{key}.file", self.file, f"cannot be used ({fault}); give a closed mesh as STL, OBJ or PLY") from None
        vertices, faces = np.asarray(surface.points, float), np.asarray(surface.regular_faces)
        return vertices - (vertices.min(0) + vertices.max(0)) / 2, faces

    def place_mesh(self, bounds: np.ndarray, rng: np.random.Generator, geometry: tuple[np.ndarray, np.ndarray]) -> Mesh:
        """Draw one of what ``read`` has found."""
        vertices = geometry[0] * sample(self.scale, rng)
        vertices = vertices + _center(self.center, np.ptp(vertices, axis=0) / 2, bounds, rng)
        return Mesh(kind="mesh", vertices=vertices.tolist(), faces=geometry[1].tolist(), friction=self.friction)


ObstacleFamily = Annotated[
    SegmentFamily | PolygonFamily | BallFamily | BoxFamily | HalfspaceFamily | FloorFamily | MeshFamily, Field(discriminator="kind")
]


def _ends(value: Range) -> tuple[float, float]:
    return value if isinstance(value, tuple) else (value, value)


def _in_2d(where: str, kind: str, dim: int) -> None:
    if dim != 2:
        raise mistake(f"{where}.kind", kind, "is 2D; use a box, ball, halfspace or mesh")


def _check_outline(where: str, vertices: list[list[float]]) -> None:
    corners = np.array(vertices, float)
    if len(corners) < 3 or not (np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) > 0).all():
        raise mistake(f"{where}.vertices", vertices, "needs three different corners at least, no two in a row alike")
    try:
        ConvexHull(corners)
    except Exception:  # Qhull's own error type is not public
        raise mistake(f"{where}.vertices", vertices, "the corners lie on one line") from None


def outside(obstacle: _Solid, anywhere: bool, bounds: np.ndarray) -> str | None:
    """Why an obstacle is not where it must be: reaching into the box, ``bounds`` [dim, 2], and wholly inside where its place was ours to draw."""
    lower, upper = bounds.T
    extent = obstacle.extent()
    if extent is None:
        corners = np.stack(np.meshgrid(*bounds, indexing="ij"), -1).reshape(-1, len(bounds))
        signs = obstacle.distance(corners)[0] < 0
        crosses = signs.any() and not signs.all()
        if isinstance(obstacle, Floor):
            heights = np.array(obstacle.vertices)[:, 1]
            crosses = heights.max() > lower[1] and heights.max() < upper[1]
        return None if crosses else "outside the box, or filling it"
    low, high = extent
    if anywhere:
        return "outside the box" if (low < lower - 1e-9).any() or (high > upper + 1e-9).any() else None
    return "outside the box" if (high <= lower).any() or (low >= upper).any() else None
