"""The scenes by number. A new scene is one file beside `scene1.py` and one line here."""

from collections.abc import Callable

from data_gen.scenes.base import Part, SceneSpec
from data_gen.scenes.scene1 import scene1
from wbgs_jax.errors import UserError

SCENES: dict[int, Callable[[], SceneSpec]] = {1: scene1}

__all__ = ["SCENES", "Part", "SceneSpec", "get_scene"]


def get_scene(number: int) -> SceneSpec:
    """Build a scene by number; an unknown one is a `UserError` that lists those there are."""
    if number not in SCENES:
        raise UserError(f"there is no scene {number}; choose among {', '.join(map(str, sorted(SCENES)))}")
    return SCENES[number]()
