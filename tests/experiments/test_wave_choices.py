"""Variants of the coherent field that ablations train."""

import dataclasses

import numpy as np
from synthetic import tiny_scene

from experiments.wave_choices import VARIANTS, displaced, settings_of
from wbgs_jax.config import check
from wbgs_jax.data import scene_dataset


def test_every_variant_changes_something_that_exists():
    plain = settings_of(VARIANTS["default"], 600)
    for name, variant in VARIANTS.items():
        settings = settings_of(variant, 600)
        check(settings)
        assert settings.optim.steps == 600
        assert (settings == plain) == (name == "default" or variant.displacement > 0)


def test_a_displaced_mesh_is_moved_part_by_part(rng):
    scene = tiny_scene(4)
    twice = dataclasses.replace(
        scene,
        vertices=np.concatenate([scene.vertices, scene.vertices + 50]),
        faces=np.concatenate([scene.faces, scene.faces + len(scene.vertices)]),
        face_part=np.concatenate([scene.face_part, scene.face_part]),
    )
    dataset = scene_dataset(twice)
    shift = displaced(dataset, 0.1, 3).vertices - dataset.vertices
    first, second = shift[: len(scene.vertices)], shift[len(scene.vertices) :]
    for part in (first, second):
        np.testing.assert_allclose(part, np.tile(part[0], (len(part), 1)), atol=1e-4)
    assert np.abs(first[0] - second[0]).max() > 1e-3
