"""The public names: stubs and runtime agree, every function is documented, earlier names still work."""

import doctest
import functools
import importlib
import inspect
import re
import subprocess
import sys
import typing
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import wbgs_jax
from wbgs_jax._util.public_names import read_stub
from wbgs_jax.fields.base import Field
from wbgs_jax.inference.trained_field import TrainedField

GROUPS = ("applications", "interchange", "power_map", "radio", "splat")
PACKAGES = ["wbgs_jax", *(f"wbgs_jax.{group}" for group in GROUPS)]
EARLIER_NAMES = """
    Field Gaussians Links Located Locator Mesh Observation Query RayPaths Receiver Reflector Surface TileLimits WaveConfig
    WidebandConfig arrivals_anywhere arrivals_of as_deepmimo at_receiver boresight_quaternion cbf cell_means choose_beams
    expected_power expected_ssim export_field frequency_encoding from_arrivals from_deepmimo from_sionna geometry_plan
    get_field hybrid image_loss learn_map load_dataset load_deepmimo load_exported load_paths load_readings load_room
    load_scene load_trained load_walls locator make_mesh make_query make_receiver make_surface map_queries mean_power
    measure_limits nerf2 pas pas_directions place_antenna place_reflector planar_array positional_encoding power_at_users
    power_predictor power_when_turned predict_blocks predict_many predict_map predictor project pytree rank_beams
    read_deepmimo read_gaussians received_power reflector register render_dense render_splats save_paths save_scene
    scene_of_paths scene_of_sionna scene_of_snapshots score_beams snapshot_to_pas soft_minimum ssim stack_receivers static
    steering_vector straight_powers surface_from_points tenth_percentile turn_array wave wideband wrfgs write_deepmimo
    write_gaussians
""".split()  # noqa: SIM905
"""All names at the top before there were groups."""


def public() -> Iterator[tuple[str, typing.Any]]:
    """Yields the public names with their groups, and what they stand for."""
    for package in [*PACKAGES, "wbgs_jax.fields"]:
        module = importlib.import_module(package)
        for name in module.__all__:
            yield f"{package}.{name}", getattr(module, name)


def functions() -> dict[str, typing.Any]:
    """Public functions, without the wrappers of `jax.jit`."""
    plain = {name: value if inspect.isclass(value) else inspect.unwrap(value) for name, value in public() if callable(value)}
    return {name: value for name, value in plain.items() if inspect.isfunction(value)}


FUNCTIONS = functions()
EXAMPLE = re.compile(r">>> .*(?<!SKIP)$", re.MULTILINE)
"""A line of an example that is run, not skipped."""


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_has_the_names_of_its_stub(package):
    module = importlib.import_module(package)
    stub = read_stub(package, module.__file__)
    assert sorted(stub) == sorted(module.__all__) == dir(module)
    for name, (source, inside) in stub.items():
        expected = importlib.import_module(f"{package}.{inside}" if source == package else source)
        assert getattr(module, name) is (expected if source == package else getattr(expected, inside)), name


def test_the_top_is_short_and_a_name_has_one_place():
    names = [name for name, value in public() if not name.startswith("wbgs_jax.fields.")]
    assert len(wbgs_jax.__all__) <= 48
    last = [name.rpartition(".")[2].lower() for name in names]
    assert sorted({name for name in last if last.count(name) > 1}) == []


@pytest.mark.parametrize("package", PACKAGES)
def test_no_name_is_that_of_a_module_beside_it(package):
    """The import of such a module would replace the name."""
    module = importlib.import_module(package)
    files = {path.stem for path in Path(module.__file__).parent.glob("*.py")}
    assert not {name for name in module.__all__ if name in files and not isinstance(getattr(module, name), ModuleType)}


def test_a_group_is_imported_without_jax():
    program = "; ".join(["import sys", *(f"import {package}" for package in PACKAGES), "print('jax' in sys.modules)"])
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def sections(text: str) -> dict[str, str]:
    """Returns the sections of a docstring by their headings."""
    found, heading = {"": ""}, ""
    for line in inspect.cleandoc(text).splitlines():
        if line in ("Args:", "Returns:", "Yields:", "Raises:", "Example:"):
            heading = line[:-1]
            found[heading] = ""
        else:
            found[heading] += line + "\n"
    return found


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_function_documents_arguments_and_result(name):
    function = FUNCTIONS[name]
    found = sections(function.__doc__ or "")
    assert found[""].split(), "a summary"
    for parameter in inspect.signature(function).parameters:
        assert parameter in found.get("Args", ""), parameter
    if inspect.signature(function).return_annotation not in (None, "None"):
        assert found.get("Returns", found.get("Yields", "")).split(), "a section Returns"
    raised = {error for error in ("UserError", "ValueError") if f"raise {error}" in inspect.getsource(function)}
    assert all(error in found.get("Raises", "") for error in raised), raised


@pytest.mark.parametrize("name", [name for name, function in FUNCTIONS.items() if EXAMPLE.search(function.__doc__ or "")])
def test_the_example_of_a_function_runs(name):
    check_examples(FUNCTIONS[name], name)


@pytest.mark.parametrize("method", ["cfr", "taps"])
def test_the_example_of_paths_runs(method):
    check_examples(getattr(wbgs_jax.Paths, method), method)


def check_examples(function, name):
    scope = vars(importlib.import_module(function.__module__)) | {"jnp": __import__("jax").numpy}
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    for example in doctest.DocTestFinder(recurse=False).find(function, name, globs=dict(scope)):
        runner.run(example)
    assert runner.tries and not runner.failures


@pytest.mark.parametrize("name", EARLIER_NAMES)
def test_an_earlier_name_works_and_warns(name):
    if name in wbgs_jax.__all__:
        return
    with pytest.warns(DeprecationWarning, match=rf"wbgs_jax\.{name} is deprecated; use wbgs_jax\.") as record:
        found = getattr(wbgs_jax, name)
    present = str(record[0].message).rpartition("use ")[2]
    assert found is functools.reduce(getattr, present.split(".")[1:], wbgs_jax)


def test_the_warning_names_the_line_of_the_caller():
    """In a process without the run-time type checks of tests, which add frames."""
    program = "import wbgs_jax; print(wbgs_jax.cbf.__name__)"
    done = subprocess.run([sys.executable, "-W", "always", "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "cbf\n" and done.stderr.startswith("<string>:1: DeprecationWarning: wbgs_jax.cbf is deprecated")


def test_old_names_can_be_imported():
    with pytest.warns(DeprecationWarning, match="wbgs_jax.radio.cbf"):
        from wbgs_jax import cbf
    assert cbf is wbgs_jax.radio.cbf


def test_an_unknown_name_is_an_error_and_a_present_one_no_warning():
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = wbgs_jax.no_such_name
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert wbgs_jax.Field is Field


def test_attributes_of_a_trained_field_by_their_old_names():
    trained = object.__new__(TrainedField)
    vars(trained).update(correction=None, intervals=None, power_intervals=None)
    for old, new in {"neighbours": "correction", "confidence": "intervals", "power_confidence": "power_intervals"}.items():
        with pytest.warns(DeprecationWarning, match=f"TrainedField.{old} is deprecated; use {new}"):
            assert getattr(trained, old) is None
