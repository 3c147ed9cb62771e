"""Docstrings, comments and messages use the terms of the field (propagation, graphics, statistics) and plain sentences."""

import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CHECKED = (
    "wbgs_jax/splat",
    "wbgs_jax/propagation",
    "wbgs_jax/mesh",
    "wbgs_jax/radio",
    "wbgs_jax/_util",
    "wbgs_jax/interchange",
    "wbgs_jax/applications",
    "wbgs_jax/power_map",
    "wbgs_jax/evaluation",
    "wbgs_jax/data",
    "wbgs_jax/inference",
    "wbgs_jax/commands",
    "wbgs_jax/viewer",
    "wbgs_jax/__init__.py",
    "wbgs_jax/plotting.py",
    "wbgs_jax/metrics.py",
    "wbgs_jax/config.py",
    "wbgs_jax/observation_kinds.py",
    "wbgs_jax/types.py",
    "wbgs_jax/fields",
    "wbgs_jax/training",
    "data_gen",
    "experiments",
    "tools",
)
"""Packages and modules whose text is checked."""
INSTEAD = {
    r"\btold\b": "name the quantity: features, settings, reported",
    r"\b(nobody|somebody|anybody)\b": "use the passive, or name the part",
    r"\b(heard|hears?)\b": "received, measured",
    r"\bbeliev\w*": "position_std, prior",
    r"\bsurpris\w*": "negative log-likelihood",
    r"\bdoubt\w*": "uncertainty, inaccurate",
    r"\b(surest|surer|how sure)\b": "most certain; prediction interval",
    r"\bopinions?\b": "expert, prediction",
    r"\bwhat (?:\w+ ){1,5}(says?|said|knows?|tells?)\b": "the prediction, the record",
    r"\b(says?|said) (of|about|nothing)\b": "predicts, records",
    r"\b(field|fields|data|model|layout)s? (knows?|knew)\b": "predicts, contains, supports",
    r"\bknows? (of|no|nothing)\b": "predicts no, has no",
    r"\b(asks?|asked|asking) (for|of)\b": "requests, queries, needs",
    r"(?<!there )\b(is|are) none\b": "does not exist, is invalid",
    r"(?<!there )\bis no (number|path|file|scene|name|text|position|wall|wedge|object)\b": "is not a",
    r"\bmend(ed|s)?\b": "repair, correct, fix",
    r"\bof so (many|much)\b": "name the number",
    r"\bwhat is left\b": "the remainder, the residual",
    r"\bby heart\b": "overfitting",
    r"\briddle\b": "ambiguous",
    r"\bclutter\b": "absorption grid",
    r"\bout of tune\b": "array gains",
    r"\b(the|of|all|every) movers?\b": "rigid body",
    r"\bunfold(s|ed)?\b": "expand",
    r"\bgo(es)? on (from|where|there)\b": "continue",
    r"\b(metres|rows?|columns?|lines?|ms|seconds) a (second|file|frequency|transmitter|TX|PAS|query)\b": "per",
    r"\bthe seam that\b": "the interface",
    r"\bas (nature|people|engineers) (has|have) it\b": "as in reality",
}
"""Expressions that are not used, each with what to say instead."""
STARTS = re.compile(r"(Of|With|Those|That|Whose|How|What) ")
"""Beginnings of docstrings that are no sentences, or hide the subject."""
NAMES = re.compile(r"(?:^|_)(heard|hears|told|tells|asked|asks|says|said|believed|believes|judges)(?:_|$)")
"""Parts of the names of variables, functions and attributes that are not used either."""
CODE = re.compile(r"`[^`]*`|\{[^{}]*\}|\bhttps?://\S+|(?<!\w)(?:--|\.)\w[\w.-]*")
"""Names, options and placeholders within text."""
NAME = re.compile(r"""[a-zA-Z]*(["'])[\w.-]*\1""")
"""Literals of a single word: keys and names."""


def texts(source: str) -> Iterator[tuple[int, str]]:
    """Yields line number and content of every comment and string literal, without code in them."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        kinds = "COMMENT", "STRING", "FSTRING_MIDDLE"
        if tokenize.tok_name[token.type] in kinds and not NAME.fullmatch(token.string):
            yield token.start[0], " ".join(CODE.sub(" ", token.string).split())


def flaws(source: str) -> Iterator[str]:
    """Yields the expressions in a module's text that have a better one."""
    for line, text in texts(source):
        for pattern, better in INSTEAD.items():
            if found := re.search(pattern, text):
                yield f"{line}: {found[0]!r} ({better})"
        if text.startswith('"""') and (found := STARTS.match(text[3:])):
            yield f"{line}: a docstring starts with {found[0]!r}"


def modules(place: str) -> list[Path]:
    return sorted((ROOT / place).rglob("*.py")) if (ROOT / place).is_dir() else [ROOT / place]


def names(source: str) -> Iterator[str]:
    """Yields names in a module that have a better one, with their lines."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.NAME and NAMES.search(token.string):
            yield f"{token.start[0]}: {token.string}"


@pytest.mark.parametrize("place", CHECKED)
def test_the_names_in_a_package(place):
    found = [f"{path.relative_to(ROOT)}:{name}" for path in modules(place) for name in names(path.read_text(encoding="utf-8"))]
    assert not found, "\n".join(found)


def test_names_are_found():
    assert list(names("power = what_it_heard(told, asking)\n")) == ["1: what_it_heard", "1: told"]


@pytest.mark.parametrize("place", CHECKED)
def test_the_words_of_a_package(place):
    found = [f"{path.relative_to(ROOT)}:{flaw}" for path in modules(place) for flaw in flaws(path.read_text(encoding="utf-8"))]
    assert modules(place) and not found, "\n".join(found)


@pytest.mark.parametrize(
    "source",
    [
        "x = 1  # nobody has measured it\n",
        '"""What the field says of a transmitter."""\n',
        "raise ValueError(f'{name} knows no paths')\n",
        '"""Of the reflected wave."""\n',
    ],
)
def test_other_words_are_found(source):
    assert list(flaws(source))


def test_names_and_placeholders_are_not_text():
    assert not list(flaws("heard = told(f'received {heard} dB')  # `nobody` returns it\n"))
    assert not list(flaws("x['clutter'] = 'use --calibration.absorption-spectra 0'\n"))
