"""Tables in Markdown."""


def markdown(head: list[str], rows: list[list[str]]) -> str:
    """Returns a table; the first column is left-aligned."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
