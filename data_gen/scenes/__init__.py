"""The scenes by number. A new scene is one file beside `scene1.py` and one line here."""

from collections.abc import Callable

from data_gen.scenes.base import FREQUENCIES_21_HZ, FREQUENCIES_HZ, Part, SceneSpec
from data_gen.scenes.scene1 import scene1
from data_gen.scenes.scene2 import scene2
from data_gen.scenes.scene3 import scene3
from data_gen.scenes.scene4 import scene4
from data_gen.scenes.scene5 import scene5
from data_gen.scenes.scene6 import scene6
from wbgs_jax._util.errors import UserError

SCENES: dict[int, Callable[[], SceneSpec]] = {1: scene1, 2: scene2, 3: scene3, 4: scene4, 5: scene5, 6: scene6}

__all__ = ["FREQUENCIES_21_HZ", "FREQUENCIES_HZ", "SCENES", "Part", "SceneSpec", "get_scene"]


def get_scene(number: int) -> SceneSpec:
    """Returns the scene of a number.

    Raises:
        UserError: there is no such scene; the message lists those that exist.
    """
    if number not in SCENES:
        raise UserError(f"there is no scene {number}; choose one of {', '.join(map(str, sorted(SCENES)))}")
    return SCENES[number]()
