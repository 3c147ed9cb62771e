"""The parts of the benchmark suite: all their figures come out, and PyTorch's renderer draws the same image."""

import dataclasses
import functools
import json
from types import SimpleNamespace
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_dataset, tiny_settings

from experiments.bench import __main__ as command_line
from experiments.bench import quality, queries, renderer, timing, training
from wbgs_jax import make_receiver
from wbgs_jax.splat import Gaussians, project, render_dense

FIELDS = {"value", "unit", "direction", "spread", "tolerance"}
EXPECTED = {
    "renderer": {"render_fwd_bwd_n64_b2", "ratio_dense_n64_b2"},
    "training": {"train_step_s_smoke_b4", "step_backward_smoke_b4", "step_optimiser_smoke_b4"},
    "queries": {"queries_per_s", "single_query"},
    "rays": {"rays_scene2_transmitter", "rays_scene2_query_of_10_frequencies"},
    "facets": {"facets_300_spectrum_cpu", "facets_300_temporaries"},
    "memory": {"temp_gb_n64_b2", "compile_s_n64_b2"},
    "quality": {"compilations_per_run", "time_to_plateau_s"},
}


@pytest.mark.slow
@pytest.mark.usefixtures("compilation_cache")
@pytest.mark.parametrize("part", command_line.PARTS)
def test_every_part_works_quickly(tmp_path, part):
    jax.clear_caches()  # as in a process of its own
    command_line.bench(command_line.Command(out=tmp_path, quick=True, update=True, only=(part,)))
    metrics = json.loads((tmp_path / "bench_cpu.json").read_text())["metrics"]
    assert EXPECTED[part] <= metrics.keys()
    assert all(metric.keys() == FIELDS and np.isfinite(metric["value"]) for metric in metrics.values())
    assert metrics.get("compilations_per_run", {"value": 1})["value"] == 1


class Lowered:
    """In the place of a compiled program: as good as its lowering was."""

    def __call__(self, *inputs):
        return np.zeros(())

    def memory_analysis(self):
        return SimpleNamespace(temp_size_in_bytes=10**6)


@pytest.mark.parametrize(("part", "measure"), [("renderer", renderer.measure), ("memory", renderer.measure_memory)])
def test_the_renderers_can_be_traced(part, measure, monkeypatch):
    monkeypatch.setattr(jax.stages.Lowered, "compile", lambda self: Lowered())
    monkeypatch.setattr(renderer, "HAS_TORCH", False)
    report = timing.Report()
    measure(report, timing.Effort(repeats=1, quick=True))
    assert EXPECTED[part] <= report.metrics.keys()


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory):
    """A tiny training of a tiny scene, before its first step."""
    with mock.patch.object(training, "load_dataset", lambda _: tiny_dataset()):
        return training.start_run(timing.Effort(quick=True), tmp_path_factory.mktemp("run"), 2)


def test_the_parts_of_a_step_can_be_traced(tiny_run, monkeypatch):
    def timed(call):
        if isinstance(call, functools.partial):  # a part; the other call is the epoch itself
            assert all(leaf.shape == () for leaf in jax.tree.leaves(jax.eval_shape(call)))
        return 1e-3

    monkeypatch.setattr(timing, "timed", timed)
    monkeypatch.setattr(training, "start_run", lambda *_: tiny_run)
    report = timing.Report()
    training.measure(report, timing.Effort(repeats=1, quick=True))
    assert EXPECTED["training"] <= report.metrics.keys() and len(report.metrics) == 11


@pytest.mark.heavy
def test_queries_are_answered(tiny_run, monkeypatch):
    monkeypatch.setattr(queries, "start_run", lambda *_: tiny_run)
    report = timing.Report()
    queries.measure(report, timing.Effort(repeats=1, quick=True))
    assert EXPECTED["queries"] <= report.metrics.keys()


def test_a_training_is_watched_until_its_plateau(monkeypatch):
    clock = SimpleNamespace(now=0.0, perf_counter=lambda: clock.now)

    class FakeRun:
        settings, step = tiny_settings(), 0

        def epoch(self):
            clock.now += 10
            self.step += self.settings.loop.epoch_steps

        def run_hooks(self):
            clock.now += 1

        def evaluate(self):
            clock.now += 1000  # the instrument
            return {"held_out_ssim": 0.8 + 0.001 * self.step}

    monkeypatch.setattr(quality, "time", clock)
    monkeypatch.setattr(quality, "start_run", lambda *_: FakeRun())
    report = timing.Report()
    quality.measure(report, timing.Effort(quick=True))
    values = {name: metric["value"] for name, metric in report.metrics.items()}
    assert EXPECTED["quality"] <= values.keys()
    assert values["time_to_ssim_080_s"] == values["time_to_plateau_s"] == 11 and values["ssim_last"] == 0.804
    assert report.skipped.keys() == {"time_to_ssim_085_s"}


# PyTorch's renderer


def splats_and_inputs(rng, n=80, b=2):
    """Splats all around the receiver, some slots empty, some below the horizon or across the image's seam."""
    directions = rng.normal(size=(n, 3))
    directions[:, 2] = np.abs(directions[:, 2]) * rng.choice([1, 1, 1, -0.3], n)
    distance = rng.uniform(1, 6, n)
    means = directions / np.linalg.norm(directions, axis=1, keepdims=True) * distance[:, None]
    log_scales = np.log(rng.uniform(0.05, 0.5, (n, 3)) * distance[:, None] / 3)
    arrays = (means, log_scales, rng.normal(size=(n, 4)), np.where(rng.random(n) > 0.1, 0.0, -np.inf))
    receiver = jax.tree.map(lambda a: a.astype(jnp.float64), make_receiver([0.0, 0.0, 0.0]))
    splats = project(Gaussians(*map(jnp.asarray, arrays)), receiver)
    return splats, rng.uniform(0, 0.99, (n, b)), rng.uniform(0, 1, (n, b)), rng.normal(size=(b, 90, 360))


def test_pytorch_draws_the_reference_in_value_and_every_gradient(rng, x64):
    torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra `bench`)")
    from experiments.bench import torch_tiles

    torch.set_num_threads(1)
    splats, attenuation, signal, cotangent = splats_and_inputs(rng)

    def dense(means2d, conics, attenuation, signal):
        image = render_dense(dataclasses.replace(splats, means2d=means2d, conics=conics), attenuation, signal)
        return jnp.sum(image * cotangent), image

    inputs = (splats.means2d, splats.conics, jnp.asarray(attenuation), jnp.asarray(signal))
    (_, image), gradients = jax.jit(jax.value_and_grad(dense, argnums=range(4), has_aux=True))(*inputs)
    given = (torch_tiles.to_torch(splats), torch.from_numpy(attenuation), torch.from_numpy(signal))
    for form, render in torch_tiles.FORMS.items():
        np.testing.assert_allclose(render(*given).numpy(), image, atol=1e-12, err_msg=form)
        for got, expected in zip(torch_tiles.gradients(form, *given, torch.from_numpy(cotangent)), gradients, strict=True):
            largest = max(1.0, float(jnp.abs(expected).max()))
            np.testing.assert_allclose(got.numpy(), expected, atol=1e-12 * largest, err_msg=form)
