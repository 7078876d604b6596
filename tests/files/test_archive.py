"""Archives in which something is wrong: refused, in one line, before they need memory."""

import io
import tracemalloc
import zipfile

import numpy as np
import pytest
import torch
from damage import damaged, is_one_line_about

from pinnobs_gym.estimation.learned import trained_file
from pinnobs_gym.files import archive
from pinnobs_gym.files.archive import Damaged, arrays_of, json_in, json_of, read_parts

CONTENT = {
    "weights": torch.linspace(-1, 1, 12, dtype=torch.float64).reshape(3, 4),
    "facts": {"seed": 3, "names": ["a", "b"], "sizes": (1, 2.5), "none": None},
}


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "weights.pt"
    trained_file.write(path, CONTENT)
    return path


def repacked(path, parts, method=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", method) as packed:
        for name, content in parts.items():
            packed.writestr(name, content)


def refusal(path):
    """The line by which a file of weights is refused, for at most some memory."""
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="is damaged or no file of saved weights") as caught:
            trained_file.read(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 4e6 + 4 * path.stat().st_size
    assert is_one_line_about(caught.value, path)
    return str(caught.value)


def test_every_flipped_bit_and_every_end_too_early_is_noticed(file):
    """Bits that are not of the content, such as those of dates, change nothing."""
    refused, same = [], 0
    for change in damaged(file, 120):
        try:
            found = trained_file.read(file)
        except ValueError as error:
            refused.append(error)
        else:
            assert torch.equal(found["weights"], CONTENT["weights"]), change
            assert found["facts"] == CONTENT["facts"], change
            same += 1
    assert len(refused) > same
    assert all(is_one_line_about(error, file) for error in refused)
    assert trained_file.read(file)["facts"] == CONTENT["facts"]


def test_tensors_of_every_kind_and_plain_values_are_read(tmp_path):
    kinds = (torch.float32, torch.bfloat16, torch.int64, torch.bool, torch.complex128, torch.uint16)
    content = {str(kind): torch.ones(2, dtype=kind) for kind in kinds}
    content["parameter"] = torch.nn.Parameter(torch.ones(2))
    plain = {
        "kind": torch.float64,
        "set": {1, 2},
        "bytes": b"1",
        "shape": torch.Size([2]),
        0: 2**70,
    }
    trained_file.write(tmp_path / "file", content | plain)
    found = trained_file.read(tmp_path / "file")
    assert found.keys() == {*content, *plain}
    for name, value in content.items():
        assert found[name].dtype == value.dtype
        assert torch.equal(found[name], value)
    assert {name: found[name] for name in plain} == plain


def test_every_bit_of_the_weights_counts(file):
    whole, weights = file.read_bytes(), CONTENT["weights"].numpy().tobytes()
    start = whole.index(weights)
    for place in range(start, start + len(weights), 5):
        wrong = bytearray(whole)
        wrong[place] ^= 1 << place % 8
        file.write_bytes(bytes(wrong))
        assert "Bad CRC-32" in refusal(file)


def test_parts_that_unpack_to_more_than_the_file_are_refused(file):
    parts = read_parts(file)
    repacked(file, {**parts, "archive/data/9": bytes(10**8)}, zipfile.ZIP_DEFLATED)
    assert file.stat().st_size < 2e5
    assert "its parts have 1000" in refusal(file)
    repacked(file, parts, zipfile.ZIP_DEFLATED)
    assert "compressed" in refusal(file) or "its parts have" in refusal(file)


def test_a_part_that_is_larger_than_it_says_is_refused(tmp_path):
    """The size in the list is small, what is unpacked is not."""
    path = tmp_path / "a.npz"
    repacked(path, {"a": bytes(10**8)}, zipfile.ZIP_DEFLATED)
    data, size = path.read_bytes(), (10**8).to_bytes(4, "little")
    path.write_bytes(data.replace(size, (1000).to_bytes(4, "little")))
    tracemalloc.start()
    try:
        with pytest.raises(Damaged):
            read_parts(path, compressed=True)
        assert tracemalloc.get_traced_memory()[1] < 2e6
    finally:
        tracemalloc.stop()


class Reserving:
    """It asks for memory when it is loaded."""

    def __reduce__(self):
        return bytearray, (10**12,)


def doubled(levels):
    part = [1.0]
    for _ in range(levels):
        part = [part, part]
    return part


def nested(levels):
    part = []
    for _ in range(levels):
        part = [part]
    return part


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (torch.zeros(1).expand(10**9), "its content is more than 16 times"),
        (doubled(50), "its content is more than 16 times"),
        (nested(300), "nested deeper than 100 levels"),
        (Reserving(), "it holds a '__builtin__ bytearray'; expected weights"),
    ],
    ids=["repeated numbers", "repeated parts", "depth", "reserved memory"],
)
def test_a_small_file_that_asks_for_much_is_refused(tmp_path, content, reason):
    path = tmp_path / "weights.pt"
    torch.save({"a": content}, path)
    assert path.stat().st_size < 10_000
    assert reason in refusal(path)


def test_a_tensor_of_more_numbers_than_the_file_has_is_refused(file):
    parts = read_parts(file)
    (name,) = (name for name in parts if name.endswith("data.pkl"))
    plan = parts[name]
    assert plan.count(b"K\x0c") == 1  # the number of weights, as a number of one byte
    repacked(file, {**parts, name: plan.replace(b"K\x0c", b"M\xff\xff")})
    assert "size" in refusal(file)


def npz(arrays):
    file = io.BytesIO()
    np.savez(file, **arrays)
    with zipfile.ZipFile(file) as packed:
        return {name: packed.read(name) for name in packed.namelist()}


def test_arrays_are_those_that_numpy_writes():
    wanted = {
        "a": np.arange(6.0).reshape(2, 3),
        "b": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "c": np.array("text"),
        "d": np.zeros((0, 3), bool),
        "e": np.array(1 + 2j),
    }
    found = arrays_of(npz(wanted))
    assert found.keys() == wanted.keys()
    for name, array in wanted.items():
        np.testing.assert_array_equal(found[name], array)
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
    assert found["b"].flags.f_contiguous
    assert found["a"].flags.writeable


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"(3,)", b"(2,)"),
        (b"(3,), }          ", b"(999999999999,), }"),
        (b"(3,)", b"-3, "),
        (b"'<f8'", b"'|O8'"),
        (b"'<f8'", b"'<V8'"),
        (b"(3,)", b"open"),
        (b"\x93NUMPY\x01", b"\x93NUMPY\x09"),
    ],
)
def test_a_header_that_does_not_fit_its_numbers_is_refused(old, new):
    parts = npz({"a": np.zeros(3)})
    assert old in parts["a.npy"]
    with pytest.raises(Damaged):
        arrays_of({"a.npy": parts["a.npy"].replace(old, new)})


@pytest.mark.parametrize("text", ["", "{", "[" * 10**5, "[" * 200 + "]" * 200, b"\xff", "9" * 9999])
def test_what_is_no_json_is_one_line(text):
    with pytest.raises(Damaged) as caught:
        json_in(text)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) <= 200


def test_a_json_file_has_a_largest_size(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("[1, 2, 3]")
    assert json_of(tmp_path / "file") == [1, 2, 3]
    monkeypatch.setattr(archive, "LONGEST", 8)
    with pytest.raises(Damaged, match="more than 8 bytes"):
        json_of(tmp_path / "file")


def test_usual_json_is_read():
    assert json_in('{"a": [1, {"b": null}]}') == {"a": [1, {"b": None}]}
    assert json_in("[" * 100 + "]" * 100)
