from __future__ import annotations

import hashlib

import pytest

from anatomy.base.errors import FileError
from anatomy.base.files import atomic_write, read_json, read_toml, require_writable_folder, sha256


def test_hash_is_of_the_bytes(tmp_path):
    (tmp_path / "a").write_bytes(b"lung")
    assert sha256(tmp_path / "a") == hashlib.sha256(b"lung").hexdigest()
    with pytest.raises(FileError, match="missing"):
        sha256(tmp_path / "missing")


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "plan.json"
    path.write_text("old")
    with pytest.raises(KeyError), atomic_write(path) as temporary:
        temporary.write_text("half")
        raise KeyError
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["plan.json"]


def test_the_temporary_file_lies_beside_and_ends_alike(tmp_path):
    path = tmp_path / "a.nii.gz"
    with atomic_write(path) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.name.endswith(".nii.gz")
        assert temporary != path
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(FileError, match="cannot be written"):
        require_writable_folder(tmp_path / "file" / "out")
    nowhere = tmp_path / "missing" / "a.txt"
    with pytest.raises(FileError, match="cannot be written"), atomic_write(nowhere) as temporary:
        temporary.write_text("")


def test_a_folder_is_made_and_left_clean(tmp_path):
    folder = require_writable_folder(tmp_path / "a" / "b")
    assert folder.is_dir()
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_text_of_any_editor_is_read(tmp_path, encoding, end):
    mark = "\ufeff" if encoding == "utf-16-be" else ""
    (tmp_path / "a.toml").write_bytes((mark + end.join(["a = 'm\u00fc'", "b = 2", ""])).encode(encoding))
    assert read_toml(tmp_path / "a.toml", remedy="") == {"a": "m\u00fc", "b": 2}
    (tmp_path / "a.json").write_bytes((mark + end.join(['{"a":', "1}"])).encode(encoding))
    assert read_json(tmp_path / "a.json", expected="", remedy="") == {"a": 1}


def test_text_in_another_encoding_says_which_byte_is_none(tmp_path):
    (tmp_path / "a.toml").write_bytes("a = 'm\u00fc'".encode("cp1252"))
    with pytest.raises(FileError, match="byte 6 is 0xfc"):
        read_toml(tmp_path / "a.toml", remedy="")
