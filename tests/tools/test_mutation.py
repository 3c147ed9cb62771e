"""Mutation testing: what it says without its tool, and that what it tries is a change of the module."""

import importlib.util

import pytest
from builders.commands import assert_error_for_people, call

from tools.qa import mutation


def test_a_changed_line_is_shown_as_it_was_and_as_it_is():
    assert mutation.changed_lines("a = 1\nb = 2\n", "a = 1\n  b = 3\n") == "b = 2  ->  b = 3"
    assert mutation.changed_lines("a = 1", "a = 1") == ""


@pytest.mark.skipif(importlib.util.find_spec("cosmic_ray") is not None, reason="cosmic-ray is installed")
def test_without_its_tool_it_says_what_to_install(tmp_path):
    assert_error_for_people(call(mutation.main, "--out", tmp_path), "wbgs-jax[mutation]")


@pytest.mark.skipif(importlib.util.find_spec("cosmic_ray") is None, reason="cosmic-ray (extra `mutation`) is not installed")
def test_mutants_of_a_module_are_sensible(tmp_path):
    path = tmp_path / "module.py"
    path.write_text("def f(x: int | None) -> int:\n    return 2 * x + 1\n")
    names = {spec.operator_name for spec in mutation.mutants(path)}
    assert names and not any(word in name for name in names for word in mutation.SENSELESS)
    assert_error_for_people(call(mutation.main, "--only", "gone", "--out", tmp_path), "there is no such module", "slab")


def test_every_module_has_tests():
    for module, tests in mutation.MODULES.items():
        assert (mutation.ROOT / "wbgs_jax" / f"{module}.py").exists()
        assert all((mutation.ROOT / "tests" / name).exists() for name in tests)
