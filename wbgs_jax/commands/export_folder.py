"""Write a scene file as a folder of the published layout (docs/formats.md): wbgs-jax layout SCENE.npz FOLDER"""

import sys

from wbgs_jax._util.cli import run_command
from wbgs_jax._util.errors import UserError
from wbgs_jax.data.image_folder import export_layout
from wbgs_jax.data.scene_file import load_scene


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    arguments = sys.argv[1:] if arguments is None else arguments
    usage = "usage: wbgs-jax layout SCENE.npz FOLDER"
    if {"-h", "--help"} & set(arguments):
        print(f"{usage}\n\nWrite a scene file as a folder of the published layout (docs/formats.md).")
        return
    if len(arguments) != 2:
        raise UserError(usage)
    export_layout(load_scene(arguments[0]), arguments[1])


if __name__ == "__main__":
    run_command(main)
