"""Coverage-guided fuzzing of one reader, by atheris: `python guided.py "YAML" -max_total_time=60` (further words: libFuzzer's).

The bytes are those of the reader's first file. What the code does with them steers what is tried next.
"""

import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import atheris

with atheris.instrument_imports(include=["wbgs_jax.data", "wbgs_jax.interchange", "wbgs_jax.mesh", "wbgs_jax._util", "yaml"]):
    sys.path.insert(0, str(Path(__file__).parents[2]))
    from builders.reliability.readables import READABLES

from wbgs_jax._util.errors import UserError


def main(name: str, words: list[str]) -> None:
    """Makes whole files, gives the first one to the fuzzer as the seed, and reads what becomes of it."""
    readable = READABLES[name]
    with tempfile.TemporaryDirectory() as place:
        folder, seeds = Path(place) / "files", Path(place) / "seeds"
        folder.mkdir()
        seeds.mkdir()
        readable.make(folder)
        target = min(path for path in folder.glob(readable.damaged) if path.is_file())
        (seeds / "whole").write_bytes(target.read_bytes())

        def one(content: bytes) -> None:
            target.write_bytes(content)
            try:
                readable.read(folder)
            except UserError as error:
                assert "\n" not in str(error)

        atheris.Setup([sys.argv[0], *words, str(seeds)], one)
        atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
