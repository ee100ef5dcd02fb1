"""Source hashes see every module that a program really loads."""

import subprocess
import sys

import pytest
from study_tree import ROOT

from workflow.sources import SOLVERS, closure, registered_models

#: What a job does, as far as it decides what is imported.
PROGRAMS = {
    "sim.generate": "import sim.generate; [sim.generate.scene_teacher(method) for method in ('mpm', 'dfsph', 'pbf')]",
    "learn.train": "import learn.train",
    "workflow.scripts.errors": "import workflow.scripts.errors",
    "workflow.scripts.timing": "import workflow.scripts.timing",
    "workflow.scripts.film": "import workflow.scripts.film",
    "workflow.scripts.summary": "import workflow.scripts.summary",
}


def loaded(program: str) -> set[str]:
    """The modules of ours that a program imports."""
    program += "; import sys; print(*[name for name in sys.modules if name.split('.')[0] in ('sim', 'learn', 'workflow')])"
    answer = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    return set(answer.stdout.splitlines()[-1].split()) - {"workflow", "workflow.scripts"}  # folders without code


@pytest.mark.parametrize("module", PROGRAMS)
def test_closure_holds_all_that_is_imported(module):
    found = loaded(PROGRAMS[module])
    assert found <= set(closure(module)), found - set(closure(module))


@pytest.mark.parametrize("method", ["mpm", "dfsph", "pbf"])
def test_a_method_needs_its_solver_alone(method):
    found = loaded(f"import sim.generate; sim.generate.scene_teacher({method!r})")
    needed = set(closure("sim.generate", method=method))
    assert found <= needed, found - needed
    assert {solver for solver in SOLVERS.values() if solver in needed} == {SOLVERS[method]}


def test_solvers_are_where_they_are_said_to_be():
    from sim.solvers import solver_class

    assert {method: solver_class(method).__module__ for method in SOLVERS} == SOLVERS


def test_solvers_are_no_part_of_trainings_and_networks_none_of_data():
    assert not [module for module in closure("learn.train", *registered_models().values()) if module.startswith("sim.mpm")]
    assert not [module for module in closure("sim.generate") if module.startswith("learn")]


def test_registered_models_are_the_registry():
    from learn.model import MODELS

    assert registered_models() == {name: module for name, (module, _) in MODELS.items() if name != "dummy"}
