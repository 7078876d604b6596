"""Digests of JSON objects."""

import json

import pytest

from pinnobs_gym.files.archive import Damaged
from pinnobs_gym.files.seal import SEAL, sealed, unsealed

VALUES = {"a": 0.1, "b": [1, {"c": None}], "d": "é"}


def test_what_was_written_is_read_in_any_order_and_spacing():
    text = json.dumps(sealed(VALUES), indent=3, ensure_ascii=False)
    assert unsealed(json.loads(text)) == VALUES
    assert unsealed(dict(reversed(sealed(VALUES).items()))) == VALUES
    assert sealed(sealed(VALUES)) == sealed(VALUES)


def test_every_flipped_bit_is_noticed():
    data = json.dumps(sealed(VALUES)).encode()
    noticed = 0
    for place in range(8 * len(data)):
        wrong = bytearray(data)
        wrong[place // 8] ^= 1 << place % 8
        try:
            read = json.loads(bytes(wrong))
        except ValueError:
            continue
        try:
            assert unsealed(read) == VALUES
        except Damaged:
            noticed += 1
    assert noticed > len(data)


def test_no_digest_is_no_seal():
    with pytest.raises(Damaged, match=SEAL):
        unsealed(VALUES)
