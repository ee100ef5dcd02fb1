"""Dam break, impact: arrival and impulse of the pressure on the wall that a collapsed column hits, against Lobovsky et al. (2014)."""

from pathlib import Path

import numpy as np

from sim.solvers import solver_class
from sim.validation import Curve, Outcome, scene, timed

NUMBER = 12
METHODS = ("mpm", "wcsph", "dfsph")
#: Particles along the column's height.
RESOLUTIONS = (16, 32, 64)
H, G, RHO, FRAME_STEP, FRAMES = 0.3, 9.81, 1000.0, 0.0025, 250
C = float(10 * np.sqrt(2 * G * H))
#: T = t sqrt(g / H), p / (rho g H); sensor P1, at 0.01 H. The digitised jump goes up and down: sorted by time.
EXPERIMENT = np.loadtxt(Path(__file__).parent / "data" / "lobovsky_2014_p1.csv", delimiter=",")
#: Pressure, over rho g H, from which on the front has arrived; and for how long the impulse is taken.
ARRIVED, LAST = 0.2, 1.0


def run(resolution: int, method: str) -> Outcome:
    """A column 2 H long and H = 0.3 m high in a tank 161 H / 30 long, rounded up to whole cells; c = 10 sqrt(2 g H).

    The sensor is 0.01 H above the floor, below the lowest particle: what is compared is the mean pressure, none where there is no particle, over a
    strip 2 spacings wide and 4 high at the foot of the wall. Arrival: when that exceeds 0.2 rho g H; impulse: its integral over the unit of
    time after. Never the peak.

    All three solvers arrive in time. Their impulse is missed, and by all in the same way: it grows with the resolution, as the strip shrinks from a
    quarter to a sixteenth of H, past what was measured.
    """
    spacing = H / resolution
    length = float(np.ceil(161 / 30 * H / (2 * spacing) - 1e-9) * 2 * spacing)
    what = scene(
        "dam-impact", {"model": "water", "sound_speed": C, "density": RHO}, [{"kind": "box", "lower": [0.0, 0.0], "upper": [2 * H, H]}],
        [[0.0, length], [0.0, 2 * H]], [round(length / spacing / 2), resolution], FRAME_STEP, gravity=[0.0, -G], solver={"method": method},
    )  # fmt: skip
    solver = solver_class(method)()
    solver.load(what)

    def observe(_):
        state = solver.state()
        pressure = RHO * C**2 / 7 * (state["stuff.J"] ** -7 - 1) if method == "mpm" else state["pressure"]
        x, y = state["position"].T
        near = (x > length - 2 * spacing) & (y < 4 * spacing)
        return np.maximum(pressure[near], 0.0).sum() / 8 / (RHO * G * H)

    found, seconds = timed(solver.frame, FRAMES, observe)
    T, p = FRAME_STEP * np.arange(1, FRAMES + 1) * np.sqrt(G / H), np.array(found)
    measured_T, measured = EXPERIMENT[np.argsort(EXPERIMENT[:, 0], kind="stable")].T

    def impact(T, p):
        begun = T[np.argmax(p > ARRIVED)]
        after = (begun <= T) & (begun + LAST >= T)
        return begun, np.trapezoid(p[after], T[after])

    (arrival, impulse), (measured_arrival, measured_impulse) = impact(T, p), impact(measured_T, measured)
    reference = np.interp(T, measured_T, measured)
    axes = ("T = t sqrt(g / H)", "p / rho g H")
    curves = {
        "arrival": Curve(f"arrival {arrival:.3f}, measured {measured_arrival:.3f}", axes, T, reference, p,
                         float(arrival / measured_arrival - 1), 0.03),
        "impulse": Curve(f"impulse {impulse:.3f}, measured {measured_impulse:.3f}", axes, T, reference, p,
                         float(impulse / measured_impulse - 1), 0.15),
    }  # fmt: skip
    return Outcome("dam_impact", resolution, len(what.particles().position), curves, seconds)
