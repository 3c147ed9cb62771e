"""Errors shown to users: one line that states the problem, its location, and a remedy."""


class UserError(Exception):
    """A problem that the user can fix.

    The message states what is wrong, where, and what to do. It is always a single readable line, whatever it quotes."""

    exit_code = 2
    """Exit code of command lines; 130 means that the user stopped them, which is no error."""

    def __init__(self, message: str = ""):
        line = " ".join(message.splitlines())
        # Maximum length of a message, and of the end that is kept when it is shortened, characters: messages quote file
        # contents.
        longest, end = 1000, 200
        super().__init__(line if len(line) <= longest else f"{line[: longest - end]} ... {line[-end:]}")
