"""What a tool of others does not check of docstrings: methods without a contract, shapes of arrays, errors that are raised."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FILES = [path for package in ("sim", "learn", "workflow") for path in sorted((ROOT / package).rglob("*.py"))]
MODULES = {path.relative_to(ROOT): ast.parse(path.read_text()) for path in FILES}
#: Protocols, whose methods say what those of the same name do wherever they are; what a material offers is in the docstring of its package.
PROTOCOLS = ("Simulator", "ManySimulator", "Teacher", "LearnedModel")
MATERIALS = Path("sim/mpm/materials/__init__.py")
#: Errors that a caller is told of; others are faults of the program.
TOLD = {"InputError", "RunError", "SimulationError"}


def classes(*trees):
    return {node.name: node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}


CLASSES = classes(*MODULES.values())


def methods(kind):
    return {node.name: node for node in kind.body if isinstance(node, ast.FunctionDef)}


def contract():
    promised = {name for protocol in PROTOCOLS for name, node in methods(CLASSES[protocol]).items() if ast.get_docstring(node)}
    return promised | set(re.findall(r"``(\w+)\(", ast.get_docstring(MODULES[MATERIALS])))


def inherited(path, kind, name):
    """Whether a base class, of the same module or another, documents the method."""
    known = CLASSES | classes(MODULES[path])
    bases = [known[base.id] for base in kind.bases if isinstance(base, ast.Name) and base.id in known]
    return any((name in methods(base) and ast.get_docstring(methods(base)[name])) or inherited(path, base, name) for base in bases)


def public(tree):
    """Functions and methods that others call: (class or None, node)."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield None, node
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from ((node, method) for name, method in methods(node).items() if not name.startswith("_") or name == "__init__")


def everything():
    return [(f"{path}:{node.lineno} {node.name}", path, kind, node) for path, tree in MODULES.items() for kind, node in public(tree)]


def test_methods_say_what_they_do_or_keep_a_contract():
    known = contract()
    assert {"begin", "advance", "load", "frame", "loss", "kirchhoff", "wave_speed"} <= known
    missing = [
        where
        for where, path, kind, node in everything()
        if kind is not None and node.name not in {"__init__", *known} and not ast.get_docstring(node) and not inherited(path, kind, node.name)
    ]
    assert not missing, "\n".join(missing)


#: Of dimensions, in brackets: [particles, dim], [frames], [n], [...]; no unit, no interval of numbers.
SHAPE = re.compile(r"\[(?:\.\.\.|dim|[knAEFN]|[a-z]+s|[^\]\n]*[a-zA-Z][^\]\n]*,[^\]\n]*)\]")


def test_functions_of_arrays_state_a_shape():
    """In their own docstring or once for all at the head of the module. Cases of known answer are apart: they plot."""
    assert all(SHAPE.search(text) for text in ("[particles, dim]", "[frames]", "[N, 2^d]", "[...]", "[k]"))
    assert not any(SHAPE.search(text) for text in ("[length]", "[0, 1]", "[m/s]", "[J]", "[-1, 1]"))
    missing = []
    for where, path, kind, node in everything():
        if kind is not None or path.parts[0] == "workflow" or path.parts[:2] in (("sim", "validation"), ("sim", "stability")):
            continue
        hints = [argument.annotation for argument in (*node.args.args, *node.args.kwonlyargs)] + [node.returns]
        said = (ast.get_docstring(node) or "") + (ast.get_docstring(MODULES[path]) or "")
        if any(hint is not None and re.search(r"\b(ndarray|Tensor)\b", ast.unparse(hint)) for hint in hints) and not SHAPE.search(said):
            missing.append(where)
    assert not missing, "\n".join(missing)


def raised(node):
    """Names of the errors that a function itself raises."""
    found, waiting = set(), list(node.body)
    while waiting:
        part = waiting.pop()
        if isinstance(part, ast.FunctionDef | ast.ClassDef | ast.Lambda):
            continue
        if isinstance(part, ast.Raise) and isinstance(part.exc, ast.Call) and isinstance(part.exc.func, ast.Name):
            found.add(part.exc.func.id)
        waiting += ast.iter_child_nodes(part)
    return found


def test_errors_are_named():
    missing = []
    for where, _, kind, node in everything():
        said = (ast.get_docstring(node) or "") + (ast.get_docstring(kind) or "" if kind else "")
        missing += [f"{where}: {error}" for error in sorted(raised(node) & TOLD) if error not in said]
    assert not missing, "\n".join(missing)
