"""Tests that calls are refused, each with a message that says why."""

from collections.abc import Callable, Mapping

import pytest

import liethermo as lt

Row = tuple[Callable, str] | tuple[Callable, str, type[Exception]]


def refusal_test(*rows: Row | Mapping[str, Row], error=lt.InputError) -> Callable:
    """Return a test with a case for each row ``(call, words)`` or ``(call, words, error)``.

    The call must raise the error, with a message that matches the words. Rows may be given by name in a dict.
    """
    named_rows = list(rows[0].items()) if isinstance(rows[0], Mapping) else [(f"{row[1]:.40}", row) for row in rows]
    cases = [pytest.param(*row, *(() if len(row) == 3 else (error,)), id=name) for name, row in named_rows]

    @pytest.mark.parametrize(("call", "words", "error"), cases)
    def test(call, words, error):
        with pytest.raises(error, match=words):
            call()

    return test
