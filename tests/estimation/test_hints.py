"""Values and the types of their fields."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import pytest

from pinnobs_gym.estimation.hints import as_tuple, check_field, field_hints, fits, in_words


class Duck(Protocol):
    def quack(self): ...


@pytest.mark.parametrize(
    ("hint", "good", "bad"),
    [
        (int, [3, np.int64(3)], [True, 3.0, "3", None, np.bool_(1), 2**63, 10**5000]),
        (float, [3, 0.5, np.float32(1), np.inf], [True, "x", None, 1j, [1.0], np.nan, 1e31, 2**70]),
        (complex, [1, 1j], ["1j", False, complex("nan+1j")]),
        (bool, [True, np.bool_(0)], [0, 1, "False", None]),
        (str, ["", "x"], [1, None, ["x"]]),
        (Path, [Path("x")], ["x"]),
        (float | None, [None, 2.0], ["None", False]),
        (Literal["a", "b"], ["a"], ["c", 1, None, ["a"], np.zeros(2)]),
        (Literal[1], [1], [True, 1.0]),
        (tuple[float, ...], [(), (1, 2.0), [1.0]], [1.0, "ab", ("a",), (True,), None]),
        (tuple[float, int], [(1.0, 2)], [(1.0,), (1.0, 2.0), (1.0, 2, 3)]),
        (tuple, [(), (1, "a")], [1]),
        (tuple[np.ndarray, ...], [(np.eye(2),)], [(1,), np.eye(2)]),
        (Sequence[Sequence[float]], [[[1, 2]], np.eye(2)], ["ab", ["ab"], [1.0], np.ones(2), 1]),
        (Mapping[str, int], [{}, {"a": 1}], [{"a": "b"}, {1: 1}, [1]]),
        (Duck, [1, "anything that cannot be checked"], []),
        (Any, [1, None], []),
    ],
)
def test_what_is_of_a_type(hint, good, bad):
    for value in good:
        assert fits(value, hint), value
    for value in bad:
        assert not fits(value, hint), value
        with pytest.raises(ValueError, match=r"^size=.*; expected \w") as error:
            check_field("size", value, hint)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("hint", "words"),
    [
        (float | None, "None or a number"),
        (Literal["a", "b", "c"], "a, b or c"),
        (Literal["a"] | None, "None or a"),
        (tuple[int, int], "a list of 2 whole numbers"),
        (Sequence[Sequence[float]], "a list of lists of numbers"),
        (tuple[float, str], "a list of a number, a text"),
        (tuple, "a list"),
    ],
)
def test_types_in_words(hint, words):
    assert in_words(hint) == words


def test_a_list_becomes_a_tuple_where_that_is_the_type():
    assert as_tuple([1, 2], tuple[float, ...] | None) == (1, 2)
    assert as_tuple([1, 2], list[float]) == [1, 2]
    assert as_tuple("ab", tuple[str, ...]) == "ab"


def test_hints_that_cannot_be_found_are_not_checked():
    @dataclass
    class Odd:
        x: "Unknown"  # noqa: F821

    assert field_hints(Odd) == {}
