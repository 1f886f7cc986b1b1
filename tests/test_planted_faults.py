"""The table of planted faults (bench/faults.yaml): it must not fall behind the source that it
breaks."""

import ast
import functools
import importlib.util
from pathlib import Path

import pytest
from parsed import parsed

ROOT = Path(__file__).parent.parent
_SPEC = importlib.util.spec_from_file_location("mutation", ROOT / "tests/bench/mutation.py")
mutation = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(mutation)


@pytest.mark.parametrize("fault", mutation.FAULTS, ids=lambda f: f.name)
def test_every_fault_can_be_planted_and_has_its_test(fault):
    assert (ROOT / fault.file).read_text(encoding="utf-8").count(fault.old) == 1
    assert fault.old != fault.new
    file, _, name = fault.test.partition("::")
    assert not name or name in _functions_of(file)


@functools.cache
def _functions_of(file):
    return {node.name for node in parsed(ROOT / file).body if isinstance(node, ast.FunctionDef)}


def test_faults_are_many_and_differ():
    names = [f.name for f in mutation.FAULTS]
    assert len(set(names)) == len(names) >= 40
