"""How far a predicted rollout is from the true one, particle by particle and as a cloud.

Every function is pure numpy/scipy in float64. Positions are [frames, particles, dim] in container units [length]; frame 0 of a
rollout is the first *predicted* frame. Three values are not numbers and mean different things: ``None`` is undefined (a horizon longer than
the rollout, a pile height without gravity), ``inf`` is "never" (divergence time, first non-finite frame), ``nan`` is a failed rollout.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from sim import periodic
from sim.errors import InputError
from sim.obstacles import combine
from sim.scene import Scene
from sim.trajectory import Trajectory

HORIZONS = (1, 5, 20, 100)
#: Shares of the rollout at which clouds are compared (the last is its last frame).
CLOUD_TIMES = (0.25, 0.5, 0.75, 1.0)
SUBSAMPLE_SEED = 0


# Particle by particle -------------------------------------------------------------------------------------------------------


def frame_mse(predicted: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Mean over particles and axes of (p - q)^2 in every frame, [frames], length^2; NaN where the prediction is."""
    return ((np.asarray(predicted, float) - np.asarray(true, float)) ** 2).mean(axis=(1, 2))


def one_step_mse(predicted: np.ndarray, true: np.ndarray) -> float:
    """Mean over samples, particles and axes of (p - q)^2, length^2: [samples, particles, dim] single steps, each from true history."""
    return float(frame_mse(predicted, true).mean())


def rollout_mse(predicted: np.ndarray, true: np.ndarray, horizons: tuple[int, ...] = HORIZONS) -> dict[str, float | None]:
    """Mean over the first h frames, all particles and axes of (p - q)^2, length^2, for every h and "all" (Sanchez-Gonzalez et al. 2020).

    Give moving particles only to keep static obstacles, which count as zeros, out of the mean. None where the rollout is shorter than h.
    """
    error = frame_mse(predicted, true)
    result: dict[str, float | None] = {str(h): float(error[:h].mean()) if h <= len(error) else None for h in horizons}
    return result | {"all": float(error.mean())}


def rms_distance(predicted: np.ndarray, true: np.ndarray) -> np.ndarray:
    """sqrt(mean over particles of |p - q|^2) in every frame, [frames], length."""
    return np.sqrt(frame_mse(predicted, true) * predicted.shape[2])


def divergence_time(predicted: np.ndarray, true: np.ndarray, radius: float, frame_step: float) -> float:
    """First time [s] after the start at which the RMS particle distance exceeds the connectivity radius or is not finite; inf if never."""
    beyond = ~(rms_distance(predicted, true) <= radius)
    return float((np.argmax(beyond) + 1) * frame_step) if beyond.any() else math.inf


def first_non_finite(predicted: np.ndarray) -> float:
    """Number, counted from 1, of the first predicted frame with a non-finite position; inf if there is none."""
    broken = ~np.isfinite(predicted).all(axis=(1, 2))
    return float(np.argmax(broken) + 1) if broken.any() else math.inf


def escaped_fraction(position: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Share of the particles outside the container in every frame, [frames]; NaN in non-finite frames. Nothing is clamped first.

    bounds [dim, 2]. Float32 storage rounds a particle on the wall to either side, so 1e-6 of the edge is allowed.
    """
    position, bounds = np.asarray(position, float), np.asarray(bounds, float)
    slack = 1e-6 * (bounds[:, 1] - bounds[:, 0])
    outside = ((position < bounds[:, 0] - slack) | (position > bounds[:, 1] + slack)).any(axis=2).mean(axis=1)
    return np.where(np.isfinite(position).all(axis=(1, 2)), outside, np.nan)


#: Frames of a rollout, evenly spaced to its last, in which particles inside obstacles are looked for: distances to a mesh take seconds a million.
_OBSTACLE_FRAMES = 100


def penetrated_fraction(position: np.ndarray, obstacles: list, bounds: np.ndarray, spacing: float) -> np.ndarray:
    """Share of the particles in the container and more than half a spacing inside an obstacle, in every frame: [frames]; NaN in non-finite frames.

    position [frames, particles, dim]; obstacles: at least one, see ``sim.scene.Scene.surfaces``; bounds [dim, 2]. A particle that rests on a face
    is less deep; one outside the container is an escaped one.
    """
    position, bounds = np.asarray(position, float), np.asarray(bounds, float)
    finite = np.isfinite(position).all(axis=(1, 2))
    inside = np.full(len(position), np.nan)
    if finite.any():
        distance, _, _ = combine(obstacles, position[finite].reshape(-1, position.shape[2]))
        contained = ((position[finite] >= bounds[:, 0]) & (position[finite] <= bounds[:, 1])).all(axis=2)
        inside[finite] = ((distance < -spacing / 2).reshape(contained.shape) & contained).mean(axis=1)
    return inside


# Energy and momentum --------------------------------------------------------------------------------------------------------


def velocities(position: np.ndarray, before: np.ndarray, frame_step: float, period: np.ndarray | None = None) -> np.ndarray:
    """(p_t - p_(t-1)) / frame_step, [frames, particles, dim], length / s; ``before`` [particles, dim] precedes the first frame."""
    return periodic.shortest(np.diff(np.concatenate([before[None], position]).astype(float), axis=0), period) / frame_step


def kinetic_energy(velocity: np.ndarray) -> np.ndarray:
    """Kinetic energy per unit mass, mean over particles of |v|^2 / 2, in every frame: [frames], length^2 / s^2."""
    return 0.5 * (np.asarray(velocity, float) ** 2).sum(axis=2).mean(axis=1)


def kinetic_energy_mse(velocity: np.ndarray, true_velocity: np.ndarray) -> float:
    """Mean over frames of the squared difference of the kinetic energies per unit mass, length^4 / s^4 (Toshev et al. 2023)."""
    return float(((kinetic_energy(velocity) - kinetic_energy(true_velocity)) ** 2).mean())


def momentum_drift(velocity: np.ndarray, true_velocity: np.ndarray) -> float | None:
    """Largest over frames of |P - P_true| / M, over the root mean square true speed: dimensionless, equal particle masses.

    Walls and gravity change the true momentum, so it is the difference from the truth that is a drift. None if nothing truly moves.
    """
    speed = math.sqrt((np.asarray(true_velocity, float) ** 2).sum(axis=2).mean())
    drift = np.linalg.norm(np.asarray(velocity, float).mean(axis=1) - np.asarray(true_velocity, float).mean(axis=1), axis=1)
    return float(drift.max() / speed) if speed > 0 else None


# Clouds: position [particles, dim] ------------------------------------------------------------------------------------------


def subsample(count: int, limit: int) -> np.ndarray:
    """Sorted indices of at most ``limit`` of ``count`` particles, drawn with ``SUBSAMPLE_SEED``: the same particles in every cloud."""
    if count <= limit:
        return np.arange(count)
    return np.sort(np.random.default_rng(SUBSAMPLE_SEED).choice(count, limit, replace=False))


def _costs(p: np.ndarray, q: np.ndarray, metric: str, period: np.ndarray | None) -> np.ndarray:
    """[n, m]: |p_i - q_j| (``euclidean``) or its square (``sqeuclidean``)."""
    p, q = np.asarray(p, float), np.asarray(q, float)
    if period is None:
        return cdist(p, q, metric)
    square = (periodic.shortest(p[:, None] - q, period) ** 2).sum(axis=2)
    return square if metric == "sqeuclidean" else np.sqrt(square)


def earth_movers_distance(p: np.ndarray, q: np.ndarray, spacing: float, period: np.ndarray | None = None) -> float:
    """Exact Wasserstein-1 distance of two equally large clouds, min over matchings of mean |p_i - q_s(i)|, in particle spacings."""
    cost = _costs(p, q, "euclidean", period)
    return float(cost[linear_sum_assignment(cost)].mean() / spacing)


def _soft_minimum(cost: np.ndarray, potential: np.ndarray, epsilon: float) -> np.ndarray:
    """-epsilon log(mean_j exp((potential_j - cost_ij) / epsilon)): one Sinkhorn half step in the log domain."""
    exponent = (potential - cost) / epsilon
    peak = exponent.max(axis=1)
    return -epsilon * (peak + np.log(np.exp(exponent - peak[:, None]).mean(axis=1)))


#: The dual objective of entropic transport is within this share of epsilon of its maximum.
_TRANSPORT_TOLERANCE = 1e-6
#: The same while epsilon is lowered: a start for the next.
_SCALE_TOLERANCE = 1e-2
#: Of the Newton steps, in shares of a particle's weight.
_LEAST_DAMPING = 1e-12


def entropic_transport(p: np.ndarray, q: np.ndarray, epsilon: float, period: np.ndarray | None = None) -> float:
    """OT(p, q) = min over plans of <plan, |p_i - q_j|^2> + epsilon KL(plan | uniform product), length^2; NaN if it does not converge.

    Uniform weights. Newton's method on the dual (Brauer et al. 2017), as clouds with a droplet several sqrt(epsilon) apart would take
    thousands of Sinkhorn steps, while epsilon is lowered from the squared diameter. Droplets that nearly nothing joins leave the curvature almost
    singular: steps are damped (Levenberg 1944, Marquardt 1963) until they gain a tenth of what the quadratic model promises.
    """
    cost = _costs(p, q, "sqeuclidean", period)
    rows, columns = cost.shape
    g, largest = np.zeros(columns), float(cost.max())
    scale = max(largest, epsilon)
    while True:
        tolerance = (_TRANSPORT_TOLERANCE if scale == epsilon else _SCALE_TOLERANCE) * scale
        damping = _LEAST_DAMPING
        for _ in range(100):
            f = _soft_minimum(cost, g, scale)
            g = _soft_minimum(cost.T, f, scale)
            # g is optimal for f, so the columns of the plan are exact and mean(f) + mean(g) is the dual objective, a concave function of f.
            value = f.mean() + g.mean()
            with np.errstate(all="ignore"):
                plan = np.exp((f[:, None] + g - cost) / scale) / (rows * columns)
                missing = 1 / rows - plan.sum(axis=1)
                # A constant added to f changes nothing; it is fixed without moving the maximum.
                curvature = np.diag(plan.sum(axis=1)) - columns * plan @ plan.T + 1 / rows**2
            if not np.isfinite(curvature).all():
                return math.nan
            # Concave, and the best f is within the range of the costs: this is all that can be gained.
            if converged := np.abs(missing).sum() * largest <= tolerance:
                break
            while damping < 1:
                step = scale * np.linalg.solve(curvature + damping / rows * np.eye(rows), missing)
                gain = 0.5 * float(missing @ step)
                if converged := gain <= tolerance and damping == _LEAST_DAMPING:
                    break
                trial = _soft_minimum(cost.T, f + step, scale)
                if (f + step).mean() + trial.mean() > value + 0.1 * gain:
                    f, g, damping = f + step, trial, max(damping / 10, _LEAST_DAMPING)
                    break
                damping *= 10
            if converged:
                break
            damping = min(damping, 0.1)  # where no step gains, the next Sinkhorn step does
        if not converged:
            return math.nan
        if scale == epsilon:
            return float(value)
        scale = max(scale / 4, epsilon)


def _self_transport(p: np.ndarray, epsilon: float, period: np.ndarray | None = None) -> float:
    """OT(p, p) with one potential; the averaged step converges in tens of iterations (Feydy et al. 2019).

    No log domain is needed: the kernel's diagonal is 1, so that the scalings stay between 1/n and sqrt(n).
    """
    kernel = np.exp(-_costs(p, p, "sqeuclidean", period) / epsilon) / len(p)
    u = np.ones(len(p))
    for _ in range(10_000):
        update = np.sqrt(u / (kernel @ u))
        change = np.abs(np.log(update / u)).max()
        u = update
        if change < _TRANSPORT_TOLERANCE:
            return float(2 * epsilon * np.log(u).mean())
    return math.nan


def sinkhorn_divergence(p: np.ndarray, q: np.ndarray, epsilon: float, period: np.ndarray | None = None) -> float:
    """OT(p, q) - OT(p, p) / 2 - OT(q, q) / 2, length^2: >= 0, zero for equal clouds, |t|^2 for a cloud moved by t (Feydy et al. 2019).

    p [n, dim], q [m, dim]; uniform weights, squared distance; epsilon [length^2] is the entropic blur squared. Converged to 1e-6
    epsilon; NaN if that cannot be reached.
    """
    return entropic_transport(p, q, epsilon, period) - 0.5 * (_self_transport(p, epsilon, period) + _self_transport(q, epsilon, period))


def density(position: np.ndarray, bounds: np.ndarray, cell: float, spacing: float, period: np.ndarray | None = None) -> np.ndarray:
    """Volume fraction at the nodes of a grid over the container: bilinear deposit of spacing^dim a particle, over cell^dim.

    [nodes, ...], 1 inside a cloud at rest and half of it on a wall; particles outside the container are left out. Along a periodic axis the
    nodes run around, and cells are as much smaller as whole ones need to be.
    """
    position, bounds = np.asarray(position, float), np.asarray(bounds, float)
    around = np.zeros(len(bounds), bool) if period is None else period > 0
    length = bounds[:, 1] - bounds[:, 0]
    cells = np.ceil(length / cell - 1e-9).astype(int)
    edge, nodes = np.where(around, length / cells, cell), np.where(around, cells, cells + 1)
    position = periodic.wrapped(position, bounds, period)
    position = position[((position >= bounds[:, 0]) & (position <= bounds[:, 1])).all(axis=1)]
    base = (position - bounds[:, 0]) / edge
    corner = np.minimum(base.astype(int), cells - 1)
    share = base - corner
    grid = np.zeros(nodes)
    for offset in np.ndindex(*(2,) * position.shape[1]):
        weight = np.where(offset, share, 1 - share).prod(axis=1)
        np.add.at(grid, tuple(((corner + offset) % nodes).T), weight)
    return grid * np.prod(spacing / edge)


def density_error(p: np.ndarray, q: np.ndarray, bounds: np.ndarray, spacing: float, period: np.ndarray | None = None) -> tuple[float, float]:
    """(mean, max) of |density(p) - density(q)| over the nodes where either is not zero; grid of two spacings, in rest densities."""
    first, second = (density(cloud, bounds, 2 * spacing, spacing, period) for cloud in (p, q))
    used = (first > 0) | (second > 0)
    difference = np.abs(first - second)[used]
    return (float(difference.mean()), float(difference.max())) if used.any() else (0.0, 0.0)


def spacing_ratio(p: np.ndarray, q: np.ndarray, period: np.ndarray | None = None) -> float | None:
    """Mean nearest-neighbour distance in p over that in q (0.85-1.15 looks right, less is clumping); None below two particles."""
    if len(p) < 2 or len(q) < 2:
        return None
    trees = [periodic.tree(cloud, period) for cloud in (p, q)]
    nearest = [tree.query(tree.data, k=2)[0][:, 1].mean() for tree in trees]
    return float(nearest[0] / nearest[1]) if nearest[1] > 0 else None


def centre_of_mass_error(p: np.ndarray, q: np.ndarray, spacing: float) -> float:
    """|mean p - mean q| in particle spacings, equal masses."""
    return float(np.linalg.norm(np.asarray(p, float).mean(axis=0) - np.asarray(q, float).mean(axis=0)) / spacing)


#: Extents are taken between these quantiles, so that one stray drop is not the front.
_EXTENT_QUANTILES = (0.01, 0.99)


def vertical_axis(gravity: np.ndarray) -> int | None:
    """The axis along which gravity is strongest; None without gravity."""
    gravity = np.abs(np.asarray(gravity, float))
    return int(np.argmax(gravity)) if gravity.any() else None


def _height(position: np.ndarray, bounds: np.ndarray, gravity: np.ndarray) -> np.ndarray:
    """Height of every particle above the floor, the face that gravity points to, [particles]."""
    axis = vertical_axis(gravity)
    down = float(np.sign(gravity[axis]))
    return down * (bounds[axis, int(down > 0)] - np.asarray(position, float)[:, axis])


def front(position: np.ndarray, gravity: np.ndarray) -> float:
    """Front position [length]: 99 % quantile along the first horizontal axis."""
    axis = 1 if vertical_axis(gravity) == 0 else 0
    return float(np.quantile(np.asarray(position, float)[:, axis], _EXTENT_QUANTILES[1]))


def width(position: np.ndarray, gravity: np.ndarray) -> float:
    """Run-out [length]: the larger of the horizontal extents between the 1 % and 99 % quantiles."""
    horizontal = [axis for axis in range(position.shape[1]) if axis != vertical_axis(gravity)]
    low, high = np.quantile(np.asarray(position, float)[:, horizontal], _EXTENT_QUANTILES, axis=0)
    return float((high - low).max())


def pile_height(position: np.ndarray, bounds: np.ndarray, gravity: np.ndarray) -> float | None:
    """99 % quantile of the height above the floor [length]; None without gravity."""
    return None if vertical_axis(gravity) is None else float(np.quantile(_height(position, bounds, gravity), _EXTENT_QUANTILES[1]))


def pile_angle(position: np.ndarray, bounds: np.ndarray, gravity: np.ndarray, spacing: float) -> float | None:
    """Slope of the surface in degrees: least squares of the height of the highest particle of each column over its distance from the axis.

    Columns are two spacings wide and the axis goes through the centre of mass, so a pile that leans on a wall reads low. None without
    gravity or with fewer than three columns.
    """
    axis = vertical_axis(gravity)
    if axis is None:
        return None
    horizontal = np.delete(np.asarray(position, float), axis, axis=1)
    height = _height(position, bounds, gravity)
    order = np.argsort(-height, kind="stable")
    _, first = np.unique(np.floor(horizontal[order] / (2 * spacing)), axis=0, return_index=True)
    top = order[first]
    distance = np.linalg.norm(horizontal[top] - horizontal.mean(axis=0), axis=1)
    if len(top) < 3 or np.ptp(distance) == 0:
        return None
    return float(np.degrees(np.arctan(-np.polyfit(distance, height[top], 1)[0])))


# All of it ------------------------------------------------------------------------------------------------------------------


#: What ``cloud_metrics`` measures.
CLOUD_METRICS = (
    "sinkhorn",
    "emd",
    "spacing_ratio",
    "density_error_mean",
    "density_error_max",
    "centre_of_mass_error",
    "front_error",
    "width_ratio",
    "height_ratio",
    "pile_angle_error",
)


def cloud_metrics(p: np.ndarray, q: np.ndarray, trajectory: Trajectory, *, emd_particles: int = 500, sinkhorn_particles: int = 300) -> dict:
    """Every cloud metric of one predicted frame p against the true one q, both [particles, dim], moving particles; NaN if p is not finite.

    ``sinkhorn`` has epsilon = R^2; clouds above the given sizes are subsampled for it and for ``emd``; ratios are predicted over true;
    ``front_error``, ``centre_of_mass_error`` and ``emd`` in spacings, ``pile_angle_error`` in degrees. In a periodic box p are the images beside
    q, and extents, heights and slopes, which need walls to begin from, are None.
    """
    spacing, bounds, gravity = float(trajectory.scene["spacing"]), trajectory.bounds, np.asarray(trajectory.scene["gravity"], float)
    period = trajectory.period
    if not np.isfinite(p).all():
        return dict.fromkeys(CLOUD_METRICS, math.nan)

    def ratio(predicted: float | None, true: float | None) -> float | None:
        return None if predicted is None or not true else predicted / true

    few, some = subsample(len(p), sinkhorn_particles), subsample(len(p), emd_particles)
    mean, largest = density_error(p, q, bounds, spacing, period)
    found = {
        "sinkhorn": sinkhorn_divergence(p[few], q[few], trajectory.radius**2, period),
        "emd": earth_movers_distance(p[some], q[some], spacing, period),
        "spacing_ratio": spacing_ratio(p, q, period),
        "density_error_mean": mean,
        "density_error_max": largest,
        "centre_of_mass_error": centre_of_mass_error(p, q, spacing),
    }
    if period is None:
        slope, true_slope = (pile_angle(cloud, bounds, gravity, spacing) for cloud in (p, q))
        found |= {
            "front_error": abs(front(p, gravity) - front(q, gravity)) / spacing,
            "width_ratio": ratio(width(p, gravity), width(q, gravity)),
            "height_ratio": ratio(pile_height(p, bounds, gravity), pile_height(q, bounds, gravity)),
            "pile_angle_error": None if slope is None or true_slope is None else abs(slope - true_slope),
        }
    return dict.fromkeys(CLOUD_METRICS) | found


def evaluate(
    predicted: np.ndarray,
    trajectory: Trajectory,
    present: int,
    *,
    horizons: tuple[int, ...] = HORIZONS,
    emd_particles: int = 500,
    sinkhorn_particles: int = 300,
) -> dict:
    """Every metric of one rollout: predicted [frames, particles, dim] are the frames after ``present`` of the true trajectory.

    Keys hold a number, or a dict by horizon ("1", ..., "all") or by share of the rollout ("0.25", ..., "1"); units as in the functions above,
    ``..._per_radius2`` and ``..._per_edge2`` (longest container edge) without unit. The clouds, energies and escapes are of the moving particles.
    In a periodic box errors are those of the nearest images, and nothing escapes. ``penetrated_fraction`` is None where the scene
    tells of no obstacles, its worst that of a hundred frames. Raises ``InputError`` for a scene with obstacles that is not one, or of another
    dimension than the positions.
    """
    moving, period = trajectory.moving, trajectory.period
    true = trajectory.position[present + 1 : present + 1 + len(predicted)]
    predicted = periodic.beside(predicted, true, period)
    p, q = predicted[:, moving], true[:, moving]
    edge = float((trajectory.bounds[:, 1] - trajectory.bounds[:, 0]).max())
    everything, only_moving = rollout_mse(predicted, true, horizons), rollout_mse(p, q, horizons)
    before = trajectory.position[present, moving]
    velocity, true_velocity = (velocities(cloud, before, trajectory.frame_step, period) for cloud in (p, q))
    escaped = escaped_fraction(p, periodic.walls(trajectory.bounds, period))
    penetrated = None
    if trajectory.scene.get("obstacles"):
        looked_at = np.unique(np.linspace(0, len(p) - 1, _OBSTACLE_FRAMES).round().astype(int))
        scene, seen = Scene.from_dict(trajectory.scene), periodic.wrapped(p[looked_at], trajectory.bounds, period)
        if scene.dim != p.shape[2]:
            raise InputError("scene", "dim", scene.dim, f"positions have {p.shape[2]} coordinates; generate the shard again")
        penetrated = penetrated_fraction(seen, scene.surfaces, trajectory.bounds, scene.spacing)
    result: dict = {
        "rollout_mse": everything,
        "rollout_mse_moving": only_moving,
        "rollout_mse_per_radius2": {key: None if value is None else value / trajectory.radius**2 for key, value in everything.items()},
        "rollout_mse_per_edge2": {key: None if value is None else value / edge**2 for key, value in everything.items()},
        "kinetic_energy_mse": kinetic_energy_mse(velocity, true_velocity),
        "momentum_drift": momentum_drift(velocity, true_velocity),
        "escaped_fraction": float(escaped[-1]),
        "escaped_fraction_worst": float(escaped.max()),
        "penetrated_fraction": None if penetrated is None else float(penetrated[-1]),
        "penetrated_fraction_worst": None if penetrated is None else float(penetrated.max()),
        "first_non_finite": first_non_finite(predicted),
        "divergence_time": divergence_time(p, q, trajectory.radius, trajectory.frame_step),
    }
    for share in CLOUD_TIMES:
        frame = max(math.ceil(share * len(p)) - 1, 0)
        clouds = cloud_metrics(p[frame], q[frame], trajectory, emd_particles=emd_particles, sinkhorn_particles=sinkhorn_particles)
        for name, value in clouds.items():
            result.setdefault(name, {})[f"{share:g}"] = value
    return result
