"""Errors for people: one line that says what is wrong, where, and what to do."""


class UserError(Exception):
    """Something the user can mend. The message is one line: what, where, what to do. Command lines exit with code 2."""
