"""The only module that imports Taichi: one initialisation, quiet, cached inside the project, one thread on a CPU.

One serial thread per trajectory, trajectories in parallel as processes: measured faster than threads with atomics on one
scene (two threads were slower than one), and bitwise reproducible.
"""

from __future__ import annotations

import contextlib
import gc
import io
import os
from collections.abc import Iterator
from pathlib import Path

# Without these, importing Taichi prints a banner and `ti.init` starts a thread that asks the network for a newer version.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")

import taichi as ti  # noqa: E402
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext  # noqa: E402
from taichi.lang.impl import current_cfg  # noqa: E402


def _place(context: ASTTransformerContext, node) -> str:
    """Where in the source an error is. Taichi's own also quotes it, wrapped line by line for every node of every function: a third of its
    work in Python, even where the kernel is in the cache."""
    return f'File "{context.file}", line {node.lineno + context.lineno_offset}, in {context.func.func.__name__}:\n'


ASTTransformerContext.get_pos_info = _place

_started: str | None = None


def start_taichi(arch: str | None = None) -> str:
    """Initialise Taichi once per process and return the architecture, ``cpu`` or ``cuda``.

    ``arch`` defaults to the environment variable SLUICE_ARCH, else ``cpu``. Raises ValueError for another name.
    """
    global _started
    arch = arch or os.environ.get("SLUICE_ARCH", "cpu")
    if arch not in ("cpu", "cuda"):
        raise ValueError(f"SLUICE_ARCH = {arch!r}: must be cpu or cuda")
    if _started is None:
        cache = Path(os.environ.get("SLUICE_TAICHI_CACHE", Path(__file__).resolve().parent.parent / ".taichi_cache"))
        # It prints the architecture whatever the log level.
        with contextlib.redirect_stdout(io.StringIO()):
            ti.init(
                arch=getattr(ti, arch),
                default_fp=ti.f32,
                fast_math=True,
                cpu_max_num_threads=1,
                log_level=ti.ERROR,
                offline_cache=True,
                offline_cache_file_path=str(cache),
                random_seed=0,
                # Its analysis of loads and stores took half of the compile time (3D water 6.3 s, without it 3.2 s); LLVM does the same.
                cfg_optimization=False,
                # Each further thread first loads Taichi's runtime, 0.2 s, and a frame is one kernel.
                num_compile_threads=1,
            )
        _started = arch
    return _started


@contextlib.contextmanager
def compiling(dim: int) -> Iterator[None]:
    """Around first calls of kernels in so many dimensions. The collector would walk the growing syntax trees again and again for nothing.

    3D kernels are several times as long, and Taichi's search for common terms, whose time grows with the square, took a third of
    theirs (3D sand 4.0 s, without it 2.6 s) for 1 to 2 % of speed; in 2D it is worth 15 %.
    """
    collecting, level = gc.isenabled(), current_cfg().opt_level
    gc.disable()
    current_cfg().opt_level = 1 if dim == 2 else 0
    try:
        yield
    finally:
        current_cfg().opt_level = level
        if collecting:
            gc.enable()
