"""Ground truth for particle physics: scenes, Taichi solvers, trajectory files, pictures. Never imports torch."""

__version__ = "0.1.0"
