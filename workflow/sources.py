"""What a result depends on in the code: the modules a program imports, directly or not, hashed without comments and docstrings, and C++ beside them.

Rules carry the hash among their parameters, so that an edit of the solver makes its data again, an edit of a figure does not, and an
edit of a comment nothing at all. Imports are read from the source: nothing is imported for it.
"""

from __future__ import annotations

import ast
import hashlib
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("sim", "learn", "workflow")
#: Where ``sim.solvers`` finds the solver of each method.
SOLVERS = {"mpm": "sim.mpm.solver", "wcsph": "sim.sph.solver", "dfsph": "sim.sph.solver", "pbf": "sim.pbd.solver"}


def _file(module: str) -> Path | None:
    place = ROOT.joinpath(*module.split("."))
    return next((path for path in (place.with_suffix(".py"), place / "__init__.py") if path.is_file()), None)


@cache
def _parsed(module: str) -> tuple[str, frozenset[str]]:
    """(hash of the module's code, names it imports that may be modules of ours)."""
    file = _file(module)
    assert file is not None, module
    tree, foreign = ast.parse(file.read_text()), file.with_suffix(".cpp")
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                raise ValueError(f"{module}, line {node.lineno}: relative import; imports are absolute here")
            names |= {node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)}
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and node.body:
            first = node.body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                node.body = node.body[1:]
    code = ast.dump(tree).encode() + (foreign.read_bytes() if foreign.is_file() else b"")
    return hashlib.sha256(code).hexdigest(), frozenset(names)


def closure(*modules: str, method: str | None = None) -> list[str]:
    """The modules of ours that ``modules`` need, themselves and the packages around them included, sorted.

    Where one ``method`` of solving is all that is run, the solvers of others count for nothing, and what only they need.
    """
    others = set() if method is None else set(SOLVERS.values()) - {SOLVERS[method]}
    found: set[str] = set()
    waiting = list(modules)
    while waiting:
        module = waiting.pop()
        if module in found or module in others or module.split(".")[0] not in PACKAGES or _file(module) is None:
            continue
        found.add(module)
        waiting += [*_parsed(module)[1], *(module.rsplit(".", depth)[0] for depth in range(1, module.count(".") + 1))]
    return sorted(found)


def code_hash(*modules: str, method: str | None = None) -> str:
    """One hash over everything that ``modules`` need; see ``closure``."""
    lines = [f"{module} {_parsed(module)[0]}" for module in closure(*modules, method=method)]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


@cache
def registered_models() -> dict[str, str]:
    """Name of a model -> module that defines it, read from the registry in ``learn/model.py`` (importing it would import torch)."""
    for node in ast.parse((ROOT / "learn/model.py").read_text()).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "MODELS":
            return {name: module for name, (module, _) in ast.literal_eval(node.value).items()}
    raise ValueError("learn/model.py: no MODELS")
