"""Whether the system libraries that films are drawn with are here; says in one line how to install them."""

import ctypes
import sys

from sim.render import GL_REMEDY

LIBRARIES = ("libGL.so.1", "libEGL.so.1", "libXrender.so.1")


def missing() -> list[str]:
    """Names of the libraries that cannot be loaded."""
    absent = []
    for name in LIBRARIES:
        try:
            ctypes.CDLL(name)
        except OSError:
            absent.append(name)
    return absent


if __name__ == "__main__":
    if absent := missing():
        print(f"{', '.join(absent)} missing: pictures will be drawn flat. For lit spheres: {GL_REMEDY} (or: make system)", file=sys.stderr)
