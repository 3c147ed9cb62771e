"""Small YAML files that people write. What is no plain data is refused: aliases that unfold to gigabytes, endless nesting."""

from pathlib import Path
from typing import Any

import yaml

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_text

LARGEST, DEEPEST = 1_000_000, 20
"""Characters, and levels of nesting: no file of positions comes near."""


class _PlainLoader(yaml.SafeLoader):
    """PyYAML's safe loader without aliases."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Returns a node; an alias or too deep a one is an error."""
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.YAMLError("it has an alias (*name); write the values out")
        self.depth += 1
        if self.depth > DEEPEST:
            raise yaml.YAMLError(f"it is nested more than {DEEPEST} levels deep")
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def read_yaml(path: Path) -> Any:
    """Returns the content of a YAML file; a missing, damaged or outlandish one is a `UserError`."""
    text = read_text(path)
    if len(text) > LARGEST:
        raise UserError(f"{path} has {len(text):,} characters; a file of positions has far fewer than {LARGEST:,}")
    try:
        return yaml.load(text, _PlainLoader)
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError) as error:  # ValueError: an impossible date
        raise UserError(f"{path} is not valid YAML ({' '.join(str(error).split())}); mend it") from error
