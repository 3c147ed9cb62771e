"""Errors for people: one line that says what is wrong, where, and what to do."""

LONGEST, END = 1000, 200
"""Characters of a message, and of its end: what is wrong with a file may be a word of five thousand digits."""


class UserError(Exception):
    """Something the user can mend. The message is one line: what, where, what to do. Command lines exit with code 2.

    Whatever it quotes, it stays one line, and one that can be read."""

    def __init__(self, message: str = ""):
        line = " ".join(message.splitlines())
        super().__init__(line if len(line) <= LONGEST else f"{line[: LONGEST - END]} ... {line[-END:]}")
