"""Files are whole or absent; JSON and YAML are valid or refused."""

import pytest

from wbgs_jax._util import files
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, read_json, read_yaml, write_json


def test_atomic_write_replaces_the_file(tmp_path):
    path = tmp_path / "new" / "file.bin"
    for content in (b"first", b"second"):
        with atomic_write(path) as stream:
            stream.write(content)
        assert path.read_bytes() == content
    assert [p.name for p in path.parent.iterdir()] == ["file.bin"]


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "file.bin"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), atomic_write(path) as stream:
        stream.write(b"half")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["file.bin"]


def test_files_have_ordinary_permissions(tmp_path):
    with atomic_write(tmp_path / "ours"):
        pass
    (tmp_path / "plain").touch()
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_folder_that_cannot_be_made_is_a_user_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot write"), atomic_write(tmp_path / "file" / "inside"):
        pass


def test_json_round_trip(tmp_path):
    value = {"a": [1, 2.5, None], "b": "é"}
    write_json(tmp_path / "v.json", value)
    assert read_json(tmp_path / "v.json") == value


def test_nan_is_refused_and_leaves_no_file(tmp_path):
    with pytest.raises(ValueError):
        write_json(tmp_path / "v.json", {"ssim": float("nan")})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [None, b"", b'{"a": 1', b"\xff\xfe"])
def test_missing_or_broken_json_is_a_user_error(tmp_path, content):
    path = tmp_path / "v.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=r"v\.json"):
        read_json(path)


def test_numbers_in_yaml_are_decimal(tmp_path):
    (tmp_path / "a.yml").write_text("a: [7, -2, 0, 1.5e-3, .5, 010, 1:30, 0x10, 1_000, 1:30.5]\nb: yes\n")
    numbers, texts = [7, -2, 0, 1.5e-3, 0.5], ["010", "1:30", "0x10", "1_000", "1:30.5"]
    assert read_yaml(tmp_path / "a.yml") == {"a": numbers + texts, "b": True}


@pytest.mark.parametrize("text", ["ap: 1\nb: 2\nap: 3\n", "a:\n  ap: 1\n  'ap': 2\n", "- {ap: 1, ap: 1}\n"])
def test_a_key_given_twice_in_yaml_is_refused(tmp_path, text):
    (tmp_path / "a.yml").write_text(text)
    with pytest.raises(UserError, match=r"a\.yml is not valid YAML \(it has the key 'ap' more than once\); correct it"):
        read_yaml(tmp_path / "a.yml")


def test_what_a_killed_writer_left_is_removed_and_what_another_one_writes_is_not(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "STALE_S", 0.0)
    target = tmp_path / "a.json"
    (tmp_path / ".a.json.deadbeef").write_text("{")
    (tmp_path / ".b.json.deadbeef").write_text("{")
    with files.atomic_write(target) as first:
        first.write(b"1")
        files.write_json(target, 2)
        assert len(files.left_by_killed(target)) == 1
    assert {path.name for path in tmp_path.iterdir()} == {"a.json", ".b.json.deadbeef"} and target.read_text() == "1"


def test_what_cannot_be_written_is_told_before_the_work(tmp_path):
    files.check_writable(None, tmp_path / "new" / "a.json")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    for path, words in ((tmp_path / "file" / "a.json", "Not a directory"), (tmp_path, "it is a folder")):
        with pytest.raises(UserError, match=words):
            files.check_writable(path)
